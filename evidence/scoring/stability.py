"""Recordings degraded in one way at a time, scored by the default command: is the cause named?

Each change is applied to a described recording with two cameras (tissue, instruments and contact-free span
stated) and to a bare one with one camera (scale and E only); plain, covered and pulsating tissue take turns.
A row is *silent* if its force errs by a tenth of the peak more than that of the undegraded recording, is not
held back, and no finding names the cause: a finding of another kind clears nothing, nor does an interval
that is wide enough to hold any force. It is *vague* if it is stated with an interval wider than the peak, of
which nobody can act. Undegraded recordings show what each further statement gains.
"""

import re
import shutil
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from bench.recording import recording_writer
from bench.recording.from_sequence import export_recording
from bench.scoring.score import score
from evidence import report
from evidence import result_cache as stored
from evidence.scoring.degradations import FPS, FRAMES, MONOCULAR, STEREO, Change, read_meta, read_table
from evidence.study import Study
from learn import load_model
from learn.inference.shipped_networks import choose_model
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
_USUAL = {"skull": ("bonded",), "membrane": {"probability": 0.0}}
_GIVEN = "scale and E", "tissue, instruments", "a span without contact", "the membrane's state"
_CASES = (2, 2), (0, 1)  # of degraded recordings: how much is stated, of `_GIVEN`; cameras
_CLEAN = 4  # undegraded recordings of each kind
_SENSOR_HZ, _SENSOR_NOISE = 100.0, 0.005
_WRONG = 0.1  # of the peak
_VAGUE = 1.0  # width of the interval over the peak, from which it says nothing


