"""Recordings degraded in one way at a time, scored by the default command: is the cause named?

Each change is applied to a described recording with two cameras (tissue, instruments and contact-free span
stated) and to a bare one with one camera (scale and E only); plain, covered and pulsating tissue take turns.
A row is *silent* if its force errs by a tenth of the peak more than that of the undegraded recording, is not
held back, and no finding names the cause: a finding of another kind clears nothing, nor does an interval
that is wide enough to hold any force. Undegraded recordings show what each further statement gains.
"""

import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from ruamel.yaml import YAML

from bench.recording import writer
from bench.recording.from_sequence import export_recording
from bench.scoring.score import score
from evidence import cache as stored
from evidence import report
from evidence.study import Study
from learn import load_model
from learn.inference.shipped import choose_model
from synth.arrays import Floats, Pixels
from synth.dataset.store import Dataset
from synth.engine.run import render_job
from synth.errors import UserError
from synth.job import reader
from synth.job.schema import FemSection
from synth.system.checked_file import read_picture

_TISSUE: dict[str, dict[str, Any]] = {
    "plain": {},
    "membrane": {"membrane": {"probability": 1.0}},
    "pulse": {"pulse": {"heart_mm": (0.1, 0.3), "breath_mm": (0.1, 0.3)}},
}
_USUAL = {"skull": ("bonded",), "membrane": {"probability": 0.0}}
_GIVEN = "scale and E", "tissue, instruments", "a span without contact", "the membrane's state"
_CASES = (2, 2), (0, 1)  # of degraded recordings: how much is stated, of `_GIVEN`; cameras
_CLEAN, _FRAMES, _FPS = 4, 24, 8.0  # undegraded recordings of each kind; frames of each
_SENSOR_HZ, _SENSOR_NOISE = 100.0, 0.005
_WRONG = 0.1  # of the peak

Change = Callable[[Path], None]  # of a recording's folder
Picture = np.ndarray[Any, Any]  # (H, W, 3) RGB


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


