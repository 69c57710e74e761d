"""One film's flow, computed in this process."""

from __future__ import annotations

import time
from concurrent.futures import Future

from synth.flow.estimator import Flags, Rgb
from synth.flow.mask_choice import ChoosingTracker, Proposal
from synth.flow.track import Tracker
from synth.recording_flow.frame_motion import FrameMotion


class LocalFlow:
    """Flow from a rest frame, frame by frame; computed here and at once, by subclasses elsewhere."""

    ahead = 0
    """How many frames may be submitted before the first is waited for."""

    def begin(self, backend: str, rest: Rgb, masked: Flags | Proposal, tissue: Flags) -> None:
        """The rest frame; arguments and errors as `Tracker`, or, of a proposal, as `ChoosingTracker`."""
        self.tracker: Tracker | ChoosingTracker = (
            ChoosingTracker(backend, rest, masked, tissue)
            if isinstance(masked, Proposal)
            else Tracker(backend, rest, masked, tissue)
        )

    def submit(self, rgb: Rgb, masked: Flags | Proposal) -> Future[FrameMotion]:
        """The motion of a frame (h, w, 3), masked (h, w); errors as `Tracker`."""
        cpu, wall, tracker = time.process_time(), time.perf_counter(), self.tracker
        if isinstance(tracker, ChoosingTracker):
            assert isinstance(masked, Proposal)
            flow, confidence = tracker.step(rgb, masked)
            masked, rest_masked, regained = tracker.blocked, tracker.rest_blocked, tracker.regained
        else:
            assert not isinstance(masked, Proposal)
            resets = tracker.resets
            flow, confidence = tracker.step(rgb, masked)
            rest_masked = tracker.tissue & ~tracker.usable
            regained = tracker.trusted and tracker.resets > resets
        done: Future[FrameMotion] = Future()
        done.set_result(
            FrameMotion(
                flow,
                confidence,
                tracker.trusted,
                regained,
                masked=masked if masked.any() else None,
                rest_masked=rest_masked if rest_masked.any() else None,
                cpu_s=time.process_time() - cpu,
                wall_s=time.perf_counter() - wall,
            )
        )
        return done
