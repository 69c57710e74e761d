"""Pictures of a sequence for a person: frame, flow and force map side by side."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from synth.dataset.store import Sequence as Sequence_
from synth.errors import UserError

Rgb = NDArray[np.uint8]
"""(H, W, 3) uint8, sRGB."""

_CAPTION_PX = 26
_GAP_PX = 6
_BAR_PX = 12


def flow_colours(flow: NDArray[np.floating], largest_px: float) -> Rgb:
    """Flow as colour: hue is direction, saturation is length; white does not move.

    The convention of Baker et al., "A Database and Evaluation Methodology for Optical Flow" (IJCV 2011),
    on the HSV circle instead of their wheel.

    Args:
        flow: (H, W, 2) px.
        largest_px: length shown at full saturation.
    """
    length = np.hypot(flow[..., 0], flow[..., 1]) / max(largest_px, 1e-9)
    angle = np.arctan2(flow[..., 1], flow[..., 0]) % (2 * np.pi)
    hsv = np.empty((*length.shape, 3), np.uint8)
    hsv[..., 0] = np.round(angle / (2 * np.pi) * 179)
    hsv[..., 1] = np.round(255 * np.clip(length, 0, 1))
    hsv[..., 2] = 255
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB), np.uint8)


def heat(values: NDArray[np.floating], largest: float) -> Rgb:
    """Non-negative values as colour, black (0) to yellow (`largest`). values: (H, W)."""
    grey = np.round(255 * np.clip(values / max(largest, 1e-12), 0, 1)).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(grey, cv2.COLORMAP_INFERNO)[..., ::-1], np.uint8)


def overlay(base: Rgb, colours: Rgb, weight: NDArray[np.floating]) -> Rgb:
    """`colours` over `base`; weight: (H, W) in 0..1."""
    blend = base + weight[..., None] * (colours.astype(np.float32) - base)
    return np.round(blend).astype(np.uint8)


def arrows(base: Rgb, flow: NDArray[np.floating], where: NDArray[np.bool_], step_px: int, gain: float) -> Rgb:
    """Flow as arrows on a grid of `step_px`, lengthened by `gain`. flow: (H, W, 2) px; where: (H, W)."""
    picture = base.copy()
    height, width = where.shape
    for row in range(step_px // 2, height, step_px):
        for column in range(step_px // 2, width, step_px):
            step = gain * flow[row, column]
            if where[row, column] and float(np.hypot(*step)) >= 1.5:
                tip = (round(column + float(step[0])), round(row + float(step[1])))
                cv2.arrowedLine(picture, (column, row), tip, (20, 20, 20), 1, cv2.LINE_AA, tipLength=0.3)
    return picture


def arrow_gain(width_px: int, largest_px: float) -> int:
    """Whole number by which arrows are lengthened so that the longest about spans the grid."""
    return max(1, int(width_px / 24 / max(largest_px, 1e-9))) if largest_px > 0.05 else 1


def colour_bar(panel: Rgb, colours: Rgb, label: str) -> Rgb:
    """The panel with a bar (a (1, N, 3) row of colours) and its label in the lower right corner."""
    picture = panel.copy()
    height, width = panel.shape[:2]
    bar = cv2.resize(colours, (width // 3, _BAR_PX), interpolation=cv2.INTER_LINEAR)
    top, left = height - _BAR_PX - 8, width - width // 3 - 8
    picture[top : top + _BAR_PX, left : left + bar.shape[1]] = bar
    return _text(picture, label, (left, top - 6), (255, 255, 255))


def side_by_side(panels: Sequence[Rgb], captions: Sequence[str]) -> Rgb:
    """Panels (H, W, 3) of one size in a row, each under its caption, on white."""
    height, width = panels[0].shape[:2]
    row = np.full((height + _CAPTION_PX, len(panels) * (width + _GAP_PX) - _GAP_PX, 3), 255, np.uint8)
    for k, (panel, caption) in enumerate(zip(panels, captions, strict=True)):
        left = k * (width + _GAP_PX)
        row[_CAPTION_PX:, left : left + width] = panel
        row = _text(row, caption, (left + 4, 18), (40, 40, 40))
    return row


def stack(rows: Sequence[Rgb]) -> Rgb:
    """Rows (h, W, 3) of one width under one another."""
    gap = np.full((_GAP_PX, rows[0].shape[1], 3), 255, np.uint8)
    parts = [part for row in rows for part in (row, gap)]
    return np.concatenate(parts[:-1])


def frame_flow_force(
    rgb: Rgb,
    rest: Rgb,
    flow: NDArray[np.floating],
    traction: NDArray[np.floating],
    tissue: NDArray[np.bool_],
    *,
    largest_px: float,
    largest_kpa: float,
    captions: Sequence[str],
) -> Rgb:
    """One row: the frame, its flow from the rest frame, and the traction that caused it.

    Args:
        rgb: the frame, (H, W, 3) uint8.
        rest: frame 0, on whose pixels flow and traction lie, (H, W, 3) uint8.
        flow: (H, W, 2) px.
        traction: (H, W, 3) kPa.
        tissue: (H, W).
        largest_px: flow at full colour.
        largest_kpa: traction at full colour.
        captions: three lines, one a panel.
    """
    inside = tissue.astype(np.float32)
    grey = np.repeat(rest.mean(axis=2, keepdims=True), 3, axis=2).astype(np.uint8)
    moved = overlay(grey, flow_colours(flow, largest_px), 0.65 * inside)
    step_px = max(rgb.shape[1] // 24, 8)
    moved = arrows(moved, flow, tissue, step_px, arrow_gain(rgb.shape[1], largest_px))
    ramp = np.linspace(0, 1, 256, dtype=np.float32)[None]
    size = np.linalg.norm(traction, axis=-1)
    weight = inside * np.clip(0.15 + size / max(largest_kpa, 1e-12), 0, 0.9)
    pushed = overlay((0.6 * grey).astype(np.uint8), heat(size, largest_kpa), weight)
    pushed = colour_bar(pushed, heat(ramp, 1.0), f"0 - {largest_kpa:.2g} kPa")
    return side_by_side([rgb, moved, pushed], captions)


def draw_sequence(sequence: Sequence_, frames: Sequence[int]) -> Rgb:
    """Frame, flow and force map of some frames of a sequence, a row each, on common scales: (h, w, 3).

    Raises:
        UserError: a frame is not in the sequence.
    """
    for t in frames:
        if not 0 <= t < sequence.frames:
            raise UserError(f"frame {t}: the sequence has frames 0 to {sequence.frames - 1}")
    flow = {t: sequence["flow"][t] for t in frames}
    traction = {t: sequence["traction"][t] for t in frames}
    largest_px = max(float(np.linalg.norm(f, axis=-1).max()) for f in flow.values())
    largest_kpa = max(float(np.linalg.norm(s, axis=-1).max()) for s in traction.values())
    force, time = sequence["force"][...], sequence["time"][...]
    gain = arrow_gain(sequence.size[1], largest_px)
    return stack(
        [
            frame_flow_force(
                sequence["rgb"][t],
                sequence["rgb"][0],
                flow[t],
                traction[t],
                sequence["tissue"][...],
                largest_px=largest_px,
                largest_kpa=largest_kpa,
                captions=[
                    f"frame {t}, {time[t]:.2f} s",
                    f"flow, {np.linalg.norm(flow[t], axis=-1).max():.1f} px at most (arrows x{gain})",
                    f"traction, {np.linalg.norm(force[t]):.1f} mN in all",
                ],
            )
            for t in frames
        ]
    )


def strongest(sequence: Sequence_) -> int:
    """The frame with the largest force."""
    return int(np.linalg.norm(sequence["force"][...], axis=-1).argmax())


def _text(picture: Rgb, text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> Rgb:
    canvas = np.ascontiguousarray(picture)
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)
    return canvas
