"""Videos of sequences with overlays of force and flow."""

from __future__ import annotations

from collections.abc import Iterator
from collections.abc import Sequence as Several
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from synth.arrays import Ints, Map, Mask
from synth.dataset.store import Dataset, Sequence
from synth.errors import UserError
from synth.publish import picture as drawing
from synth.publish.picture import Rgb
from synth.video.write_video import encode_video

OVERLAYS = {"flow": "flow", "recovered": "flow_recovered", "force": "traction"}  # overlay -> its field

_QUALITY = 18
_CURVE_PX, _LEFT_PX = 64, 4
_ITERATIONS = 5
_LINE = (200, 60, 20)


def write_videos(
    dataset: Dataset,
    target: Path,
    overlays: Several[str] | None = None,
    interval_s: tuple[float, float] | None = None,
) -> None:
    """Writes `NNNNNN.mp4` per sequence, with some of `OVERLAYS`; `interval_s`: first and last time [s].

    `overlays`: flow, and force where it is known, if None. UserError: an unknown overlay, no frame in the
    interval, or a sequence without the field.
    """
    if overlays is None:
        overlays = ["flow", "force"] if "force" in dataset[0] else ["flow"]
    if unknown := [name for name in overlays if name not in OVERLAYS]:
        raise UserError(f"{unknown[0]}: is not one of {', '.join(OVERLAYS)}")
    for sequence in dataset:
        frames = draw_video(sequence, overlays, interval_s)
        file = target / f"{sequence.index:06d}.mp4"
        encode_video(file, frames, float(sequence.attrs["fps"]), quality=_QUALITY)


def draw_video(
    sequence: Sequence, overlays: Several[str], interval_s: tuple[float, float] | None = None
) -> Iterator[Rgb]:
    """The frames of the interval, (h, w, 3), with the curve of `force` below. Raises as `write_videos`."""
    for name in overlays:
        if OVERLAYS[name] not in sequence:
            raise UserError(f"{sequence.path}: holds no {OVERLAYS[name]}")
    time = sequence["time"][:]
    first, last = interval_s or (-np.inf, np.inf)
    frames = np.flatnonzero((time >= first) & (time <= last)).tolist()
    if not frames:
        raise UserError(f"{sequence.path}: has no frame between {first:g} and {last:g} s")
    largest = {
        name: max(float(np.linalg.norm(sequence[OVERLAYS[name]][t], axis=-1).max()) for t in frames)
        for name in overlays
    }
    tissue, curve = sequence["tissue"][:], None
    for k, t in enumerate(frames):
        picture = _draw_overlays(sequence, t, tissue, largest) if overlays else sequence["rgb"][t]
        if "force" in overlays:
            if curve is None:
                force = np.linalg.norm(sequence["force"][:], axis=1)
                curve = draw_curve(time[frames], force[frames], picture.shape[1])
            picture = np.vstack([picture, mark(curve, k, len(frames))])
        yield picture


def _draw_overlays(sequence: Sequence, t: int, tissue: Mask, largest: dict[str, float]) -> Rgb:
    picture, words = sequence["rgb"][t], [f"{sequence['time'][t]:.2f} s"]
    if "force" in largest:
        size = np.linalg.norm(sequence["traction"][t], axis=-1)
        warped = warp_to_frame(np.where(tissue, size, 0.0), sequence["flow"][t])
        picture = glow(picture, warped, largest["force"])
        words.append(f"{np.linalg.norm(sequence['force'][t]):.1f} mN (yellow: {largest['force']:.2g} kPa)")
    for name in (name for name in largest if name != "force"):
        gain = drawing.arrow_gain(sequence.size[1], largest[name])
        picture = drawing.arrows(picture, sequence[OVERLAYS[name]][t], tissue, gain)
        words.append(f"{OVERLAYS[name]} x{gain}")
    return drawing.caption(drawing.enlarge(picture), "  ".join(words))


def warp_to_frame(values: NDArray[np.floating], flow: NDArray[np.floating]) -> Map:
    """Values (H, W) of the rest frame, warped by the flow (H, W, 2) px, inverted by fixed-point iteration."""
    height, width = values.shape
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    flow = flow.astype(np.float32)
    inverse = flow
    for _ in range(_ITERATIONS):
        inverse = cv2.remap(flow, columns - inverse[..., 0], rows - inverse[..., 1], cv2.INTER_LINEAR)
    x, y = columns - inverse[..., 0], rows - inverse[..., 1]
    return np.asarray(cv2.remap(values.astype(np.float32), x, y, cv2.INTER_LINEAR), np.float32)


def glow(picture: Rgb, values: NDArray[np.floating], largest: float) -> Rgb:
    """The picture with non-negative values (H, W) as overlay, from transparent (0) to yellow (`largest`)."""
    share = np.clip(values / max(largest, 1e-12), 0, 1)
    weight = np.where(share > 0.02, 0.2 + 0.6 * share, 0.0)
    return drawing.overlay(picture, drawing.heat(values, largest), weight)


def draw_curve(time_s: NDArray[np.floating], force_mn: NDArray[np.floating], width_px: int) -> Rgb:
    """A strip (h, width_px, 3) with force (T,) over time (T,), with gaps at NaN."""
    strip = np.full((_CURVE_PX, width_px, 3), 255, np.uint8)
    finite = np.isfinite(force_mn)
    top = max(float(force_mn[finite].max()), 1e-9) if finite.any() else 1.0
    level = np.clip(np.nan_to_num(force_mn) / top, 0, 1)
    y = np.round((_CURVE_PX - 6) - level * (_CURVE_PX - 24)).astype(int)
    points = np.stack([_columns(len(force_mn), width_px), y], axis=1).tolist()
    for k in np.flatnonzero(finite[1:] & finite[:-1]):
        cv2.line(strip, points[k], points[k + 1], _LINE, 1, cv2.LINE_AA)
    text = f"0 to {top:.3g} mN, {time_s[0]:.2f} to {time_s[-1]:.2f} s"
    cv2.putText(strip, text, (_LEFT_PX, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.4, drawing.INK, 1, cv2.LINE_AA)
    return strip


def mark(curve: Rgb, k: int, count: int) -> Rgb:
    """The strip (h, w, 3) with a cursor at the k-th of `count` values."""
    strip = curve.copy()
    strip[16:, _columns(count, curve.shape[1])[k]] = drawing.INK
    return strip


def _columns(count: int, width_px: int) -> Ints:
    return np.round(np.linspace(_LEFT_PX, width_px - 1 - _LEFT_PX, count)).astype(int)
