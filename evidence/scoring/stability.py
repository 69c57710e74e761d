"""Films spoilt in one way at a time: what becomes of the answer, and is the cause named?

Silently wrong: the error, of the peak or over time, more than doubled and above a tenth of the peak, nothing
new said, and the 90% interval misses. Also what is said of films that nothing is wrong with.

Run: python -m evidence.scoring.stability films
"""

from __future__ import annotations

import re
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from ruamel.yaml import YAML

from bench.methods.comparison import PHYSICS
from bench.methods.physics import Physics
from bench.recording import writer
from bench.recording.from_sequence import export_recording
from bench.scoring.score import score
from evidence import cache as kept
from evidence import report
from learn import load_model
from learn.inference.shipped import require_model
from synth.dataset.store import Dataset
from synth.engine.run import render_job
from synth.errors import UserError
from synth.job import reader
from synth.system.checked_file import read_picture

_JOBS = {"opening": "mission", "edge to edge": str(Path(__file__).parents[1] / "curves/mission-bench.yaml")}
_SCENES = (("opening", 1), ("edge to edge", 0))
_CLEAN = 8  # films of either kind that nothing is wrong with
_SENSOR_HZ, _SENSOR_NOISE = 100.0, 0.005
_DOUBLED, _LEAST, _COVERED = 2.0, 0.1, 0.8
_NOTES = "out of distribution|again, frozen"


@dataclass(frozen=True, eq=False)
class Film:
    """A recording in memory: pictures of either eye (T, H, W, 3), masks, sensor (N, 4) in s and newtons."""

    rgb: NDArray[np.uint8]
    right: Any
    tool: NDArray[np.bool_]
    tissue: NDArray[np.bool_]
    time_s: NDArray[np.float64]
    sensor: NDArray[np.float64]
    meta: dict[str, Any]
    pair: str
    """stereo.yaml."""
    video: tuple[int, str, int] | None = None
    """Quality (crf), format of the pixels, and their width in thirds of their height; None: PNG."""
    white: int = 255
    """Of masks."""


Change = Callable[[Film], Film]


def main(
    work: Path, out: Path = report.RESULTS / "scoring/stability", seed: int = 35, only: str = ""
) -> None:
    """Renders into `work`; `only`: a pattern of films."""
    cv2.setNumThreads(1)
    rows = list[dict[str, Any]]()
    for name, index in _SCENES:
        clean = _read(_rendered(work, name, seed, 2)[index])
        peak = 1000 * float(np.linalg.norm(clean.sensor[:, 1:], axis=1).max())
        for what in filter(re.compile(only).search, FILMS):
            eyes = 1 if what in ONE_EYE else 2
            film, (change, cause) = clean if eyes == 2 else replace(clean, right=None), FILMS[what]
            before = _point(work, film, lambda same: same, peak, name, index, seed, eyes)
            after = _point(work, film, change, peak, name, index, seed, eyes, what)
            row = {"film": what, "scene": f"{name} {index}", "eyes": eyes}
            rows.append(row | _judged(after, before, cause))
    found: dict[str, Any] = {"seed": seed, "films": _summary(rows), "undegraded": [], "points": rows}
    if not only:
        found["undegraded"] = list(_alarms(work, seed + 1000))
    report.save(out, "stability.json", found, page(found))
    report.show({key: found[key] for key in ("films", "undegraded")})


def _point(work: Path, film: Film, change: Change, peak_mn: float, *key: Any) -> Any:
    """A film, spoilt and scored; what was found before is kept, and a run that ended goes on."""
    return kept.result(
        work / "points", "film", kept.key(*key), lambda: _scored(_written(change(film), work), peak_mn)
    )


def _rendered(work: Path, name: str, seed: int, count: int) -> list[Path]:
    """Recordings of both eyes, 24 frames in 3 s."""
    data, folders = work / f"{name} {seed}", [work / f"{name} {seed} {k}" for k in range(count)]
    if not folders[-1].is_dir():
        changed = {"seed": seed, "sequences": count, "frames": 24, "fps": 8.0}
        render_job(reader.load_job(_JOBS[name]).model_copy(update=changed), data, workers=1)
        for sequence, folder in zip(Dataset(data), folders, strict=True):
            export_recording(sequence, folder)
    return folders


