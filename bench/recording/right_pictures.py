"""Measurements on the right camera's pictures over a tracked video, for `bench check` and the report."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.recording.stereo_pairing import StereoPairing
from bench.recording.stereo_timing import StereoTiming
from synth.recording_flow import stereo
from synth.recording_flow.frame_motion import FrameMotion
from synth.recording_flow.passes import VideoPass
from synth.recording_flow.stereo import RightCamera


@dataclass(frozen=True)
class StereoQuality(stereo.StereoQuality):
    """Quality of the right or depth camera, and whether the pictures belong together."""

    copied: bool = False  # whether the right pictures are copies of the left ones
    frozen: int = 0  # frames in which only the left picture changes
    tool_behind_px: float = 0.0  # disparity of tissue minus that of the tool; 0: unknown
    lag_s: float = 0.0  # of the right camera; negative: early
    lag_from_s: float | None = None  # time from which on it is late or early; None: the start

    def describe(self) -> str:
        """The quality in words."""
        noise = f"depth motion has a standard deviation of {self.noise_mm:.2g} mm"
        if np.isnan(self.baseline_mm):
            return f"depth camera; {noise}"
        return f"baseline {self.baseline_mm:.3g} mm, rows {self.epipolar_px:.2g} px off; {noise}"


class RightPictures:
    """Compares the pictures of both cameras, frame by frame, the rest frame first."""

    def __init__(self, video: VideoPass) -> None:
        self._video, self._pairing = video, StereoPairing()
        self._timing: StereoTiming | None = None

    def add(self, frame: FrameMotion) -> None:
        """Adds a frame; one without a right picture is ignored."""
        camera = self._video.stereo
        if frame.right is None or not isinstance(camera, RightCamera) or camera.stereo is None:
            return
        tissue = self._video.rest.tissue
        masked = np.zeros_like(tissue) if frame.masked is None else frame.masked
        self._pairing.add(frame.rgb, frame.right, masked)
        if self._timing is None:
            self._timing = StereoTiming(camera.stereo, frame.rgb, frame.right, tissue & ~masked)
        else:
            self._timing.add(frame.rgb, frame.right, frame.time_s or 0.0)

    @property
    def quality(self) -> StereoQuality | None:
        """The quality over all frames; None: no such camera, or the rest frame could not be used."""
        camera = self._video.stereo
        found = None if camera is None else camera.quality
        if found is None:
            return None
        if self._timing is None or not isinstance(camera, RightCamera) or camera.stereo is None:
            return StereoQuality(**vars(found))
        behind_px = self._pairing.find_tool_behind_px(camera.stereo.rectified)
        pair = self._pairing.copied, self._pairing.frozen, behind_px, *self._timing.find_lag_s()
        return StereoQuality(*vars(found).values(), *pair)
