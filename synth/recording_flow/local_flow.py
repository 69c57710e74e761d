"""Flow of one video, computed in this process."""

from __future__ import annotations

import time
from concurrent.futures import Future

from synth.flow.estimator import Flags, Rgb
from synth.flow.mask_selection import Proposal, SelectingTracker
from synth.recording_flow.frame_motion import FrameMotion


class LocalFlow:
    """Computes flow from the rest frame, frame by frame; subclasses use another process."""

    ahead = 0  # number of frames that may be submitted before the first result is awaited

    def begin(self, backend: str, rest: Rgb, proposal: Proposal, tissue: Flags) -> None:
        """Starts with the rest frame; arguments and errors as for `SelectingTracker`."""
        self._tracker = SelectingTracker(backend, rest, proposal, tissue)

    def submit(self, rgb: Rgb, proposal: Proposal) -> Future[FrameMotion]:
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
