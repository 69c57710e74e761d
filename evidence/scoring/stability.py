"""Recordings degraded in one way at a time, scored by the default command: what leads, and what is found.

Each way is applied to a described recording with two cameras (tissue, instruments and contact-free span
stated) and to a bare one with one camera (scale and E only); plain, covered and pulsating tissue take turns.
Silently wrong: the force errs by more than a tenth of the peak, its 90% interval holds under 80% of the
frames in or out of contact, and there is no finding that the undegraded recording lacks. Undegraded
recordings show what each further statement gains.
"""

import re
import shutil
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from numpy.typing import NDArray
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
from synth.dataset.store import Dataset, Sequence
from synth.engine.run import render_job
from synth.errors import UserError
from synth.job import reader
from synth.job.schema import FemSection

_KINDS = {
    "plain": {"skull": ("bonded",), "membrane": {"probability": 0.0}},
    "membrane": {"skull": ("bonded",), "membrane": {"probability": 1.0}},
    "pulse": {
        "skull": ("bonded",),
        "membrane": {"probability": 0.0},
        "pulse": {"heart_mm": (0.1, 0.3), "breath_mm": (0.1, 0.3)},
    },
}
_GIVEN = (
    "scale and E",
    "tissue, instruments",
    "a span without contact",
    "the membrane's state",
)  # and those before
_DESCRIBED, _BARE = 2, 0  # of degraded recordings
_CASES = ((_DESCRIBED, 2), (_BARE, 1))  # statements, cameras
_CLEAN = 4  # undegraded recordings of each kind
_SENSOR_HZ, _SENSOR_NOISE = 100.0, 0.005
_LEAST, _COVERED = 0.1, 0.8


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
    given: int = _DESCRIBED  # how much is stated, of `_GIVEN`


Change = Callable[[Video], Video]


