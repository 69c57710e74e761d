"""Share of the sim-to-real gap closed by training on recovered flow, and by training with fitted noise.

Trainings on one split: ideal flow (I), recovered flow (R), ideal flow plus noise fitted to the error of the
recovered flow (N), and as a control recovered flow with another sequence's force (S). Each is tested on ideal
and on recovered flow of held-out sequences, of an unseen appearance and anatomy, of clinical loads, and of
recordings simulated and rendered by other programs. Twice: by ridge regression, in closed form, and by
networks, whose training may not have converged.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import gaussian_filter

from bench.recording.recording_folder import open_recording
from bench.tracking.estimate import apply_physics
from bench.tracking.tracking import track_recording
from evidence import report, result_cache, result_status, training
from evidence.curves.models import fit_ridge_on_components
from evidence.foreign.recordings import TRUTH
from evidence.paired_means import difference, mean_of
from evidence.pooled import FOLDERS
from evidence.study import STEREO_MOTION, Study
from learn.data.clips import Clip, load_clips
from learn.data.grid import Grid, GridView
from learn.evaluation.evaluate import evaluate
from learn.inference.predict import Predictor, force_size
from learn.inference.video_motion import motions, read_single
from learn.settings import TrainingSettings, preset
from learn.settings import replace as changed
from learn.split import Split, groups
from synth.arrays import Floats, Map
from synth.dataset.store import Dataset
from synth.errors import UserError
from synth.flow.recording.decode import RecordingFlowSettings
from synth.flow.recording.frame_motion import FrameMotion

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Errors = dict[str, list[float]]  # by test, of each sequence [mN]
Tests = Mapping[str, tuple[Sequence[Clip], str]]  # by name: tested clips, and name of their displacement
KINDS = ("I", "R", "N", "S")
FLOWS = ("ideal", "recovered")
PLACES = {
    "own": "held-out sequences",
    "unseen": "unseen appearance and anatomy",
    "clinical": "clinical loads",
    "foreign": "recordings by other programs",
}
"""What is tested on; each on ideal and on recovered flow."""
NONE = "no force"  # the trivial baseline
PHYSICS = "physics"  # not trained
_KEY = "force_mae"  # error of a sequence: of the total force [mN]
_RESAMPLES = 2000
_INPUTS = {"I": "ideal", "R": "recovered", "N": "recovered", "S": "recovered"}
_SHOWN = (2, 4, 8, 16, 32, 48, 64, 96, 128, 192, 256)  # epochs of the curve


def measure(
    dataset: Path,
    unseen: Path,
    clinical: Path,
    recordings: Path | None = None,
    work: Path = Path("runs/gap"),
    fit: int = 375,
    epochs: int = 64,
    seeds: int = 1,
    kinds: str = ",".join(KINDS),
    device: str = "cpu",
) -> dict[str, Any]:
    """Share of the sim-to-real gap closed by training on recovered flow, and by fitted noise.

    `dataset`: of which `fit` sequences are used, a fifth of them held out; `unseen`, `clinical`: only tested
    on; `recordings`: folder of `foreign.recordings`, likewise, if given; `work`: folder of intermediate
    results, from which an interrupted run continues; `seeds`: networks a training; `kinds`: of `KINDS`, I and
    R among them; `device`: that trains.
    """
    tiny = preset("tiny", epochs=epochs)
    # A stem of 4 errs as much as one of 2 in two thirds of the time.
    arch = changed(tiny.arch, output="vector", relative=True, stem=4)
    # By frame, as forces span three decades.
    settings = changed(tiny, arch=arch, loss="mse-frame")
    own_clips, unseen_clips, clinical_clips = (
        load_clips(root, settings.grid, FLOWS, cache=work) for root in (dataset, unseen, clinical)
    )
    own_clips = own_clips[:fit]
    split, held_out = parts(own_clips, [*unseen_clips, *clinical_clips])
    clips = [*own_clips, *unseen_clips, *clinical_clips]
    test_clips: dict[str, Sequence[Clip]] = {
        "own": [clips[i] for i in held_out],
        "unseen": unseen_clips,
        "clinical": clinical_clips,
    }
    if recordings is not None:
        test_clips["foreign"] = read_foreign(recordings, settings.grid)
    tests = {f"{place}, {flow}": (part, flow) for place, part in test_clips.items() for flow in FLOWS}
    chosen_kinds = kinds.split(",")
    if not {"I", "R"} <= {*chosen_kinds} <= {*KINDS}:
        raise UserError(f"kinds {kinds!r}: I and R, and any of {', '.join(KINDS[2:])}")
    force = {place: [_mean_force(clip) for clip in part] for place, part in test_clips.items()}
    trainings: dict[str, list[Errors]] = {kind: [] for kind in chosen_kinds}
    curve: dict[str, list[list[float]]] = {}
    for seed, kind in product(range(seeds), chosen_kinds):
        seeded = changed(settings, seed=seed, input=_INPUTS[kind])
        result = errors(kind, clips, split, seeded, tests, work, device)
        trainings[kind].append(result["errors"])
        curve.setdefault(kind, result["curve"])
    parts_used = {"fit": [clips[i] for i in split.fit]} | test_clips
    key = result_cache.key({name: list_hashes(part) for name, part in parts_used.items()})
    roots = {"own": dataset, "unseen": unseen, "clinical": clinical}
    ridge = result_cache.result(
        work / "runs", "ridge", key, lambda: ridge_by_size(clips, split.fit, tests, force)
    )
    physics = result_cache.result(work / "runs", "physics", key, lambda: physics_errors(roots, test_clips))
    noise = fit_noise([clips[i] for i in split.fit])
    sizes = {"fit": len(split.fit), "select": len(split.select)}
    return {
        "data": result_status.data(dataset, unseen, clinical),
        "settings": settings.model_dump(),
        "sequences": sizes | {place: len(part) for place, part in test_clips.items()},
        "seeds": seeds,
        "noise": asdict(noise),
        "curve": {kind: curve[kind] for kind in ("I", "R")},
        "ridge": ridge,
    } | summary(trainings, force, physics)


def list_hashes(clips: Sequence[Clip]) -> list[str]:
    """Hashes of the contents of clips."""
    return [clip.content_hash for clip in clips]


def physics_errors(roots: Mapping[str, Path], test_clips: Mapping[str, Sequence[Clip]]) -> Errors:
    """Errors of physics with E stated, and that nothing pulsates nor relaxes, as of `ridge_errors`.

    `roots`: dataset of a place; `test_clips`: of each place the sequences to estimate.
    """
    by_test: Errors = {}
    for place, root in roots.items():
        indices = {clip.content_hash: k for k, clip in enumerate(test_clips[place])}
        by_flow = {flow: [np.nan] * len(indices) for flow in FLOWS}
        for sequence in Dataset(root):
            if (k := indices.get(sequence.attrs["content_hash"])) is None:
                continue
            for flow, errors_mn in by_flow.items():
                motion = read_single(sequence.path, motions(sequence.path, flow))
                # A frame that is held back counts as an answer of no force.
                size = np.nan_to_num(apply_physics(motion, living=False, relaxation=())["total_force_mn"])
                errors_mn[k] = float(np.abs(size - force_size(test_clips[place][k].force)).mean())
        by_test |= {f"{place}, {flow}": errors_mn for flow, errors_mn in by_flow.items()}
    return by_test


def read_foreign(recordings: Path, grid: Grid) -> list[Clip]:
    """All recordings in a folder of `foreign.recordings`. UserError: there are none."""
    folders = sorted(file.parent for file in (recordings / FOLDERS[1]).glob(f"*/{TRUTH}"))
    if not folders:
        raise UserError(f"{recordings}: no recording of foreign.recordings with its {TRUTH}")
    return [read_foreign_clip(folder, grid) for folder in folders]


def read_foreign_clip(folder: Path, grid: Grid) -> Clip:
    """A recording of `foreign.recordings` with its true flow, and that recovered by `bench score`."""
    recording = open_recording(folder)
    with np.load(folder / TRUTH) as stored:
        true_flow, force = stored["flow_px"], stored["force_mn"]
    young, scale = recording.meta.young_kpa or np.nan, recording.scale.mm_per_px
    tracked_frames: dict[int, tuple[Map, Map]] = {}

    def add(frame: FrameMotion) -> None:
        tracked_frames[frame.index] = frame.flow.copy(), frame.confidence.copy()

    tracking = track_recording(recording, {}, scale, RecordingFlowSettings(), on_frame=add)
    view = GridView(np.asarray(tracking.tissue), scale, grid)
    numbers = sorted(tracked_frames)
    flows = {"ideal": true_flow[numbers], "recovered": np.stack([tracked_frames[k][0] for k in numbers])}
    density = np.zeros((len(numbers), 3, grid.size, grid.size), np.float32)
    density[:, :, grid.size // 2, grid.size // 2] = force[numbers] / (young * grid.pitch_mm**2)
    return Clip(
        name=folder.name,
        content_hash=result_status.content(folder / TRUTH),
        group=folder.name,
        young_kpa=young,
        mask=view.mask,
        displacement={k: view.mean(scale * v.transpose(0, 3, 1, 2)) * view.mask for k, v in flows.items()},
        confidence=view.mean(np.stack([tracked_frames[k][1] for k in numbers])) * view.mask,
        density=density,  # of the sum alone, which is compared
        force=force[numbers],
    )


def parts(clips: Sequence[Clip], unseen: Sequence[Clip]) -> tuple[Split, tuple[int, ...]]:
    """Split with fit and select from `clips` and `unseen`, which follow them, as test; and a test of `clips`.

    Raises:
        UserError: an anatomy is in both datasets, or too few sequences are left.
    """
    held_out = training.folds(clips, 5, 1)[0]
    rest = [i for i in range(len(clips)) if i not in set(held_out)]
    inner = training.split_nested([clips[i] for i in rest], 5, 0, 0)
    fit, select = (tuple(rest[i] for i in part) for part in ((*inner.fit, *inner.test), inner.select))
    labels = groups([*clips, *unseen])
    if set(labels[: len(clips)]) & set(labels[len(clips) :]):
        raise UserError("unseen: shares an anatomy with the other dataset")
    return Split(fit, select, tuple(range(len(clips), len(labels)))), tuple(sorted(held_out))


def ridge_by_size(
    clips: Sequence[Clip], fit: Sequence[int], tests: Tests, force: Mapping[str, Sequence[float]]
) -> list[dict[str, Any]]:
    """`summary` of ridge regression on a quarter, a half and all of the clips at `fit`, with their number."""
    rows = []
    for size in (len(fit) // 4, len(fit) // 2, len(fit)):
        by_kind = {kind: [ridge_errors(kind, clips, fit[:size], tests)] for kind in KINDS}
        rows.append({"fit": size} | summary(by_kind, force))
    return rows


def prepare_clips(kind: str, clips: Sequence[Clip], fit: Sequence[int], seed: int) -> list[Clip]:
    """The clips as a training of `KINDS` gets them: S with other forces, N with noise for recovered flow,
    fitted to those at `fit`."""
    prepared = list(clips)
    if kind == "S":
        half = len(clips) // 2
        others = [*clips[half:], *clips[:half]]
        prepared = [
            replace(clip, density=other.density, force=other.force)
            for clip, other in zip(clips, others, strict=True)
        ]
    if kind == "N":
        noise = fit_noise([clips[i] for i in fit])
        for k, clip in enumerate(clips):
            rng = np.random.default_rng([seed, k])
            noisy = noise.add(np.asarray(clip.displacement["ideal"]), clip.mask, rng)
            prepared[k] = replace(clip, displacement=clip.displacement | {"recovered": noisy})
    return prepared


def ridge_errors(kind: str, clips: Sequence[Clip], fit: Sequence[int], tests: Tests) -> Errors:
    """Errors of ridge regression on the clips at `fit` as one of `KINDS`: of every test, those of its
    sequences [mN]."""
    prepared = prepare_clips(kind, clips, fit, 0)
    estimate = fit_ridge_on_components([prepared[i] for i in fit], _INPUTS[kind])
    return {
        test: [
            float(np.abs(force_size(estimate(clip, source)) - force_size(clip.force)).mean()) for clip in part
        ]
        for test, (part, source) in tests.items()
    }


def errors(
    kind: str,
    clips: Sequence[Clip],
    split: Split,
    settings: TrainingSettings,
    tests: Tests,
    work: Path,
    device: str = "cpu",
) -> dict[str, Any]:
    """Errors of a network trained as one of `KINDS` on fit and select of `split`, cached.

    Returns:
        `errors`: of every test, those of its sequences [mN]; `curve`: rows of an epoch, and the mean errors
        on ideal and on recovered flow of the held-out sequences as shares of their mean forces.
    """
    name = f"{kind}-seed{settings.seed}"

    def score(predictor: Predictor, test: str) -> list[float]:
        part, source = tests[test]
        return [row[_KEY] for row in evaluate(predictor, part, source).per_clip()]

    def compute() -> dict[str, Any]:
        prepared = prepare_clips(kind, clips, split.fit, settings.seed)
        trained_split = replace(split, test=())  # so that other tests need no other training
        final, earlier = training.fit_with_epochs(
            name, prepared, trained_split, settings, work / "models", _SHOWN, device
        )
        curve = []
        for epoch, predictor in earlier.items():
            means = []
            for flow in FLOWS:
                part, _ = tests[f"own, {flow}"]
                errors_mn = score(predictor, f"own, {flow}")
                means.append(float(np.mean(np.array(errors_mn) / [_mean_force(clip) for clip in part])))
            curve.append([epoch, *means])
        return {"errors": {test: score(final, test) for test in tests}, "curve": curve}

    split_hashes = [list_hashes([clips[i] for i in part]) for part in (split.fit, split.select)]
    test_hashes = {test: list_hashes(part) for test, (part, _) in tests.items()}
    key = result_cache.key(name, settings.model_dump(), split_hashes, test_hashes)
    result: dict[str, Any] = result_cache.result(work / "runs", name, key, compute)
    return result


def _mean_force(clip: Clip) -> float:
    """Mean size of the total force [mN]: also the error of estimating none."""
    return float(np.linalg.norm(clip.force, axis=1).mean())


def summary(
    trainings: Mapping[str, Sequence[Errors]],
    force: Mapping[str, Sequence[float]],
    physics: Errors | None = None,
) -> dict[str, Any]:
    """Errors with intervals, also of no force, the factor by which the gap opens, and the shares closed.

    `force`: of each place, the mean forces of its sequences [mN]; `physics`: errors of physics, if known.
    """
    absolute = {  # means over seeds
        kind: {test: np.mean([run[test] for run in runs], axis=0) for test in runs[0]}
        for kind, runs in trainings.items()
    }
    if physics is not None:
        absolute[PHYSICS] = {test: np.array(values) for test, values in physics.items()}
    absolute[NONE] = {test: np.array(force[test.split(",")[0]]) for test in absolute["I"]}
    share = {
        kind: {test: values / np.array(force[test.split(",")[0]]) for test, values in tests.items()}
        for kind, tests in absolute.items()
    }
    places = {}
    for place in force:
        ideal = share["I"][f"{place}, ideal"]
        recovered = {kind: share[kind][f"{place}, recovered"] for kind in trainings}
        gap = recovered["I"] - ideal
        places[place] = {
            "opened": float(recovered["I"].mean() / ideal.mean()),
            "closed": {
                kind: compute_share(gap, recovered["I"] - recovered[kind])
                for kind in trainings
                if kind != "I"
            },
        }
        if "N" in trainings:
            places[place]["noise_less_real"] = difference(recovered["R"], recovered["N"])
    spread, spread_mn = (
        {kind: {test: mean_of(values) for test, values in tests.items()} for kind, tests in part.items()}
        for part in (share, absolute)
    )
    return {"errors": spread, "errors_mn": spread_mn, "places": places}


def compute_share(gap: Floats, gain: Floats) -> dict[str, Any]:
    """Share of the gap closed by a training.

    Args:
        gap: (S,) error of each sequence on recovered flow less that on ideal flow, after training on ideal
            flow.
        gain: (S,) error on recovered flow after training on ideal flow less that after the training in
            question.

    Returns:
        `share` and its 95% `interval` by resampling sequences in pairs, None where `undefined` states why.
    """
    resamples = np.random.default_rng(0).integers(0, len(gap), (_RESAMPLES, len(gap)))
    gaps, gains = gap[resamples].mean(axis=1), gain[resamples].mean(axis=1)
    low, high = np.quantile(gaps, [0.025, 0.975]).tolist()
    if low <= 0 <= high or gap.mean() <= 0:
        reason = f"the gap's interval {low:.3g} to {high:.3g} touches zero: there may be none to close"
        return {"share": None, "interval": None, "undefined": reason}
    ends = np.quantile(gains / gaps, [0.025, 0.975]).tolist()
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
        pair_mask = inside[:, 1:] & inside[:, :-1]
        neighbours += float((error[..., 1:] * error[..., :-1])[..., pair_mask].sum())
        pairs += 2 * len(error) * int(pair_mask.sum())
    variance = square / max(count, 1)
    rho = float(np.clip(neighbours / max(pairs, 1) / max(variance, 1e-12), 0.01, 0.999))
    # White noise blurred by a Gaussian of s cells has correlation exp(-1 / (4 s²)) between neighbours.
    return Noise(float(gain), float(np.sqrt(variance)), float(np.sqrt(-1 / (4 * np.log(rho)))))


def page(data: Mapping[str, Any]) -> report.Page:
    """The answers, the curve of the networks' trainings, and the tables of both estimators."""
    kinds = [kind for kind in KINDS if kind in data["errors"]]
    ridge = data["ridge"][-1]
    count = ", ".join(f"{number} {name}" for name, number in data["sequences"].items())
    return report.Page(
        "Sim-to-real gap: training on recovered flow",
        data,
        (
            "Gap: error on recovered flow less error on ideal flow, after training on ideal flow. I: trained "
            "on ideal flow, R: on recovered, N: on ideal with noise fitted to the recovered flow's error, S: "
            "(control) on recovered flow with the forces of other sequences, so that it learns to estimate "
            "none: what it closes is closed without any knowledge of the force. Physics is not trained; E "
            "is stated to it, and that nothing pulsates. The ideal flow of recordings "
            "by other programs is that of the contacts alone. Errors are of the total force, as "
            "shares of a sequence's mean force, so that each sequence counts alike whatever its load. "
            f"Sequences: {count}; networks a training: {data['seeds']}; 95% BCa intervals. Where an error "
            "exceeds 100%, assuming no force is better. "
            "[The same question by four commands](../../howto/gap.md).",
        ),
        [
            report.Section("Ridge regression", words=_answer(ridge, KINDS)),
            *_tables(ridge, KINDS),
            report.Section("Share closed by ridge regression, against fitted sequences", _sizes(data)),
            report.Section(f"D2FNet, after {data['settings']['epochs']} epochs", words=_answer(data, kinds)),
            *_tables(data, kinds),
        ],
        report.chart(partial(_draw_curve, curve=data["curve"]), width=720),
    )


