"""The calibration of the force's interval: recordings of several makes, scored, fitted, cross-validated.

`python -m weights intervals WORK --foreign FOLDER` renders recordings, scores each as it states much or
little and with one camera or two, and writes `bench/methods/force_interval.json`. Recordings and scores are
kept in WORK, so that a later run continues, also with further recordings.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from ruamel.yaml import YAML

from bench.methods import force_interval
from bench.methods.comparison import PHYSICS
from bench.methods.force_interval import CameraModel, IntervalTable, VideoEstimates, describe
from bench.methods.physics import Physics
from bench.recording import recording_writer
from bench.recording.from_sequence import export_recording
from bench.recording.recording_folder import open_recording
from bench.scoring.evaluate_recording import evaluate_recording
from learn.uncertainty.error_model import ErrorModel, fit_error_model
from synth.arrays import Floats
from synth.dataset.store import Dataset
from synth.dataset.store import Sequence as Stored
from synth.engine.run import render_job
from synth.errors import UserError
from synth.flow.estimator import name_motion
from synth.flow.recording.decode import RecordingFlowSettings
from synth.job import reader
from synth.job.schema import Job
from synth.system.checked_file import write_whole

Tree = dict[str, Any]
MAKES: Mapping[str, tuple[str, Tree]] = {
    "plain": ("mission", {"fem": {"membrane": {"probability": 0.0}}}),
    "membrane": ("mission", {"fem": {"membrane": {"probability": 1.0}}}),
    "pulse": (
        "mission",
        {
            "fem": {
                "membrane": {"probability": 0.5},
                "pulse": {"heart_mm": [0.1, 0.4], "breath_mm": [0.1, 0.5]},
            }
        },
    ),
    "unseen": (
        "mission",
        {
            "anatomy": {"dome_mm": 90, "gyrus_mm": [7, 10], "sulcus_mm": [0.8, 1.4]},
            "appearance": {"families": ["calf"]},
            "fem": {"membrane": {"probability": 0.5}},
        },
    ),
    "two instruments": ("mission", {"fem": {"instruments": [2, 2], "membrane": {"probability": 0.3}}}),
    "clinical": ("clinical", {}),
    "calf": ("ex-vivo-calf", {}),
}
"""Makes of our own: a named job, and what differs from it."""
_VIDEO: Tree = {
    "frames": 16,
    "fps": 5,
    "anatomy": {"vertices": 12000},
    "flow": {"backend": "ideal"},
    "render": {"size": [320, 240], "stereo_mm": 24},
}
_SEED = 7001
FOREIGN = "foreign"
_USED = "size", "spread", "overall spread", "motion"
"""Features of the error model: of nine sets tried on 26 recordings of eight makes, that with the least score
on makes left out, two cameras."""
_RIDGE = 0.3  # of the frames: recordings are few
_LEAST_ERROR = 0.02  # of the largest force: smaller errors are not told apart
_LEAST_FRAMES = 8
_SIDE = 0.95  # each end holds so many


@dataclass(frozen=True, eq=False)
class Example:
    """One recording as it was scored, with the truth in T frames."""

    make: str
    recording: str
    video: VideoEstimates
    true_mn: Floats  # (T,) size of the force; NaN: not scored

    @property
    def used(self) -> Any:
        """(T,) whether the truth is known."""
        return np.isfinite(self.true_mn)

    @property
    def error(self) -> Floats:
        """(n,) of the used frames: true less estimated size, over the largest estimate."""
        return np.asarray(((self.true_mn - self.video.size_mn) / max(self.video.largest_mn, 1e-9))[self.used])

    @property
    def features(self) -> Floats:
        """(n, F) of the used frames."""
        return np.asarray(describe(self.video)[self.used])


def intervals(
    work: Path,
    foreign: Annotated[Path | None, typer.Option(help="Folder of evidence.foreign's recordings.")] = None,
    count: int = 4,
    makes: str = ",".join(MAKES),
    only_fit: Annotated[bool, typer.Option("--only-fit", help="Use the scores that WORK has.")] = False,
    check: Annotated[bool, typer.Option("--check", help="Keep the table, for today's motion.")] = False,
) -> None:
    """Calibrates the interval of the force and writes its table into the package.

    With `check` the table is not fitted again but judged on these recordings, whose motion it then is for: a
    motion that errs less needs no new one.
    """
    if not only_fit:
        for folder, make, stated in _recordings(work, foreign, count, makes.split(",")):
            for is_full, cameras in product((True, False), (2, 1)):
                _score(work, folder, make, stated if is_full else None, cameras)
    examples = read_examples(work / "scores")
    table = check_table(force_interval.read_table(), examples) if check else fit_table(examples)
    text = json.dumps(asdict(table), indent=1, allow_nan=False)
    write_whole(force_interval.TABLE, text + "\n", durable=False)
    for name, row in (table.checked or table.reached).items():
        print(name, {key: round(value, 3) for key, value in row.items()})


def _merge(tree: Tree, other: Mapping[str, Any]) -> Tree:
    merged = dict(tree)
    for key, value in other.items():
        merged[key] = _merge(merged[key], value) if isinstance(merged.get(key), dict) else value
    return merged


def _recordings(
    work: Path, foreign: Path | None, count: int, makes: Sequence[str]
) -> Iterator[tuple[Path, str, Tree]]:
    """Folder, make, and what can be stated of each recording."""
    for number, make in enumerate(MAKES):
        if make not in makes:
            continue
        data, (job_name, change) = work / "data" / make, MAKES[make]
        tree = reader.load_job(job_name).model_dump(mode="json", exclude_unset=True)
        tree = _merge(_merge(_merge(tree, _VIDEO), change), {"sequences": count, "seed": _SEED + number})
        render_job(Job.model_validate(tree), data, workers=1)
        for sequence in Dataset(data):
            folder = work / "recordings" / make / f"{sequence.index:03d}"
            if not folder.exists():
                export_recording(sequence, folder)
            yield folder, make, _list_statements(sequence)
    for file in sorted([] if foreign is None else foreign.glob("**/truth.npz")):
        kind = file.parent.name.split("-")[0]
        membrane = "intact" if kind == "membrane" else "stripped"
        yield (
            file.parent,
            FOREIGN,
            {"membrane": membrane, "tissue": "brain" if kind == "pulse" else "ex-vivo"},
        )


def _list_statements(sequence: Stored) -> Tree:
    """Keys of meta.yaml for what an experimenter could state of a sequence."""
    covered = sequence.attrs["scenario"]["tissue"].get("membrane")
    size = np.linalg.norm(np.asarray(sequence["force"][:], np.float64), axis=1)
    rest_s = float(sequence["time"][max(int(np.flatnonzero(size > 0)[0]) - 1, 0)]) if size.any() else 0.0
    free_s = [[0.0, rest_s]] if rest_s > 0 else []
    sensor = {"axes": "camera", "acts_on": "tissue", "low_pass_hz": None, "free_s": free_s}
    return {"membrane": "intact" if covered else "stripped", "sensor": sensor}


def _score(work: Path, source: Path, make: str, stated: Tree | None, cameras: int) -> None:
    """Scores a copy of a recording that states this, None: scale and E alone; kept in WORK/scores."""
    label = "little" if stated is None else "much"
    file = work / "scores" / f"{make}-{source.name}-{label}-{cameras}.npz"
    if file.exists():
        return
    folder = work / "copy"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(source, folder)
    meta = YAML(typ="safe").load((folder / "meta.yaml").read_text("utf-8"))
    if stated is None:
        shutil.rmtree(folder / "masks", ignore_errors=True)
        (folder / "tissue.png").unlink(missing_ok=True)
        meta["sensor"].pop("free_s", None)
        meta["tissue"] = "brain"
    if cameras == 1:
        meta.pop("stereo", None)
        shutil.rmtree(folder / "right", ignore_errors=True)
        (folder / "right.mp4").unlink(missing_ok=True)
    recording_writer.write_meta(folder, meta | (stated or {}))
    recording = open_recording(folder)
    scale = recording.scale
    arrays: dict[str, Any] = {"make": make, "recording": source.name}
    try:
        settings = RecordingFlowSettings()
        result = evaluate_recording(recording, {PHYSICS: Physics()}, PHYSICS, scale, settings, {})
        video = result.tracked.evidence
        if video is not None and result.sensor_mn is not None and not result.refused:
            trusted = np.array(result.tracked.trusted)
            arrays |= vars(video)
            arrays["true_mn"] = np.where(result.scored, result.sensor_mn, np.nan)[trusted]
    except UserError as error:
        arrays["failed"] = str(error)
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(file, **arrays)
    print(file.stem, flush=True)


def read_examples(folder: Path) -> list[Example]:
    """The scores of a folder that have a force and a truth."""
    examples = []
    for file in sorted(folder.glob("*.npz")):
        with np.load(file) as stored:
            if "true_mn" not in stored:
                continue
            video = VideoEstimates(
                size_mn=stored["size_mn"],
                spread_mn=stored["spread_mn"],
                motion_mm=stored["motion_mm"],
                cameras=int(stored["cameras"]),
                stated=float(stored["stated"]),
            )
            example = Example(str(stored["make"]), str(stored["recording"]), video, stored["true_mn"])
            if example.used.sum() >= _LEAST_FRAMES:
                examples.append(example)
    return examples


def fit_table(examples: Sequence[Example]) -> IntervalTable:
    """The calibration on all examples, and what it reaches on each make without that make."""
    table = _fit(examples)
    crossed = {make: _fit([e for e in examples if e.make != make]) for make in table.makes}
    rows = {id(example): _judge(example, crossed[example.make]) for example in examples}
    return replace(table, stating=_find_gains(examples, rows), reached=_pool_groups(examples, rows))


def check_table(table: IntervalTable, examples: Sequence[Example]) -> IntervalTable:
    """A table for today's motion, with what it holds on examples of that, rendered and recovered anew."""
    rows = {id(example): _judge(example, table) for example in examples}
    return replace(table, flow=_name_motion(), checked=_pool_groups(examples, rows))


