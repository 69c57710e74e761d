"""Position of the network's grid on a picture that is wider than it: on the tissue that moves."""

from __future__ import annotations

import cv2
import numpy as np

from learn.data.grid import Grid, centre, check_scale
from synth.arrays import Map, Mask
from synth.flow.confidence import LOW_CONFIDENCE

Point = tuple[float, float]  # (x, y) px

# Chosen by hand.
_CUT_OFF = 0.005  # share of the tissue that may lie beyond a grid that covers it
_STILL_PX = 0.5  # 98th percentile of motion under which the grid isn't moved
_COARSE = 8  # reduction of the map on which the motion's centre is searched
_OFF_CENTRE = 0.25  # share of the grid's width; the grid is moved to motion further from its centre


class GridPlacement:
    """The grid's position, frame by frame; it is moved only if motion is far from its centre."""

    def __init__(self, tissue: Mask, scale_mm_per_px: float, grid: Grid) -> None:
        """`tissue`: (H, W). UserError if it is empty, or if the scale is invalid."""
        self.centre_px = centre(tissue)  # current centre of the grid
        self.moves = 0  # number of times the grid was moved
        rows, columns = np.nonzero(tissue)
        self._half = 0.5 * grid.extent_mm / check_scale(scale_mm_per_px)
        distance = np.maximum(abs(columns - self.centre_px[0]), abs(rows - self.centre_px[1]))
        # Whether the grid covers all of the tissue, so that it needn't be moved.
        self.fits = float(np.mean(distance > self._half + 0.5)) <= _CUT_OFF
        self._tissue = tissue
        self._ends = [(float(axis.min()), float(axis.max())) for axis in (columns, rows)]

    def place(self, flow: Map, confidence: Map | None) -> Point:
        """The grid's centre for a frame, by flow (H, W, 2) px of no low confidence (H, W; None: 1)."""
        if self.fits:
            return self.centre_px
        usable = self._tissue if confidence is None else self._tissue & (confidence >= LOW_CONFIDENCE)
        power = np.square(flow.astype(np.float32)).sum(-1) * usable
        if float(np.quantile(power[self._tissue][::7], 0.98)) < _STILL_PX**2:
            return self.centre_px
        place = self._within(self._find_strongest(power))
        if max(abs(a - b) for a, b in zip(place, self.centre_px, strict=True)) > _OFF_CENTRE * 2 * self._half:
            self.centre_px, self.moves = place, self.moves + 1
        return self.centre_px

    def _find_strongest(self, power: Map) -> Point:
        """The centre of the strongest motion; of two places the stronger, not their mean."""
        height, width = power.shape
        size = (max(1, width // _COARSE), max(1, height // _COARSE))
        coarse = cv2.resize(power, size, interpolation=cv2.INTER_AREA)
        step = width / size[0], height / size[1]
        smoothed = cv2.GaussianBlur(coarse, (0, 0), max(0.5 * self._half / step[0], 0.5), borderType=0)
        row, column = np.unravel_index(int(smoothed.argmax()), smoothed.shape)
        return (float(column) + 0.5) * step[0] - 0.5, (float(row) + 0.5) * step[1] - 0.5

    def _within(self, point: Point) -> Point:
        """The nearest centre whose grid reaches as little as possible beyond the tissue."""
        position = []
        for value, (low, high) in zip(point, self._ends, strict=True):
            low, high = low + self._half, high - self._half
            position.append(min(max(value, low), high) if low < high else (low + high) / 2)
        return position[0], position[1]
