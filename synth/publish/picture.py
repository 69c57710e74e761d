"""Pictures of a sequence: frame, flow and force map side by side."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from synth.arrays import Mask, Pixels
from synth.dataset.store import Sequence as Sequence_
from synth.errors import UserError, as_user_error
from synth.system.checked_file import write_whole

Rgb = Pixels  # (H, W, 3) uint8, sRGB

INK = (40, 40, 40)
_CAPTION_PX = 26
_GAP_PX = 6
_WIDE_PX = 480


def flow_colours(flow: NDArray[np.floating], largest_px: float) -> Rgb:
    """Flow (H, W, 2) px as colour: hue is direction, saturation is length, full at `largest_px`; white is 0.

    As in Baker et al., "A Database and Evaluation Methodology for Optical Flow" (IJCV 2011), with HSV's hues.
    """
    length = np.hypot(flow[..., 0], flow[..., 1]) / max(largest_px, 1e-9)
    angle = np.arctan2(flow[..., 1], flow[..., 0]) % (2 * np.pi)
    hsv = np.empty((*length.shape, 3), np.uint8)
    hsv[..., 0] = np.round(angle / (2 * np.pi) * 179)
    hsv[..., 1] = np.round(255 * np.clip(length, 0, 1))
    hsv[..., 2] = 255
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB), np.uint8)


def heat(values: NDArray[np.floating], largest: float) -> Rgb:
    """Non-negative values (H, W) as colour, black (0) to yellow (`largest`)."""
    grey = np.round(255 * np.clip(values / max(largest, 1e-12), 0, 1)).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(grey, cv2.COLORMAP_INFERNO)[..., ::-1], np.uint8)


def overlay(base: Rgb, colours: Rgb, weight: NDArray[np.floating]) -> Rgb:
    """`colours` blended over `base`; weight: (H, W) in 0..1."""
    blend = base + weight[..., None] * (colours.astype(np.float32) - base)
    return np.round(blend).astype(np.uint8)


def arrows(base: Rgb, flow: NDArray[np.floating], mask: Mask, gain: float) -> Rgb:
    """Flow (H, W, 2) px as arrows on a grid, 24 across, lengthened by `gain`, in a mask (H, W)."""
    picture = base.copy()
    height, width = mask.shape
    step_px = max(width // 24, 8)
    for row in range(step_px // 2, height, step_px):
        for column in range(step_px // 2, width, step_px):
            step = gain * flow[row, column]
            if mask[row, column] and float(np.hypot(*step)) >= 1.5:
                tip = (round(column + float(step[0])), round(row + float(step[1])))
                cv2.arrowedLine(picture, (column, row), tip, (20, 20, 20), 1, cv2.LINE_AA, tipLength=0.3)
    return picture


def arrow_gain(width_px: int, largest_px: float) -> int:
    """Integer factor by which the longest arrow becomes about as long as the grid's spacing."""
    return max(1, int(width_px / 24 / max(largest_px, 1e-9))) if largest_px > 0.05 else 1


