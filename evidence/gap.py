"""Share of the sim-to-real gap closed by training on recovered flow, and by training with fitted noise.

Trainings on one split: ideal flow (I), recovered flow (R), ideal flow plus noise fitted to the error of the
recovered flow (N), and as a control recovered flow with another sequence's force (S). Each is tested on ideal
and on recovered flow: in distribution, out of distribution ('), and on recordings simulated and rendered by
other programs ('').
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from bench.recording.recording_folder import open_recording
from bench.recording.recording_scale import find_scale
from bench.tracking.tracking import track_recording
from evidence import report, result_cache, result_status, training
from evidence.bootstrap import difference
from evidence.foreign.recordings import TRUTH
from evidence.pooled import FOLDERS
from evidence.study import Study
from learn.data.clips import Clip, load_clips
from learn.data.grid import Grid, GridView
from learn.evaluation.evaluate import evaluate
from learn.evaluation.statistics import interval
from learn.settings import TrainingSettings, preset
from learn.settings import replace as changed
from learn.split import Split, groups
from synth.arrays import Floats, Map
from synth.errors import UserError
from synth.flow.recording.decode import RecordingFlowSettings
from synth.flow.recording.frame_motion import FrameMotion

Errors = Mapping[str, list[float | None]]  # by test, of each sequence [mN]
Tests = Mapping[str, tuple[Sequence[Clip], str]]  # by name: tested clips, and name of their displacement
KINDS = ("I", "R", "N", "S")
_KEY = "force_mae"  # error of a sequence: of the total force [mN]
_RESAMPLES = 2000
_INPUTS = {"I": "ideal", "R": "recovered", "N": "recovered", "S": "recovered"}
_TESTS = {
    "I": "ideal flow",
    "R": "recovered flow",
    "I'": "ideal flow, out of distribution",
    "R'": "recovered flow, out of distribution",
    "I''": "true flow of foreign recordings",
    "R''": "recovered flow of foreign recordings",
}
_PLACES = {"'": "out of distribution", "''": "foreign recordings"}
_UNIT = "mean error of the total force [mN]"


def measure(
    dataset: Path,
    unseen: Path,
    recordings: Path,
    work: Path = Path("runs/gap"),
    fit: int = 200,
    epochs: int = 24,
    seeds: int = 1,
    device: str = "cpu",
) -> dict[str, Any]:
    """Share of the sim-to-real gap closed by training on recovered flow, and by fitted noise.

    `dataset`: of which `fit` sequences are used; `unseen`: out of distribution, only tested on; `recordings`:
    folder of `foreign.recordings`, likewise; `work`: folder of intermediate results; `seeds`: networks a
    training; `device`: that trains. The gap opens with convergence: on a GPU use `--fit 560 --epochs 96`.
    """
    tiny = preset("tiny", epochs=epochs)
    settings = changed(tiny, arch=changed(tiny.arch, output="vector", relative=True))
    known, others = (
        load_clips(root, settings.grid, ("ideal", "recovered"), cache=work) for root in (dataset, unseen)
    )
    known = known[:fit]
    split, own_test = parts(known, others)
    clips = [*known, *others]
    folders = sorted(file.parent for file in (recordings / FOLDERS[1]).glob(f"*/{TRUTH}"))
    if not folders:
        raise UserError(f"{recordings}: no recording of foreign.recordings with its {TRUTH}")
    tested = (
        [clips[i] for i in own_test],
        [clips[i] for i in split.test],
        [foreign(one, settings.grid) for one in folders],
    )
    tests = {name: (tested[name.count("'")], "ideal" if name[0] == "I" else "recovered") for name in _TESTS}
    seeded = [changed(settings, seed=seed) for seed in range(seeds)]
    trained = {
        kind: [errors(kind, clips, split, one, tests, work, device) for one in seeded] for kind in KINDS
    }
    noise = fit_noise([clips[i] for i in split.fit])
    nothing = {
        test: [float(np.linalg.norm(clip.force, axis=1).mean()) for clip in part]
        for test, (part, _) in tests.items()
    }
    sizes = (split.fit, split.select, *tested)
    return {
        "data": result_status.data(dataset, unseen),
        "settings": settings.model_dump(),
        "held_out": unseen.name,
        "sequences": dict(zip(("fit", "select", "test", "unseen", "foreign"), map(len, sizes), strict=True)),
        "seeds": seeds,
        "flows": {"tvl1": {"noise": asdict(noise)} | summary(trained, nothing)},
    }


def foreign(folder: Path, grid: Grid) -> Clip:
    """A recording of `foreign.recordings` with its true flow, and that recovered by `bench score`."""
    recording = open_recording(folder)
    with np.load(folder / TRUTH) as stored:
        flow, force = stored["flow_px"], stored["force_mn"]
    young, scale = recording.meta.young_kpa or np.nan, find_scale(recording.meta, folder).mm_per_px
    found: dict[int, tuple[Map, Map]] = {}

    def add(frame: FrameMotion) -> None:
        found[frame.index] = frame.flow.copy(), frame.confidence.copy()

    tracked = track_recording(recording, {}, scale, RecordingFlowSettings(), each=add)
    view = GridView(np.asarray(tracked.tissue), scale, grid)
    at = sorted(found)
    flows = {"ideal": flow[at], "recovered": np.stack([found[k][0] for k in at])}
    density = np.zeros((len(at), 3, grid.size, grid.size), np.float32)
    density[:, :, grid.size // 2, grid.size // 2] = force[at] / (young * grid.pitch_mm**2)
    return Clip(
        name=folder.name,
        content_hash=result_status.content(folder / TRUTH),
        group=folder.name,
        young_kpa=young,
        mask=view.mask,
        displacement={k: view.mean(scale * v.transpose(0, 3, 1, 2)) * view.mask for k, v in flows.items()},
        confidence=view.mean(np.stack([found[k][1] for k in at])) * view.mask,
        density=density,  # of the sum alone, which is compared
        force=force[at],
    )


def parts(clips: Sequence[Clip], unseen: Sequence[Clip]) -> tuple[Split, tuple[int, ...]]:
    """Split with fit and select from `clips` and `unseen`, which follow them, as test; and a test of `clips`.

    Raises:
        UserError: an anatomy is in both datasets, or too few sequences are left.
    """
    aside = training.folds(clips, 5, 1)[0]
    rest = [i for i in range(len(clips)) if i not in set(aside)]
    inner = training.nested([clips[i] for i in rest], 5, 0, 0)
    fit, select = (tuple(rest[i] for i in part) for part in ((*inner.fit, *inner.test), inner.select))
    number = groups([*clips, *unseen])
    if set(number[: len(clips)]) & set(number[len(clips) :]):
        raise UserError("unseen: shares an anatomy with the other dataset")
    return Split(fit, select, tuple(range(len(clips), len(number)))), tuple(sorted(aside))


def errors(
    kind: str,
    clips: Sequence[Clip],
    split: Split,
    settings: TrainingSettings,
    tests: Tests,
    work: Path,
    device: str = "cpu",
) -> Errors:
    """Errors in every test of a network trained as one of `KINDS` on fit and select of `split`, cached."""
    settings = changed(settings, input=_INPUTS[kind])
    name = f"{kind}-seed{settings.seed}"

    def compute() -> Errors:
        own = list(clips)
        if kind == "S":
            half = len(clips) // 2
            others = [*clips[half:], *clips[:half]]
            own = [
                replace(clip, density=other.density, force=other.force)
                for clip, other in zip(clips, others, strict=True)
            ]
        if kind == "N":
            noise = fit_noise([clips[i] for i in split.fit])
            for k, clip in enumerate(clips):
                rng = np.random.default_rng([settings.seed, k])
                noisy = noise.add(np.asarray(clip.displacement["ideal"]), clip.mask, rng)
                own[k] = replace(clip, displacement=clip.displacement | {"recovered": noisy})
        predictor = training.fit(name, own, split, settings, work / "models", device)
        found = {test: evaluate(predictor, part, source).per_clip() for test, (part, source) in tests.items()}
        return {test: [row[_KEY] for row in rows] for test, rows in found.items()}

    used = [[clips[i].content_hash for i in part] for part in (split.fit, split.select)]
    tested = {test: [clip.content_hash for clip in part] for test, (part, _) in tests.items()}
    key = result_cache.key(name, settings.model_dump(), used, tested)
    done: Errors = result_cache.result(work / "runs", name, key, compute)
    return done


def summary(
    trained: Mapping[str, Sequence[Errors]], nothing: Mapping[str, Sequence[float]]
) -> dict[str, Any]:
    """Errors with intervals, also of no force (`nothing`), and the share of the gap that each one closes."""
    of: dict[str, dict[str, Floats]] = {  # means over seeds
        kind: {test: np.mean([np.array(run[test], float) for run in runs], axis=0) for test in _TESTS}
        for kind, runs in trained.items()
    }
    spread = {
        kind: {test: asdict(interval(own, np.random.default_rng(0))) for test, own in tests.items()}
        for kind, tests in (of | {"no force": {test: np.array(own) for test, own in nothing.items()}}).items()
    }
    found: dict[str, Any] = {"errors": {_KEY: spread}}
    for where, name in _PLACES.items():
        own = {kind: of[kind][f"R{where}"] for kind in KINDS}
        gap = own["I"] - of["I"][f"I{where}"]
        shares = {kind: closed(gap, own["I"] - own[kind]) for kind in KINDS[1:]}
        found[name] = {"closed": shares, "noise_less_real": difference(own["R"], own["N"])[1:]}
    return found


def closed(gap: Floats, gain: Floats) -> dict[str, Any]:
    """Share of the gap closed by a training.

    Args:
        gap: (S,) error of each sequence on recovered flow less that on ideal flow, after training on ideal
            flow.
        gain: (S,) error on recovered flow after training on ideal flow less that after the training in
            question.

    Returns:
        `share` and its 95% `interval` by resampling sequences in pairs, None where `undefined` states why.
    """
    picks = np.random.default_rng(0).integers(0, len(gap), (_RESAMPLES, len(gap)))
    below, above = gap[picks].mean(axis=1), gain[picks].mean(axis=1)
    low, high = np.quantile(below, [0.025, 0.975]).tolist()
    if low <= 0 <= high or gap.mean() <= 0:
        reason = f"the gap's interval {low:.3g} to {high:.3g} touches zero: there may be none to close"
        return {"share": None, "interval": None, "undefined": reason}
    ends = np.quantile(above / below, [0.025, 0.975]).tolist()
    return {"share": float(gain.mean() / gap.mean()), "interval": ends, "undefined": ""}


@dataclass(frozen=True)
class Noise:
    """The simplest model of the error of recovered displacement: a gain, and smooth Gaussian noise."""

    gain: float  # recovered over ideal displacement
    sigma_mm: float  # standard deviation of a component
    reach_cells: float
    """Standard deviation of the Gaussian filter that reproduces the error's spatial correlation."""

    def add(self, displacement: Map, mask: Map, rng: np.random.Generator) -> Map:
        """Displacement (T, 2, N, N) mm with noise in all frames except the first, the rest frame."""
        out = self.gain * displacement
        for t in range(1, len(out)):
            for axis in range(2):
                smooth = gaussian_filter(rng.normal(size=mask.shape), self.reach_cells)
                out[t, axis] += self.sigma_mm / max(float(smooth.std()), 1e-12) * smooth
        return np.asarray(out * mask, np.float32)