def _read(folder: Path) -> Film:
    """A recording of `export_recording`; its sensor is sampled more often, with noise, free at first."""
    rgb, right = (
        np.stack([read_picture(p, cv2.IMREAD_COLOR)[..., ::-1] for p in sorted((folder / eye).glob("*.png"))])
        for eye in ("frames", "right")
    )
    meta = YAML(typ="safe").load((folder / "meta.yaml").read_text("utf-8"))
    tool = np.zeros(rgb.shape[:3], bool)
    for path in (folder / "masks").glob("*.png"):
        tool[int(path.stem)] = np.asarray(read_picture(path, 0)) > 127
    time_s = np.loadtxt(folder / "frames.csv", delimiter=",", skiprows=1)[:, 1]
    force = np.loadtxt(folder / "force.csv", delimiter=",", skiprows=1)
    clock = np.arange(0, time_s[-1] + 0.5, 1 / _SENSOR_HZ)
    values = np.stack([np.interp(clock, force[:, 0], f) for f in force[:, 1:].T], axis=1)
    size = np.linalg.norm(force[:, 1:], axis=1)
    values += _SENSOR_NOISE * size.max() * np.random.default_rng(0).normal(size=values.shape)
    meta["sensor"]["free_s"] = [[0.0, max(float(force[np.flatnonzero(size > 0)[0] - 1, 0]), 0.1)]]
    tissue, sensor = (
        np.asarray(read_picture(folder / "tissue.png", 0)) > 127,
        np.column_stack([clock, values]),
    )
    return Film(rgb, right, tool, tissue, time_s, sensor, meta, (folder / "stereo.yaml").read_text("utf-8"))


def _written(film: Film, work: Path) -> Path:
    """A film as a recording, in place of the one before."""
    folder, meta = work / "spoilt", dict(film.meta)
    shutil.rmtree(folder, ignore_errors=True)
    for name, eye in (("frames", film.rgb), ("right", film.right)):
        if eye is not None and film.video:
            folder.mkdir(exist_ok=True)
            _encode(folder / f"{name.replace('frames', 'video')}.mp4", eye, film.video)
        elif eye is not None:
            (folder / name).mkdir(parents=True)
            for k, rgb in enumerate(eye):
                cv2.imwrite(str(folder / f"{name}/{k:06d}.png"), np.ascontiguousarray(rgb[..., ::-1]))
    (folder / "masks").mkdir()
    for k, tool in enumerate(film.tool):
        if tool.any():
            cv2.imwrite(str(folder / f"masks/{k:06d}.png"), tool.astype(np.uint8) * film.white)
    cv2.imwrite(str(folder / "tissue.png"), film.tissue.astype(np.uint8) * 255)
    writer.write_force(folder, film.sensor[:, 0], film.sensor[:, 1:])
    writer.write_frames(folder, film.time_s)
    if film.right is None:
        meta.pop("stereo", None)
    else:
        (folder / "stereo.yaml").write_text(film.pair, "utf-8")
    writer.write_meta(folder, meta)
    return folder