def enlarge(picture: Rgb) -> Rgb:
    """The picture (H, W, 3), enlarged by an integer factor so that a line of text fits."""
    factor = -(-_WIDE_PX // picture.shape[1])
    return picture.repeat(factor, axis=0).repeat(factor, axis=1)


def caption(picture: Rgb, text: str, row: int = 14) -> Rgb:
    """The picture (H, W, 3) with a line of outlined white text, whose baseline is `row`."""
    canvas = np.ascontiguousarray(picture)
    offsets = [(across, down, 0) for across in (-1, 0, 1) for down in (-1, 0, 1)]  # the outline
    for across, down, level in (*offsets, (0, 0, 255)):
        origin = (4 + across, row + down)
        cv2.putText(canvas, text, origin, cv2.FONT_HERSHEY_SIMPLEX, 0.4, (level,) * 3, 1, cv2.LINE_AA)
    return canvas


def tile(pictures: Sequence[Rgb]) -> Rgb:
    """Pictures (H, W, 3) of one size in a nearly square grid, empty cells black."""
    columns = int(np.ceil(np.sqrt(len(pictures))))
    cells = [*pictures, *[np.zeros_like(pictures[0])] * (-len(pictures) % columns)]
    return np.vstack([np.hstack(cells[k : k + columns]) for k in range(0, len(cells), columns)])


def draw_sequence(sequence: Sequence_, frames: Sequence[int]) -> Rgb:
    """Picture (h, w, 3) of frames on common scales, a row each: the frame, flow and traction on the rest
    frame.

    UserError if a frame is not in the sequence.
    """
    for t in frames:
        if not 0 <= t < sequence.frames:
            raise UserError(f"frame {t}: the sequence has frames 0 to {sequence.frames - 1}")
    flows = [sequence["flow"][t] for t in frames]
    has_force = "force" in sequence
    loads = [np.linalg.norm(sequence["traction"][t], axis=-1) if has_force else np.zeros(1) for t in frames]
    largest_px = max(float(np.linalg.norm(flow, axis=-1).max()) for flow in flows)
    largest_kpa = max(float(load.max()) for load in loads)
    time, tissue = sequence["time"][...], sequence["tissue"][...]
    grey = to_grey(sequence["rgb"][0])
    gain, rows = arrow_gain(sequence.size[1], largest_px), []
    for t, flow, load in zip(frames, flows, loads, strict=True):
        flow_panel = arrows(overlay(grey, flow_colours(flow, largest_px), 0.65 * tissue), flow, tissue, gain)
        most_px = np.linalg.norm(flow, axis=-1).max()
        panels = {
            f"frame {t}, {time[t]:.2f} s": sequence["rgb"][t],
            f"flow, {most_px:.1f} px at most (arrows x{gain})": flow_panel,
        }
        if has_force:
            weight = tissue * np.clip(0.15 + load / max(largest_kpa, 1e-12), 0, 0.9)
            traction_panel = overlay((0.6 * grey).astype(np.uint8), heat(load, largest_kpa), weight)
            total_mn = np.linalg.norm(sequence["force"][t])
            panels[f"traction, {total_mn:.1f} mN in total (yellow: {largest_kpa:.2g} kPa)"] = traction_panel
        rows.append(np.hstack([frame_panel(panel, text) for text, panel in panels.items()]))
    return np.vstack(rows)[:, _GAP_PX:]


def write_animation(path: Path, rows: Rgb, count: int, fps: float) -> None:
    """Writes the `count` rows of `draw_sequence` as an animated WebP. UserError: it can't be written."""
    from PIL import Image

    first, *others = (Image.fromarray(row) for row in np.split(rows, count))
    options: dict[str, Any] = {"duration": round(1000 / fps), "loop": 0, "quality": 85, "method": 6}
    file = io.BytesIO()
    with as_user_error(f"{path}: cannot be written"):
        first.save(file, "WEBP", save_all=True, append_images=others, **options)
        write_whole(path, file.getvalue())


def to_grey(picture: Rgb) -> Rgb:
    """The picture (H, W, 3) in grey."""
    return np.repeat(picture.mean(axis=2, keepdims=True), 3, axis=2).astype(np.uint8)


def find_strongest(sequence: Sequence_) -> int:
    """The frame with the largest force, or flow where no force is known."""
    if "force" in sequence:
        return int(np.linalg.norm(sequence["force"][...], axis=-1).argmax())
    return int(np.argmax([np.abs(sequence["flow"][t]).max() for t in range(sequence.frames)]))


def frame_panel(panel: Rgb, text: str) -> Rgb:
    """A panel (H, W, 3) with a white margin above and left, and a caption."""
    canvas = cv2.copyMakeBorder(panel, _CAPTION_PX, 0, _GAP_PX, 0, cv2.BORDER_CONSTANT, value=(255,) * 3)
    cv2.putText(canvas, text, (_GAP_PX + 4, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.45, INK, 1, cv2.LINE_AA)
    return np.asarray(canvas, np.uint8)
