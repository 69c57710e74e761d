"""Ways in which a recording may be wrong: a change of its folder, and the finding that names it."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from ruamel.yaml import YAML

from bench.recording import recording_writer
from synth.arrays import Floats, Pixels
from synth.system.checked_file import read_picture

FRAMES, FPS = 24, 8.0  # of the recordings that are changed

Change = Callable[[Path], None]  # of a recording's folder
Picture = np.ndarray[Any, Any]  # (H, W, 3) RGB


def read_meta(folder: Path) -> Any:
    """A recording's meta.yaml."""
    return YAML(typ="safe").load((folder / "meta.yaml").read_text("utf-8"))


def read_table(file: Path) -> Floats:
    """A CSV file (rows, columns) without its first line."""
    return np.loadtxt(file, delimiter=",", skiprows=1)


def _read(file: Path) -> Pixels:
    return np.asarray(read_picture(file)[..., ::-1], np.uint8)


def _edit_frames(change: Callable[[Picture, int], Any], camera: str = "frames") -> Change:
    """A change of each image of a camera and its number."""

    def apply(folder: Path) -> None:
        for k, file in enumerate(sorted((folder / camera).iterdir())):
            picture = change(_read(file), k)
            cv2.imwrite(str(file), np.clip(picture, 0, 255).astype(np.uint8)[..., ::-1])

    return apply


def _edit_cameras(change: Callable[[Picture, int], Any]) -> Change:
    """A change of each image of both cameras."""

    def apply(folder: Path) -> None:
        for camera in (name for name in ("frames", "right") if (folder / name).is_dir()):
            _edit_frames(change, camera)(folder)

    return apply


