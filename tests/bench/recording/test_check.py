"""`bench check` foresees what `bench score` would stumble over."""

from __future__ import annotations

import pytest
from fake_recording import Bump, Maker

from bench.recording import check, pixel_scale
from bench.recording.folder import open_recording
from bench.recording.meta import LEAST_INTERVALS
from bench.scoring import evaluate_recording
from bench.scoring.evaluate_recording import Settings


@pytest.mark.parametrize(("span", "long_enough"), [([0.6, 2.0], False), ([0.6, 3.4], True)])
def test_the_length_that_the_clocks_need_is_foreseen(
    make: Maker, span: list[float], long_enough: bool
) -> None:
    about = {"sync": {"method": "correlate", "calibration_s": span, "search_s": 0.5}}
    folder = make(frames=42, meta=about)
    said = next(f for f in check.check_recording(folder) if "calibration_s holds" in f.said)
    assert (said.state == "ok") is long_enough
    assert f"{LEAST_INTERVALS / 10:.3g} s are needed" in said.said
    recording = open_recording(folder)
    sync = evaluate_recording.evaluate_recording(
        recording, {"bump": Bump()}, "bump", pixel_scale.find_scale(recording.meta, folder), Settings(), {}
    ).sync
    assert sync is not None
    assert ("frame intervals" in sync.refused) is not long_enough


def test_a_sensor_without_the_searchs_margin_is_foreseen(make: Maker) -> None:
    about = {"sync": {"method": "correlate", "calibration_s": [0.2, 4.0], "search_s": 0.5}}
    said = [f.said for f in check.check_recording(make(frames=42, meta=about)) if f.state == "odd"]
    assert any("lacks 0.4 s of sync.calibration_s" in line for line in said), said


def test_a_press_of_two_frames_and_a_span_without_samples_are_foreseen(make: Maker) -> None:
    folder = make(frames=20, meta={"press_s": [0.5, 0.65], "sensor": {"free_s": [[5.0, 6.0]]}})
    found = check.check_recording(folder)
    assert any(f.what == "press" and f.state == "odd" for f in found)
    assert any("no samples between 5 and 6 s" in f.said and f.state == "bad" for f in found)
