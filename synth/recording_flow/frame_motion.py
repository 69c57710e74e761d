"""What is found of a frame's motion, and what masks and trust came to over a recording."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from synth.flow.estimator import Flags, Rgb
from synth.flow.stereo.track import Moved
from synth.recording_flow.camera_motion import Similarity

_ODD = 0.2
"""Share of the tissue masked, or of the frames lost, that is worth a look."""


@dataclass(frozen=True, eq=False)
class FrameMotion:
    """Motion of the tissue from the rest frame to one frame, on the rest frame's pixels."""

    flow: NDArray[np.float32]  # (h, w, 2) px
    confidence: NDArray[np.float32]  # (h, w) in 0..1
    trusted: bool = True  # whether the frame could be followed
    reinitialised: bool = False  # it could, but only from nothing or with other masks
    is_rest: bool = False  # it is the rest frame itself
    masked: Flags | None = None  # (h, w) what was masked in the picture; None: nothing
    rest_masked: Flags | None = None  # (h, w) what was masked in the rest frame for it; None: nothing
    camera: Similarity | None = None
    """The camera's motion, undone before anything was followed; None: it stood still."""
    motion: Moved | None = None  # in three dimensions; None without a second eye or a depth camera
    index: int = 0  # number in the film
    time_s: float | None = None  # on the film's clock; only the rest frame may be without
    rgb: Rgb = field(default_factory=lambda: np.zeros((0, 0, 3), np.uint8))
    """(h, w, 3) the picture, as small as the flow was computed, and as a camera at rest had taken it."""
    cpu_s: float = 0.0
    wall_s: float = 0.0  # time that the flow took
    masking_s: float = 0.0  # time that shrinking, masking and the camera's motion took
    peak_bytes: int = 0  # memory of the process that computed it, if it was another

    @classmethod
    def none(cls, size: tuple[int, ...], *, trusted: bool) -> FrameMotion:
        """No motion of (h, w) pixels, with no confidence in it."""
        return cls(np.zeros((*size, 2), np.float32), np.zeros(size, np.float32), trusted)


@dataclass(eq=False)
class TrackingSummary:
    """What masks and trust came to over a recording, without its rest frame."""

    frames: int = 0
    lost: int = 0
    reinitialised: int = 0
    masked: float = 0.0  # sum over frames of the share of tissue that was masked
    masked_count: NDArray[np.float32] | None = None
    """(h, w) in how many frames a pixel of the picture was masked."""
    rest_masked: Flags | None = None  # (h, w) what of the rest frame was masked at last

    def add(self, frame: FrameMotion, tissue: Flags) -> None:
        """Counts a frame, not the rest frame."""
        if self.masked_count is None:
            self.masked_count = np.zeros(tissue.shape, np.float32)
        self.frames += 1
        self.lost += not frame.trusted
        self.reinitialised += frame.reinitialised
        self.rest_masked = frame.rest_masked
        if frame.masked is not None:
            self.masked += np.count_nonzero(frame.masked & tissue) / np.count_nonzero(tissue)
            self.masked_count += frame.masked

    @property
    def shares(self) -> dict[str, float]:
        """Shares of the tissue masked, and of the frames lost and reinitialised."""
        n = max(self.frames, 1)
        return {"masked": self.masked / n, "lost": self.lost / n, "reinitialised": self.reinitialised / n}

    @property
    def is_odd(self) -> bool:
        """Whether somebody should look at it."""
        return self.shares["masked"] > _ODD or self.shares["lost"] > _ODD

    def describe(self) -> str:
        """A line for a person."""
        masked = f"{100 * self.shares['masked']:.2g}% of the tissue is masked on average; "
        lost = f"{self.lost} of {self.frames} frames looked at could not be followed"
        return masked + lost + (f", {self.reinitialised} only at a second try" if self.reinitialised else "")
