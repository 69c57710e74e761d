"""Force by frame: prediction intervals and their part of the card; the grid on a wider picture."""

from pathlib import Path
from typing import Any

import fake_intervals
import numpy as np
import pytest
from fake_model import write_model
from numpy.typing import NDArray

from learn.checkpoint import read_card
from learn.data.grid import Grid
from learn.inference.force_estimator import ForceEstimator, FrameForce
from learn.inference.grid_placement import GridPlacement
from learn.inference.predict import load_model, net_force
from learn.uncertainty.intervals import LEVEL
from synth.errors import UserError
from synth.flow.recording.frame_motion import FrameMotion

SHAPE, SCALE = (48, 64), 0.5


def flow(size_mm: float) -> NDArray[np.float32]:
    """Half of the picture moved to the right."""
    out = np.zeros((*SHAPE, 2), np.float32)
    out[:, :32, 0] = size_mm / SCALE
    return out


def estimate(
    folder: Path, size_mm: float = 0.4, young_kpa: float | None = 2.0
) -> tuple[FrameForce, list[str]]:
    """The force and the notes on its interval."""
    estimator = ForceEstimator(load_model(folder), np.ones(SHAPE, bool), SCALE, young_kpa)
    frame_force = estimator.estimate(FrameMotion(flow(size_mm), np.ones(SHAPE, np.float32)))
    return frame_force, estimator.interval_notes


@pytest.fixture
def vector(tmp_path: Path) -> Path:
    return write_model(tmp_path / "vector", "arch.output=vector")


@pytest.mark.parametrize("young_kpa", [2.0, None])
def test_bounds_are_those_of_the_card_in_mn(vector: Path, young_kpa: float | None) -> None:
    frame_force, notes = estimate(fake_intervals.give(vector, fake_intervals.make()), young_kpa=young_kpa)
    force, young = frame_force.force_mn, young_kpa or 1.0
    size = np.linalg.norm(force)
    for level, factor in fake_intervals.FACTORS.items():
        band = frame_force.bands[float(level)]
        assert band.high[0] == pytest.approx(size + 5 * young * factor)
        assert band.low[0] == pytest.approx(max(size - 5 * young * factor, 0))
        assert band.axes_high[0] - force == pytest.approx(factor * young * np.array([3, 4, 50]))
        assert force - band.axes_low[0] == pytest.approx(factor * young * np.array([3, 4, 50]))
    assert notes == []


def test_without_direction_components_are_around_zero(tmp_path: Path) -> None:
    model = write_model(tmp_path / "sizes", "arch.output=magnitude")
    band = estimate(fake_intervals.give(model, fake_intervals.make()))[0].bands[LEVEL]
    assert band.axes_high[0] == pytest.approx([12, 16, 200])
    assert band.axes_low[0] == pytest.approx([-12, -16, -200])


def test_out_of_distribution_is_reported_and_widens_intervals(vector: Path) -> None:
    limit = 0.1
    frame_force, notes = estimate(fake_intervals.give(vector, fake_intervals.make(frame_limit=limit)))
    distance = abs(frame_force.map.motion[0])
    # From 1 mm; half of the tissue moved.
    assert distance == pytest.approx(abs(np.log(0.4 * np.sqrt(0.5) + 0.005)), rel=0.03)
    wider = frame_force.bands[0.68].high[0] - np.linalg.norm(frame_force.force_mn)
    assert wider == pytest.approx(10 * distance / limit)
    assert len(notes) == 1
    assert "log motion (low)" in notes[0]
    resting, notes = estimate(vector, 0.0)
    assert resting.bands
    assert notes == []


@pytest.mark.parametrize("output", ["vector", "magnitude"])
def test_fitting_and_estimation_use_the_same_force(output: str, tmp_path: Path) -> None:
    folder = write_model(tmp_path / "model", f"arch.output={output}")
    (loaded, _), (unloaded, _) = estimate(folder), estimate(folder, 0.0)
    force = net_force(loaded.map.density[None], unloaded.map.density[None], loaded.map.grid)
    assert force[0] == pytest.approx(loaded.force_mn, nan_ok=True, rel=1e-5, abs=1e-5)


