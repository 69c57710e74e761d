"""Third stage of a video: flow from the rest frame, with the masks that it selects."""

from __future__ import annotations

import time
from concurrent.futures import Future
from dataclasses import replace

from synth.arrays import Mask, Pixels
from synth.flow.confidence import add_deviation
from synth.flow.mask_selection import Proposal, SelectingTracker
from synth.recording_flow.frame_motion import FrameMotion


class LocalFlow:
    """Computes flow frame by frame in this process; subclasses use another process."""

    ahead = 0  # number of frames that may be submitted before the first result is awaited

    def begin(self, backend: str, rest: Pixels, proposal: Proposal, tissue: Mask) -> None:
        """Starts with the rest frame; arguments and errors as for `SelectingTracker`."""
        self._tracker = SelectingTracker(backend, rest, proposal, tissue)

    def submit(self, rgb: Pixels, proposal: Proposal) -> Future[FrameMotion]:
        """Computes the motion of a frame (h, w, 3); errors as for `SelectingTracker.step`."""
        cpu, wall, tracker = time.process_time(), time.perf_counter(), self._tracker
        flow, confidence = tracker.step(rgb, proposal)
        done: Future[FrameMotion] = Future()
        done.set_result(
            FrameMotion(
                flow,
                confidence,
                tracker.trusted,
                tracker.reinitialised,
                masked=tracker.blocked if tracker.blocked.any() else None,
                rest_masked=tracker.rest_blocked if tracker.rest_blocked.any() else None,
                cpu_s=time.process_time() - cpu,
                wall_s=time.perf_counter() - wall,
            )
        )
        return done


def with_flow(frame: FrameMotion, found: FrameMotion) -> FrameMotion:
    """A frame with the flow `found` for it, whose uncertainty includes that of the camera's motion."""
    confidence = found.confidence
    if frame.camera is not None:
        confidence = add_deviation(confidence, frame.camera.deviation_px)
    return replace(
        found,
        confidence=confidence,
        trusted=found.trusted and frame.trusted,
        index=frame.index,
        time_s=frame.time_s,
        rgb=frame.rgb,
        camera=frame.camera,
        masking_s=frame.masking_s,
    )
