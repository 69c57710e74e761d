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

LATE = 0.22  # share of the motion that the right camera lacks, from which it is out of sync


@dataclass(frozen=True)
class StereoQuality(stereo.StereoQuality):
    """Quality of the right or depth camera, and whether the pictures belong together."""

    fault: str = ""  # why the right pictures don't belong to the left ones; empty if they do

    def describe(self) -> str:
        """The quality in words."""
        noise = f"depth motion has a standard deviation of {self.noise_mm:.2g} mm"
        if np.isnan(self.baseline_mm):
            return f"depth camera; {noise}"
        late = f"; the right camera lacks {100 * self.lag:.0f}% of the motion: out of sync" * (
            self.lag > LATE
        )
        return f"baseline {self.baseline_mm:.3g} mm, rows {self.epipolar_px:.2g} px off; {noise}{late}"


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
        fault = ""
        if isinstance(camera, RightCamera) and camera.stereo is not None:
            fault = self._pairing.fault(camera.stereo.rectified)
            fault = fault or ("" if self._timing is None else self._timing.fault())
        return StereoQuality(**vars(found), fault=fault)
