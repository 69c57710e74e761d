"""Measurements on the right camera's pictures over a tracked video: do they belong to the left ones?"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import cv2
import numpy as np

from synth.arrays import Mask, Pixels
from synth.errors import UserError
from synth.flow import image
from synth.flow.recording.frame_motion import FrameMotion
from synth.flow.recording.stereo_motion import RightCamera, StereoQuality
from synth.flow.recording.stereo_timing import StereoTiming
from synth.flow.recording.video_pass import VideoPass
from synth.flow.stereo import rest
from synth.flow.stereo.rig import Rectified

_SAME = 0.2  # share of the left picture's change below which the right picture is frozen
_COPY = 0.03  # share of the picture's detail: the noise of two cameras differs by more
_MIN_TOOL = 300  # px
_KERNEL = np.ones((25, 25), np.uint8)


@dataclass(frozen=True)
class PairQuality(StereoQuality):
    """Quality of the right or depth camera, and whether the pictures belong together."""

    copied: bool = False  # whether the right pictures are copies of the left ones
    frozen: int = 0  # frames in which only the left picture changes
    tool_behind_px: float = 0.0  # disparity of the surrounding tissue minus that of the tool; 0: unknown
    lag_s: float = 0.0  # of the right camera; negative: early; 0: none, or unknown
    lag_from_s: float | None = None  # time from which on it is late or early; None: the start
    last_rows_px: float = 0.0  # as `epipolar_px`, in the last frame; 0: unknown
    sharpness: float = 1.0  # share of fine detail over that of the left camera
    motion: tuple[str, ...] = ()  # sentences on the motion of the right camera

    def describe(self) -> str:
        """The quality in words."""
        noise = f"depth motion has a standard deviation of {self.noise_mm:.2g} mm"
        if np.isnan(self.baseline_mm):
            return f"depth camera; {noise}"
        return f"baseline {self.baseline_mm:.3g} mm, rows {self.epipolar_px:.2g} px off; {noise}"


class RightPictures:
    """Compares the pictures of both cameras, frame by frame, the rest frame first."""

    def __init__(self, video: VideoPass) -> None:
        self._video = video
        self._timing: StereoTiming | None = None
        self._last: tuple[Pixels, Pixels, Mask] | None = None  # and the visible tissue
        self._copied, self._frozen, self._largest = True, 0, 0
        self._tool: tuple[Mask, Pixels, Pixels] | None = None  # largest tool mask, and its frame's pictures

    def add(self, frame: FrameMotion) -> None:
        """Adds a frame; one without a right picture is ignored."""
        camera, left, right = self._video.stereo, frame.rgb, frame.right
        if right is None or not isinstance(camera, RightCamera) or camera.stereo is None:
            return
        masked = frame.hidden
        if self._timing is None:
            self._timing = StereoTiming(camera.stereo.rectified)
            self._sharpness = _sharpness(right) / max(_sharpness(left), 1e-6)
        self._timing.add(left, right, frame.time_s or 0.0)
        # A flat surface may look the same in both cameras, but not in every frame.
        self._copied &= _change(left, right) < _COPY * _change(left[:, 1:], left[:, :-1])
        if not frame.trusted:
            return
        if self._last is not None:  # without noise, of which a camera out of focus or frozen has less or more
            pairs = zip((left, right), self._last[:2], strict=True)
            left_change, right_change = (
                _change(*(cv2.GaussianBlur(picture, (0, 0), 3) for picture in pair)) for pair in pairs
            )
            self._frozen += right_change < _SAME * left_change
        self._last = left, right, self._video.rest.tissue & ~masked
        tool = frame.instruments
        if tool.sum() > max(_MIN_TOOL, self._largest):
            self._largest, self._tool = int(tool.sum()), (tool, left, right)

    @property
    def quality(self) -> PairQuality | None:
        """The quality over all frames; None: no such camera, or the rest frame could not be used."""
        camera = self._video.stereo
        quality = None if camera is None else camera.quality
        if quality is None:
            return None
        if self._timing is None or not isinstance(camera, RightCamera) or camera.stereo is None:
            return PairQuality(**vars(quality))
        numbers = quality.baseline_mm, quality.epipolar_px, quality.mm_per_px, quality.noise_mm
        pair = self._copied, self._frozen, self._tool_behind_px(camera.stereo.rectified)
        rows_px, motion = self._last_rows_px(camera.stereo.rectified), tuple(camera.describe())
        return PairQuality(*numbers, *pair, *self._timing.find_lag_s(), rows_px, self._sharpness, motion)

    def _last_rows_px(self, rectified: Rectified) -> float:
        if self._last is None:
            return 0.0
        *pair, tissue = self._last
        rest_match = _match(rectified, pair, rectified.flags(tissue, 0), np.ones_like(tissue), refine=True)
        return 0.0 if rest_match is None else rest_match.epipolar_px

    def _tool_behind_px(self, rectified: Rectified) -> float:
        if self._tool is None:
            return 0.0
        tool, *pair = self._tool
        full_mask = np.ones(tool.shape, bool)
        rest_match = _match(rectified, pair, full_mask, full_mask, refine=False)
        if rest_match is None:
            return 0.0
        inner = rest_match.matched & rectified.flags(cv2.erode(tool.astype(np.uint8), np.ones((3, 3))) > 0, 0)
        surroundings = (
            rest_match.matched & ~rectified.flags(tool, 0) & (cv2.dilate(inner.astype(np.uint8), _KERNEL) > 0)
        )
        if min(inner.sum(), surroundings.sum()) < _MIN_TOOL / 2:
            return 0.0
        return float(np.median(rest_match.disparity[surroundings]) - np.median(rest_match.disparity[inner]))


def _match(
    rectified: Rectified, pair: list[Pixels], left: Mask, right: Mask, *, refine: bool
) -> rest.Rest | None:
    """`rest.match` of two pictures; None: too little in common."""
    left_grey, right_grey = (
        rectified.picture(image.luminance(rgb), camera) for camera, rgb in enumerate(pair)
    )
    with suppress(UserError):
        return rest.match(left_grey, right_grey, left, right, refine=refine)
    return None


def _sharpness(rgb: Pixels) -> float:
    """Detail of 1 to 2 px, which is coarser than noise, over that of 4 to 8 px."""
    levels = [cv2.GaussianBlur(image.luminance(rgb), (0, 0), width) for width in (1, 2, 4, 8)]
    return float((levels[0] - levels[1]).std() / max((levels[2] - levels[3]).std(), 1e-6))


def _change(first: Pixels, second: Pixels) -> float:
    """Mean difference of two pictures [grey levels]."""
    return float(cv2.absdiff(np.ascontiguousarray(first), np.ascontiguousarray(second)).mean())