def _name_motion() -> str:
    """Name of the motion that recordings are tracked by."""
    return name_motion(RecordingFlowSettings().backend)


def _pool_groups(
    examples: Sequence[Example], rows: Mapping[int, Mapping[str, float]]
) -> dict[str, dict[str, float]]:
    """`_pool` by cameras and statements, by make, and of all examples."""
    groups: dict[str, list[Example]] = {}
    for cameras, is_stated in product((2, 1), (True, False)):
        name = f"{cameras} cameras, {'much' if is_stated else 'little'} stated"
        groups[name] = [e for e in examples if (e.video.cameras, e.video.stated > 0) == (cameras, is_stated)]
    for make in sorted({example.make for example in examples}):
        groups[make] = [example for example in examples if example.make == make]
    groups["all"] = [*examples]
    return {
        name: _pool(group, [rows[id(example)] for example in group])
        for name, group in groups.items()
        if group
    }


def _fit(examples: Sequence[Example]) -> IntervalTable:
    by_cameras = {}
    for cameras in (1, 2):
        subset = [example for example in examples if example.video.cameras == cameras]
        if subset:
            by_cameras[cameras] = _fit_model(subset)
    makes = sorted({example.make for example in examples})
    count = {make: len({example.recording for example in examples if example.make == make}) for make in makes}
    return IntervalTable(
        features=tuple(force_interval.NAMES),
        by_cameras=by_cameras,
        makes=count,
        flow=_name_motion(),
        stating={},
        reached={},
    )


