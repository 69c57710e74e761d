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


def _each(change: Callable[[Picture, int], Any], camera: str = "frames") -> Change:
    """A change of each image of a camera and its number."""

    def apply(folder: Path) -> None:
        for k, file in enumerate(sorted((folder / camera).iterdir())):
            picture = change(_read(file), k)
            cv2.imwrite(str(file), np.clip(picture, 0, 255).astype(np.uint8)[..., ::-1])

    return apply


def _warp(rgb: Picture, x: float = 0, y: float = 0, scale: float = 1, turn_deg: float = 0) -> Any:
    """The image of a camera that is shifted [px], zoomed and turned about the middle."""
    matrix = cv2.getRotationMatrix2D((rgb.shape[1] / 2, rgb.shape[0] / 2), turn_deg, scale)
    matrix[:, 2] += x, y
    return cv2.warpAffine(rgb, matrix, rgb.shape[1::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def _later(change: Callable[[Picture], Any], since: int = FRAMES // 2, camera: str = "frames") -> Change:
    """A change of the images from a frame on."""
    return _each(lambda rgb, k: change(rgb) if k >= since else rgb, camera)


def _ordered(order: Callable[[Any], Any], *parts: str) -> Change:
    """Another order of pictures; by default of the left camera's and the instrument masks."""

    def apply(folder: Path) -> None:
        numbers, time_s = order(np.arange(FRAMES)), read_table(folder / "frames.csv")[:, 1]
        for part in (folder / name for name in parts or ("frames", "masks") if (folder / name).is_dir()):
            old = part.rename(folder / "old")
            part.mkdir()
            files = {int(file.stem): file for file in old.iterdir()}
            for new, k in enumerate(numbers):
                if k in files:
                    shutil.copy(files[k], part / f"{new:06d}.png")
            shutil.rmtree(old)
        if "right" not in parts[:1]:
            recording_writer.write_frames(folder, time_s[: len(numbers)])

    return apply


def _noise(levels: float, rgb: Picture, k: int) -> Any:
    return np.random.default_rng((4, k)).normal(0, levels, rgb.shape)


def _cover(rgb: Picture, colour: tuple[int, int, int], low: float, high: float) -> Any:
    """The image with a rough rectangle of a colour at its right edge, between two shares of its height."""
    shown, (height, width) = np.array(rgb, np.float64), rgb.shape[:2]
    part = shown[int(low * height) : int(high * height), int(0.6 * width) :]
    part[:] = colour + _noise(5, part, 0)
    return shown


def _stated(**changes: Any) -> Change:
    """Changes of meta.yaml; a float multiplies the value."""

    def apply(folder: Path) -> None:
        meta = read_meta(folder)
        new = {key: meta[key] * by if isinstance(by, float) else by for key, by in changes.items()}
        recording_writer.write_meta(folder, meta | new)

    return apply


def _sensor(change: Callable[[Floats, Floats], tuple[Any, Any]]) -> Change:
    """A change of the sensor's times (N,) and forces (N, 3) N."""

    def apply(folder: Path) -> None:
        rows = read_table(folder / "force.csv")
        recording_writer.write_force(folder, *change(rows[:, 0], rows[:, 1:]))

    return apply


def _begin_late(folder: Path) -> None:
    """Cuts the first half of the recording off, and the span without contact with it."""
    _ordered(lambda k: k[FRAMES // 2 :], "frames", "masks", "right")(folder)
    begin = FRAMES // 2 / FPS
    _sensor(lambda t, f: (t[t >= begin] - begin, f[t >= begin]))(folder)
    sensor = {key: value for key, value in read_meta(folder)["sensor"].items() if key != "free_s"}
    _stated(sensor=sensor)(folder)


def _swap_cameras(folder: Path) -> None:
    for name, new in (("frames", "old"), ("right", "frames"), ("old", "right")):
        (folder / name).rename(folder / new)


def _drift(share: float) -> Change:
    """The sensor's zero rises by a share of the largest force over the recording."""

    def change(t: Any, f: Any) -> Any:
        most = np.linalg.norm(f, axis=1).max()
        return t, f + share * most * np.outer((t - t[0]) / np.ptp(t), [0.6, 0.0, 0.8])

    return _sensor(change)


def _offset(folder: Path) -> None:
    """A sensor's offset, and no span without contact by which to know it."""
    _sensor(lambda t, f: (t, f + 2 * np.linalg.norm(f, axis=1).max() * np.array([0.3, -0.5, 0.8])))(folder)
    about = {key: value for key, value in read_meta(folder)["sensor"].items() if key != "free_s"}
    _stated(sensor=about)(folder)


def _free_under_load(folder: Path) -> None:
    """The span without contact holds the whole recording."""
    end_s = float(read_table(folder / "force.csv")[-1, 0])
    _stated(sensor=read_meta(folder)["sensor"] | {"free_s": [[0.0, end_s]]})(folder)


def _draw_tissue(radius: float, inside: bool) -> Change:
    """Writes tissue.png: a disc of a share of the picture's height, or all but it."""

    def apply(folder: Path) -> None:
        height, width = _read(sorted((folder / "frames").iterdir())[0]).shape[:2]
        disc = np.zeros((height, width), np.uint8)
        cv2.circle(disc, (width // 2, height // 2), round(radius * height), 255, -1)
        cv2.imwrite(str(folder / "tissue.png"), disc if inside else 255 - disc)

    return apply


def _invert_masks(folder: Path) -> None:
    height, width = _read(sorted((folder / "frames").iterdir())[0]).shape[:2]
    (folder / "masks").mkdir(exist_ok=True)
    for k in range(FRAMES):
        file = folder / "masks" / f"{k:06d}.png"
        mask = np.zeros((height, width), np.uint8)
        if file.exists():
            mask = np.asarray(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), np.uint8)
        cv2.imwrite(str(file), 255 - mask)


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


_COARSE, _UNITS, _AGAIN = "^pictures: .*(detail|compressed)", "^sensor|in newtons|in mN", "again"
_MISSING, _LATE = r"^pictures: .*missing|^clocks|^times", "^stereo: .*(late|early)"
_PAIR = {"calibration": "stereo.yaml", "mm_per_unit": 2}
# What makes it, and a pattern of the finding that names it; empty: the force should stay the same.
MONOCULAR: dict[str, tuple[Change, str]] = {
    "camera bumped by 5 px": (_later(lambda rgb: _warp(rgb, 4, 3)), "^camera"),
    "zoom by 1%": (_later(lambda rgb: _warp(rgb, scale=1.01)), "^camera"),
    "rotation by 2 deg": (_later(lambda rgb: _warp(rgb, turn_deg=2)), "^camera"),
    "camera drifts by 6 px": (_each(lambda rgb, k: _warp(rgb, k / 6)), "^camera"),
    "first picture under load": (_begin_late, "^rest frame|most likely.*rest frame"),
    "frozen for 5 frames": (_ordered(lambda k: np.where((k > 7) & (k < 13), 8, k)), _AGAIN),
    "4 frames dropped": (_ordered(lambda k: k[(k < 8) | (k > 11)]), _MISSING),
    "4 frames late": (_ordered(lambda k: np.maximum(k - 4, 0)), f"{_MISSING}|{_AGAIN}"),
    "frames reversed": (_ordered(lambda k: k[::-1]), "^clocks"),
    "half the light later": (_later(lambda rgb: 0.5 * rgb), "^pictures: .*light"),
    "a hand comes into view": (_later(lambda rgb: _cover(rgb, (222, 202, 180), 0.3, 0.7)), "^foreground"),
    "letterbox": (_each(lambda rgb, k: np.pad(rgb[20:-20], ((20, 20), (0, 0), (0, 0)))), "bars"),
    "H.264 at crf 51": (_compress, _COARSE),
    "noise of 30 levels": (_each(lambda rgb, k: rgb + _noise(30, rgb, k)), "noisy"),
    "dark": (_each(lambda rgb, k: 0.2 * rgb + _noise(1, rgb, k)), "dim"),
    "blur of 3 px": (_later(_blur, 0), "detail"),
    "focus lost later": (_later(_blur, 9), "sharp"),
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
    "sensor: drift of a fifth": (_drift(0.2), "drift"),
    "sensor: offset without a tare": (_offset, "^sensor|^rest frame"),
    "sensor: free_s under load": (_free_under_load, "free_s"),
    "sensor: stamped as 30 for 25": (_sensor(lambda t, f: (t * 25 / 30, f)), "^clocks"),
    "tissue.png: a blob": (_draw_tissue(0.06, True), "^tissue|tissue.png"),
    "tissue.png: inverted": (_draw_tissue(0.4, False), "^tissue|tissue.png"),
    "masks: inverted": (_invert_masks, "^tool"),
    "video: cut off": (_damage(True), "cut off|damaged|cannot be read|unreadable|not readable"),
    "video: corrupt packets": (_damage(False), "damaged|cut off|cannot be read|unreadable|not readable"),
    "white balance": (_each(lambda rgb, k: rgb * [1.2, 1, 0.7]), ""),
    "gauze at rest": (_later(lambda rgb: _cover(rgb, (225, 220, 212), 0, 0.2), 0), ""),
    "grey": (_each(lambda rgb, k: rgb @ np.full((3, 3), 1 / 3)), ""),
    "flicker": (_each(lambda rgb, k: rgb * (1 + 0.15 * (-1) ** k)), ""),
}  # fmt: skip
STEREO: dict[str, tuple[Change, str]] = {
    "right camera a frame late": (_ordered(lambda k: np.maximum(k - 1, 0), "right"), _LATE),
    "right camera frozen": (_ordered(lambda k: np.minimum(k, 6), "right"), "^stereo"),
    "right camera mirrored": (_later(lambda rgb: rgb[:, ::-1], 0, "right"), "mirrored"),
    "right camera 4 rows down": (_later(lambda rgb: np.roll(rgb, 4, axis=0), 0, "right"), "rows"),
    "right camera bumped by 3 px": (
        _later(lambda rgb: _warp(rgb, 2.4, 1.8), camera="right"),
        "^stereo|right camera",
    ),
    "right camera out of focus": (_later(_blur, 0, "right"), "^stereo"),
    "right camera of another site": (_later(lambda rgb: rgb[::-1], 0, "right"), "^stereo|mirrored|match"),
    "right camera's gain: half": (_later(lambda rgb: 0.5 * rgb, 0, "right"), ""),
    "cameras swapped": (_swap_cameras, "swapped"),
    "baseline 2 times too long": (_stated(stereo=_PAIR), "^scale"),
}  # fmt: skip
