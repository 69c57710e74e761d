"""Displacement through a video: from the rest frame to each frame, initialised with the previous frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from synth.arguments import checked
from synth.arrays import Map, Mask, Pixels
from synth.errors import UserError
from synth.flow import image
from synth.flow.confidence import LOW_CONFIDENCE
from synth.flow.estimator import Estimator, create
from synth.flow.segmentation import with_highlights


class Tracking:
    """When a frame is solved again or counts as lost; chosen by hand where no source is given."""

    min_confidence: float = 0.5  # mean over visible tissue below which a frame is solved again from zero
    min_ratio: float = 0.85  # the same relative to the last trusted frame
    min_matched: float = 0.1  # share of the visible tissue above `LOW_CONFIDENCE`; a frame with less is lost
    min_visible: float = 0.02  # unmasked share of the tissue; a frame with less is lost
    min_gain: float = 0.2  # in confidence, for which surroundings are used; they cost 10% error (design.md)
    max_tries: int = 3  # frames in which surroundings are tried, to limit the time
    lost_px: float = 1.0  # from the flow that continues the sure one, from which lost flow counts as wrong
    min_lost: float = 0.02  # share of the visible tissue with such flow, from which a frame is solved again


@dataclass(frozen=True)
class Track:
    """Recovered displacement of a sequence."""

    flow: Map
    """(T, H, W, 2) px, rest frame to frame t, on the rest frame's pixels; 0 outside the tissue."""
    confidence: Map
    """(T, H, W) in 0..1; 0 outside the tissue, under the tool and in glare."""
    trusted: Mask
    """(T,), False where a frame could not be tracked."""


@dataclass(frozen=True, eq=False)
class Solution:
    """One flow of a frame."""

    flow: Map  # (H, W, 2) px
    confidence: Map  # (H, W) in 0..1; 0 outside the tissue and where it is masked
    level: float  # mean confidence over the unmasked tissue
    is_matched: bool  # whether enough of the unmasked tissue is above `LOW_CONFIDENCE`
    is_visible: bool  # whether enough of the tissue is unmasked


