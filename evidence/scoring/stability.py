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
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import av
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
from synth.arrays import Floats, Mask, Pixels
from synth.dataset.store import Dataset
from synth.dataset.store import Sequence as Stored
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


@dataclass(frozen=True, eq=False)
class Video:
    """A recording in memory: images of both cameras (T, H, W, 3), masks, sensor (N, 4) in s and newtons."""

    rgb: Pixels
    right: Any
    tool: Mask
    tissue: Mask
    time_s: Floats
    sensor: Floats
    meta: dict[str, Any]
    pair: str  # stereo.yaml
    codec: tuple[int, str, int] | None = None
    """Quality (crf), pixel format, and pixels' width in thirds of their height; None: PNG."""
    white: int = 255  # value of masked pixels


Change = Callable[[Video], Video]


def measure(work: Path, seed: int = 35, only: str = "", kinds: str = ",".join(_TISSUE)) -> dict[str, Any]:
    """Scores rendered recordings after each change; `only`: a pattern of the changes' names."""
    points, clean = list[dict[str, Any]](), list[dict[str, Any]]()
    for kind, cameras, given in product(kinds.split(","), (2, 1), range(len(_GIVEN))):
        case = {"kind": kind, "cameras": cameras, "given": given}
        videos = [v if cameras == 2 else replace(v, right=None) for v in _rendered(work, kind, seed)]
        usual = [
            _scored(video, _peak_mn(video), given, work, seed, k, *case.values())
            for k, video in enumerate(videos)
        ]
        clean.append(case | _means(usual))
        for number, (name, (change, cause)) in enumerate((MONOCULAR | STEREO).items()):
            turn = list(_TISSUE)[(number + given // 2 + cameras) % len(_TISSUE)]
            known = (given, cameras) in _CASES and (cameras == 2 or name in MONOCULAR)
            if known and kind == turn and re.search(only, name):
                row = _scored(
                    change(videos[0]), _peak_mn(videos[0]), given, work, seed, 0, *case.values(), name
                )
                named = any(re.search(cause, one) for one in row["findings"]) if cause else None
                points.append({"change": name, **case, **row, "usual": usual[0]["error"], "named": named})
    return {"seed": seed, "points": points, "undegraded": clean}


def is_silent(row: Mapping[str, Any]) -> bool:
    """Whether a force is wrong, not held back, and no finding names the cause."""
    return row["named"] is False and (row["error"] or 0.0) > _WRONG + (row.get("usual") or 0.0)


def _means(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means of undegraded recordings that are not held back, and the number of all."""
    known = {
        key: [row[key] for row in rows if row[key] is not None] for key in ("error", "over_time", "width")
    }
    return {"count": len(rows)} | {
        key: float(np.mean(values)) if values else None for key, values in known.items()
    }


def _rendered(work: Path, kind: str, seed: int) -> list[Video]:
    """Stereo recordings of 24 frames in 3 s."""
    data, job = work / f"{kind} {seed}", reader.load_job("mission")
    changed = {"seed": seed + list(_TISSUE).index(kind), "sequences": _CLEAN, "frames": 24, "fps": 8.0}
    fem = FemSection.model_validate({**job.fem.model_dump(exclude_unset=True), **_USUAL, **_TISSUE[kind]})
    render_job(job.model_copy(update={**changed, "fem": fem}), data, workers=1)
    videos = [_read(sequence, work / f"{data.name} {k}") for k, sequence in enumerate(Dataset(data))]
    state = {"membrane": "intact" if kind == "membrane" else "stripped", "tissue": "brain"}
    return [replace(video, meta=video.meta | state) for video in videos]


def _read(sequence: Stored, folder: Path) -> Video:
    """A sequence as a recording, in `folder`, its sensor resampled at a higher rate, with noise."""
    if not folder.is_dir():
        export_recording(sequence, folder)
    meta = YAML(typ="safe").load((folder / "meta.yaml").read_text("utf-8"))
    rgb, right, tool, tissue = (sequence[name][:] for name in ("rgb", "rgb_right", "tool", "tissue"))
    time_s = np.loadtxt(folder / "frames.csv", delimiter=",", skiprows=1)[:, 1]
    force = np.loadtxt(folder / "force.csv", delimiter=",", skiprows=1)
    clock = np.arange(0, time_s[-1] + 0.5, 1 / _SENSOR_HZ)
    values = np.stack([np.interp(clock, force[:, 0], f) for f in force[:, 1:].T], axis=1)
    size = np.linalg.norm(force[:, 1:], axis=1)
    values += _SENSOR_NOISE * size.max() * np.random.default_rng(0).normal(size=values.shape)
    meta["sensor"]["free_s"] = [[0.0, max(float(force[np.flatnonzero(size > 0)[0] - 1, 0]), 0.1)]]
    sensor, pair = np.column_stack([clock, values]), (folder / "stereo.yaml").read_text("utf-8")
    return Video(rgb, right, tool > 0, tissue > 0, time_s, sensor, meta, pair)


def _written(video: Video, given: int, work: Path) -> Path:
    """Folder of the recording, in place of the previous one; `given`: how much is stated, of `_GIVEN`."""
    folder, meta = work / "degraded", {**video.meta}
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for name, images in (("frames", video.rgb), ("right", video.right)):
        if images is not None and video.codec:
            _encode(folder / f"{name.replace('frames', 'video')}.mp4", images, video.codec)
        elif images is not None:
            writer.write_second(folder / name, range(len(images)), images)
    if given >= 1:
        (folder / "masks").mkdir()
        for k in np.flatnonzero(video.tool.any(axis=(1, 2))):
            cv2.imwrite(str(folder / f"masks/{k:06d}.png"), video.tool[k].astype(np.uint8) * video.white)
        cv2.imwrite(str(folder / "tissue.png"), video.tissue.astype(np.uint8) * 255)
    unstated = {"free_s"} if given < 2 else set()
    meta["sensor"] = {key: value for key, value in meta["sensor"].items() if key not in unstated}
    hidden = [*["membrane"] * (given < 3), *["stereo"] * (video.right is None)]
    writer.write_force(folder, video.sensor[:, 0], video.sensor[:, 1:])
    writer.write_frames(folder, video.time_s)
    if video.right is not None:
        (folder / "stereo.yaml").write_text(video.pair, "utf-8")
    writer.write_meta(folder, {key: value for key, value in meta.items() if key not in hidden})
    return folder


def _encode(path: Path, images: Pixels, codec: tuple[int, str, int]) -> None:
    """Writes H.264; see `Video.codec`."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=8, options={"crf": str(codec[0]), "threads": "1"})
        stream.height, stream.width, stream.pix_fmt = *images.shape[1:3], codec[1]
        stream.codec_context.sample_aspect_ratio = Fraction(codec[2], 3)
        for rgb in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), "rgb24")))
        container.mux(stream.encode())