def measure(work: Path, seed: int = 35, only: str = "", kinds: str = ",".join(_KINDS)) -> dict[str, Any]:
    """Scores rendered recordings after each change; `only`: a pattern of the changes' names."""
    rows, clean = list[dict[str, Any]](), list[dict[str, Any]]()
    for kind, cameras, given in product(kinds.split(","), (2, 1), range(len(_GIVEN))):
        for k, video in enumerate(_rendered(work, kind, seed, _CLEAN)):
            state = {"membrane": "intact" if kind == "membrane" else "stripped"}
            right = video.right if cameras == 2 else None
            video = replace(video, given=given, right=right, meta=video.meta | state)
            case = {"kind": kind, "cameras": cameras, "given": given}
            usual = _point(work, video, lambda same: same, "", kind, seed, k, *case.values())
            clean.append(case | usual)
            if k or (given, cameras) not in _CASES:
                continue
            for number, (what, (change, cause)) in enumerate(CHANGES.items()):
                turn = list(_KINDS)[(number + given // 2 + cameras) % len(_KINDS)]
                if re.search(only, what) and (cameras == 2 or what in MONOCULAR) and kind == turn:
                    row = _point(work, video, change, cause, kind, seed, k, *case.values(), what)
                    silent = _is_silently_wrong(row, usual["findings"])
                    rows.append({"change": what, **case, **row, "silently_wrong": silent})
    return {"seed": seed, "changes": _summary(rows), "undegraded": _undegraded(clean), "points": rows}


def _point(work: Path, video: Video, change: Change, cause: str, *key: Any) -> Any:
    """Scores of a changed recording, cached in `work`; `cause`: pattern of a finding that names it."""
    peak_mn = 1000 * float(np.linalg.norm(video.sensor[:, 1:], axis=1).max())
    row = stored.result(
        work / "points", "change", stored.key(*key), lambda: _scored(_written(change(video), work), peak_mn)
    )
    named = any(re.search(cause, one) for one in row["findings"]) if cause else None
    return {**row, "named": named}


def _is_silently_wrong(row: dict[str, Any], usual: list[str]) -> bool:
    """Whether a wrong force has no finding besides the `usual` ones of the undegraded recording."""
    holds = min((row[key] for key in ("holds", "holds_free") if row[key] is not None), default=1.0)
    found, known = ({re.sub(r"[\d.]+", "", one) for one in findings} for findings in (row["findings"], usual))
    return bool((row["error"] or 0.0) > _LEAST and holds < _COVERED and not found - known)


def _rendered(work: Path, kind: str, seed: int, count: int) -> list[Video]:
    """Stereo recordings of 24 frames in 3 s."""
    data = work / f"{kind} {seed}"
    job = reader.load_job("mission")
    changed = {"seed": seed + list(_KINDS).index(kind), "sequences": count, "frames": 24, "fps": 8.0}
    fem = FemSection.model_validate({**job.fem.model_dump(exclude_unset=True), **_KINDS[kind]})
    render_job(job.model_copy(update={**changed, "fem": fem}), data, workers=1)
    return [_read(sequence, data.with_name(f"{data.name} {k}")) for k, sequence in enumerate(Dataset(data))]


def _read(sequence: Sequence, folder: Path) -> Video:
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


def _written(video: Video, work: Path) -> Path:
    """Folder of the recording, in place of the previous one."""
    folder, meta = work / "degraded", {**video.meta, "tissue": "brain"}
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for name, images in (("frames", video.rgb), ("right", video.right)):
        if images is not None and video.codec:
            _encode(folder / f"{name.replace('frames', 'video')}.mp4", images, video.codec)
        elif images is not None:
            writer.write_second(folder / name, range(len(images)), images)
    if video.given >= 1:
        (folder / "masks").mkdir()
        for k, tool in enumerate(video.tool):
            if tool.any():
                cv2.imwrite(str(folder / f"masks/{k:06d}.png"), tool.astype(np.uint8) * video.white)
        cv2.imwrite(str(folder / "tissue.png"), video.tissue.astype(np.uint8) * 255)
    if video.given < 2:
        meta["sensor"] = {key: value for key, value in meta["sensor"].items() if key != "free_s"}
    if video.given < 3:
        del meta["membrane"]
    writer.write_force(folder, video.sensor[:, 0], video.sensor[:, 1:])
    writer.write_frames(folder, video.time_s)
    if video.right is None:
        meta.pop("stereo", None)
    else:
        (folder / "stereo.yaml").write_text(video.pair, "utf-8")
    writer.write_meta(folder, meta)
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
    return load_model(choose_model(stereo))


def _scored(folder: Path, peak_mn: float) -> dict[str, Any]:
    """Errors of the leading force, of the peak, share of frames in its interval, and findings."""
    row: dict[str, Any] = dict.fromkeys(("error", "over_time", "holds", "holds_free"))
    try:
        result = score(folder, _model((folder / "stereo.yaml").exists()))
    except UserError as error:
        return {**row, "findings": [str(error).replace(f"{folder}: ", "")]}
    row["findings"] = [f"{one.cause}: {one.message}" for one in result.findings]
    sensor, main = np.asarray(result.sensor_mn, np.float64), result.methods[result.main]
    if result.refused or main.low_mn is None or main.high_mn is None:
        return row
    known = result.scored & np.isfinite(main.size_mn) & np.isfinite(sensor)
    if known.sum() > 1:
        row["error"] = abs(float(main.size_mn[known].max() - sensor[known].max())) / peak_mn
        row["over_time"] = float(np.abs(main.size_mn - sensor)[known].mean()) / peak_mn
        inside, touched = (sensor >= main.low_mn) & (sensor <= main.high_mn), sensor > _LEAST * peak_mn
        for key, of in (("holds", known & touched), ("holds_free", known & ~touched)):
            row[key] = float(inside[of].mean()) if of.any() else None
    return row


def _summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A line for each change: tissue, errors, and whether the cause is named or the force held back."""
    lines = []
    for (name,), own in report.grouped(rows, "change").items():
        line: dict[str, Any] = {"change": name, "silently wrong": sum(row["silently_wrong"] for row in own)}
        for given, cameras in _CASES:
            of = [row for row in own if (row["given"], row["cameras"]) == (given, cameras)]
            if of:
                line[f"{'described' if given else 'bare'}, {cameras}"] = f"{of[0]['kind']}: {_cell(of)}"
        messages, cause = (one for row in own for one in row["findings"]), CHANGES[name][1] or "$^"
        line["finding"] = max(messages, key=lambda one: bool(re.search(cause, one)), default="")[:90]
        lines.append(line)
    return lines


def _cell(rows: list[Mapping[str, Any]]) -> str:
    """Error of the peak, least share in the interval, and how often the cause is named, in words."""
    errors = [row["error"] for row in rows if row["error"] is not None]
    holds = [row["holds"] for row in rows if row["holds"] is not None]
    text = (
        f"{100 * np.median(errors):.0f}%, holds {100 * min(holds):.0f}%" if errors and holds else "held back"
    )
    if rows[0]["named"] is None:
        return text
    named = all(row["named"] or row["error"] is None for row in rows)
    return f"{text}, {'named' if named else 'not named'}"


def _undegraded(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A line for each kind of tissue and case: the same, and the causes of findings."""
    lines = []
    for (cameras, kind, given), own in report.grouped(rows, "cameras", "kind", "given").items():
        causes = Counter(cause for row in own for cause in {one.split(":")[0] for one in row["findings"]})
        known = ", ".join(f"{cause}: {count}" for cause, count in causes.items()) or "none"
        case = {"cameras": cameras, "tissue": kind, "stated, with all above": _GIVEN[given]}
        over = [row["over_time"] for row in own if row["over_time"] is not None]
        case["mean error, of the peak"] = f"{100 * np.mean(over):.0f}%" if over else "–"
        free = [row["holds_free"] for row in own if row["holds_free"] is not None]
        held = {"holds without contact": f"{100 * min(free):.0f}%" if free else "–"}
        lines.append({**case, "count": len(own), "error": _cell(own), **held, "findings": known})
    return lines


def page(found: Mapping[str, Any]) -> report.Page:
    """Draws `stability.json`."""
    changes = found["changes"]
    silent = sum(row["silently wrong"] for row in changes) or "None"
    words = [
        f"**{silent} of {len(found['points'])} recordings, degraded in {len(changes)} ways, had a force "
        "outside its interval without a finding that the undegraded one lacks.** Each cell: tissue, error of "
        "the peak force, share of contact frames in the 90% interval, and whether a finding named the cause "
        "or the force was held back; of undegraded recordings the median and the least.",
        "The force is that of the default command. *Described*: tissue, instruments and the span without "
        "contact are stated; *bare*: scale and Young's modulus only. 2, 1: cameras.",
    ]
    sections = [
        report.Section("Degraded recordings", changes),
        report.Section("Undegraded recordings", found["undegraded"]),
    ]
    return report.Page("Scoring: degraded recordings", found, (), sections, words)


def _each(change: Callable[[Pixels, int], Any]) -> Change:
    """A change of each image (H, W, 3) of the left camera and its number."""
    return lambda video: replace(
        video,
        rgb=np.stack([np.clip(change(rgb, k), 0, 255).astype(np.uint8) for k, rgb in enumerate(video.rgb)]),
    )


def _warped(rgb: Pixels, matrix: Any) -> Any:
    return cv2.warpAffine(rgb, matrix, rgb.shape[1::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def _moved(video: Video, scale: float = 1.0, turn_deg: float = 0.0, shift: float = 0.0) -> Video:
    """The recording with the left camera moved from half of its frames on."""
    height, width = video.rgb.shape[1:3]
    matrix = cv2.getRotationMatrix2D((width / 2, height / 2), turn_deg, scale)
    matrix[:, 2] += np.array([0.8, 0.6]) * shift
    return _each(lambda rgb, k: rgb if k < len(video.rgb) // 2 else _warped(rgb, matrix))(video)


def _moved_untouched(video: Video) -> Video:
    """The first frame under camera motion, without contact."""
    still = np.clip(video.rgb[:1] + np.random.default_rng(1).normal(0, 1.5, video.rgb.shape), 0, 255)
    sensor = video.sensor.copy()
    sensor[:, 1:] -= cv2.GaussianBlur(sensor[:, 1:], (1, 15), 0)
    video = replace(video, rgb=still.astype(np.uint8), sensor=sensor, tool=video.tool & False)
    return _each(
        lambda rgb, k: _warped(rgb, np.array([[1, 0, 5 * np.sin(k / 3)], [0, 1, 2 * np.sin(k / 2)]]))
    )(video)


def _rippled(rgb: Pixels, k: int) -> Any:
    y, x = np.mgrid[: rgb.shape[0], : rgb.shape[1]].astype(np.float32)
    wave = (k > 2) * np.sin(y / 6 - 1.3 * k)
    return cv2.remap(rgb, x + wave, y + wave, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def _order(of: Callable[[NDArray[np.intp]], Any], right: bool = False) -> Change:
    """A change of the order of one camera's images; tool masks follow those of the left."""

    def change(video: Video) -> Video:
        order = np.asarray(of(np.arange(len(video.rgb))))
        if right:
            return replace(video, right=video.right[order])
        return replace(video, rgb=video.rgb[order], tool=video.tool[order], time_s=video.time_s[: len(order)])

    return change


def _hand(video: Video) -> Video:
    """The recording with a gloved finger that enters from the right after a third of its frames."""
    height, width = video.rgb.shape[1:3]
    weave = np.random.default_rng(2).normal(0, 60, (height, width, 1)).astype(np.float32)
    weave = cv2.GaussianBlur(weave, (0, 0), 2)[..., None]

    def one(rgb: Pixels, k: int) -> Any:
        into = min(max(k - len(video.rgb) // 3, 0) / 5, 1) * 0.45 * width
        mask, centre = np.zeros((height, width), np.uint8), (int(width * 1.1 - into), height // 2)
        cv2.ellipse(mask, centre, (width // 5, height // 6), 0, 0, 360, 255, -1)
        return np.where(mask[..., None] > 0, np.array([222, 202, 180]) + weave, rgb)

    return _each(one)(video)


def _noise(levels: float, k: int, rgb: Pixels) -> Any:
    return np.random.default_rng((4, k)).normal(0, levels, rgb.shape)


def _still(colour: tuple[int, int, int], noise: float, *points: tuple[float, float]) -> Change:
    """A polygon of a colour in all frames; points in shares of the image."""

    def one(rgb: Pixels, k: int) -> Any:
        mask = np.zeros(rgb.shape[:2], np.uint8)
        cv2.fillPoly(mask, [np.int32(np.array(points) * rgb.shape[1::-1])], 255)
        weave = np.random.default_rng(3).normal(0, noise, rgb.shape[:2])[..., None]
        return np.where(mask[..., None] > 0, np.array(colour) + weave, rgb)

    return _each(one)


def _jpeg(quality: int) -> Change:
    how = [cv2.IMWRITE_JPEG_QUALITY, quality]
    return _each(lambda rgb, k: cv2.imdecode(cv2.imencode(".jpg", rgb, how)[1], 1))


def _squeezed(video: Video, codec: tuple[int, str, int] | None) -> Video:
    """The recording with non-square pixels; only a video declares their aspect ratio."""
    small = np.stack(
        [cv2.resize(rgb, None, fx=0.75, fy=1, interpolation=cv2.INTER_AREA) for rgb in video.rgb]
    )
    if codec:
        return replace(video, rgb=small, codec=codec)
    columns = np.linspace(0, video.tissue.shape[1] - 1, small.shape[2]).astype(int)
    return replace(video, rgb=small, tissue=video.tissue[:, columns], tool=video.tool[..., columns])


def _boxed(rgb: Pixels, k: int) -> Any:
    bar = rgb.shape[0] // 8
    inner = cv2.resize(rgb, (rgb.shape[1], rgb.shape[0] - 2 * bar), interpolation=cv2.INTER_AREA)
    return cv2.copyMakeBorder(inner, bar, bar, 0, 0, cv2.BORDER_CONSTANT, value=(16, 16, 16))


def _combed(video: Video) -> Video:
    rgb = video.rgb.copy()
    rgb[:-1, 1::2] = video.rgb[1:, 1::2]
    return replace(video, rgb=rgb)


def _stated(**changes: Any) -> Change:
    """Changes of meta.yaml; a float multiplies the value."""
    return lambda video: replace(
        video,
        meta=video.meta | {k: video.meta[k] * v if isinstance(v, float) else v for k, v in changes.items()},
    )


def _sensor(of: Callable[[Floats, Floats], tuple[Any, Any]]) -> Change:
    """A change of the sensor's times (N,) and forces (N, 3)."""
    return lambda video: replace(video, sensor=np.column_stack(of(video.sensor[:, 0], video.sensor[:, 1:])))


def _clipped(force: Floats) -> Any:
    return np.clip(force, -0.4 * np.abs(force).max(), 0.4 * np.abs(force).max())


def _stuck(force: Floats) -> Any:
    peak = int(np.linalg.norm(force, axis=1).argmax())
    return np.where((np.arange(len(force)) < peak)[:, None], force, force[peak])


def _rest_at_peak(video: Video) -> Video:
    at = video.sensor[np.linalg.norm(video.sensor[:, 1:], axis=1).argmax(), 0]
    return replace(video, meta={**video.meta, "rest_frame": int(np.abs(video.time_s - at).argmin())})


def _starts_at_peak(tared: bool) -> Change:
    """The recording from the largest force on; with a sensor that is tared there or not."""

    def change(video: Video) -> Video:
        peak = int(np.linalg.norm(video.sensor[:, 1:], axis=1).argmax())
        first = int(np.abs(video.time_s - video.sensor[peak, 0]).argmin())
        sensor = video.sensor - tared * np.append(0, video.sensor[peak, 1:])
        left, times = video.sensor[:, 0] >= video.time_s[first], video.time_s[first:]
        meta = {
            **video.meta,
            "sensor": {key: v for key, v in video.meta["sensor"].items() if key != "free_s"},
        }
        right = None if video.right is None else video.right[first:]
        cut = replace(video, rgb=video.rgb[first:], right=right, tool=video.tool[first:], time_s=times)
        return replace(cut, sensor=sensor[left], meta=meta)

    return change


def _refrozen(video: Video) -> Video:
    """Five frames frozen, with new sensor noise on each copy."""
    frozen = _order(lambda k: np.where((k > 7) & (k < 13), 8, k))(video)
    return _each(lambda rgb, k: rgb + _noise(2, k, rgb) * (8 < k < 13))(frozen)


def _drifted(video: Video) -> Video:
    """A camera that drifts by 6 px over the recording."""
    move = 6 / max(len(video.rgb) - 1, 1)
    return _each(lambda rgb, k: _warped(rgb, np.array([[1, 0, 0.8 * move * k], [0, 1, 0.6 * move * k]])))(
        video
    )


def _right(of: Callable[[Video], Any]) -> Change:
    return lambda video: replace(video, right=np.ascontiguousarray(of(video)))


def _doubled(video: Video) -> Video:
    twice = np.repeat(np.arange(len(video.rgb)), 2)
    time_s = np.arange(len(twice)) * (video.time_s[1] - video.time_s[0]) / 2
    return replace(video, rgb=video.rgb[twice], tool=video.tool[twice], time_s=time_s)


def _turned(video: Video, how: Any) -> Video:
    masks = (..., *how)
    return replace(
        video, rgb=video.rgb[(*masks, np.s_[:])], tool=video.tool[masks], tissue=video.tissue[masks]
    )


def _shifted(pictures: Pixels, when: Mask, x: float, y: float) -> Pixels:
    """Pictures (T, H, W, 3), shifted by x, y px in the frames `when` (T,)."""
    matrix = np.array([[1, 0, x], [0, 1, y]])
    return np.stack([_warped(one, matrix) if now else one for one, now in zip(pictures, when, strict=True)])


def _both_bumped(video: Video) -> Video:
    right = _moved(replace(video, rgb=video.right), shift=5.0).rgb
    return replace(_moved(video, shift=5.0), right=right)


_OOD, _AGAIN, _REST = "out of distribution", "again", "^rest frame|most likely.*rest frame"
_MISSING = r"^pictures: .*missing|^clocks|^times"
_LATE = "^stereo: .*(late|early)"
_COARSE, _UNITS, _FLIP = "^pictures: .*(detail|compressed)", "^sensor|in newtons|in mN", np.s_[::-1]
# Function that makes it, and pattern of the message on its cause; empty: the force should stay the same.
MONOCULAR: dict[str, tuple[Change, str]] = {
    "camera bumped by 5 px": (lambda video: _moved(video, shift=5.0), "^camera"),
    "camera bumped by 2 px": (lambda video: _moved(video, shift=2.0), "^camera"),
    "camera drifts by 6 px": (_drifted, "^camera"),
    "zoom by 1%": (lambda video: _moved(video, scale=1.01), "^camera"),
    "camera moves, no contact": (_moved_untouched, "^camera"),
    "zoom by 3%": (lambda video: _moved(video, scale=1.03), "^camera"),
    "rotation by 2 deg": (lambda video: _moved(video, turn_deg=2.0), "^camera"),
    "ripples of 1 px": (_each(_rippled), f"moves unlike|{_OOD}"),
    "rest frame at the peak": (_rest_at_peak, "^rest frame"),
    "first picture under load": (_starts_at_peak(False), _REST),
    "first picture under load, sensor tared": (_starts_at_peak(True), _REST),
    "frozen, new noise on copies": (_refrozen, _AGAIN),
    "half the light later": (_each(lambda rgb, k: rgb * (0.5 if k > 11 else 1.0)), "^pictures: .*light"),
    "frozen for 5 frames": (_order(lambda k: np.where((k > 7) & (k < 13), 8, k)), _AGAIN),
    "4 frames dropped": (_order(lambda k: k[(k < 8) | (k > 11)]), _MISSING),
    "4 frames late": (_order(lambda k: np.maximum(k - 4, 0)), f"{_MISSING}|{_AGAIN}"),
    "a hand comes into view": (_hand, "^foreground"),
    "interlaced": (_combed, "interlaced"),
    "pixels 4:3, declared": (lambda video: _squeezed(video, (12, "yuv420p", 4)), ""),
    "pixels 4:3, not declared": (lambda video: _squeezed(video, None), "(?i)pixels"),
    "letterbox": (_each(_boxed), "bars"),
    "H.264 at crf 51": (lambda video: replace(video, codec=(51, "yuv420p", 3)), _COARSE),
    "JPEG at quality 3": (_jpeg(3), _COARSE),
    "noise of 30 levels": (_each(lambda rgb, k: rgb + _noise(30, k, rgb)), "noisy"),
    "dark": (_each(lambda rgb, k: 0.2 * rgb + _noise(1, k, rgb)), "dim"),
    "blur of 3 px": (_each(lambda rgb, k: cv2.GaussianBlur(rgb, (0, 0), 3)), "detail"),
    "focus lost later": (_each(lambda rgb, k: cv2.GaussianBlur(rgb, (0, 0), 3) if k > 8 else rgb), "sharp"),
    "scale 1.5 times too large": (_stated(scale_mm_per_px=1.5), "^scale"),
    "scale 2 times too small": (_stated(scale_mm_per_px=0.5), "^(scale|force)"),
    "scale in cm": (_stated(scale_mm_per_px=0.1), "^scale"),
    "E 5 times too large": (_stated(young_kpa=5.0), "^(stiffness|force)"),
    "E in Pa": (_stated(young_kpa=1000.0), "^stiffness"),
    "tissue.png inverted": (lambda video: replace(video, tissue=~video.tissue), "^tissue|marks no tissue"),
    "sensor: 2 times too large": (_sensor(lambda t, f: (t, 2 * f)), "^(sensor|force)"),
    "sensor: grams": (_sensor(lambda t, f: (t, f * 1000 / 9.81)), _UNITS),
    "sensor: mN": (_sensor(lambda t, f: (t, f * 1000)), _UNITS),
    "sensor: sign": (_sensor(lambda t, f: (t, -f)), "^sensor"),
    "sensor: axes": (_sensor(lambda t, f: (t, f[:, [1, 2, 0]])), "^sensor"),
    "sensor: saturated": (_sensor(lambda t, f: (t, _clipped(f))), "^sensor"),
    "sensor: stuck": (_sensor(lambda t, f: (t, _stuck(f))), "^sensor"),
    "sensor: clock 8% fast": (_sensor(lambda t, f: (t * 1.08, f)), "^clocks"),
    "sensor: clock 0.6 s off": (_sensor(lambda t, f: (t - 0.6, f)), "^clocks"),
    "frames reversed": (_order(lambda k: k[::-1]), "^clocks"),
    "every frame twice": (_doubled, _AGAIN),
    "masks of 0 and 1": (lambda video: replace(video, white=1), ""),
    "exposure 0.4 to 1.6": (_each(lambda rgb, k: rgb * (0.4 + 1.2 * k / 23)), ""),
    "white balance": (_each(lambda rgb, k: rgb * np.array([1.2, 1, 0.7])), ""),
    "text burnt in": (
        _each(lambda rgb, k: cv2.putText(rgb.copy(), f"12:30:{k:02d}", (6, 16), 0, 0.5, (255, 255, 255))),
        "",
    ),
    "black tool at rest": (_still((15, 15, 17), 3, (0, 0.75), (0, 0.83), (0.35, 0.66), (0.34, 0.61)), ""),
    "gauze at rest": (_still((225, 220, 212), 15, (0.02, 0.1), (0.2, 0.05), (0.22, 0.3), (0.03, 0.32)), ""),
    "blood pool": (_still((95, 10, 14), 2, (0.7, 0.75), (0.85, 0.7), (0.92, 0.85), (0.75, 0.92)), ""),
    "mirrored": (lambda video: _turned(video, (np.s_[:], _FLIP)), ""),
    "turned by 180 deg": (lambda video: _turned(video, (_FLIP, _FLIP)), ""),
    "grey": (_each(lambda rgb, k: rgb @ np.full((3, 3), 1 / 3)), ""),
    "BGR": (_each(lambda rgb, k: rgb[..., ::-1]), ""),
    "10 bits": (lambda video: replace(video, codec=(12, "yuv420p10le", 3)), ""),
    "flicker": (_each(lambda rgb, k: rgb * (1 + 0.15 * (-1) ** k)), ""),
}
STEREO: dict[str, tuple[Change, str]] = {
    "right camera a frame late": (_order(lambda k: np.maximum(k - 1, 0), True), _LATE),
    "right camera lost a frame": (_order(lambda k: np.minimum(k + (k > 6), len(k) - 1), True), _LATE),
    "right camera frozen": (_order(lambda k: np.minimum(k, 6), True), "^stereo"),
    "right camera mirrored": (_right(lambda video: video.right[:, :, ::-1]), "mirrored"),
    "right camera 4 rows down": (_right(lambda video: np.roll(video.right, 4, axis=1)), "rows"),
    "right camera 1.2 rows down": (
        _right(lambda video: _shifted(video.right, np.arange(len(video.right)) >= 0, 0.0, 1.2)),
        "^stereo",
    ),
    "right camera bumped by 3 px": (
        _right(lambda v: _shifted(v.right, np.arange(len(v.right)) >= len(v.right) // 2, 2.4, 1.8)),
        "^stereo|right camera",
    ),
    "right camera out of focus": (
        _right(lambda video: np.stack([cv2.GaussianBlur(one, (0, 0), 3) for one in video.right])),
        "^stereo",
    ),
    "baseline 1.2 times too long": (
        _stated(stereo={"calibration": "stereo.yaml", "mm_per_unit": 1.2}),
        "^scale",
    ),
    "cameras swapped": (lambda video: replace(video, rgb=video.right, right=video.rgb), "swapped"),
    "right camera a copy of the left": (_right(lambda video: video.rgb), "left camera's own"),
    "baseline 2 times too long": (
        _stated(stereo={"calibration": "stereo.yaml", "mm_per_unit": 2}),
        "^scale",
    ),
    "scale 1.5 times too large, stereo": (_stated(scale_mm_per_px=1.5), "^scale"),
    "bumped by 5 px, stereo": (_both_bumped, "^camera"),
}
CHANGES = MONOCULAR | STEREO


STUDY = Study(measure, "scoring/stability/stability.json", page, ("{work}/degraded",))