def _encode(path: Path, film: NDArray[np.uint8], how: tuple[int, str, int]) -> None:
    """H.264; see `Film.video`."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=8, options={"crf": str(how[0]), "threads": "1"})
        stream.height, stream.width, stream.pix_fmt = *film.shape[1:3], how[1]
        stream.codec_context.sample_aspect_ratio = Fraction(how[2], 3)
        for rgb in film:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), "rgb24")))
        container.mux(stream.encode())


@cache
def _model(stereo: bool) -> Any:
    return load_model(require_model(stereo), quick=True)


def _scored(folder: Path, peak_mn: float) -> dict[str, Any]:
    """Errors over the undegraded film's peak, how often the interval holds, and what is said."""
    row: dict[str, Any] = dict.fromkeys(("physics", "error", "over_time", "held"))
    stereo = (folder / "stereo.yaml").exists()
    try:
        result = score(folder, _model(stereo), methods={PHYSICS: Physics()}, baselines=False)
    except UserError as error:
        return {**row, "said": [str(error).replace(f"{folder}: ", "")]}
    row["said"] = [f"{one.what}: {one.message}" for one in result.findings]
    row["said"] += [note for note in result.notes if re.search(_NOTES, note)]
    sensor, main = np.asarray(result.sensor_mn), result.methods[result.main]
    for key, method in (("physics", result.methods[PHYSICS]), ("error", main)):
        found = method.size_mn
        known = result.scored & np.isfinite(found) & np.isfinite(sensor)
        if known.sum() > 1:
            row[key] = abs(float(found[known].max() - sensor[known].max())) / peak_mn
    if row["error"] is not None:
        row["over_time"] = float(np.abs(found - sensor)[known].mean()) / peak_mn
        if main.low_mn is not None and main.high_mn is not None:
            touched = known & (np.maximum(found, sensor) > _LEAST * peak_mn) & np.isfinite(main.low_mn)
            inside = (sensor >= main.low_mn) & (sensor <= main.high_mn)
            row["held"] = float(inside[touched].mean()) if touched.any() else None
    return row


def _judged(after: dict[str, Any], before: dict[str, Any], cause: str) -> dict[str, Any]:
    """A film against itself before it was spoilt; `cause`: a pattern of what names it, empty: need not be."""
    known = {re.sub(r"[\d.,]+", "", one) for one in before["said"]}
    new = [one for one in after["said"] if re.sub(r"[\d.,]+", "", one) not in known]
    worse = any(
        after[key] is not None and after[key] > max(_DOUBLED * (before[key] or 0.0), _LEAST)
        for key in ("error", "over_time")
    )
    named = any(re.search(cause, one) for one in new) if cause else None
    row = {"before": before["error"], **after, "said": new, "worse": worse, "named": named}
    return {**row, "silently_wrong": worse and (after["held"] or 0.0) < _COVERED and not new}


