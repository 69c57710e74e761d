"""Position of the grid on a picture that is wider than it."""

from pathlib import Path

import numpy as np
import pytest
from fake_model import write_model
from numpy.typing import NDArray

from learn.data.grid import Grid
from learn.inference.force_estimator import ForceEstimator
from learn.inference.grid_placement import GridPlacement
from learn.inference.predict import load_model
from synth.recording_flow.frame_motion import FrameMotion

_WIDE = np.ones((240, 480), bool)  # 48 x 96 mm
_MM_PER_PX = 0.2
_GRID = Grid(32, 36.0)


def _bump(x: float, y: float, height: float = 4.0) -> NDArray[np.float32]:
    rows, columns = np.mgrid[: _WIDE.shape[0], : _WIDE.shape[1]]
    near = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 15.0**2))
    return np.stack([height * near, 0.5 * height * near], -1).astype(np.float32)


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
    moved = _bump(370, 120)
    found = estimator.estimate(FrameMotion(moved, np.ones(_WIDE.shape, np.float32)))
    force = found.force_mn
    x, y = (round(2 * value) / 2 for value in estimator.placement.centre_px)
    half = round(predictor.grid.extent_mm / _MM_PER_PX / 2)
    top, left = round(y + 0.5) - half, round(x + 0.5) - half
    cut = slice(top, top + 2 * half), slice(left, left + 2 * half)
    part = FrameMotion(moved[cut], np.ones(moved[cut].shape[:2], np.float32))
    alone = ForceEstimator(predictor, _WIDE[cut], _MM_PER_PX, 1.0).estimate(part).force_mn
    assert force == pytest.approx(alone, rel=0.05, abs=0.02 * float(np.abs(alone).max()))
    middle = predictor(moved, _WIDE, _MM_PER_PX, 1.0).force_mn
    ignoring = ForceEstimator(predictor, _WIDE[cut], _MM_PER_PX, 1.0, "intact")
    assert np.array_equal(ignoring.estimate(part).force_mn, alone)
    assert [len(one.notes) for one in (estimator, ignoring)] == [1, 1]
    assert middle is not None
    assert float(np.linalg.norm(middle - found.map.force_mn)) > 0.2 * float(np.linalg.norm(alone))
