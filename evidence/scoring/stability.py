"""Recordings degraded in one way at a time, scored by the default command: is the cause named?

Each change is applied to a described recording with two cameras (tissue, instruments and contact-free span
stated) and to a bare one with one camera (scale and E only); plain, covered and pulsating tissue take turns.
A fault is *missed* if no finding names its cause, the force is stated, and it errs by a tenth of the peak
more than that of the undegraded recording, unless its interval holds the true force and is narrower than the
peak: then, or with the usual error, it is *harmless*. It is missed too if a finding names another cause. An
interval that is wider than the peak holds any force, and clears nothing: nobody can act on it. Undegraded
recordings show what each further statement gains.
"""

import re
import shutil
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from bench.recording import recording_writer
from bench.recording.from_sequence import export_recording
from bench.scoring.score import score
from evidence import report, result_cache
from evidence.scoring.degradations import FPS, FRAMES, MONOCULAR, STEREO, Change, read_meta, read_table
from evidence.study import Study
from synth.dataset.store import Dataset
from synth.engine.run import render_job
from synth.errors import UserError
from synth.job import reader
from synth.job.schema import FemSection

_TISSUE: dict[str, dict[str, Any]] = {
    "plain": {},
    "membrane": {"membrane": {"probability": 1.0}},
    "pulse": {"pulse": {"heart_mm": (0.1, 0.3), "breath_mm": (0.1, 0.3)}},
}
_USUAL = {"skull": ("bonded",), "membrane": {"probability": 0.0}, "instruments": (1, 1)}
_SHOWN = {"contact": ("driven",), "gestures": ("pull",), "travel_mm": (1.0, 3.0), "travel_scale": "even"}
_GIVEN = "scale and E", "tissue, instruments", "a span without contact", "the membrane's state"
_CASES = (2, 2), (0, 1)  # of degraded recordings: how much is stated, of `_GIVEN`; cameras
_CLEAN = 2  # undegraded recordings of each kind
_SENSOR_HZ, _SENSOR_NOISE = 100.0, 0.005
_WRONG = 0.1  # of the peak
_VAGUE = 1.0  # width of the interval over the peak, from which it says nothing
_NO_CAUSES = {"tracking", "network and physics", "physics", "interval"}  # findings that name no fault
_HOLDS = 0.8  # least share of the frames in which a right interval of 90% holds the true force


