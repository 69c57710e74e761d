"""Intervals beside a network's answer: where they are said, and what the card holds of them."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import fake_intervals
import fake_model
import numpy as np
import pytest
from numpy.typing import NDArray

from learn.checkpoint import read_card, write_card
from learn.inference import prediction_file
from learn.inference.apply import Motion, Step, apply
from learn.inference.force_reader import ForceReader, net_force
from learn.inference.predict import load_predictor
from learn.uncertainty.intervals import LEVEL
from synth.errors import UserError

SHAPE, SCALE = (48, 64), 0.5


def flow(size_mm: float) -> NDArray[np.float32]:
    """Half of the picture moved to the right."""
    out = np.zeros((*SHAPE, 2), np.float32)
    out[:, :32, 0] = size_mm / SCALE
    return out


def reader(folder: Path, young_kpa: float | None = 2.0) -> ForceReader:
    return ForceReader(load_predictor(folder), np.ones(SHAPE, bool), SCALE, young_kpa)


@pytest.fixture
def vector(tmp_path: Path) -> Path:
    return fake_model.write_model(tmp_path / "vector", "arch.output=vector")


@pytest.fixture
def sizes(tmp_path: Path) -> Path:
    return fake_model.write_model(tmp_path / "sizes", "arch.output=magnitude")


@pytest.mark.parametrize("young_kpa", [2.0, None])
def test_bounds_are_those_of_the_card_in_newtons(vector: Path, young_kpa: float | None) -> None:
    reading = reader(fake_intervals.give(vector, fake_intervals.make()), young_kpa)
    force, said = reading.read(flow(0.4), None)
    bounds, young = reading.bound(force, said), young_kpa or 1.0
    assert bounds is not None
    size = np.linalg.norm(force)
    for level, factor in fake_intervals.FACTORS.items():
        band = bounds[float(level)]
        assert band.high[0] == pytest.approx(size + 5 * young * factor)
        assert band.low[0] == pytest.approx(max(size - 5 * young * factor, 0))
        assert band.axes_high[0] - force == pytest.approx(factor * young * np.array([3, 4, 50]))
        assert force - band.axes_low[0] == pytest.approx(factor * young * np.array([3, 4, 50]))
    ends = reading.bound_map(force, said)
    assert ends is not None
    assert ends[1] - said.magnitude == pytest.approx(young * said.view.mask, rel=1e-4)
    assert reading.notes == []


def test_of_a_network_of_sizes_components_are_around_zero(sizes: Path) -> None:
    reading = reader(fake_intervals.give(sizes, fake_intervals.make()))
    force, said = reading.read(flow(0.4), None)
    bounds = reading.bound(force, said)
    assert bounds is not None
    assert bounds[LEVEL].axes_high[0] == pytest.approx([12, 16, 200])
    assert bounds[LEVEL].axes_low[0] == pytest.approx([-12, -16, -200])


def test_an_unseen_world_is_said_with_its_distance_and_widens(vector: Path) -> None:
    usual = 0.1
    reading = reader(fake_intervals.give(vector, fake_intervals.make(usual=usual)))
    force, said = reading.read(flow(0.4), None)
    bounds = reading.bound(force, said)
    assert bounds is not None
    assert said.motion is not None
    distance = abs(said.motion[0])
    # From 1 mm; half of the tissue moved.
    assert distance == pytest.approx(abs(np.log(0.4 * np.sqrt(0.5) + 0.005)), rel=0.03)
    assert bounds[0.68].high[0] - np.linalg.norm(force) == pytest.approx(10 * distance / usual)
    assert len(reading.notes) == 1
    assert "unseen world: 100% of the frames that moved" in reading.notes[0]
    assert f"distance {distance / usual:.2g} times" in reading.notes[0]
    # Stillness is no world.
    resting = reader(vector)
    assert resting.bound(*resting.read(flow(0.0), None)) is not None
    assert resting.notes == []


def test_intervals_of_true_motion_say_so(vector: Path) -> None:
    reading = reader(fake_intervals.give(vector, fake_intervals.make(source="ideal")))
    reading.bound(*reading.read(flow(0.4), None))
    assert reading.notes == ["intervals are of true motion: of recovered motion they are too narrow"]


def test_a_model_without_intervals_has_none(vector: Path) -> None:
    reading = reader(vector)
    force, said = reading.read(flow(0.4), None)
    assert reading.bound(force, said) is None
    assert reading.bound_map(force, said) is None
    assert said.motion is None
    assert reading.notes == []


@pytest.mark.parametrize("kind", ["vector", "sizes"])
def test_the_force_that_is_fitted_on_is_the_one_that_is_read(
    kind: str, request: pytest.FixtureRequest
) -> None:
    folder = request.getfixturevalue(kind)
    force, said = reader(folder).read(flow(0.4), None)
    _, still = reader(folder).read(flow(0.0), None)
    found = net_force(said.density[None], still.density, said.kind, said.grid)
    assert found.shape == (1, 3)
    assert found[0] == pytest.approx(force, nan_ok=True, rel=1e-5, abs=1e-5)


def test_a_card_keeps_its_intervals(vector: Path) -> None:
    given = fake_intervals.make()
    fake_intervals.give(vector, given)
    assert read_card(vector).intervals == given
    without = dataclasses.replace(read_card(vector), intervals=None, no_intervals="too few")
    write_card(vector, without)
    assert read_card(vector) == without


def test_a_card_from_before_there_were_intervals_is_read(vector: Path) -> None:
    file = vector / "config.json"
    tree = json.loads(file.read_text())
    for key in ("intervals", "no_intervals", "seal"):
        tree.pop(key, None)
    file.write_text(json.dumps(tree))
    card = read_card(vector)
    assert card.intervals is None
    assert card.no_intervals == ""


@pytest.mark.parametrize(
    ("at", "value"),
    [
        (("size", "factors", "0.9"), -1.0),
        (("size", "factors", "0.9"), float("nan")),
        (("size", "scale", "least"), 0.0),
        (("world", "usual"), "far"),
        (("axes",), []),
        (("features",), ["log motion"]),
        (("size", "factors"), {"0.9": 1.0}),
        (("world", "middle"), [0.0]),
        (("more",), 1),
    ],
)
def test_intervals_that_can_not_be_are_one_line(vector: Path, at: tuple[str, ...], value: object) -> None:
    fake_intervals.give(vector, fake_intervals.make())
    file = vector / "config.json"
    tree = json.loads(file.read_text())
    del tree["seal"]
    place = tree["intervals"]
    for key in at[:-1]:
        place = place[key]
    place[at[-1]] = value
    file.write_text(json.dumps(tree))
    with pytest.raises(UserError, match="intervals") as caught:
        read_card(vector)
    assert "\n" not in str(caught.value)


def test_an_edited_interval_is_seen(vector: Path) -> None:
    fake_intervals.give(vector, fake_intervals.make())
    file = vector / "config.json"
    file.write_text(file.read_text().replace('"usual": 1000000.0', '"usual": 1000001.0'))
    with pytest.raises(UserError, match="edited or damaged"):
        read_card(vector)


@pytest.mark.parametrize("scale_known", [True, False])
def test_a_film_of_unknown_scale_has_none(vector: Path, scale_known: bool) -> None:
    """Its forces are of no unit, and its motion in mm is of no world."""
    fake_intervals.give(vector, fake_intervals.make())
    steps = iter([Step(flow(0.0), None, 0), Step(flow(0.4), None, 1, trusted=False)])
    film = Motion("film", steps, np.ones(SHAPE, bool), SCALE, 2.0, scale_known=scale_known)
    found = apply(load_predictor(vector), film)
    rows = prediction_file.tabulate(found).splitlines()[1:]
    assert ("low_mn" in found) == ("density_high" in found) == scale_known
    assert rows[0].endswith(",,") != scale_known
    if scale_known:
        assert found["high_mn"][0] == pytest.approx(found["total_force_mn"][0] + 20)
        assert np.isnan(found["low_mn"][1])
        assert np.isnan(found["force_high_mn"][1]).all()
        assert rows[1].endswith(",,")