def measure(work: Path, seed: int = 35, only: str = "", kinds: str = ",".join(_TISSUE)) -> dict[str, Any]:
    """Scores rendered recordings after each change; `only`: a pattern of the changes' names."""
    points, clean = list[dict[str, Any]](), list[dict[str, Any]]()
    for kind, cameras, given in product(kinds.split(","), (2, 1), range(len(_GIVEN))):
        case = {"kind": kind, "cameras": cameras, "given": given}
        folders = _rendered(work, kind, seed)
        usual = [_scored(folder, None, case, work, seed, "") for folder in folders]
        clean.append(case | _means(usual))
        for number, (name, (change, cause)) in enumerate((MONOCULAR | STEREO).items()):
            turn = list(_TISSUE)[(number + given // 2 + cameras) % len(_TISSUE)]
            known = (given, cameras) in _CASES and (cameras == 2 or name in MONOCULAR)
            if known and kind == turn and re.search(only, name):
                row = _scored(folders[0], change, case, work, seed, name)
                named = any(re.search(cause, one) for one in row["findings"]) if cause else None
                points.append({"change": name, **case, **row, "usual": usual[0]["error"], "named": named})
    return {"seed": seed, "points": points, "undegraded": clean}


def is_silent(row: Mapping[str, Any]) -> bool:
    """Whether a force is wrong, not held back, and no finding names the cause."""
    return row["named"] is False and (row["error"] or 0.0) > _WRONG + (row.get("usual") or 0.0)


def is_vague(row: Mapping[str, Any]) -> bool:
    """Whether a force is stated with an interval that is wider than the peak."""
    return row["width"] is not None and row["width"] > _VAGUE


def count_caught(points: Sequence[Mapping[str, Any]]) -> tuple[int, int]:
    """Number of ways to degrade whose cause is named or whose force is held back in every recording, of all
    that have a cause to name."""
    caught = [
        all(row["named"] or row["error"] is None for row in rows)
        for _, rows in report.grouped(points, "change").items()
        if rows[0]["named"] is not None
    ]
    return sum(caught), len(caught)


def _means(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means of undegraded recordings that are not held back, and the number of all."""
    keys = "error", "over_time", "width"
    known = {key: [row[key] for row in rows if row[key] is not None] for key in keys}
    means = {key: float(np.mean(values)) if values else None for key, values in known.items()}
    return {"count": len(rows)} | means


def _rendered(work: Path, kind: str, seed: int) -> list[Path]:
    """Stereo recordings of 3 s that state everything, with a sensor at a higher rate and with noise."""
    data, job = work / f"{kind} {seed}", reader.load_job("mission")
    settings = {"seed": seed + list(_TISSUE).index(kind), "sequences": _CLEAN, "frames": FRAMES, "fps": FPS}
    fem = FemSection.model_validate({**job.fem.model_dump(exclude_unset=True), **_USUAL, **_TISSUE[kind]})
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


@cache
def _model(stereo: bool) -> Any:
    return load_model(choose_model(stereo))


def _scored(source: Path, change: Change | None, case: Mapping[str, Any], work: Path, *key: Any) -> Any:
    """Errors of the leading force and width of its interval, of the peak, and findings; cached in `work`."""

    def compute() -> dict[str, Any]:
        row: dict[str, Any] = dict.fromkeys(("error", "over_time", "width"))
        folder = degrade(source, change, case, work)
        try:
            result = score(folder, _model(case["cameras"] == 2))
        except UserError as error:
            return {**row, "findings": [str(error).replace(f"{folder}: ", "")]}
        row["findings"] = [f"{one.cause}: {one.message}" for one in result.findings]
        sensor, main = np.asarray(result.sensor_mn, np.float64), result.methods[result.main]
        known = result.scored & np.isfinite(main.size_mn) & np.isfinite(sensor)
        if result.refused or main.low_mn is None or main.high_mn is None or known.sum() < 2:
            return row
        peak_mn = 1000 * float(np.linalg.norm(read_table(source / "force.csv")[:, 1:], axis=1).max())
        row["error"] = abs(float(main.size_mn[known].max() - sensor[known].max())) / peak_mn
        row["over_time"] = float(np.abs(main.size_mn - sensor)[known].mean()) / peak_mn
        row["width"] = float((main.high_mn - main.low_mn)[known].mean()) / peak_mn
        return row

    return stored.result(work / "points", "change", stored.key(source.name, dict(case), *key), compute)


def page(found: Mapping[str, Any]) -> report.Page:
    """The silent rows, the names of the other changes, and errors of undegraded recordings."""
    points = found["points"]
    silent = [row for row in points if is_silent(row)]
    table = [
        {"change": row["change"], "recording": f"{row['kind']}, {row['cameras']}"}
        | {name: None if row.get(key) is None else f"{row[key]:.0%}" for name, key in _COLUMNS.items()}
        for row in silent
    ]
    quiet, names = {row["change"] for row in silent}, dict[str, list[str]]()
    for (name,), rows in report.grouped(points, "change").items():
        if name not in quiet:
            outcome = "no cause to name" if rows[0]["named"] is None else "held back or named"
            names.setdefault(outcome, []).append(name)
    stated = [
        {"stated, with all above": _GIVEN[given]}
        | {f"{row['kind']}, {row['cameras']}": f"{row['over_time']:.0%}" for row in rows}
        for (given,), rows in report.grouped(found["undegraded"], "given").items()
    ]
    ways = len(report.grouped(points, "change"))
    verdict = f"**In {len(silent)} of {len(points)} recordings, degraded in {ways} ways, {_VERDICT}"
    caught, faults = count_caught(points)
    stated_rows = [row for row in points if row["width"] is not None]
    vague = sum(map(is_vague, stated_rows))
    verdict += f" Named or held back in every recording: {caught} of {faults} faults. Of {len(stated_rows)} "
    verdict += f"stated forces {vague} have an interval wider than the peak."
    others = [f"*{outcome}*: {'; '.join(some)}." for outcome, some in names.items()]
    sections = [
        report.Section("Wrong without its cause", table),
        report.Section("Other changes", (), others),
        report.Section("Undegraded: mean error, of the peak", stated),
    ]
    return report.Page("Scoring: degraded recordings", found, (verdict, _CASES_ARE), sections)


_COLUMNS = {"error of the peak": "error", "undegraded": "usual", "width of the interval": "width"}
_VERDICT = (
    "the force is wrong by more than a tenth of the peak and no finding names the cause.** A finding of "
    "another kind clears no row; without a figure for the undegraded recording every such error counts."
)
_CASES_ARE = (
    "The force is that of the default command. 2: two cameras; tissue, instruments and the span without "
    "contact are stated. 1: one camera; scale and Young's modulus only."
)


STUDY = Study(
    measure,
    "scoring/stability/stability.json",
    page,
    ("{work}/degraded",),
    needs=("mesh", "mechanics", "picture", "truth", "score", "score-stereo"),
)
