"""Measures of whether the right camera's pictures are copies, frozen, or swapped with the left camera's."""

from __future__ import annotations

import cv2
import numpy as np

from synth.errors import UserError
from synth.flow import image, mask_detection
from synth.flow.estimator import Flags, Rgb
from synth.flow.stereo import rest
from synth.flow.stereo.rig import Rectified

_SAME = 0.2  # share of the left picture's change below which the right picture is frozen
_COPY = 0.03  # share of the picture's detail: the noise of two cameras differs by more
_LEAST_TOOL = 300  # px
_NEAR = np.ones((25, 25), np.uint8)


class StereoPairing:
    """Gathers the evidence frame by frame."""

    def __init__(self) -> None:
        self._last: tuple[Rgb, Rgb] | None = None
        self.copied = True  # whether the right pictures are copies of the left ones
        self.frozen = 0  # number of frames in which only the left picture changed
        self._largest = 0
        self._tool: tuple[Flags, Rgb, Rgb] | None = None

    def add(self, left: Rgb, right: Rgb, masked: Flags) -> None:
        """Adds a frame's pictures (H, W, 3) and its mask; the rest frame first."""
        # A flat surface may look the same in both cameras, but not in every frame.
        self.copied &= _change(left, right) < _COPY * _change(left[:, 1:], left[:, :-1])
        if self._last is not None:
            before_left, before_right = self._last
            self.frozen += _change(right, before_right) < _SAME * _change(left, before_left)
        self._last = left, right
        tool = masked & ~mask_detection.glare(left, 3)
        if tool.sum() > max(_LEAST_TOOL, self._largest):
            self._largest, self._tool = int(tool.sum()), (tool, left, right)

    def find_tool_behind_px(self, rectified: Rectified) -> float:
        """Disparity of the surrounding tissue minus that of the tool [px]; 0: unknown."""
        if self._tool is None:
            return 0.0
        tool, *pair = self._tool
        left, right = (rectified.picture(rgb @ image.GREY, camera) for camera, rgb in enumerate(pair))
        everywhere = np.ones(tool.shape, bool)
        try:
            found = rest.match(left, right, everywhere, everywhere, refine=False)
        except UserError:  # too little in common
            return 0.0
        inner = found.found & rectified.flags(cv2.erode(tool.astype(np.uint8), np.ones((3, 3))) > 0, 0)
        around = found.found & ~rectified.flags(tool, 0) & (cv2.dilate(inner.astype(np.uint8), _NEAR) > 0)
        if min(inner.sum(), around.sum()) < _LEAST_TOOL / 2:
            return 0.0
        return float(np.median(found.disparity[around]) - np.median(found.disparity[inner]))


def _change(one: Rgb, other: Rgb) -> float:
    """Mean difference of two pictures [grey levels]."""
    return float(cv2.absdiff(np.ascontiguousarray(one), np.ascontiguousarray(other)).mean())