class Tracker:
    """Tracks frames one at a time, in streams and recordings, and returns displacement from the rest frame.

    Flow is computed from rest to now, because errors of frame-to-frame flow add up (0.8 px after 60 frames).
    Each frame starts from the last trusted flow. When confidence drops, the frame is solved again from zero
    and the better flow is used, so that tracking recovers after a lost frame.
    """

    def __init__(self, backend: str | Estimator, rest: Pixels, rest_blocked: Mask, tissue: Mask) -> None:
        """Starts at the rest frame (H, W, 3) uint8 with its mask of instruments and glare and that of tissue
        to be tracked, (H, W) each. UserError: no such estimator."""
        self.estimator = create(backend)
        self.rest, self.tissue = rest, tissue
        self.usable = tissue & ~rest_blocked
        self.trusted = True  # whether the last frame could be tracked
        self.resets = 0  # frames whose flow from zero was the better one
        self.last: Solution | None = None  # of the last frame
        self.initial: Map | None = None  # (H, W, 2) px from which the next frame starts; None: zero
        self._level = 1.0  # mean confidence of the last trusted frame
        self._surroundings, self._tries = ~tissue & ~rest_blocked, 0
        self.widened = False  # whether the surroundings are tracked together with the tissue

    def step(self, frame: Pixels, blocked: Mask) -> tuple[Map, Map]:
        """Flow (H, W, 2) px and confidence (H, W) of the next frame (H, W, 3) uint8; sets `trusted`.

        `blocked`: (H, W), its instruments and glare. UserError: shapes differ from the rest frame's.
        """
        if frame.shape != self.rest.shape or blocked.shape != self.tissue.shape:
            raise UserError(f"flow: frame {frame.shape} does not fit the rest frame {self.rest.shape}")
        solution = self.solve(frame, blocked, self.initial)
        if self.needs_retry(solution):
            if self.initial is not None:
                retry = self.solve(frame, blocked, None)
                if retry.level > solution.level:
                    solution, self.resets = retry, self.resets + 1
            solution = self._try_surroundings(frame, blocked, solution)
        return self.accept(self._solve_lost(frame, blocked, solution))

    def _solve_lost(self, frame: Pixels, blocked: Mask, solution: Solution) -> Solution:
        """Solves a frame again if its flow is lost where it differs from that of the sure tissue around.

        Still tissue beside a contact that moves by many pixels takes on its motion on coarse levels, finds no
        match there, and would pass the wrong flow on to the next frame.
        """
        visible, is_sure = self.usable & ~blocked, solution.confidence >= LOW_CONFIDENCE
        is_lost, most = visible & ~is_sure, Tracking.min_lost * visible.sum()
        if is_lost.sum() <= most:
            return solution
        planes = np.ascontiguousarray(solution.flow.transpose(2, 0, 1))
        start = np.stack([image.fill(plane, image.flags(is_sure)) for plane in planes], axis=-1)
        if (is_lost & (np.linalg.norm(start - solution.flow, axis=-1) > Tracking.lost_px)).sum() <= most:
            return solution
        retry = self.solve(frame, blocked, start)
        return retry if retry.level > solution.level else solution

    def _try_surroundings(self, frame: Pixels, blocked: Mask, solution: Solution) -> Solution:
        """Includes the surroundings, here and in all later frames, if confidence in the tissue rises enough.

        Still surroundings stabilise the flow of tissue with little texture; otherwise they bias its rim.
        """
        if self.widened or self._tries >= Tracking.max_tries:
            return solution
        self.widened, self._tries = True, self._tries + 1
        wide_solution = self.solve(frame, blocked, None)
        self.widened = wide_solution.level > solution.level + Tracking.min_gain
        return wide_solution if self.widened else solution

    def solve(self, frame: Pixels, blocked: Mask, initial: Map | None) -> Solution:
        """Solves a frame from a flow `initial` (None: zero) without changing the state; see `step`."""
        domain = self.usable | self._surroundings if self.widened else self.usable
        flow, confidence = self.estimator.flow(self.rest, frame, domain, ~blocked, initial)
        confidence = confidence * self.tissue
        visible = self.usable & ~blocked
        visible_confidence = confidence[visible] if visible.any() else np.zeros(1, np.float32)
        return Solution(
            flow,
            confidence,
            level=float(visible_confidence.mean(dtype=np.float64)),
            is_matched=float(np.mean(visible_confidence >= LOW_CONFIDENCE)) >= Tracking.min_matched,
            is_visible=float(visible.sum() / max(1, self.tissue.sum())) >= Tracking.min_visible,
        )

    def needs_retry(self, solution: Solution) -> bool:
        """Whether the confidence of a flow is low, alone or relative to the last trusted frame."""
        return solution.level < max(Tracking.min_confidence, Tracking.min_ratio * self._level)

    def accept(self, solution: Solution) -> tuple[Map, Map]:
        """Makes a solution that of the frame; the next frame starts from it if it is trusted."""
        self.last, self.trusted = solution, solution.is_visible and solution.is_matched
        if self.trusted:
            self.initial, self._level = solution.flow, solution.level
        confidence = (
            solution.confidence if self.trusted else np.minimum(solution.confidence, 0.5 * LOW_CONFIDENCE)
        )
        return solution.flow * self.tissue[..., None], confidence


@checked
def recover_flow(frames: Pixels, tool: Mask, tissue: Mask, backend: str | Estimator = "tvl1") -> Track:
    """Displacement through a video with known instrument masks; specular highlights are detected.

    Args:
        frames: (T, H, W, 3) uint8, sRGB; frame 0 is the rest frame.
        tool: (T, H, W), instrument masks.
        tissue: (H, W), where tissue is tracked, in the rest frame.
        backend: an estimator, or a name: tvl1, opencv-tvl1, dis or that of a plug-in.

    Raises:
        UserError: no such estimator, no frames, or shapes that differ.
    """
    is_video = isinstance(frames, np.ndarray) and frames.dtype == np.uint8 and frames.shape[3:] == (3,)
    if not is_video or not frames.size:
        raise UserError("frames: expected a non-empty array (T, H, W, 3) of uint8")
    for name, mask, shape in (("tool", tool, frames.shape[:3]), ("tissue", tissue, frames.shape[1:3])):
        if np.shape(mask) != shape or np.asarray(mask).dtype != bool:
            raise UserError(f"{name}: expected an array {shape} of bool, got {np.shape(mask)}")
    return track(backend, frames, with_highlights(frames, tool), tissue)


def track(backend: str | Estimator, frames: Pixels, blocked: Mask, tissue: Mask) -> Track:
    """As `recover_flow`, with masks (T, H, W) of everything that is not tissue."""
    tracker = Tracker(backend, frames[0], blocked[0], tissue)
    flow = np.zeros((*frames.shape[:3], 2), np.float32)
    confidence = np.zeros(frames.shape[:3], np.float32)
    trusted = np.ones(len(frames), bool)
    confidence[0] = tracker.usable
    for t in range(1, len(frames)):
        flow[t], confidence[t] = tracker.step(frames[t], blocked[t])
        trusted[t] = tracker.trusted
    return Track(flow, confidence, trusted)