def _places(data: Mapping[str, Any]) -> dict[str, str]:
    """Names of the places that were tested."""
    return {place: name for place, name in PLACES.items() if place in data["places"]}


def _tables(data: Mapping[str, Any], kinds: Sequence[str]) -> list[report.Section]:
    """Shares closed and errors of one estimator."""
    shares = [
        {"training": kind}
        | {
            name: _format_share(data["places"][place]["closed"][kind])
            for place, name in _places(data).items()
        }
        for kind in kinds[1:]
    ]
    tables = [report.Section("", shares, ("Share of the gap closed:",))]
    for words, by_kind, factor in (
        ("Errors as shares of the mean force, in percent:", data["errors"], 100.0),
        ("Errors [mN]:", data["errors_mn"], 1.0),
    ):
        rows = [
            {"trained on": kind, "tested on": flow}
            | {name: _cell(tests, f"{place}, {flow}", factor) for place, name in _places(data).items()}
            for kind, tests in by_kind.items()
            for flow in (FLOWS if kind != NONE else FLOWS[:1])
        ]
        tables.append(report.Section("", rows, (words,)))
    return tables


def _cell(tests: Mapping[str, Sequence[float]], test: str, factor: float) -> str | None:
    return report.mean_cell(tests[test], factor=factor) if test in tests else None


