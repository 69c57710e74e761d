"""Displacement through a video: always from the rest frame, each frame starting from the one before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from synth.errors import UserError
from synth.flow import mask_detection
from synth.flow.confidence import DOUBTFUL
from synth.flow.estimator import Estimator, Flags, Flow, Map, Rgb, create


@dataclass(frozen=True)
class TrackingConstants:
    """When a frame is solved again or lost; by hand where no source is given."""

    low: float = 0.5  # mean confidence of what is visible; frames below it are solved again from nothing
    drop: float = 0.85  # and so are those below this share of the last trusted frame's
    matched: float = 0.1  # share of what is visible that is no lost pixel; below it motion is a guess
    free: float = 0.02  # share of the tissue that must be free of masks for anything to be concluded
    wider: float = 0.2  # confidence that surroundings must add: else they cost a tenth of error (design.md)
    tries: int = 3  # frames in which they may: time


TRACKING = TrackingConstants()


@dataclass(frozen=True)
class Track:
    """Recovered displacement of a sequence."""

    flow: NDArray[np.float32]
    """(T, H, W, 2) px, rest frame to frame t, on the rest frame's pixels; 0 outside the tissue."""
    confidence: NDArray[np.float32]
    """(T, H, W) in 0..1; 0 outside the tissue, under the tool and in glare."""
    trusted: NDArray[np.bool_]
    """(T,), False where the frame could not be followed."""


@dataclass(frozen=True, eq=False)
class Solution:
    """One answer for a frame."""

    flow: Flow  # (H, W, 2) px
    confidence: Map  # (H, W) in 0..1; 0 outside the tissue and where it is masked
    level: float  # mean confidence over what is not masked
    matched: float  # share of that whose confidence says that it is not lost
    visible: float  # share of the tissue that is not masked

    @property
    def is_matched(self) -> bool:
        """Whether enough of what is visible is found again."""
        return self.matched >= TRACKING.matched


class Tracker:
    """Frames in, displacement from the rest frame out, one at a time, for streams as for recordings.

    Rest to now, never frame to frame: errors of small steps add up (0.8 px after 60 frames), those of one
    long step don't. Each frame starts from the last one that could be trusted; when confidence falls, the
    frame is solved again from nothing and the better answer kept: one lost frame doesn't lose the rest.
    """

    def __init__(self, backend: str | Estimator, rest: Rgb, rest_blocked: Flags, tissue: Flags) -> None:
        """Starts at rest.

        Args:
            backend: an estimator or its name.
            rest: the rest frame, (H, W, 3) uint8.
            rest_blocked: (H, W), tool and glare in it.
            tissue: (H, W), where there is tissue to follow.

        Raises:
            UserError: no such estimator, or shapes that don't fit.
        """
        if rest.shape[:2] != tissue.shape or rest_blocked.shape != tissue.shape:
            raise UserError(
                f"flow: rest frame {rest.shape[:2]}, masks {rest_blocked.shape}, {tissue.shape} differ"
            )
        self.estimator = create(backend)
        self.rest, self.tissue = rest, tissue
        self.usable = tissue & ~rest_blocked
        self.trusted = True
        """Whether the last frame could be followed."""
        self.lost = ""
        """Why the last frame could not be followed; empty if it could."""
        self.resets = 0
        """How often a frame was solved again from nothing, and better."""
        self.last: Solution | None = None
        """The last frame's answer as it was found."""
        self.initial: Flow | None = None
        """(H, W, 2) px, what the next frame starts from; None: from nothing."""
        self.unsure: Flags = np.zeros_like(tissue)
        """(H, W) where confidence says nothing about the frame."""
        self._level = 1.0
        self._around, self._tries = ~tissue & ~rest_blocked, 0
        self.widened = False
        """Whether the surroundings are followed with the tissue."""

    def step(self, frame: Rgb, blocked: Flags) -> tuple[Flow, Map]:
        """Flow (H, W, 2) px and confidence (H, W) of the next frame; `trusted` says whether it was followed.

        Args:
            frame: (H, W, 3) uint8.
            blocked: (H, W), tool and glare in it.
        """
        if frame.shape != self.rest.shape or blocked.shape != self.tissue.shape:
            raise UserError(f"flow: frame {frame.shape} does not fit the rest frame {self.rest.shape}")
        found = self.solve(frame, blocked, self.initial)
        if self.is_doubtful(found):
            if self.initial is not None:
                again = self.solve(frame, blocked, None)
                if again.level > found.level:
                    found, self.resets = again, self.resets + 1
            found = self._wider(frame, blocked, found)
        return self.accept(found)

    def _wider(self, frame: Rgb, blocked: Flags, found: Solution) -> Solution:
        """The answer with the surroundings, if it is so much surer in the tissue; then in all later frames.

        Where tissue is faint, what lies still around it holds the flow; elsewhere it pulls at the rim.
        """
        if self.widened or self._tries >= TRACKING.tries:
            return found
        self.widened, self._tries = True, self._tries + 1
        wider = self.solve(frame, blocked, None)
        self.widened = wider.level > found.level + TRACKING.wider
        return wider if self.widened else found

    def solve(self, frame: Rgb, blocked: Flags, initial: Flow | None) -> Solution:
        """One answer for a frame; nothing is remembered of it. Arguments as `step` and `initial`."""
        domain = self.usable | self._around if self.widened else self.usable
        flow, confidence = self.estimator.flow(self.rest, frame, domain, ~blocked, initial)
        confidence = confidence * self.tissue
        seen = self.usable & ~blocked
        where, tissue = seen & ~self.unsure, int(np.count_nonzero(self.tissue))
        if np.count_nonzero(where) < TRACKING.free * tissue:
            where = seen
        inside = confidence[where] if where.any() else np.zeros(1, np.float32)
        level = float(inside.mean(dtype=np.float64))
        return Solution(
            flow,
            confidence,
            level,
            matched=float(np.mean(inside >= DOUBTFUL)),
            visible=int(np.count_nonzero(seen)) / max(1, tissue),
        )

    def is_doubtful(self, found: Solution) -> bool:
        """Whether an answer is so much worse than the last good one's that others are tried."""
        return found.level < max(TRACKING.low, TRACKING.drop * self._level)

    def accept(self, found: Solution) -> tuple[Flow, Map]:
        """Makes it the frame's answer; the next one starts from it if it can be trusted."""
        self.last = found
        self.lost = ""
        if found.visible < TRACKING.free:
            self.lost = f"masks leave {100 * found.visible:.2g}% of the tissue"
        elif not found.is_matched:
            self.lost = f"only {100 * found.matched:.0f}% of what is visible matches the rest frame"
        self.trusted = not self.lost
        if self.trusted:
            self.initial, self._level = found.flow, found.level
        sure = found.confidence if self.trusted else np.minimum(found.confidence, 0.5 * DOUBTFUL)
        return found.flow * self.tissue[..., None], sure