def _summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A line for each way."""
    lines = []
    for film in dict.fromkeys(row["film"] for row in rows):
        own = [row for row in rows if row["film"] == film]
        named = [row["named"] for row in own if row["named"] is not None]
        said, cause = (one for row in own for one in row["said"]), FILMS[film][1] or "$^"
        errors = {k: [row[k] for row in own if row[k] is not None] for k in ("before", "error", "physics")}
        lines.append(
            {"film": film, "eyes": own[0]["eyes"]}
            | {key: f"{100 * np.median(e):.0f}%" if e else "none" for key, e in errors.items()}
            | {
                "worse": f"{sum(row['worse'] for row in own)} of {len(own)}",
                "interval holds": f"{sum((row['held'] or 0) >= _COVERED for row in own)} of {len(own)}",
                "named": f"{sum(named)} of {len(named)}" if named else None,
                "silently wrong": sum(row["silently_wrong"] for row in own),
                "said": max(said, key=lambda one: bool(re.search(cause, one)), default="")[:90],
            }
        )
    return lines


def _alarms(work: Path, seed: int) -> Iterator[dict[str, Any]]:
    """What is said of films as they are, which nothing here was tuned on."""
    for name in _JOBS:
        folders, said = _rendered(work, name, seed, _CLEAN), Counter[str]()
        for folder in folders:
            where = _written(_read(folder), work)
            said.update({one.split(":")[0] for one in _scored(where, 1.0)["said"]} or {"nothing"})
        line = ", ".join(f"{k}: {n}" for k, n in said.items())
        yield {"films": name, "count": len(folders), "said of": line}


def page(found: dict[str, Any]) -> report.Page:
    """Draws `stability.json`: the films that an error or a missing name makes worth a look."""
    films = found["films"]
    silent = sum(row["silently wrong"] for row in films)
    columns = ("film", "eyes", "before", "error", "worse", "interval holds", "named")
    shown = [row for row in films if row["worse"][0] != "0" or row["named"] in ("0 of 2", "1 of 2")]
    words = [
        f"**{silent or 'None'} of {len(films)} ways to spoil a film moved the force out of its interval "
        f"unsaid.** {len(shown)} made the error worse or weren't always named (the rest: in the data).",
        "Two scenes each, one with tissue from edge to edge. Errors are of the peak, in the median. *Worse*: "
        "more than doubled and above a tenth of the peak, there or over time. *Named*: a warning says why. "
        "*Unsaid*: without any warning that the film unspoilt doesn't have.",
    ]
    sections = [
        report.Section("Spoilt", [{key: row[key] for key in columns} for row in shown]),
        report.Section("What is said where nothing is wrong", found["undegraded"]),
    ]
    return report.Page("Scoring: films that go wrong", found, (), sections, words)


def _each(change: Callable[[NDArray[np.uint8], int], Any]) -> Change:
    """A change of each picture (H, W, 3) of the left eye, given its number."""
    return lambda film: replace(
        film,
        rgb=np.stack([np.clip(change(rgb, k), 0, 255).astype(np.uint8) for k, rgb in enumerate(film.rgb)]),
    )


def _warped(rgb: NDArray[np.uint8], matrix: Any) -> Any:
    return cv2.warpAffine(rgb, matrix, rgb.shape[1::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def _moved(film: Film, scale: float = 1.0, turn_deg: float = 0.0, shift: float = 0.0) -> Film:
    """The camera from the middle of the film on."""
    height, width = film.rgb.shape[1:3]
    matrix = cv2.getRotationMatrix2D((width / 2, height / 2), turn_deg, scale)
    matrix[:, 2] += np.array([0.8, 0.6]) * shift
    return _each(lambda rgb, k: rgb if k < len(film.rgb) // 2 else _warped(rgb, matrix))(film)


def _swayed(film: Film) -> Film:
    """Nothing is touched."""
    still = np.clip(film.rgb[:1] + np.random.default_rng(1).normal(0, 1.5, film.rgb.shape), 0, 255)
    sensor = film.sensor.copy()
    sensor[:, 1:] -= cv2.GaussianBlur(sensor[:, 1:], (1, 15), 0)
    film = replace(film, rgb=still.astype(np.uint8), sensor=sensor, tool=film.tool & False)
    return _each(
        lambda rgb, k: _warped(rgb, np.array([[1, 0, 5 * np.sin(k / 3)], [0, 1, 2 * np.sin(k / 2)]]))
    )(film)


def _rippled(rgb: NDArray[np.uint8], k: int) -> Any:
    y, x = np.mgrid[: rgb.shape[0], : rgb.shape[1]].astype(np.float32)
    wave = (k > 2) * np.sin(y / 6 - 1.3 * k)
    return cv2.remap(rgb, x + wave, y + wave, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def _order(of: Callable[[NDArray[np.intp]], Any], right: bool = False) -> Change:
    """Other pictures in these places, those of one eye; the tool's masks go with the left."""

    def change(film: Film) -> Film:
        order = np.asarray(of(np.arange(len(film.rgb))))
        if right:
            return replace(film, right=film.right[order])
        return replace(film, rgb=film.rgb[order], tool=film.tool[order], time_s=film.time_s[: len(order)])

    return change