def test_the_force_at_rest_is_subtracted_and_a_size_is_not_negative() -> None:
    grid, density = Grid(16), np.zeros((2, 1, 3, 16, 16), np.float32)
    density[0, ..., 8, 8], density[1, ..., 8, 8] = 1 / grid.pitch_mm**2, 3 / grid.pitch_mm**2
    assert np.abs(net_force(*density, grid)[0]) == pytest.approx([2.0, 2.0, 2.0])
    assert net_force(density[1, :, :1], density[0, :, :1], grid)[0, 0] == pytest.approx(2.0)
    assert net_force(density[0, :, :1], density[1, :, :1], grid)[0, 0] == 0


@pytest.mark.parametrize(
    "change", [("force_unit", -1.0), ("features", ("log motion",)), ("precision", ((1.0, 0.0),))]
)
def test_invalid_intervals_are_refused(vector: Path, change: tuple[str, Any]) -> None:
    intervals = fake_intervals.make()
    object.__setattr__(intervals.distribution if change[0] == "precision" else intervals, *change)
    fake_intervals.give(vector, intervals)
    with pytest.raises(UserError, match=r"config\.json.*intervals"):
        read_card(vector)


_WIDE = np.ones((240, 480), bool)  # 48 x 96 mm
_MM_PER_PX = 0.2
_GRID = Grid(32, 36.0)


def _bump(x: float, y: float, height: float = 4.0) -> NDArray[np.float32]:
    rows, columns = np.mgrid[: _WIDE.shape[0], : _WIDE.shape[1]]
    gaussian = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 15.0**2))
    return np.stack([height * gaussian, 0.5 * height * gaussian], -1).astype(np.float32)


def test_grid_that_covers_the_tissue_stays_in_its_middle() -> None:
    small = np.zeros_like(_WIDE)
    small[40:200, 60:220] = True
    placement = GridPlacement(small, _MM_PER_PX, _GRID)
    assert placement.fits
    assert placement.place(_bump(70, 50), None) == pytest.approx((139.5, 119.5))


def test_grid_goes_to_what_moves_and_not_beyond_the_tissue() -> None:
    placement = GridPlacement(_WIDE, _MM_PER_PX, _GRID)
    assert placement.place(_bump(400, 120, 0.1), None) == pytest.approx((239.5, 119.5)), "nothing moves yet"
    assert placement.place(_bump(360, 120), None) == pytest.approx((360, 119.5), abs=8)
    assert placement.place(_bump(375, 120), None)[0] == pytest.approx(360, abs=8), "that is near enough"
    assert placement.place(_bump(30, 120), None) == pytest.approx((90, 119.5), abs=5)
    assert placement.moves == 2


def test_force_is_that_of_the_part_that_moves(tmp_path: Path) -> None:
    """The same contact, far off the middle of a wide picture and alone on a picture as wide as the grid."""
    predictor = load_model(write_model(tmp_path / "model", "arch.output=vector"))
    estimator = ForceEstimator(predictor, _WIDE, _MM_PER_PX, 1.0)
    motion = _bump(370, 120)
    frame_force = estimator.estimate(FrameMotion(motion, np.ones(_WIDE.shape, np.float32)))
    force = frame_force.force_mn
    x, y = (round(2 * value) / 2 for value in estimator.placement.centre_px)
    half = round(predictor.grid.extent_mm / _MM_PER_PX / 2)
    top, left = round(y + 0.5) - half, round(x + 0.5) - half
    cut = slice(top, top + 2 * half), slice(left, left + 2 * half)
    part = FrameMotion(motion[cut], np.ones(motion[cut].shape[:2], np.float32))
    alone = ForceEstimator(predictor, _WIDE[cut], _MM_PER_PX, 1.0).estimate(part).force_mn
    assert force == pytest.approx(alone, rel=0.05, abs=0.02 * float(np.abs(alone).max()))
    middle = predictor(motion, _WIDE, _MM_PER_PX, 1.0).force_mn
    ignoring = ForceEstimator(predictor, _WIDE[cut], _MM_PER_PX, 1.0, "intact")
    assert np.array_equal(ignoring.estimate(part).force_mn, alone)
    assert [len(candidate.notes) for candidate in (estimator, ignoring)] == [1, 1]
    assert float(np.linalg.norm(middle - frame_force.map.force_mn)) > 0.2 * float(np.linalg.norm(alone))