def _fit_model(examples: Sequence[Example]) -> CameraModel:
    """Error model and quantiles: makes weigh equally, so do a make's recordings, and a recording's frames."""
    makes = sorted({example.make for example in examples})
    recordings = {make: {example.recording for example in examples if example.make == make} for make in makes}
    weight = []
    for example in examples:
        count_same = sum(e.make == example.make and e.recording == example.recording for e in examples)
        weight.append(1 / (len(makes) * len(recordings[example.make]) * count_same))
    parts = [np.full(len(e.error), w / len(e.error)) for e, w in zip(examples, weight, strict=True)]
    features, error = (np.concatenate([getattr(e, name) for e in examples]) for name in ("features", "error"))
    frames = np.concatenate(parts)
    columns = [k for k, name in enumerate(force_interval.NAMES) if name in _USED]
    model = fit_error_model(features[:, columns], np.abs(error), frames, _LEAST_ERROR, _RIDGE * len(error))
    slopes = np.zeros(features.shape[1])
    slopes[columns] = model.slopes
    lowest, highest = tuple(features.min(axis=0).tolist()), tuple(features.max(axis=0).tolist())
    model = ErrorModel(model.intercept, tuple(slopes.tolist()), lowest, highest, model.least)
    count = sum(map(len, recordings.values()))
    # Without conformal prediction's correction for a new recording: of twenty it takes the largest error.
    shares = error / model.predict(features)
    below, above = (
        max(float(np.quantile(sign * shares, _SIDE, weights=frames, method="inverted_cdf")), 1e-3)
        for sign in (-1, 1)
    )
    return CameraModel(model, below, above, count, len(examples))