def fit_noise(clips: Sequence[Clip]) -> Noise:
    """Noise of recovered displacement: gain by least squares, then spread and reach of the residual."""
    ideal, recovered = (
        [np.asarray(clip.displacement[name]) for clip in clips] for name in ("ideal", "recovered")
    )
    masks = [clip.mask for clip in clips]
    top = sum(float((i * r).sum()) for i, r in zip(ideal, recovered, strict=True))
    gain = top / max(sum(float((i * i).sum()) for i in ideal), 1e-12)
    square = neighbours = 0.0
    count = pairs = 0
    for i, r, mask in zip(ideal, recovered, masks, strict=True):
        inside = mask > 0
        error = ((r - gain * i) * mask)[1:]
        square += float(np.square(error).sum())
        count += 2 * len(error) * int(inside.sum())
        both = inside[:, 1:] & inside[:, :-1]
        neighbours += float((error[..., 1:] * error[..., :-1])[..., both].sum())
        pairs += 2 * len(error) * int(both.sum())
    variance = square / max(count, 1)
    rho = float(np.clip(neighbours / max(pairs, 1) / max(variance, 1e-12), 0.01, 0.999))
    # White noise blurred by a Gaussian of s cells has correlation exp(-1 / (4 s²)) between neighbours.
    return Noise(float(gain), float(np.sqrt(variance)), float(np.sqrt(-1 / (4 * np.log(rho)))))


