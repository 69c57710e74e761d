"""Selection of masks among true and false detections of instruments and highlights."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, shift

from synth.flow.mask_selection import Proposal, SelectingTracker

_SIZE = 96
_NOTHING = np.zeros((_SIZE, _SIZE), bool)
_MIDDLE = np.pad(np.ones((36, 36), bool), 30)


def _texture() -> NDArray[np.float64]:
    rng = np.random.default_rng(5)
    field = gaussian_filter(rng.standard_normal((_SIZE, _SIZE)), 1.6)
    return 120 + 35 * field / field.std()


def _picture(grey: NDArray[np.float64]) -> NDArray[np.uint8]:
    return np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, -1)


def _moved(by_px: float) -> NDArray[np.float64]:
    return shift(_texture(), (0, by_px), order=5, mode="mirror")


def _tracker(rest: NDArray[np.float64], found: Proposal) -> SelectingTracker:
    return SelectingTracker("tvl1", _picture(rest), found, ~_NOTHING)


def test_tissue_that_is_detected_as_a_tool_is_not_masked() -> None:
    wrong = Proposal(_NOTHING, _MIDDLE, _NOTHING)
    tracker = _tracker(_texture(), wrong)
    for by_px in (1.0, 2.0):
        flow, _ = tracker.step(_picture(_moved(by_px)), wrong)
    assert not tracker.blocked.any()
    assert not tracker.rest_blocked.any()
    assert np.abs(flow[30:66, 30:66] - [2.0, 0.0]).mean() < 0.05


def test_a_tool_that_occludes_the_tissue_is_masked() -> None:
    tracker = _tracker(_texture(), Proposal(_NOTHING, _NOTHING, _NOTHING))
    for by_px in (1.0, 2.0):
        now = _picture(np.where(_MIDDLE, 60.0, _moved(by_px)))
        tracker.step(now, Proposal(_NOTHING, _MIDDLE, _NOTHING))
    assert tracker.blocked[36:60, 36:60].mean() > 0.9


def test_still_highlights_on_moving_tissue_are_masked_and_masking_helps() -> None:
    spots = gaussian_filter(np.random.default_rng(1).standard_normal((_SIZE, _SIZE)), 3)
    wet = spots > np.quantile(spots, 0.85)
    shine = Proposal(wet, _NOTHING, _NOTHING)
    errors = {}
    for name, found in (("chosen", shine), ("none", Proposal(_NOTHING, _NOTHING, _NOTHING))):
        tracker = _tracker(np.where(wet, 250.0, _texture()), found)
        for by_px in (1.5, 3.0):
            flow, _ = tracker.step(_picture(np.where(wet, 250.0, _moved(by_px))), found)
        errors[name] = float(np.abs(flow - [3.0, 0.0]).mean())
        if name == "chosen":
            assert tracker.blocked[wet].mean() > 0.8
    assert errors["chosen"] < 0.7 * errors["none"]


def _faint(by_px: float, noise: int, contrast: float = 0.3) -> NDArray[np.float64]:
    """Moved texture of low contrast with sensor noise."""
    grain = np.random.default_rng(noise).normal(0, 3, (_SIZE, _SIZE))
    return 120 + contrast * (_moved(by_px) - 120) + grain


@pytest.mark.parametrize(("contrast", "held"), [(0.06, True), (1.0, False)])
def test_confidence_is_low_where_only_highlights_support_zero_motion(contrast: float, held: bool) -> None:
    spots = gaussian_filter(np.random.default_rng(1).standard_normal((_SIZE, _SIZE)), 6)
    wet = spots > np.quantile(spots, 0.95)
    found = Proposal(wet, _NOTHING, _NOTHING)
    tracker = _tracker(np.where(wet, 250.0, _faint(0.0, 2, contrast)), found)
    for k, by_px in enumerate((1.5, 3.0, 3.0)):
        flow, confidence = tracker.step(_picture(np.where(wet, 250.0, _faint(by_px, 3 + k, contrast))), found)
        off = float(np.linalg.norm(flow - [by_px, 0.0], axis=-1)[~wet].mean())
        assert (off > 1) == held, "the case is only meaningful if the motion is missed"
        assert (confidence[wet].max() < 0.4) == held
