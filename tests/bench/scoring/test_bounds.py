"""A network's intervals in score.json and the report."""

from __future__ import annotations

import json
from pathlib import Path

import fake_intervals
import fake_model
import numpy as np
import pytest
from fake_recording import Maker

from bench.methods.network import Model
from bench.methods.protocol import Answer, Scene
from bench.recording import pixel_scale
from bench.recording.folder import open_recording
from bench.scoring import charts, evaluate_recording, report
from bench.scoring.evaluate_recording import Result, Settings
from learn.uncertainty.intervals import Intervals

HALF = 15.0  # between 60 mN and 70.5, which the sensor reads twice a press


class Told:
    """Answers 50 mN more or less than HALF, one frame in two being of another world."""

    def __init__(self, far: float = 0.5) -> None:
        self.far, self.count = far, 0

    def __call__(self, flow: np.ndarray, confidence: np.ndarray, scene: Scene, picture: bool) -> Answer:
        self.count += 1
        said = np.array([60.0, 0, 0])
        return Answer(said, None, 60.0 - HALF, 60.0 + HALF, self.far if self.count % 2 else np.nan)


def run(folder: Path, **methods: object) -> Result:
    recording = open_recording(folder)
    found = pixel_scale.find_scale(recording.meta, folder)
    return evaluate_recording.evaluate_recording(
        recording, methods, "told", found, Settings(rate_hz=None), {}  # type: ignore[arg-type]
    )  # fmt: skip


def test_columns_coverage_and_width(make: Maker, tmp_path: Path) -> None:
    result = run(make(), told=Told())
    assert result.sensor_mn is not None
    within = np.abs(result.sensor_mn - 60) <= HALF
    assert 0 < within.mean() < 1
    tree = evaluate_recording.as_json(result)
    assert tree["methods"]["told"]["interval"] == {
        "level": 0.9,
        "width_mn": pytest.approx(2 * HALF),
        "coverage": pytest.approx(within.mean(), abs=1e-6),
    }
    count = len(result.time_s)
    assert tree["curve"]["low_mn"] == {"told": [60 - HALF] * count}
    assert tree["curve"]["high_mn"] == {"told": [60 + HALF] * count}
    assert [name for name, one in tree["methods"].items() if "interval" in one] == ["told"]
    bands = [line for line in charts.draw_force(result)["data"] if line.get("fill") == "tonexty"]
    assert [line["name"] for line in bands] == ["90% interval", "±8% scale, stiffness"]
    assert bands[0]["y"] == [60 + HALF] * count
    report.write_report(result, tmp_path / "report.html")
    assert "90% interval is" in (tmp_path / "report.html").read_text()


def test_another_world_is_noted(make: Maker) -> None:
    folder = make(frames=8)
    assert not [note for note in run(folder, told=Told(0.9)).notes if "unseen" in note]
    (note,) = [note for note in run(folder, told=Told(1.7)).notes if "unseen" in note]
    assert note.startswith("told: unseen world: 100% of the frames that moved")
    assert "distance 1.7 times" in note


def test_of_unknown_stiffness_nothing_is_covered(make: Maker) -> None:
    result = run(make(frames=8, meta={"young_kpa": None}), told=Told())
    assert set(result.methods["told"].held) == {"level", "width_mn"}
    names = [line["name"] for line in charts.draw_force(result)["data"]]
    assert "90% interval" not in names


def test_methods_without_intervals_have_no_columns(make: Maker, tmp_path: Path) -> None:
    model = Model(fake_model.write_model(tmp_path / "model"))
    tree = evaluate_recording.as_json(run(make(frames=6), told=model))
    assert "low_mn" not in tree["curve"]
    assert not [name for name, one in tree["methods"].items() if "interval" in one]
    json.dumps(tree, allow_nan=False)


@pytest.mark.parametrize("output", ["magnitude", "vector"])
def test_a_network_s_own_are_those_of_its_card(make: Maker, tmp_path: Path, output: str) -> None:
    given: Intervals = fake_intervals.make()
    folder = fake_intervals.give(fake_model.write_model(tmp_path / "model", f"arch.output={output}"), given)
    one = run(make(frames=6), told=Model(folder)).methods["told"]
    assert one.low_mn is not None
    assert one.high_mn is not None
    assert one.high_mn == pytest.approx(one.size_mn + 10)
    assert one.low_mn == pytest.approx(np.maximum(one.size_mn - 10, 0))
