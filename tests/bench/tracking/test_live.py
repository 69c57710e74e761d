"""A stream with its flow elsewhere: the same answers, none held back for a frame that isn't there yet."""

from __future__ import annotations

from concurrent.futures import Future
from contextlib import closing

import numpy as np
import pytest

from bench.tracking import live
from bench.tracking.flow_process import FlowProcess
from synth.flow.estimator import Rgb
from synth.flow.mask_selection import Proposal
from synth.recording_flow.frame_motion import FrameMotion
from synth.recording_flow.local_flow import LocalFlow
from synth.recording_flow.video_flow import Footage, RecordingFlowSettings, VideoFlow
from synth.video.read import Picture


def film(frames: int) -> list[Picture]:
    rng = np.random.default_rng(3)
    rest = np.kron(rng.integers(40, 220, (16, 20)), np.ones((4, 4)))[..., None].repeat(3, 2).astype(np.uint8)
    return [Picture(k, k / 25, np.roll(rest, k, axis=1)) for k in range(frames)]


@pytest.mark.slow
def test_flow_elsewhere_gives_the_same_answers_in_order() -> None:
    def watched(flow: LocalFlow | None) -> list[live.LiveFrame]:
        answered: list[live.LiveFrame] = []
        footage, settings = Footage(film(5), "test"), RecordingFlowSettings("dis", 1, None, False, "none")
        live.stream_video(footage, settings, paced=False, report=answered.append, flow=flow)
        return answered

    here = watched(None)
    with closing(FlowProcess()) as process:
        there = watched(process)
    assert [one.index for one in there] == [one.index for one in here] == [1, 2, 3, 4]
    assert [one.largest_px for one in there] == [one.largest_px for one in here]


@pytest.mark.parametrize(
    ("needs_s", "expected"),
    [
        # There before the next frame: answered at once.
        (0.01, ["due 1", "asked 1", "told 1", "due 2", "asked 2", "told 2", "due 3", "asked 3", "told 3"]),
        # Not there: the next frame is asked meanwhile, and no more than that one.
        (9.0, ["due 1", "asked 1", "due 2", "asked 2", "told 1", "due 3", "asked 3", "told 2", "told 3"]),
    ],
)
def test_an_answer_comes_as_soon_as_it_is_there(needs_s: float, expected: list[str]) -> None:
    log: list[str] = []

    class Slow(Future[FrameMotion]):
        def result(self, timeout: float | None = None) -> FrameMotion:
            if timeout is not None and timeout < needs_s:
                raise TimeoutError
            return super().result()

    class Later(LocalFlow):
        ahead = 1
        asked = -1  # once before the stream's start

        def submit(self, rgb: Rgb, proposal: Proposal) -> Future[FrameMotion]:
            self.asked += 1
            if self.asked:
                log.append(f"asked {self.asked}")
            slow = Slow()
            slow.set_result(super().submit(rgb, proposal).result())
            return slow

    class Clock:
        def start(self, time_s: float) -> None:
            pass

        def is_due(self, index: int, time_s: float) -> bool:
            log.append(f"due {index}")
            return True

        def spare_s(self, time_s: float) -> float:
            return 0.04

    settings = RecordingFlowSettings("dis", 1, rate_hz=None, pulse=False, masks="none")
    for frame in VideoFlow(Footage(film(4), "test"), settings, Later(), pace=Clock()).frames():
        if not frame.is_rest:
            log.append(f"told {frame.index}")
    assert log == expected