def _judge(example: Example, table: IntervalTable) -> dict[str, float]:
    """Of one recording, over its largest true force: share that its interval holds, width, interval score
    (Gneiting and Raftery, JASA 102, 2007, eq. 43), error; and whether it has a number."""
    low, high = (end[example.used] for end in table.bound(example.video, 0.0))
    true, size = example.true_mn[example.used], example.video.size_mn[example.used]
    peak = float(true.max())
    return {
        "holds": float(((low <= true) & (true <= high)).mean()),
        "width": float((high - low).mean()) / peak,
        "score": float(_interval_score(low, high, true).mean()) / peak,
        "error": float(np.abs(size - true).mean()) / peak,
        "reached": float(not table.find_gaps(example.video)),
    }


def _interval_score(low: Floats, high: Floats, true: Floats) -> Floats:
    excess = np.maximum(low - true, 0) + np.maximum(true - high, 0)
    return np.asarray(high - low + 2 / (1 - force_interval.LEVEL) * excess)


def _pool(examples: Sequence[Example], rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Counts and means, and the interval score over that of the best constant width."""
    recordings = len({(e.make, e.recording) for e in examples})
    counts = {"recordings": recordings, "scores": len(examples)}
    counts["without a number"] = sum(not row["reached"] for row in rows)
    means = {key: float(np.mean([row[key] for row in rows])) for key in ("error", "holds", "width")}
    score = float(np.mean([row["score"] for row in rows]))
    best = min(_constant(examples, half) for half in np.linspace(0.01, 1.5, 150))
    return counts | means | {"score over a constant width's": score / best}


def _constant(examples: Sequence[Example], half: float) -> float:
    """Mean interval score with a half width of this share of the largest estimate everywhere."""
    scores = []
    for example in examples:
        size, true = example.video.size_mn[example.used], example.true_mn[example.used]
        half_mn = half * example.video.largest_mn
        score = _interval_score(np.maximum(size - half_mn, 0), size + half_mn, true)
        scores.append(score.mean() / true.max())
    return float(np.mean(scores))


def _find_gains(examples: Sequence[Example], rows: Mapping[int, Mapping[str, float]]) -> dict[str, float]:
    """Mean width with a second camera, and with all that can be stated, over that without it."""
    widths: dict[tuple[str, str, int, bool], float] = {}
    for example in examples:
        key = example.make, example.recording, example.video.cameras, example.video.stated > 0
        widths[key] = rows[id(example)]["width"]

    def ratio(with_it: Mapping[Any, float], without: Mapping[Any, float]) -> float:
        log_ratios = [np.log(width / without[key]) for key, width in with_it.items() if key in without]
        return float(np.exp(np.mean(log_ratios))) if log_ratios else 1.0

    cameras = [{(m, r, s): w for (m, r, c, s), w in widths.items() if c == n} for n in (2, 1)]
    stated = [
        {(m, r, c): w for (m, r, c, s), w in widths.items() if s is is_stated} for is_stated in (True, False)
    ]
    return {"second camera": ratio(*cameras), "statements": ratio(*stated)}