def measure(work: Path, seed: int = 35, only: str = "", kinds: str = ",".join(_TISSUE)) -> dict[str, Any]:
    """Scores rendered recordings after each change; `only`: a pattern of the changes' names."""
    points, clean = list[dict[str, Any]](), list[dict[str, Any]]()
    for kind, cameras, level in product(kinds.split(","), (2, 1), range(len(_GIVEN))):
        case = {"kind": kind, "cameras": cameras, "given": level}
        folders = _render(work, kind, seed)
        undegraded = [_score(folder, None, case, work, seed, "") for folder in folders]
        clean.append(case | _means(undegraded))
        for number, (name, (change, cause)) in enumerate((MONOCULAR | STEREO).items()):
            turn = list(_TISSUE)[(number + level // 2 + cameras) % len(_TISSUE)]
            is_case = (level, cameras) in _CASES and (cameras == 2 or name in MONOCULAR)
            if is_case and kind == turn and re.search(only, name):
                # Masks that are wrong are masks that are given.
                stated_case = case | {"given": max(level, 1)} if name.startswith("masks") else case
                row = _score(folders[0], change, stated_case, work, seed, name)
                is_named = any(re.search(cause, finding) for finding in row["findings"]) if cause else None
                reference = {f"usual_{key}": undegraded[0][key] for key in ("error", "over_time")}
                other_causes = _causes(row) - _causes(undegraded[0]) - _NO_CAUSES
                row |= {"named": is_named, "misnamed": is_named is False and bool(other_causes)}
                points.append({"change": name, **case, **row, **reference})
    return {"seed": seed, "points": points, "undegraded": clean}


def _causes(row: Mapping[str, Any]) -> set[str]:
    return {message.split(":")[0] for message in row["findings"]}


def judge(row: Mapping[str, Any]) -> str:
    """The outcome of a change: named, held back, harmless, missed, or that there is no cause to name."""
    if row["named"] is None:
        return "no cause to name"
    if row["named"] or row.get("misnamed"):
        return "named" if row["named"] else "missed"
    if row["error"] is None:
        return "held back"
    wrong = any(row[key] > _WRONG + (row.get(f"usual_{key}") or 0.0) for key in ("error", "over_time"))
    holds = (row.get("held") or 0.0) >= _HOLDS and not is_vague(row)
    return "missed" if wrong and not holds else "harmless"


def is_vague(row: Mapping[str, Any]) -> bool:
    """Whether a force is stated with an interval that is wider than the peak."""
    return row.get("width") is not None and row["width"] > _VAGUE


def judge_all(points: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """The worst outcome of each change over its recordings, by name."""
    order = "missed", "harmless", "held back", "named", "no cause to name"
    by_change = report.group_rows(points, "change").items()
    return {name: min(map(judge, rows), key=order.index) for (name,), rows in by_change}


def _means(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means of undegraded recordings that are not held back, and the number of all."""
    keys = "error", "over_time", "width"
    columns = {key: [row[key] for row in rows if row[key] is not None] for key in keys}
    means = {key: float(np.mean(values)) if values else None for key, values in columns.items()}
    return {"count": len(rows)} | means


def _render(work: Path, kind: str, seed: int) -> list[Path]:
    """Stereo recordings of 3 s that state everything, with a sensor at a higher rate and with noise."""
    data, job = work / f"{kind} {seed}", reader.load_job("mission")
    settings = {"seed": seed + list(_TISSUE).index(kind), "sequences": _CLEAN, "frames": FRAMES, "fps": FPS}
    fem = FemSection.model_validate(
        {**job.fem.model_dump(exclude_unset=True), **_USUAL, **_SHOWN, **_TISSUE[kind]}
    )
    render_job(job.model_copy(update={**settings, "fem": fem}), data, workers=1)
    folders = []
    for sequence in Dataset(data):
        folders.append(folder := work / f"{data.name} {sequence.index}")
        if folder.is_dir():
            continue
        export_recording(sequence, folder)
        force = read_table(folder / "force.csv")
        clock, size = np.arange(0, force[-1, 0] + 0.5, 1 / _SENSOR_HZ), np.linalg.norm(force[:, 1:], axis=1)
        values = np.stack([np.interp(clock, force[:, 0], f) for f in force[:, 1:].T], axis=1)
        noise = np.random.default_rng(0).normal(size=values.shape)
        recording_writer.write_force(folder, clock, values + _SENSOR_NOISE * size.max() * noise)
        meta = read_meta(folder) | {"tissue": "brain"}
        meta["membrane"] = "intact" if kind == "membrane" else "stripped"
        meta["sensor"]["free_s"] = [[0.0, max(float(force[np.flatnonzero(size > 0)[0] - 1, 0]), 0.1)]]
        recording_writer.write_meta(folder, meta)
    return folders


def degrade(source: Path, change: Change | None, case: Mapping[str, Any], work: Path) -> Path:
    """A copy of a recording that states what the case does, changed, in place of the previous one."""
    folder = work / "degraded"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(source, folder)
    meta = read_meta(folder)
    if case["given"] < 1:
        shutil.rmtree(folder / "masks")
        (folder / "tissue.png").unlink()
    if case["given"] < 2:
        del meta["sensor"]["free_s"]
    if case["given"] < 3:
        del meta["membrane"]
    if case["cameras"] == 1:
        shutil.rmtree(folder / "right")
        (folder / meta.pop("stereo")["calibration"]).unlink()
    recording_writer.write_meta(folder, meta)
    if change is not None:
        change(folder)
    return folder


def _score(source: Path, change: Change | None, case: Mapping[str, Any], work: Path, *key: Any) -> Any:
    """Errors of physics' force and width of its interval, of the peak, and findings; cached in `work`."""

    def compute() -> dict[str, Any]:
        row: dict[str, Any] = dict.fromkeys(("error", "over_time", "width", "held"))
        folder = degrade(source, change, case, work)
        try:
            result = score(folder)
        except UserError as error:
            return {**row, "findings": [str(error).replace(f"{folder}: ", "")]}
        row["findings"] = [f"{finding.cause}: {finding.message}" for finding in result.findings]
        sensor, main = np.asarray(result.sensor_mn, np.float64), result.methods[result.main]
        is_known = result.scored & np.isfinite(main.size_mn) & np.isfinite(sensor)
        if result.refused or main.low_mn is None or main.high_mn is None or is_known.sum() < 2:
            return row
        true = read_table(source / "force.csv")
        size_mn = 1000 * np.linalg.norm(true[:, 1:], axis=1)
        true_mn, peak_mn = np.interp(result.time_s, true[:, 0], size_mn), float(size_mn.max())
        row["error"] = abs(float(main.size_mn[is_known].max() - sensor[is_known].max())) / peak_mn
        row["over_time"] = float(np.abs(main.size_mn - sensor)[is_known].mean()) / peak_mn
        row["width"] = float((main.high_mn - main.low_mn)[is_known].mean()) / peak_mn
        margin = 3 * _SENSOR_NOISE * peak_mn
        inside = (true_mn > main.low_mn - margin) & (true_mn < main.high_mn + margin)
        row["held"] = float(inside[is_known].mean())
        return row

    content_key = result_cache.key(source.name, dict(case), *key)
    return result_cache.result(work / "points", "change", content_key, compute)


def page(data: Mapping[str, Any]) -> report.Page:
    """The missed rows, the outcome of every change, and errors of undegraded recordings."""
    points, outcomes = data["points"], judge_all(data["points"])
    missed = [row for row in points if judge(row) == "missed"]
    table = [
        {"change": row["change"], "recording": f"{row['kind']}, {row['cameras']}"}
        | {name: _format_share(row.get(key)) for name, key in _COLUMNS.items()}
        for row in missed
    ]
    names = dict[str, list[str]]()
    for name, outcome in outcomes.items():
        names.setdefault(outcome, []).append(name)
    stated = [
        dict[str, str | None]({"stated, with all above": _GIVEN[level]})
        | {f"{row['kind']}, {row['cameras']}": _format_share(row["over_time"]) for row in rows}
        for (level,), rows in report.group_rows(data["undegraded"], "given").items()
    ]
    counts = {outcome: len(changes) for outcome, changes in names.items()}
    faults = len(outcomes) - counts.get("no cause to name", 0)
    caught = counts.get("named", 0) + counts.get("held back", 0)
    verdict = f"**Of {faults} faults {caught} are named or held back in every recording, "
    verdict += f"{counts.get('harmless', 0)} are harmless and {counts.get('missed', 0)} missed.**"
    if stated_rows := [row for row in points if row.get("width") is not None]:
        vague = sum(map(is_vague, stated_rows))
        verdict += f" Of {len(stated_rows)} stated forces {vague} have an interval wider than the peak."
    others = [f"*{outcome}*: {'; '.join(changes)}." for outcome, changes in names.items()]
    sections = [
        report.Section("Missed", table),
        report.Section("Each change, by its worst recording", (), others),
        report.Section("Undegraded: mean error, of the peak", stated),
    ]
    return report.Page("Scoring: degraded recordings", data, (verdict, _CASES_ARE), sections)


def _format_share(share: float | None) -> str | None:
    """In per cent; None: no recording of the row has a force with an interval."""
    return None if share is None else f"{share:.0%}"


_COLUMNS = {
    "error of the peak": "error",
    "undegraded": "usual_error",
    "over time": "over_time",
    "width": "width",
}
_CASES_ARE = (
    "The force is that of the default command. 2: two cameras; tissue, instruments and the span without "
    "contact are stated. 1: one camera; scale and Young's modulus only."
)


STUDY = Study(
    measure,
    "scoring/stability/stability.json",
    page,
    ("{work}/degraded",),
    needs=("mesh", "mechanics", "picture", "truth", "score", "score-stereo", "pulse"),
)