def _means(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means of undegraded recordings that are not held back, and the number of all."""
    keys = "error", "over_time", "width"
    known = {key: [row[key] for row in rows if row[key] is not None] for key in keys}
    means = {key: float(np.mean(values)) if values else None for key, values in known.items()}
    return {"count": len(rows)} | means


def _rendered(work: Path, kind: str, seed: int) -> list[Path]:
    """Stereo recordings of 3 s that state everything, with a sensor at a higher rate and with noise."""
    data, job = work / f"{kind} {seed}", reader.load_job("mission")
    settings = {"seed": seed + list(_TISSUE).index(kind), "sequences": _CLEAN, "frames": _FRAMES, "fps": _FPS}
    fem = FemSection.model_validate({**job.fem.model_dump(exclude_unset=True), **_USUAL, **_TISSUE[kind]})
    render_job(job.model_copy(update={**settings, "fem": fem}), data, workers=1)
    folders = []
    for sequence in Dataset(data):
        folders.append(folder := work / f"{data.name} {sequence.index}")
        if folder.is_dir():
            continue
        export_recording(sequence, folder)
        force = np.loadtxt(folder / "force.csv", delimiter=",", skiprows=1)
        clock, size = np.arange(0, force[-1, 0] + 0.5, 1 / _SENSOR_HZ), np.linalg.norm(force[:, 1:], axis=1)
        values = np.stack([np.interp(clock, force[:, 0], f) for f in force[:, 1:].T], axis=1)
        noise = np.random.default_rng(0).normal(size=values.shape)
        writer.write_force(folder, clock, values + _SENSOR_NOISE * size.max() * noise)
        meta = read_meta(folder) | {"tissue": "brain"}
        meta["membrane"] = "intact" if kind == "membrane" else "stripped"
        meta["sensor"]["free_s"] = [[0.0, max(float(force[np.flatnonzero(size > 0)[0] - 1, 0]), 0.1)]]
        writer.write_meta(folder, meta)
    return folders


def read_meta(folder: Path) -> Any:
    return YAML(typ="safe").load((folder / "meta.yaml").read_text("utf-8"))


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
    writer.write_meta(folder, meta)
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
        peak_mn = 1000 * float(np.linalg.norm(_table(source / "force.csv")[:, 1:], axis=1).max())
        row["error"] = abs(float(main.size_mn[known].max() - sensor[known].max())) / peak_mn
        row["over_time"] = float(np.abs(main.size_mn - sensor)[known].mean()) / peak_mn
        row["width"] = float((main.high_mn - main.low_mn)[known].mean()) / peak_mn
        return row

    return stored.result(work / "points", "change", stored.key(source.name, dict(case), *key), compute)


def page(found: Mapping[str, Any]) -> report.Page:
    """The silent rows, the names of the others by outcome, and errors of undegraded recordings."""
    points, clean = found["points"], found["undegraded"]
    silent = [row for row in points if is_silent(row)]
    table = [
        {"change": row["change"], "recording": f"{row['kind']}, {row['cameras']}"}
        | {name: None if row.get(key) is None else f"{row[key]:.0%}" for name, key in _COLUMNS.items()}
        for row in silent
    ]
    quiet = {row["change"] for row in silent}
    groups: dict[str, list[str]] = {"held back or named": [], "no cause to name": []}
    for (name,), rows in report.grouped(points, "change").items():
        if name not in quiet:
            groups["no cause to name" if rows[0]["named"] is None else "held back or named"].append(name)
    words = [
        f"**In {len(silent)} of {len(points)} recordings, degraded in "
        f"{len(report.grouped(points, 'change'))} ways, the force is wrong by more than a tenth of the peak "
        "and no finding names the cause.** A finding of another kind clears no row.",
        "The force is that of the default command. 2: two cameras; tissue, instruments and the span without "
        "contact are stated. 1: one camera; scale and Young's modulus only.",
        "" if points and "usual" in points[0] else _EARLIER,
    ]
    stated = [
        {"stated, with all above": _GIVEN[given]}
        | {f"{row['kind']}, {row['cameras']}": f"{row['over_time']:.0%}" for row in rows}
        for (given,), rows in report.grouped(clean, "given").items()
    ]
    sections = [
        report.Section("Wrong without its cause", table),
        report.Section(
            "Other changes", (), [f"*{what}*: {'; '.join(names)}." for what, names in groups.items()]
        ),
        report.Section("Undegraded: mean error, of the peak", stated),
    ]
    return report.Page("Scoring: degraded recordings", found, [text for text in words if text], sections)


_COLUMNS = {"error of the peak": "error", "undegraded": "usual", "width of the interval": "width"}
_EARLIER = (
    "These data were measured before a row stored the width of its interval and the error of its undegraded "
    "recording, so that every error above a tenth counts, also where the undegraded recording errs as much "
    "(one camera, under a membrane)."
)


def _table(file: Path) -> Floats:
    return np.loadtxt(file, delimiter=",", skiprows=1)


def _read(file: Path) -> Pixels:
    return np.asarray(read_picture(file)[..., ::-1], np.uint8)


def _each(change: Callable[[Picture, int], Any], camera: str = "frames") -> Change:
    """A change of each image of a camera and its number."""

    def apply(folder: Path) -> None:
        for k, file in enumerate(sorted((folder / camera).iterdir())):
            picture = change(_read(file), k)
            cv2.imwrite(str(file), np.clip(picture, 0, 255).astype(np.uint8)[..., ::-1])

    return apply


def _bumped(
    scale: float = 1, turn_deg: float = 0, x: float = 0, y: float = 0, camera: str = "frames"
) -> Change:
    """A camera that is moved after half of the frames."""

    def move(rgb: Picture, k: int) -> Any:
        matrix = cv2.getRotationMatrix2D((rgb.shape[1] / 2, rgb.shape[0] / 2), turn_deg, scale)
        return _warped(rgb, matrix + _shift(x, y) - _shift(0, 0)) if k >= _FRAMES // 2 else rgb

    return _each(move, camera)


def _shift(x: float, y: float) -> Any:
    return np.array([[1, 0, x], [0, 1, y]])


def _warped(rgb: Picture, matrix: Any) -> Any:
    return cv2.warpAffine(rgb, matrix, rgb.shape[1::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def _ordered(order: Callable[[Any], Any], *parts: str) -> Change:
    """Another order of pictures; by default of the left camera's and the instrument masks."""

    def apply(folder: Path) -> None:
        numbers, time_s = order(np.arange(_FRAMES)), _table(folder / "frames.csv")[:, 1]
        for part in (folder / name for name in parts or ("frames", "masks") if (folder / name).is_dir()):
            old = part.rename(folder / "old")
            part.mkdir()
            files = {int(file.stem): file for file in old.iterdir()}
            for new, k in enumerate(numbers):
                if k in files:
                    shutil.copy(files[k], part / f"{new:06d}.png")
            shutil.rmtree(old)
            if part.name == "frames":
                writer.write_frames(folder, time_s[: len(numbers)])

    return apply


def _noise(levels: float, rgb: Picture, k: int) -> Any:
    return np.random.default_rng((4, k)).normal(0, levels, rgb.shape)


def _patch(colour: tuple[int, int, int], since: int, *points: tuple[float, float]) -> Change:
    """A polygon of a colour from a frame on; points in shares of the image."""

    def draw(rgb: Picture, k: int) -> Any:
        shown = np.array(rgb)
        if k >= since:
            cv2.fillPoly(shown, [np.int32(np.array(points) * rgb.shape[1::-1])], colour)
        return shown + _noise(5, rgb, k) * (shown != rgb)

    return _each(draw)


def _stated(**changes: Any) -> Change:
    """Changes of meta.yaml; a float multiplies the value."""

    def apply(folder: Path) -> None:
        meta = read_meta(folder)
        new = {key: meta[key] * by if isinstance(by, float) else by for key, by in changes.items()}
        writer.write_meta(folder, meta | new)

    return apply


def _sensor(change: Callable[[Floats, Floats], tuple[Any, Any]]) -> Change:
    """A change of the sensor's times (N,) and forces (N, 3) N."""

    def apply(folder: Path) -> None:
        rows = _table(folder / "force.csv")
        writer.write_force(folder, *change(rows[:, 0], rows[:, 1:]))

    return apply


def _started(folder: Path) -> None:
    """Cuts the first half of the recording off."""
    _ordered(lambda k: k[_FRAMES // 2 :], "frames", "masks", "right")(folder)
    begin = _FRAMES // 2 / _FPS
    _sensor(lambda t, f: (t[t >= begin] - begin, f[t >= begin]))(folder)
    sensor = {key: value for key, value in read_meta(folder)["sensor"].items() if key != "free_s"}
    _stated(sensor=sensor)(folder)


def _swap(folder: Path) -> None:
    for name, new in (("frames", "old"), ("right", "frames"), ("old", "right")):
        (folder / name).rename(folder / new)


def _compressed(folder: Path) -> None:
    time_s = _table(folder / "frames.csv")[:, 1]
    for name, video in (("frames", "video.mp4"), ("right", "right.mp4")):
        if (folder / name).is_dir():
            pictures = (_read(file) for file in sorted((folder / name).iterdir()))
            writer.write_video(folder / video, pictures, time_s, crf=51)
            shutil.rmtree(folder / name)


def _blurred(rgb: Picture) -> Any:
    return cv2.GaussianBlur(rgb, (0, 0), 3)


_COARSE, _UNITS, _AGAIN = "^pictures: .*(detail|compressed)", "^sensor|in newtons|in mN", "again"
_MISSING, _LATE = r"^pictures: .*missing|^clocks|^times", "^stereo: .*(late|early)"
_PAIR = {"calibration": "stereo.yaml", "mm_per_unit": 2}
_HAND, _GAUZE = ((0.6, 0.3), (1, 0.3), (1, 0.7), (0.6, 0.7)), ((0, 0.1), (0.2, 0), (0.2, 0.3), (0, 0.3))
# What makes it, and a pattern of the finding that names it; empty: the force should stay the same.
MONOCULAR: dict[str, tuple[Change, str]] = {
    "camera bumped by 5 px": (_bumped(x=4, y=3), "^camera"),
    "zoom by 1%": (_bumped(scale=1.01), "^camera"),
    "rotation by 2 deg": (_bumped(turn_deg=2), "^camera"),
    "camera drifts by 6 px": (_each(lambda rgb, k: _warped(rgb, _shift(k / 6, 0))), "^camera"),
    "first picture under load": (_started, "^rest frame|most likely.*rest frame"),
    "frozen for 5 frames": (_ordered(lambda k: np.where((k > 7) & (k < 13), 8, k)), _AGAIN),
    "4 frames dropped": (_ordered(lambda k: k[(k < 8) | (k > 11)]), _MISSING),
    "4 frames late": (_ordered(lambda k: np.maximum(k - 4, 0)), f"{_MISSING}|{_AGAIN}"),
    "frames reversed": (_ordered(lambda k: k[::-1]), "^clocks"),
    "half the light later": (_each(lambda rgb, k: rgb * (0.5 if k > 11 else 1.0)), "^pictures: .*light"),
    "a hand comes into view": (_patch((222, 202, 180), 12, *_HAND), "^foreground"),
    "letterbox": (_each(lambda rgb, k: np.pad(rgb[20:-20], ((20, 20), (0, 0), (0, 0)))), "bars"),
    "H.264 at crf 51": (_compressed, _COARSE),
    "noise of 30 levels": (_each(lambda rgb, k: rgb + _noise(30, rgb, k)), "noisy"),
    "dark": (_each(lambda rgb, k: 0.2 * rgb + _noise(1, rgb, k)), "dim"),
    "blur of 3 px": (_each(lambda rgb, k: _blurred(rgb)), "detail"),
    "focus lost later": (_each(lambda rgb, k: _blurred(rgb) if k > 8 else rgb), "sharp"),
    "scale 1.5 times too large": (_stated(scale_mm_per_px=1.5), "^scale"),
    "scale 2 times too small": (_stated(scale_mm_per_px=0.5), "^(scale|force)"),
    "scale in cm": (_stated(scale_mm_per_px=0.1), "^scale"),
    "E 5 times too large": (_stated(young_kpa=5.0), "^(stiffness|force)"),
    "E in Pa": (_stated(young_kpa=1000.0), "^stiffness"),
    "sensor: 2 times too large": (_sensor(lambda t, f: (t, 2 * f)), "^(sensor|force)"),
    "sensor: mN": (_sensor(lambda t, f: (t, 1000 * f)), _UNITS),
    "sensor: sign": (_sensor(lambda t, f: (t, -f)), "^sensor"),
    "sensor: axes": (_sensor(lambda t, f: (t, f[:, [1, 2, 0]])), "^sensor"),
    "sensor: saturated": (_sensor(lambda t, f: (t, f.clip(f.min() / 2, f.max() / 2))), "^sensor"),
    "sensor: clock 8% fast": (_sensor(lambda t, f: (t * 1.08, f)), "^clocks"),
    "sensor: clock 0.6 s off": (_sensor(lambda t, f: (t - 0.6, f)), "^clocks"),
    "white balance": (_each(lambda rgb, k: rgb * [1.2, 1, 0.7]), ""),
    "gauze at rest": (_patch((225, 220, 212), 0, *_GAUZE), ""),
    "grey": (_each(lambda rgb, k: rgb @ np.full((3, 3), 1 / 3)), ""),
    "flicker": (_each(lambda rgb, k: rgb * (1 + 0.15 * (-1) ** k)), ""),
}  # fmt: skip
STEREO: dict[str, tuple[Change, str]] = {
    "right camera a frame late": (_ordered(lambda k: np.maximum(k - 1, 0), "right"), _LATE),
    "right camera frozen": (_ordered(lambda k: np.minimum(k, 6), "right"), "^stereo"),
    "right camera mirrored": (_each(lambda rgb, k: rgb[:, ::-1], "right"), "mirrored"),
    "right camera 4 rows down": (_each(lambda rgb, k: np.roll(rgb, 4, axis=0), "right"), "rows"),
    "right camera bumped by 3 px": (_bumped(x=2.4, y=1.8, camera="right"), "^stereo|right camera"),
    "right camera out of focus": (_each(lambda rgb, k: _blurred(rgb), "right"), "^stereo"),
    "cameras swapped": (_swap, "swapped"),
    "baseline 2 times too long": (_stated(stereo=_PAIR), "^scale"),
}  # fmt: skip


STUDY = Study(
    measure,
    "scoring/stability/stability.json",
    page,
    ("{work}/degraded",),
    needs=("mesh", "mechanics", "picture", "truth", "score", "score-stereo"),
)