@cache
def _model(stereo: bool) -> Any:
    return load_model(choose_model(stereo), quick=True)


def _peak_mn(video: Video) -> float:
    return 1000 * float(np.linalg.norm(video.sensor[:, 1:], axis=1).max())


def _scored(video: Video, peak_mn: float, given: int, work: Path, *key: Any) -> Any:
    """Errors of the leading force and width of its interval, of the peak, and findings; cached in `work`."""

    def compute() -> dict[str, Any]:
        row: dict[str, Any] = dict.fromkeys(("error", "over_time", "width"))
        folder = _written(video, given, work)
        try:
            result = score(folder, _model(video.right is not None))
        except UserError as error:
            return {**row, "findings": [str(error).replace(f"{folder}: ", "")]}
        row["findings"] = [f"{one.cause}: {one.message}" for one in result.findings]
        sensor, main = np.asarray(result.sensor_mn, np.float64), result.methods[result.main]
        known = result.scored & np.isfinite(main.size_mn) & np.isfinite(sensor)
        if result.refused or main.low_mn is None or main.high_mn is None or known.sum() < 2:
            return row
        row["error"] = abs(float(main.size_mn[known].max() - sensor[known].max())) / peak_mn
        row["over_time"] = float(np.abs(main.size_mn - sensor)[known].mean()) / peak_mn
        row["width"] = float((main.high_mn - main.low_mn)[known].mean()) / peak_mn
        return row

    return stored.result(work / "points", "change", stored.key(*key), compute)


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


def _each(change: Callable[[Pixels, int], Any]) -> Change:
    """A change of each image (H, W, 3) of the left camera and its number."""

    def apply(video: Video) -> Video:
        images = [np.clip(change(rgb, k), 0, 255).astype(np.uint8) for k, rgb in enumerate(video.rgb)]
        return replace(video, rgb=np.stack(images))

    return apply


def _shift(x: float, y: float) -> Any:
    return np.array([[1, 0, x], [0, 1, y]])


