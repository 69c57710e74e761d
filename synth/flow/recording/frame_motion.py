"""Motion of one frame, and a summary of masks and lost frames over a recording."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from synth.arrays import Map, Mask, Pixels
from synth.flow.recording.camera_path import Similarity
from synth.flow.recording.finding import Finding
from synth.flow.stereo.stereo_track import Motion3D

Size = tuple[int, int]  # height, width [px]


@dataclass(frozen=True, eq=False)
class RestFrame:
    """The frame to which all motion refers; with it every later stage starts."""

    rgb: Pixels  # (h, w, 3), downsampled
    tissue: Mask  # (h, w)
    size: Size  # of the video's own pictures
    shrink: int  # factor of downsampling
    time_s: float | None  # on the clock of the video, if known
    fault: str  # why nothing can be tracked; empty if it can
    findings: tuple[Finding, ...] = ()  # on the tissue mask and black bars


@dataclass(frozen=True, eq=False)
class FrameMotion:
    """One frame and the motion of the tissue to it from the rest frame, on the pixels of the rest frame.

    Each stage of a `VideoPass` fills in its part: picture, camera motion, masks, flow and motion in three
    dimensions; the last one subtracts pulsation.
    """

    flow: Map  # (h, w, 2) px
    confidence: Map  # (h, w) in 0..1
    trusted: bool = True  # whether the frame could be tracked
    reinitialised: bool = False  # tracked only after a start from zero
    is_rest: bool = False  # whether this is the rest frame
    masked: Mask | None = None  # (h, w) where the picture shows no tissue; None: nowhere
    tool: Mask | None = None  # (h, w) instruments and other objects; None: none
    camera: Similarity | None = None  # camera motion, which is removed from the flow; None: none
    motion: Motion3D | None = None  # in three dimensions; None: monocular
    index: int = 0  # number in the video
    time_s: float | None = None  # on the clock of the video; only that of the rest frame may be unknown
    # (h, w, 3) the downsampled picture without camera motion.
    rgb: Pixels = field(default_factory=lambda: np.zeros((0, 0, 3), np.uint8))
    right: Pixels | None = None  # (h, w, 3) the right camera's picture, likewise; None: no such camera
    cpu_s: float = 0.0  # of the flow
    wall_s: float = 0.0  # of the flow
    masking_s: float = 0.0  # wall time of downsampling, masking and the estimate of camera motion
    peak_bytes: int = 0  # memory of the flow process, if there is one

    @property
    def hidden(self) -> Mask:
        """(h, w) mask of the picture, also if it is empty."""
        return np.zeros(self.confidence.shape, bool) if self.masked is None else self.masked

    @property
    def instruments(self) -> Mask:
        """(h, w) the instruments in the picture, also if there are none."""
        return np.zeros(self.confidence.shape, bool) if self.tool is None else self.tool


@dataclass(eq=False)
class TrackingSummary:
    """Summary of masks and lost frames over a recording without its rest frame."""

    frames: int = 0
    lost: int = 0
    reinitialised: int = 0
    masked: float = 0.0  # sum over frames of the masked share of the tissue
    masked_count: Map | None = None  # (h, w) number of frames in which a pixel is masked
    rest_masked: Mask | None = None  # (h, w) mask of the rest frame; None: empty

    def add(self, frame: FrameMotion, tissue: Mask) -> None:
        """Adds a frame other than the rest frame."""
        if self.masked_count is None:
            self.masked_count = np.zeros(tissue.shape, np.float32)
        self.frames += 1
        self.lost += not frame.trusted
        self.reinitialised += frame.reinitialised
        if frame.masked is not None:
            self.masked += np.count_nonzero(frame.masked & tissue) / np.count_nonzero(tissue)
            self.masked_count += frame.masked

    @property
    def shares(self) -> dict[str, float]:
        """Share of the tissue that is masked, and of the frames that are lost and reinitialised."""
        n = max(self.frames, 1)
        return {"masked": self.masked / n, "lost": self.lost / n, "reinitialised": self.reinitialised / n}

    def describe(self) -> str:
        """A sentence for reports."""
        masked = f"{100 * self.shares['masked']:.3g}% of the tissue is masked on average; "
        lost = f"{self.lost} of {self.frames} frames could not be tracked"
        retries = f", {self.reinitialised} only at a second attempt" if self.reinitialised else ""
        return masked + lost + retries