def _hand(film: Film) -> Film:
    """A finger of a glove, from the right, from the middle of the film on."""
    height, width = film.rgb.shape[1:3]
    weave = np.random.default_rng(2).normal(0, 60, (height, width, 1)).astype(np.float32)
    weave = cv2.GaussianBlur(weave, (0, 0), 2)[..., None]

    def one(rgb: NDArray[np.uint8], k: int) -> Any:
        into = min(max(k - len(film.rgb) // 3, 0) / 5, 1) * 0.45 * width
        mask, centre = np.zeros((height, width), np.uint8), (int(width * 1.1 - into), height // 2)
        cv2.ellipse(mask, centre, (width // 5, height // 6), 0, 0, 360, 255, -1)
        return np.where(mask[..., None] > 0, np.array([222, 202, 180]) + weave, rgb)

    return _each(one)(film)


def _noise(levels: float, k: int, rgb: NDArray[np.uint8]) -> Any:
    return np.random.default_rng((4, k)).normal(0, levels, rgb.shape)


def _still(colour: tuple[int, int, int], noise: float, *points: tuple[float, float]) -> Change:
    """Something of a colour that lies there in all frames."""

    def one(rgb: NDArray[np.uint8], k: int) -> Any:
        mask = np.zeros(rgb.shape[:2], np.uint8)
        cv2.fillPoly(mask, [np.int32(np.array(points) * rgb.shape[1::-1])], 255)
        weave = np.random.default_rng(3).normal(0, noise, rgb.shape[:2])[..., None]
        return np.where(mask[..., None] > 0, np.array(colour) + weave, rgb)

    return _each(one)


def _jpeg(quality: int) -> Change:
    how = [cv2.IMWRITE_JPEG_QUALITY, quality]
    return _each(lambda rgb, k: cv2.imdecode(cv2.imencode(".jpg", rgb, how)[1], 1))


def _squeezed(film: Film, video: tuple[int, str, int] | None) -> Film:
    """Fewer columns than square pixels would have; only a video says so."""
    small = np.stack([cv2.resize(rgb, None, fx=0.75, fy=1, interpolation=cv2.INTER_AREA) for rgb in film.rgb])
    if video:
        return replace(film, rgb=small, video=video)
    columns = np.linspace(0, film.tissue.shape[1] - 1, small.shape[2]).astype(int)
    return replace(film, rgb=small, tissue=film.tissue[:, columns], tool=film.tool[..., columns])


def _boxed(rgb: NDArray[np.uint8], k: int) -> Any:
    bar = rgb.shape[0] // 8
    inner = cv2.resize(rgb, (rgb.shape[1], rgb.shape[0] - 2 * bar), interpolation=cv2.INTER_AREA)
    return cv2.copyMakeBorder(inner, bar, bar, 0, 0, cv2.BORDER_CONSTANT, value=(16, 16, 16))


def _combed(film: Film) -> Film:
    rgb = film.rgb.copy()
    rgb[:-1, 1::2] = film.rgb[1:, 1::2]
    return replace(film, rgb=rgb)


def _stated(**changes: Any) -> Change:
    """Other things in meta.yaml; a float multiplies what is there."""
    return lambda film: replace(
        film,
        meta=film.meta | {k: film.meta[k] * v if isinstance(v, float) else v for k, v in changes.items()},
    )


def _sensor(of: Callable[[NDArray[np.float64], NDArray[np.float64]], tuple[Any, Any]]) -> Change:
    """Another sensor, made of its times (N,) and forces (N, 3)."""
    return lambda film: replace(film, sensor=np.column_stack(of(film.sensor[:, 0], film.sensor[:, 1:])))


def _clipped(force: NDArray[np.float64]) -> Any:
    return np.clip(force, -0.4 * np.abs(force).max(), 0.4 * np.abs(force).max())


def _stuck(force: NDArray[np.float64]) -> Any:
    peak = int(np.linalg.norm(force, axis=1).argmax())
    return np.where((np.arange(len(force)) < peak)[:, None], force, force[peak])


def _rest_at_peak(film: Film) -> Film:
    at = film.sensor[np.linalg.norm(film.sensor[:, 1:], axis=1).argmax(), 0]
    return replace(film, meta={**film.meta, "rest_frame": int(np.abs(film.time_s - at).argmin())})


def _right(of: Callable[[Film], Any]) -> Change:
    return lambda film: replace(film, right=np.ascontiguousarray(of(film)))


def _doubled(film: Film) -> Film:
    twice = np.repeat(np.arange(len(film.rgb)), 2)
    time_s = np.arange(len(twice)) * (film.time_s[1] - film.time_s[0]) / 2
    return replace(film, rgb=film.rgb[twice], tool=film.tool[twice], time_s=time_s)


def _turned(film: Film, how: Any) -> Film:
    masks = (..., *how)
    return replace(film, rgb=film.rgb[(*masks, np.s_[:])], tool=film.tool[masks], tissue=film.tissue[masks])


def _both_bumped(film: Film) -> Film:
    right = _moved(replace(film, rgb=film.right), shift=5.0).rgb
    return replace(_moved(film, shift=5.0), right=right)


_UNSEEN, _AGAIN = "out of distribution", "again"
_MISSING = r"^pictures: .*missing|^clocks|^times"
_LATE = "^stereo: .*(late|early)"
_COARSE, _UNITS, _FLIP = "^pictures: .*(detail|compressed)", "^sensor|in newtons|in mN", np.s_[::-1]
# How it is made, and what names its cause (a pattern; none: the answer is to hold).
ONE_EYE: dict[str, tuple[Change, str]] = {
    "camera bumped by 5 px": (lambda film: _moved(film, shift=5.0), "^camera"),
    "camera sways, nothing touched": (_swayed, "^camera"),
    "zoom by 3%": (lambda film: _moved(film, scale=1.03), "^camera"),
    "rotation by 2 deg": (lambda film: _moved(film, turn_deg=2.0), "^camera"),
    "ripples of 1 px": (_each(_rippled), f"moves unlike|{_UNSEEN}"),
    "rest frame at the peak": (_rest_at_peak, "^rest frame"),
    "frozen for 5 frames": (_order(lambda k: np.where((k > 7) & (k < 13), 8, k)), _AGAIN),
    "4 frames dropped": (_order(lambda k: k[(k < 8) | (k > 11)]), _MISSING),
    "4 frames late": (_order(lambda k: np.maximum(k - 4, 0)), f"{_MISSING}|{_AGAIN}"),
    "a hand comes into view": (_hand, "^foreground"),
    "interlaced": (_combed, "interlaced"),
    "pixels 4:3, said": (lambda film: _squeezed(film, (12, "yuv420p", 4)), ""),
    "pixels 4:3, not said": (lambda film: _squeezed(film, None), "(?i)pixels"),
    "letterbox": (_each(_boxed), "bars"),
    "H.264 at crf 51": (lambda film: replace(film, video=(51, "yuv420p", 3)), _COARSE),
    "JPEG at quality 3": (_jpeg(3), _COARSE),
    "noise of 30 levels": (_each(lambda rgb, k: rgb + _noise(30, k, rgb)), "noisy"),
    "dark": (_each(lambda rgb, k: 0.2 * rgb + _noise(1, k, rgb)), "dim"),
    "blur of 3 px": (_each(lambda rgb, k: cv2.GaussianBlur(rgb, (0, 0), 3)), "detail"),
    "focus lost later": (_each(lambda rgb, k: cv2.GaussianBlur(rgb, (0, 0), 3) if k > 8 else rgb), "sharp"),
    "scale 1.5 times too large": (_stated(scale_mm_per_px=1.5), "^scale"),
    "scale in cm": (_stated(scale_mm_per_px=0.1), "^scale"),
    "scale in um": (_stated(scale_mm_per_px=1000.0), "^scale"),
    "scale in m": (_stated(scale_mm_per_px=0.001), "^scale"),
    "scale in px": (_stated(scale_mm_per_px=1), "^scale"),
    "E in Pa": (_stated(young_kpa=1000.0), "^stiffness"),
    "E in MPa": (_stated(young_kpa=0.001), "^stiffness"),
    "tissue.png inverted": (lambda film: replace(film, tissue=~film.tissue), "^tissue|marks no tissue"),
    "sensor: grams": (_sensor(lambda t, f: (t, f * 1000 / 9.81)), _UNITS),
    "sensor: mN": (_sensor(lambda t, f: (t, f * 1000)), _UNITS),
    "sensor: sign": (_sensor(lambda t, f: (t, -f)), "^sensor"),
    "sensor: axes": (_sensor(lambda t, f: (t, f[:, [1, 2, 0]])), "^sensor"),
    "sensor: saturated": (_sensor(lambda t, f: (t, _clipped(f))), "^sensor"),
    "sensor: stuck": (_sensor(lambda t, f: (t, _stuck(f))), "^sensor"),
    "sensor: clock 8% fast": (_sensor(lambda t, f: (t * 1.08, f)), "^clocks"),
    "sensor: clock 0.6 s off": (_sensor(lambda t, f: (t - 0.6, f)), "^clocks"),
    "film backwards": (_order(lambda k: k[::-1]), "^clocks"),
    "every frame twice": (_doubled, _AGAIN),
    "masks of 0 and 1": (lambda film: replace(film, white=1), ""),
    "exposure 0.4 to 1.6": (_each(lambda rgb, k: rgb * (0.4 + 1.2 * k / 23)), ""),
    "white balance": (_each(lambda rgb, k: rgb * np.array([1.2, 1, 0.7])), ""),
    "text burnt in": (
        _each(lambda rgb, k: cv2.putText(rgb.copy(), f"12:30:{k:02d}", (6, 16), 0, 0.5, (255, 255, 255))),
        "",
    ),
    "black tool at rest": (_still((15, 15, 17), 3, (0, 0.75), (0, 0.83), (0.35, 0.66), (0.34, 0.61)), ""),
    "gauze at rest": (_still((225, 220, 212), 15, (0.02, 0.1), (0.2, 0.05), (0.22, 0.3), (0.03, 0.32)), ""),
    "blood pool": (_still((95, 10, 14), 2, (0.7, 0.75), (0.85, 0.7), (0.92, 0.85), (0.75, 0.92)), ""),
    "mirrored": (lambda film: _turned(film, (np.s_[:], _FLIP)), ""),
    "turned by 180 deg": (lambda film: _turned(film, (_FLIP, _FLIP)), ""),
    "negative": (_each(lambda rgb, k: 255 - rgb), ""),
    "grey": (_each(lambda rgb, k: rgb @ np.full((3, 3), 1 / 3)), ""),
    "BGR": (_each(lambda rgb, k: rgb[..., ::-1]), ""),
    "10 bits": (lambda film: replace(film, video=(12, "yuv420p10le", 3)), ""),
    "JPEG at quality 10": (_jpeg(10), ""),
    "flicker": (_each(lambda rgb, k: rgb * (1 + 0.15 * (-1) ** k)), ""),
}
TWO_EYES: dict[str, tuple[Change, str]] = {
    "right eye a frame late": (_order(lambda k: np.maximum(k - 1, 0), True), _LATE),
    "right eye lost a frame": (_order(lambda k: np.minimum(k + (k > 6), len(k) - 1), True), _LATE),
    "right eye frozen": (_order(lambda k: np.minimum(k, 6), True), "^stereo"),
    "right eye mirrored": (_right(lambda film: film.right[:, :, ::-1]), "mirrored"),
    "right eye 4 rows down": (_right(lambda film: np.roll(film.right, 4, axis=1)), "rows"),
    "eyes swapped": (lambda film: replace(film, rgb=film.right, right=film.rgb), "swapped"),
    "right eye a copy of the left": (_right(lambda film: film.rgb), "left camera's own"),
    "baseline 2 times too long": (
        _stated(stereo={"calibration": "stereo.yaml", "mm_per_unit": 2}),
        "^scale",
    ),
    "scale 1.5 times too large, two eyes": (_stated(scale_mm_per_px=1.5), "^scale"),
    "bumped by 5 px, two eyes": (_both_bumped, "^camera"),
}
FILMS = ONE_EYE | TWO_EYES


if __name__ == "__main__":
    typer.run(main)
