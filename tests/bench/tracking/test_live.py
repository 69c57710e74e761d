"""A stream with its flow elsewhere: the same answers, none held back for a frame that isn't there yet."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest

from bench.tracking import live
from bench.tracking.flow_process import FlowProcess
from synth.flow.mask_choice import Proposal
from synth.recording_flow.video_flow import Asked, Flags, FlowHere, Footage, Rgb, Settings, VideoFlow
from synth.video.read import Picture


def film(frames: int) -> list[Picture]:
    rng = np.random.default_rng(3)
    rest = np.kron(rng.integers(40, 220, (16, 20)), np.ones((4, 4)))[..., None].repeat(3, 2).astype(np.uint8)
    return [Picture(k, k / 25, np.roll(rest, k, axis=1)) for k in range(frames)]


@pytest.mark.slow
def test_flow_elsewhere_gives_the_same_answers_in_order() -> None:
    def watched(flow: FlowHere | None) -> list[live.Frame]:
        told: list[live.Frame] = []
        footage = Footage(film(5), "test")
        live.watch_video(footage, backend="dis", masks="none", paced=False, told=told.append, flow=flow)
        return told

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

    class Later(FlowHere):
        ahead = 1
        asked = 0

        def ask(self, rgb: Rgb, blocked: Flags | Proposal) -> Asked:
            self.asked += 1
            log.append(f"asked {self.asked}")
            return Asked(super().ask(rgb, blocked).take, lambda within_s: needs_s <= within_s)

    def is_due(index: int, time_s: float) -> bool:
        log.append(f"due {index}")
        return True

    settings = Settings("dis", 1, rate_hz=None, pulse=False, masks="none")
    video = VideoFlow(Footage(film(4), "test"), settings, Later(), is_due, spare_s=lambda time_s: 0.04)
    for step in video.steps():
        if not step.found.is_rest:
            log.append(f"told {step.picture.index}")
    assert log == expected