def _sizes(data: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Shares closed by ridge regression on recovered flow, for each number of fitted sequences."""
    return [
        {"fitted": row["fit"]}
        | {name: _format_share(row["places"][place]["closed"]["R"]) for place, name in _places(row).items()}
        for row in data["ridge"]
    ]


def _answer(data: Mapping[str, Any], kinds: Sequence[str]) -> list[str]:
    """Of each place, by how much the gap opens, and what closes it."""
    words = []
    for place, name in _places(data).items():
        at_place = data["places"][place]
        factor, closes = at_place["opened"], at_place["closed"]
        words.append(
            f"- *{name.capitalize()}*: trained on ideal flow, it errs {factor:.2g} times as much on "
            "recovered flow as on ideal flow"
        )
        if closes["R"]["undefined"]:
            words[-1] += "; there is no gap to close."
            continue
        words[-1] += f"; training on recovered flow closes {_format_share(closes['R'])} of that gap."
        if "N" in kinds:
            low, high = (100 * end for end in at_place["noise_less_real"][1:])
            words[-1] += (
                f" Fitted noise closes {_format_share(closes['N'])}: after it the error is {low:.2g} to "
                f"{high:.2g} percentage points above that after recovered flow."
            )
        if "S" in kinds:
            words[-1] += f" The control, which learns to answer zero, closes {_format_share(closes['S'])}"
            is_worse = closes["S"]["share"] is not None and closes["S"]["share"] < 0
            words[-1] += ": answering zero errs more than the gap is wide." if is_worse else "."
        if data["errors"]["R"][f"{place}, recovered"][2] >= 1:
            words[-1] += " There its error is not below that of no force: nothing follows from these shares."
    return words


def _draw_curve(axes: Axes, curve: Mapping[str, Sequence[Sequence[float]]]) -> None:
    """Errors on the held-out sequences against epochs, of networks trained on ideal and recovered flow."""
    for color, (kind, rows) in zip(("C1", "C0"), curve.items(), strict=True):
        epochs, *by_flow = np.transpose(rows)
        for flow, values, line in zip(FLOWS, by_flow, ("--", "-"), strict=True):
            axes.plot(
                epochs,
                values,
                line,
                color=color,
                marker="o",
                label=f"trained on {_INPUTS[kind]}, on {flow} flow",
            )
    report.set_log(axes)
    axes.set(title="D2FNet: error on held-out sequences over their mean force", xlabel="epochs of training")
    axes.axhline(1, color="#9aa3ad", linewidth=1, label="no force")
    report.legend(axes)


def _format_share(share: Mapping[str, Any]) -> str:
    return "undefined" if share["undefined"] else report.percent([share["share"], *share["interval"]]) or ""


STUDY = Study(
    measure,
    "gap/results.json",
    page,
    ("{mission} {mission-ood} {gap-clinical} --recordings {work}/foreign --work {work}/gap-study",),
    needs=(*STEREO_MOTION, "lost-flow", "network", "score-stereo", "wide-tissue"),
)