def page(found: Mapping[str, Any]) -> report.Page:
    """Errors of the trainings on the flow of recordings, and the tables."""
    ((flow, one),) = found["flows"].items()
    charts: list[tuple[str, str, dict[str, Any]]] = []
    words = []
    for where, name in _PLACES.items():
        bars = {}
        for kind, test in (("I", f"I{where}"), *((kind, f"R{where}") for kind in KINDS)):
            value = one["errors"][_KEY][kind][test]
            bars[f"{kind} on {test}"] = value["mean"], value["low"], value["high"]
        charts.append((name, _UNIT, bars))
        shares, (low, high) = (one[name][key] for key in ("closed", "noise_less_real"))
        words.append(
            f"{name}: training on recovered flow closes {_closed(shares['R'])} of the gap, with fitted noise "
            f"{_closed(shares['N'])}; the error with noise less that with recovered flow is {low:.3g} to "
            f"{high:.3g} mN"
        )
    rows = [
        {"trained on": kind}
        | {_TESTS[test]: report.mean_cell([*value.values()][:3]) for test, value in tests.items()}
        | {f"closed, {name}": _closed(one[name]["closed"].get(kind)) for name in _PLACES.values()}
        for kind, tests in one["errors"][_KEY].items()
    ]
    return report.Page(
        "Sim-to-real gap: training on recovered flow",
        found,
        (
            f"**Flow by {flow}; {'. '.join(words)}.**",
            "Gap: error on recovered flow less error on ideal flow, after training on ideal flow. I: trained "
            "on ideal flow, R: on recovered, N: on ideal with noise fitted to the recovered flow's error, S: "
            "(a control) on recovered flow with the forces of other sequences; ': "
            f"out of distribution ({found['held_out']}), '': recordings by felupe and Blender's Cycles, "
            "whose ideal flow is that of the contacts alone. "
            f"Sequences: {', '.join(f'{n} {name}' for name, n in found['sequences'].items())}; "
            f"networks a training: {found['seeds']}; 95% BCa intervals. "
            "[The same question by four commands](../../howto/gap.md).",
        ),
        [report.Section(f"{flow}: {_UNIT}", rows)],
        report.interval_charts(*charts),
    )


def _closed(found: Mapping[str, Any] | None) -> str | None:
    """A cell; None for the training that the gap is defined by."""
    if found is None:
        return None
    return "undefined" if found["undefined"] else report.percent([found["share"], *found["interval"]])


STUDY = Study(
    measure,
    "gap/results.json",
    page,
    ("{mission} {mission-ood} {work}/foreign --work {work}/gap",),
    needs=("mesh", "mechanics", "picture", "truth", "flow", "stereo", "network", "score-stereo"),
)