def _warp(rgb: Picture, x: float = 0, y: float = 0, scale: float = 1, turn_deg: float = 0) -> Any:
    """The image of a camera that is shifted [px], zoomed and turned about the middle."""
    matrix = cv2.getRotationMatrix2D((rgb.shape[1] / 2, rgb.shape[0] / 2), turn_deg, scale)
    matrix[:, 2] += x, y
    return cv2.warpAffine(rgb, matrix, rgb.shape[1::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def _edit_later(change: Callable[[Picture], Any], since: int = FRAMES // 2, camera: str = "frames") -> Change:
    """A change of the images from a frame on."""
    return _edit_frames(lambda rgb, k: change(rgb) if k >= since else rgb, camera)


def _reorder(order: Callable[[Any], Any], *parts: str) -> Change:
    """Another order of pictures; by default of the left camera's and the instrument masks."""

    def apply(folder: Path) -> None:
        numbers, time_s = order(np.arange(FRAMES)), read_table(folder / "frames.csv")[:, 1]
        for part in (folder / name for name in parts or ("frames", "masks") if (folder / name).is_dir()):
            source = part.rename(folder / "old")
            part.mkdir()
            files = {int(file.stem): file for file in source.iterdir()}
            for position, k in enumerate(numbers):
                if k in files:
                    shutil.copy(files[k], part / f"{position:06d}.png")
            shutil.rmtree(source)
        if "right" not in parts[:1]:
            recording_writer.write_frames(folder, time_s[: len(numbers)])

    return apply


def _interlace(folder: Path) -> None:
    """Takes every second row of each picture from the next one: a field later."""
    files = sorted((folder / "frames").iterdir())
    pictures = [_read(file) for file in files]
    for file, rgb, next_picture in zip(files, pictures, pictures[1:], strict=False):
        rgb = rgb.copy()
        rgb[1::2] = next_picture[1::2]
        cv2.imwrite(str(file), rgb[..., ::-1])


def _mirror(folder: Path) -> None:
    """Mirrors all pictures, also those that the user has drawn on them."""
    for file in sorted(folder.rglob("*.png")):
        cv2.imwrite(str(file), np.asarray(cv2.imread(str(file), cv2.IMREAD_UNCHANGED))[:, ::-1])


def _burn_in(rgb: Picture, k: int) -> Any:
    """The image with a clock at its upper left corner."""
    position, font = (6, 24), cv2.FONT_HERSHEY_SIMPLEX
    picture = np.ascontiguousarray(rgb)
    return cv2.putText(picture, f"{k / FPS:08.3f}", position, font, 0.7, (255, 255, 255), 2, cv2.LINE_AA)


def _press_elsewhere(rgb: Picture, k: int) -> Any:
    """The image of tissue that a second instrument, which the sensor doesn't hold, presses late."""
    y, x = np.mgrid[: rgb.shape[0], : rgb.shape[1]].astype(np.float32)
    offsets = np.stack([x - 0.38 * rgb.shape[1], y - 0.36 * rgb.shape[0]], axis=-1)
    load = np.clip(min(k - 12, 22 - k) / 3, 0, 1)
    source = (
        offsets * (1 + load * 0.35 * np.exp(-(offsets**2).sum(-1, keepdims=True) / (2 * 16**2))) - offsets
    )
    places = (np.stack([x, y], axis=-1) + source).astype(np.float32)
    return cv2.remap(rgb, places[..., 0], places[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def _noise(levels: float, rgb: Picture, k: int) -> Any:
    return np.random.default_rng((4, k)).normal(0, levels, rgb.shape)


def _cover(rgb: Picture, colour: tuple[int, int, int], low: float, high: float) -> Any:
    """The image with a rough rectangle of a colour at its right edge, between two shares of its height."""
    picture, (height, width) = np.array(rgb, np.float64), rgb.shape[:2]
    part = picture[int(low * height) : int(high * height), int(0.6 * width) :]
    part[:] = colour + _noise(5, part, 0)
    return picture


def _edit_meta(**changes: Any) -> Change:
    """Changes of meta.yaml; a float multiplies the value."""

    def apply(folder: Path) -> None:
        meta = read_meta(folder)
        values = {
            key: meta[key] * value if isinstance(value, float) else value for key, value in changes.items()
        }
        recording_writer.write_meta(folder, meta | values)

    return apply


def _edit_sensor(change: Callable[[Floats, Floats], tuple[Any, Any]]) -> Change:
    """A change of the sensor's times (N,) and forces (N, 3) N."""

    def apply(folder: Path) -> None:
        rows = read_table(folder / "force.csv")
        recording_writer.write_force(folder, *change(rows[:, 0], rows[:, 1:]))

    return apply


def _begin_late(folder: Path) -> None:
    """Cuts the first half of the recording off, and the span without contact with it."""
    _reorder(lambda k: k[FRAMES // 2 :], "frames", "masks", "right")(folder)
    begin = FRAMES // 2 / FPS
    _edit_sensor(lambda t, f: (t[t >= begin] - begin, f[t >= begin]))(folder)
    sensor = {key: value for key, value in read_meta(folder)["sensor"].items() if key != "free_s"}
    _edit_meta(sensor=sensor)(folder)


def _swap_cameras(folder: Path) -> None:
    for name, new in (("frames", "old"), ("right", "frames"), ("old", "right")):
        (folder / name).rename(folder / new)


def _spoil(change: Callable[[Floats, Floats], Floats]) -> Change:
    """Another force (N, 3) N from the times' share (N, 1) of the record and the force over its peak."""

    def spoil(t: Floats, f: Floats) -> tuple[Floats, Floats]:
        peak = float(np.linalg.norm(f, axis=1).max())
        return t, peak * change(((t - t[0]) / np.ptp(t))[:, None], f / peak)

    return _edit_sensor(spoil)


def _freeze(share: Floats, force: Floats) -> Floats:
    return np.where(share < 0.35, force, force[int(0.35 * len(force))])


def _add_spikes(share: Floats, force: Floats) -> Floats:
    rng, spiked = np.random.default_rng(1), force.copy()
    spiked[rng.integers(0, len(force), 12)] += 4 * rng.normal(size=(12, 3))
    return spiked


def _lose_samples(share: Floats, force: Floats) -> Floats:
    return np.where((share > 0.3) & (share < 0.42), np.nan, force)


def _add_offset(folder: Path) -> None:
    """A sensor's offset, and no span without contact by which to know it."""
    offset = np.array([0.3, -0.5, 0.8])
    _edit_sensor(lambda t, f: (t, f + 2 * np.linalg.norm(f, axis=1).max() * offset))(folder)
    sensor = {key: value for key, value in read_meta(folder)["sensor"].items() if key != "free_s"}
    _edit_meta(sensor=sensor)(folder)


def _free_under_load(folder: Path) -> None:
    """The span without contact holds the whole recording."""
    end_s = float(read_table(folder / "force.csv")[-1, 0])
    _edit_meta(sensor=read_meta(folder)["sensor"] | {"free_s": [[0.0, end_s]]})(folder)


def _draw_tissue(radius: float, inside: bool) -> Change:
    """Writes tissue.png: a disc of a share of the picture's height, or all but it."""

    def apply(folder: Path) -> None:
        height, width = _read(sorted((folder / "frames").iterdir())[0]).shape[:2]
        disc = np.zeros((height, width), np.uint8)
        cv2.circle(disc, (width // 2, height // 2), round(radius * height), 255, -1)
        cv2.imwrite(str(folder / "tissue.png"), disc if inside else 255 - disc)

    return apply


def _draw_masks(change: Callable[[Pixels], Any]) -> Change:
    """Instrument masks (H, W) that are changed; black ones where there are none."""

    def apply(folder: Path) -> None:
        size = _read(sorted((folder / "frames").iterdir())[0]).shape[:2]
        (folder / "masks").mkdir(exist_ok=True)
        for file in (folder / "masks" / f"{k:06d}.png" for k in range(FRAMES)):
            mask = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) if file.exists() else np.zeros(size, np.uint8)
            cv2.imwrite(str(file), change(np.asarray(mask, np.uint8)))

    return apply


def _damage(cut: bool) -> Change:
    """A video that is cut off at 60%, or has bytes overwritten in its second half."""

    def apply(folder: Path) -> None:
        time_s = read_table(folder / "frames.csv")[:, 1]
        pictures = (_read(file) for file in sorted((folder / "frames").iterdir()))
        recording_writer.write_video(folder / "video.mp4", pictures, time_s, crf=18)
        shutil.rmtree(folder / "frames")
        data = bytearray((folder / "video.mp4").read_bytes())
        rng = np.random.default_rng(0)
        for start in [] if cut else rng.integers(len(data) // 2, int(0.85 * len(data)), 40):
            data[start : start + 8] = rng.bytes(8)
        (folder / "video.mp4").write_bytes(bytes(data[: int(0.6 * len(data))] if cut else data))

    return apply


def _compress(folder: Path) -> None:
    time_s = read_table(folder / "frames.csv")[:, 1]
    for name, video in (("frames", "video.mp4"), ("right", "right.mp4")):
        if (folder / name).is_dir():
            pictures = (_read(file) for file in sorted((folder / name).iterdir()))
            recording_writer.write_video(folder / video, pictures, time_s, crf=51)
            shutil.rmtree(folder / name)


def _blur(rgb: Picture) -> Any:
    return cv2.GaussianBlur(rgb, (0, 0), 3)


_COARSE, _AGAIN, _LIGHT = "^pictures: .*(detail|compressed)", "again", "^pictures: .*light"
_MISSING, _LATE = "^(pictures|stereo): .*missing|^clocks|^times", "^stereo: .*(late|early)"
_UNMASKED = "^(tool|foreground): .*masks"
_BROKEN = "damaged|cut off|cannot be read|unreadable|not readable"
_PAIR = {"calibration": "stereo.yaml", "mm_per_unit": 2}
# What makes it, and a pattern of the finding that names it; empty: the force should stay the same.
MONOCULAR: dict[str, tuple[Change, str]] = {
    "camera bumped by 5 px": (_edit_later(lambda rgb: _warp(rgb, 4, 3)), "^camera"),
    "zoom by 1%": (_edit_later(lambda rgb: _warp(rgb, scale=1.01)), "^camera"),
    "first picture under load": (_begin_late, "^rest frame|most likely.*rest frame"),
    "frozen for 5 frames": (_reorder(lambda k: np.where((k > 7) & (k < 13), 8, k)), _AGAIN),
    "each frame twice": (_reorder(lambda k: k - k % 2), _AGAIN),
    "4 frames dropped": (_reorder(lambda k: k[(k < 8) | (k > 11)]), _MISSING),
    "a part at double speed": (_reorder(lambda k: k[(k < 6) | (k > 15) | (k % 2 == 0)]), _MISSING),
    "half the light later": (_edit_later(lambda rgb: 0.5 * rgb), _LIGHT),
    "gamma of 0.6 later": (_edit_later(lambda rgb: 255 * (rgb / 255) ** 0.6), _LIGHT),
    "a hand comes into view": (
        _edit_later(lambda rgb: _cover(rgb, (222, 202, 180), 0.3, 0.7)),
        "^foreground",
    ),
    "letterbox": (_edit_frames(lambda rgb, k: np.pad(rgb[20:-20], ((20, 20), (0, 0), (0, 0)))), "bars"),
    "interlaced": (_interlace, "interlaced"),
    "mirrored": (_mirror, "mirrored"),
    "H.264 at crf 51": (_compress, _COARSE),
    "focus lost later": (_edit_later(_blur, 9), "sharp"),
    "scale 2 times too small": (_edit_meta(scale_mm_per_px=0.5), "^(scale|force)"),
    "E 4 times too large": (_edit_meta(young_kpa=4.0), "^(stiffness|force)"),
    "a second contact without sensor": (_edit_cameras(_press_elsewhere), "^sensor: .*contact that"),
    "sensor: mN": (_edit_sensor(lambda t, f: (t, 1000 * f)), "in newtons|in mN|unit"),
    "sensor: sign": (_edit_sensor(lambda t, f: (t, -f)), "^sensor: .*sign"),
    "sensor: axes": (_edit_sensor(lambda t, f: (t, f[:, [1, 2, 0]])), "^sensor: .*axes"),
    "sensor: saturated": (_edit_sensor(lambda t, f: (t, f.clip(f.min() / 2, f.max() / 2))), "saturated"),
    "sensor: stuck": (_spoil(_freeze), "^sensor: .*stuck"),
    "sensor: spikes": (_spoil(_add_spikes), "^sensor: .*spike"),
    "sensor: samples lost": (_spoil(_lose_samples), "^files: .*without a force"),
    "sensor: drift of a fifth": (_spoil(lambda share, f: f + 0.2 * share * [0.6, 0.0, 0.8]), "drift"),
    "sensor: offset without a tare": (_add_offset, "^sensor|^rest frame"),
    "sensor: free_s under load": (_free_under_load, "free_s"),
    "sensor: clock 0.3 s off": (_edit_sensor(lambda t, f: (t - 0.3, f)), "^clocks"),
    "sensor: times in ms": (_edit_sensor(lambda t, f: (1000 * t, f)), "^clocks.*milliseconds"),
    "sensor: stamped as 30 for 25": (_edit_sensor(lambda t, f: (t * 25 / 30, f)), "^clocks"),
    "tissue.png: a blob": (_draw_tissue(0.06, True), "^tissue|tissue.png"),
    "masks: empty": (_draw_masks(lambda mask: 0 * mask), _UNMASKED),
    "masks: 5 frames late": (_reorder(lambda k: np.maximum(k - 5, 0), "masks"), _UNMASKED),
    "video: corrupt packets": (_damage(False), _BROKEN),
    "white balance": (_edit_frames(lambda rgb, k: rgb * [1.2, 1, 0.7]), ""),
    "gauze at rest": (_edit_later(lambda rgb: _cover(rgb, (225, 220, 212), 0, 0.2), 0), ""),
    "flicker": (_edit_frames(lambda rgb, k: rgb * (1 + 0.15 * (-1) ** k)), ""),
    "a clock burnt in": (_edit_frames(_burn_in), ""),
}  # fmt: skip
STEREO: dict[str, tuple[Change, str]] = {
    "right camera a frame late": (_reorder(lambda k: np.maximum(k - 1, 0), "right"), _LATE),
    "right camera bumped by 3 px": (
        _edit_later(lambda rgb: _warp(rgb, 2.4, 1.8), camera="right"),
        "^stereo|right camera",
    ),
    "right camera of another site": (
        _edit_later(lambda rgb: rgb[::-1], 0, "right"),
        "^stereo|mirrored|match",
    ),
    "right camera's gain: half": (_edit_later(lambda rgb: 0.5 * rgb, 0, "right"), ""),
    "cameras swapped": (_swap_cameras, "swapped"),
    "baseline 2 times too long": (_edit_meta(stereo=_PAIR), "^scale"),
}  # fmt: skip
