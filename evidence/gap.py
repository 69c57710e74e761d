"""Share of the sim-to-real gap closed by training on recovered flow, and by training with fitted noise.

Four trainings on one split: ideal flow (I), recovered flow (R), ideal flow plus noise fitted to the recovered
flow's error (N), and a mixture. Each is tested on ideal and on recovered flow, in distribution and out of
distribution (').
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from evidence import cache, report, status, training
from evidence.intervals import difference
from evidence.study import Study
from learn.data.clips import Clip, load_clips
from learn.evaluation.evaluate import evaluate
from learn.evaluation.statistics import interval
from learn.settings import TrainingSettings, preset
from learn.settings import replace as changed
from learn.split import Split, groups
from synth.arrays import Floats, Map
from synth.errors import UserError

Errors = Mapping[str, list[float | None]]  # by test, of each sequence [mN]
Tests = Mapping[str, tuple[Sequence[Clip], str]]  # by name: tested clips, and name of their displacement
KINDS = ("I", "R", "N", "mixed")
_KEY = "force_mae"  # error of a sequence: of the total force [mN]
_RESAMPLES = 2000
_INPUTS = {"I": "ideal", "R": "recovered", "N": "recovered", "mixed": "mixed"}
_TESTS = {
    "I": "ideal flow",
    "R": "recovered flow",
    "I'": "ideal flow, out of distribution",
    "R'": "recovered flow, out of distribution",
}
_UNIT = "mean error of the total force [mN]"


def measure(
    dataset: Path,
    unseen: Path,
    work: Path = Path("runs/gap"),
    fit: int = 300,
    epochs: int = 24,
    seeds: int = 1,
) -> dict[str, Any]:
    """Share of the sim-to-real gap closed by training on recovered flow, and by fitted noise.

    `dataset`: of which `fit` sequences are used; `unseen`: out of distribution, only tested on; `work`:
    folder of intermediate results; `seeds`: networks a training.
    """
    tiny = preset("tiny", epochs=epochs)
    settings = changed(tiny, arch=changed(tiny.arch, output="magnitude"))  # the same metrics for all
    known, others = (
        load_clips(root, settings.grid, ("ideal", "recovered"), cache=work) for root in (dataset, unseen)
    )
    known = known[:fit]
    split, own_test = parts(known, others)
    clips = [*known, *others]
    ours, theirs = [clips[i] for i in own_test], [clips[i] for i in split.test]
    tests = {
        name: (theirs if "'" in name else ours, "ideal" if name[0] == "I" else "recovered") for name in _TESTS
    }
    seeded = [changed(settings, seed=seed) for seed in range(seeds)]
    trained = {kind: [errors(kind, clips, split, one, tests, work) for one in seeded] for kind in KINDS}
    noise = fit_noise([clips[i] for i in split.fit])
    sizes = (split.fit, split.select, own_test, split.test)
    return {
        "data": status.data(dataset, unseen),
        "settings": settings.model_dump(),
        "held_out": unseen.name,
        "sequences": dict(zip(("fit", "select", "test", "unseen"), map(len, sizes), strict=True)),
        "seeds": seeds,
        "flows": {"tvl1": {"noise": asdict(noise)} | summary(trained)},
    }


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
    kind: str, clips: Sequence[Clip], split: Split, settings: TrainingSettings, tests: Tests, work: Path
) -> Errors:
    """Errors in every test of a network trained as one of `KINDS` on fit and select of `split`, cached."""
    settings = changed(settings, input=_INPUTS[kind])
    name = f"{kind}-seed{settings.seed}"

    def compute() -> Errors:
        own = list(clips)
        if kind == "N":
            noise = fit_noise([clips[i] for i in split.fit])
            for k, clip in enumerate(clips):
                rng = np.random.default_rng([settings.seed, k])
                noisy = noise.add(np.asarray(clip.displacement["ideal"]), clip.mask, rng)
                own[k] = replace(clip, displacement=clip.displacement | {"recovered": noisy})
        predictor = training.fit(name, own, split, settings, work / "models")
        found = {test: evaluate(predictor, part, source).per_clip() for test, (part, source) in tests.items()}
        return {test: [row[_KEY] for row in rows] for test, rows in found.items()}

    used = [[clips[i].content_hash for i in part] for part in (split.fit, split.select)]
    tested = {test: [clip.content_hash for clip in part] for test, (part, _) in tests.items()}
    key = cache.key(name, settings.model_dump(), used, tested)
    done: Errors = cache.result(work / "runs", name, key, compute)
    return done


def summary(trained: Mapping[str, Sequence[Errors]]) -> dict[str, Any]:
    """Errors with intervals, and the share of the gap closed by each training."""
    of: dict[str, dict[str, Floats]] = {  # means over seeds
        kind: {test: np.mean([np.array(run[test], float) for run in runs], axis=0) for test in _TESTS}
        for kind, runs in trained.items()
    }
    spread = {
        kind: {test: asdict(interval(own, np.random.default_rng(0))) for test, own in tests.items()}
        for kind, tests in of.items()
    }
    ideal, gain = of["I"], {kind: of["I"]["R'"] - of[kind]["R'"] for kind in KINDS[1:]}
    share = {kind: closed(ideal["R'"] - ideal["I'"], own) for kind, own in gain.items()}
    less = difference(of["R"]["R'"], of["N"]["R'"])[1:]
    return {"errors": {_KEY: spread}, "closed": {_KEY: share}, "noise_less_real": {_KEY: less}}


def closed(gap: Floats, gain: Floats) -> dict[str, Any]:
    """Share of the gap closed by a training, out of distribution.

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
    bars = []
    for kind, test in (("I", "I'"), *((kind, "R'") for kind in KINDS)):
        value = one["errors"][_KEY][kind][test]
        name = f"{flow}: {kind} on {_TESTS[test].split(',')[0]}"
        bars.append(report.Row(name, value["mean"], (value["low"], value["high"])))
    rows = [
        {"trained on": kind}
        | {_TESTS[test]: report.mean_cell([*value.values()][:3]) for test, value in tests.items()}
        | {"share of the gap closed": _closed(one["closed"][_KEY].get(kind))}
        for kind, tests in one["errors"][_KEY].items()
    ]
    shares, (low, high) = one["closed"][_KEY], one["noise_less_real"][_KEY]
    return report.Page(
        "Sim-to-real gap: training on recovered flow",
        found,
        [report.Chart(f"Out of distribution ({found['held_out']})", _UNIT, tuple(bars))],
        [report.Section(f"{flow}: {_UNIT}", rows)],
        (
            f"**Flow by {flow}: training on recovered flow closes {_closed(shares['R'])} of the gap, with "
            f"fitted noise {_closed(shares['N'])}; the error with noise less that with recovered flow is "
            f"{low:.3g} to {high:.3g} mN.**",
            "Gap: error on recovered flow less error on ideal flow, out of distribution, after training on "
            "ideal flow. I: trained on ideal flow, R: on recovered, N: on ideal with noise fitted to the "
            "recovered flow's error, mixed: both, and errors of other frames (as stereo presets are). "
            f"Sequences: {', '.join(f'{n} {name}' for name, n in found['sequences'].items())}; "
            f"networks a training: {found['seeds']}; 95% BCa intervals.",
        ),
    )


def _closed(found: Mapping[str, Any] | None) -> str | None:
    """A cell; None for the training that the gap is defined by."""
    if found is None:
        return None
    return "undefined" if found["undefined"] else report.percent([found["share"], *found["interval"]])


STUDY = Study(measure, "gap/results.json", page, ("{mission} {mission-ood} --work {work}/gap",))