def _warped(rgb: Pixels, matrix: Any) -> Any:
    return cv2.warpAffine(rgb, matrix, rgb.shape[1::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def _bumped(
    scale: float = 1.0, turn_deg: float = 0.0, x: float = 0.0, y: float = 0.0, since: int = 12
) -> Change:
    """The left camera moved from a frame on."""

    def move(rgb: Pixels, k: int) -> Any:
        matrix = cv2.getRotationMatrix2D((rgb.shape[1] / 2, rgb.shape[0] / 2), turn_deg, scale)
        return _warped(rgb, matrix + _shift(x, y) - _shift(0, 0)) if k >= since else rgb

    return _each(move)


def _right(change: Change) -> Change:
    """A change of the right camera's images, by one of the left camera's."""
    return lambda video: replace(
        video, right=np.ascontiguousarray(change(replace(video, rgb=video.right)).rgb)
    )


def _ordered(order: Callable[[Any], Any]) -> Change:
    """Another order of the left camera's images and tool masks."""

    def apply(video: Video) -> Video:
        numbers = np.asarray(order(np.arange(len(video.rgb))))
        times = video.time_s[: len(numbers)]
        return replace(video, rgb=video.rgb[numbers], tool=video.tool[numbers], time_s=times)

    return apply


def _noise(levels: float, rgb: Pixels, k: int) -> Any:
    return np.random.default_rng((4, k)).normal(0, levels, rgb.shape)


def _patch(
    colour: tuple[int, int, int], noise: float, *points: tuple[float, float], since: int = 0
) -> Change:
    """A polygon of a colour from a frame on; points in shares of the image."""

    def draw(rgb: Pixels, k: int) -> Any:
        mask = np.zeros(rgb.shape[:2], np.uint8)
        cv2.fillPoly(mask, [np.int32(np.array(points) * rgb.shape[1::-1])], 255)
        weave = np.random.default_rng(3).normal(0, noise, rgb.shape[:2])[..., None]
        return np.where(mask[..., None] * (k >= since) > 0, np.array(colour) + weave, rgb)

    return _each(draw)


def _boxed(rgb: Pixels, k: int) -> Any:
    bar = rgb.shape[0] // 8
    inner = cv2.resize(rgb, (rgb.shape[1], rgb.shape[0] - 2 * bar), interpolation=cv2.INTER_AREA)
    return cv2.copyMakeBorder(inner, bar, bar, 0, 0, cv2.BORDER_CONSTANT, value=(16, 16, 16))


def _stated(**changes: Any) -> Change:
    """Changes of meta.yaml; a float multiplies the value."""

    def change(video: Video) -> Video:
        new = {key: video.meta[key] * by if isinstance(by, float) else by for key, by in changes.items()}
        return replace(video, meta=video.meta | new)

    return change


def _sensor(change: Callable[[Floats, Floats], tuple[Any, Any]]) -> Change:
    """A change of the sensor's times (N,) and forces (N, 3)."""
    return lambda v: replace(v, sensor=np.column_stack(change(v.sensor[:, 0], v.sensor[:, 1:])))


def _mirrored(video: Video) -> Video:
    return replace(video, rgb=video.rgb[:, :, ::-1], tool=video.tool[..., ::-1], tissue=video.tissue[:, ::-1])


def _interlaced(video: Video) -> Video:
    rgb = video.rgb.copy()
    rgb[:-1, 1::2] = video.rgb[1:, 1::2]
    return replace(video, rgb=rgb)


def _started_at_peak(video: Video) -> Video:
    """The recording from the largest force on."""
    peak = video.sensor[np.linalg.norm(video.sensor[:, 1:], axis=1).argmax(), 0]
    first = int(np.abs(video.time_s - peak).argmin())
    sensor = {key: value for key, value in video.meta["sensor"].items() if key != "free_s"}
    right, times = None if video.right is None else video.right[first:], video.time_s[first:]
    cut = replace(video, rgb=video.rgb[first:], right=right, tool=video.tool[first:], time_s=times)
    return replace(
        cut, sensor=video.sensor[video.sensor[:, 0] >= times[0]], meta=video.meta | {"sensor": sensor}
    )


_COARSE, _UNITS, _AGAIN = "^pictures: .*(detail|compressed)", "^sensor|in newtons|in mN", "again"
_MISSING, _LATE = r"^pictures: .*missing|^clocks|^times", "^stereo: .*(late|early)"
_FROZEN = _ordered(lambda k: np.where((k > 7) & (k < 13), 8, k))
_NOISY = _each(lambda rgb, k: rgb + _noise(2, rgb, k))
_HAND = _patch((222, 202, 180), 30, (0.6, 0.3), (1, 0.3), (1, 0.7), (0.6, 0.7), since=12)
_DOUBLE = {"calibration": "stereo.yaml", "mm_per_unit": 2}
# What makes it, and a pattern of the finding that names it; empty: the force should stay the same.
MONOCULAR: dict[str, tuple[Change, str]] = {
    "camera bumped by 5 px": (_bumped(x=4, y=3), "^camera"),
    "camera drifts by 6 px": (_each(lambda rgb, k: _warped(rgb, _shift(k / 5, k / 6))), "^camera"),
    "zoom by 1%": (_bumped(scale=1.01), "^camera"),
    "rotation by 2 deg": (_bumped(turn_deg=2), "^camera"),
    "first picture under load": (_started_at_peak, "^rest frame|most likely.*rest frame"),
    "frozen for 5 frames": (_FROZEN, _AGAIN),
    "frozen, new noise on copies": (lambda v: _NOISY(_FROZEN(v)), _AGAIN),
    "4 frames dropped": (_ordered(lambda k: k[(k < 8) | (k > 11)]), _MISSING),
    "4 frames late": (_ordered(lambda k: np.maximum(k - 4, 0)), f"{_MISSING}|{_AGAIN}"),
    "frames reversed": (_ordered(lambda k: k[::-1]), "^clocks"),
    "half the light later": (_each(lambda rgb, k: rgb * (0.5 if k > 11 else 1.0)), "^pictures: .*light"),
    "a hand comes into view": (_HAND, "^foreground"),
    "interlaced": (_interlaced, "interlaced"),
    "letterbox": (_each(_boxed), "bars"),
    "H.264 at crf 51": (lambda v: replace(v, codec=(51, "yuv420p", 3)), _COARSE),
    "noise of 30 levels": (_each(lambda rgb, k: rgb + _noise(30, rgb, k)), "noisy"),
    "dark": (_each(lambda rgb, k: 0.2 * rgb + _noise(1, rgb, k)), "dim"),
    "blur of 3 px": (_each(lambda rgb, k: cv2.GaussianBlur(rgb, (0, 0), 3)), "detail"),
    "focus lost later": (_each(lambda rgb, k: cv2.GaussianBlur(rgb, (0, 0), 3) if k > 8 else rgb), "sharp"),
    "scale 1.5 times too large": (_stated(scale_mm_per_px=1.5), "^scale"),
    "scale 2 times too small": (_stated(scale_mm_per_px=0.5), "^(scale|force)"),
    "scale in cm": (_stated(scale_mm_per_px=0.1), "^scale"),
    "E 5 times too large": (_stated(young_kpa=5.0), "^(stiffness|force)"),
    "E in Pa": (_stated(young_kpa=1000.0), "^stiffness"),
    "tissue.png inverted": (lambda v: replace(v, tissue=~v.tissue), "^tissue|marks no tissue"),
    "sensor: 2 times too large": (_sensor(lambda t, f: (t, 2 * f)), "^(sensor|force)"),
    "sensor: mN": (_sensor(lambda t, f: (t, 1000 * f)), _UNITS),
    "sensor: sign": (_sensor(lambda t, f: (t, -f)), "^sensor"),
    "sensor: axes": (_sensor(lambda t, f: (t, f[:, [1, 2, 0]])), "^sensor"),
    "sensor: saturated": (_sensor(lambda t, f: (t, f.clip(f.min() / 2, f.max() / 2))), "^sensor"),
    "sensor: clock 8% fast": (_sensor(lambda t, f: (t * 1.08, f)), "^clocks"),
    "sensor: clock 0.6 s off": (_sensor(lambda t, f: (t - 0.6, f)), "^clocks"),
    "masks of 0 and 1": (lambda v: replace(v, white=1), ""),
    "white balance": (_each(lambda rgb, k: rgb * np.array([1.2, 1, 0.7])), ""),
    "gauze at rest": (_patch((225, 220, 212), 15, (0.02, 0.1), (0.2, 0.05), (0.22, 0.3), (0.03, 0.32)), ""),
    "mirrored": (_mirrored, ""),
    "grey": (_each(lambda rgb, k: rgb @ np.full((3, 3), 1 / 3)), ""),
    "10 bits": (lambda v: replace(v, codec=(12, "yuv420p10le", 3)), ""),
    "flicker": (_each(lambda rgb, k: rgb * (1 + 0.15 * (-1) ** k)), ""),
}  # fmt: skip
STEREO: dict[str, tuple[Change, str]] = {
    "right camera a frame late": (_right(_ordered(lambda k: np.maximum(k - 1, 0))), _LATE),
    "right camera frozen": (_right(_ordered(lambda k: np.minimum(k, 6))), "^stereo"),
    "right camera mirrored": (_right(_mirrored), "mirrored"),
    "right camera 4 rows down": (_right(_bumped(y=4, since=0)), "rows"),
    "right camera bumped by 3 px": (_right(_bumped(x=2.4, y=1.8)), "^stereo|right camera"),
    "cameras swapped": (lambda v: replace(v, rgb=v.right, right=v.rgb), "swapped"),
    "right camera a copy of the left": (lambda v: replace(v, right=v.rgb), "left camera's own"),
    "baseline 2 times too long": (_stated(stereo=_DOUBLE), "^scale"),
}  # fmt: skip


STUDY = Study(measure, "scoring/stability/stability.json", page, ("{work}/degraded",))