def recover_flow(
    frames: NDArray[np.uint8],
    tool: NDArray[np.bool_],
    tissue: Flags,
    backend: str | Estimator = "tvl1",
) -> Track:
    """Displacement through a video whose instruments' outlines are known; glare is found in the pictures.

    Args:
        frames: (T, H, W, 3) uint8, sRGB; frame 0 is the rest frame.
        tool: (T, H, W), pixels of instruments.
        tissue: (H, W), where there is tissue to follow in the rest frame.
        backend: an estimator, or the name of one: tvl1, opencv-tvl1, dis or a plug-in's.

    Raises:
        UserError: no such estimator, no frames, or shapes that don't fit.
    """
    if not (
        isinstance(frames, np.ndarray)
        and frames.size
        and frames.dtype == np.uint8
        and np.shape(frames)[3:] == (3,)
    ):
        raise UserError("frames: expected a filled array (T, H, W, 3) of uint8")
    for what, given, shape in (("tool", tool, frames.shape[:3]), ("tissue", tissue, frames.shape[1:3])):
        if np.shape(given) != shape or np.asarray(given).dtype != bool:
            raise UserError(f"{what}: expected an array {shape} of bool, got {np.shape(given)}")
    return track(backend, frames, mask_detection.hidden(frames, tool), tissue)


def track(
    backend: str | Estimator, frames: NDArray[np.uint8], blocked: NDArray[np.bool_], tissue: Flags
) -> Track:
    """As `recover_flow`, with all that is masked, (T, H, W), given."""
    if len(frames) == 0 or len(frames) != len(blocked):
        raise UserError(f"flow: {len(frames)} frames with {len(blocked)} masks")
    tracker = Tracker(backend, frames[0], blocked[0], tissue)
    flow = np.zeros((*frames.shape[:3], 2), np.float32)
    confidence = np.zeros(frames.shape[:3], np.float32)
    trusted = np.ones(len(frames), bool)
    confidence[0] = tracker.usable
    for t in range(1, len(frames)):
        flow[t], confidence[t] = tracker.step(frames[t], blocked[t])
        trusted[t] = tracker.trusted
    return Track(flow, confidence, trusted)
