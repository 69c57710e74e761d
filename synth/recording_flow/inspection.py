"""Stage of a video that changes no frame: shares of masked tissue and lost frames, foreground objects."""

from __future__ import annotations

from synth.recording_flow.finding import Finding
from synth.recording_flow.foreground import ForegroundSearch
from synth.recording_flow.frame_motion import FrameMotion, RestFrame, TrackingSummary
from synth.recording_flow.stereo import Stereo

_SEARCHED = 12  # the first frames, and then one in this many, are searched for foreground


class Inspection:
    """Inspects every frame once its motion is complete but for detrending."""

    def __init__(self, rest: RestFrame, stereo: Stereo | None, foreground: bool) -> None:
        """`stereo`: of the same video, for the depth of objects; `foreground`: whether they are searched."""
        self.summary = TrackingSummary()
        self._rest, self._stereo = rest, stereo
        self._foreground = ForegroundSearch(rest.tissue, rest.shrink) if foreground else None

    def process(self, frame: FrameMotion) -> FrameMotion:
        """The same frame."""
        if not frame.is_rest:
            self.summary.add(frame, self._rest.tissue)
        count = self.summary.frames
        if self._foreground is not None and (count <= _SEARCHED or count % _SEARCHED == 0):
            depth = self._stereo.depth_mm() if self._stereo is not None and frame.trusted else None
            self._foreground.add(frame, depth)
        return frame

    @property
    def findings(self) -> list[Finding]:
        """Foreground objects, after the last frame."""
        return [] if self._foreground is None else self._foreground.findings
