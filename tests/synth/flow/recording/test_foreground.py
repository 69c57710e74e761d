"""Foreground objects on tissue of analytic motion and depth."""

import re

import numpy as np
import pytest
from numpy.typing import NDArray

from synth.flow.recording.foreground import ForegroundSearch, fit_surface, flow_jump
from synth.flow.recording.frame_motion import FrameMotion

SHAPE = (120, 160)
Y, X = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float32)
ROD = (np.abs(Y - 60) < 8) & (X < 90)


def load(peak_px: float) -> NDArray[np.float32]:
    """Motion of a half-space around a load at (90, 60), which falls as 1 / r (Cerruti)."""
    x, y = X - 90, Y - 60
    r = np.sqrt(x**2 + y**2 + 17.0**2)
    return peak_px * 17 * np.stack([(0.55 / r + 0.45 * x * x / r**3), 0.45 * x * y / r**3], -1)


def find_messages(
    motion: NDArray[np.float32], depth: NDArray[np.float32] | None, masked: bool = False
) -> list[str]:
    search = ForegroundSearch(np.ones(SHAPE, bool), 1, is_stated=True, has_masks=True)
    mask, confidence = ROD if masked else None, np.ones(SHAPE, np.float32)
    for k in range(4):
        search.add(FrameMotion(k / 3 * motion, confidence, is_rest=k == 0, index=k, masked=mask), depth)
    return [finding.message for finding in search.findings]


@pytest.mark.parametrize("peak_px", [0.5, 2.0, 8.0, 30.0])
def test_a_rod_is_found_by_its_motion_or_its_depth_and_elastic_tissue_is_not(peak_px: float) -> None:
    tissue_motion, depth = load(peak_px), (300 + X / 50 + Y**2 / 9000).astype(np.float32)
    rigid_motion = np.where(ROD[..., None], tissue_motion[60, 90], tissue_motion)
    assert find_messages(tissue_motion, depth) == []
    motion_messages = find_messages(rigid_motion, None)
    assert len(motion_messages) == (peak_px > 1)
    depth_messages = find_messages(tissue_motion, np.where(ROD, depth - 6, depth))
    assert len(depth_messages) == 1
    for message in motion_messages + depth_messages:
        x, y = map(int, re.findall(r"\d+", message)[:2])
        assert ROD[max(y - 10, 0) : y + 10, x].any()
    assert find_messages(rigid_motion, np.where(ROD, depth - 6, depth), masked=True) == []


@pytest.mark.parametrize(("half_width", "reported"), [(8, False), (16, False), (24, True)])
def test_a_detected_instrument_is_no_foreign_object_but_a_hand_is(half_width: int, reported: bool) -> None:
    tool = (np.abs(Y - 60) < half_width) & (X < 90)
    search = ForegroundSearch(np.ones(SHAPE, bool), 1, is_stated=True, has_masks=False)
    for k in range(4):
        confidence = np.where(tool & (k > 0), 0.1, 1).astype(np.float32)
        masks = {"masked": tool & (k > 0), "tool": tool & (k > 0)}
        frame = FrameMotion(k * load(2.0), confidence, is_rest=k == 0, index=k, **masks)
        search.add(frame, (300 - 6.0 * (tool & (k > 0))).astype(np.float32))
    assert bool(search.findings) is reported


def test_the_surface_follows_the_tissue_and_a_slope_is_not_a_jump() -> None:
    depth = (300 + X / 50 + X * Y / 9000).astype(np.float32)
    surface, deviation = fit_surface(np.where(ROD, depth - 6, depth), np.ones(SHAPE, bool))
    assert np.abs(surface - depth).max() < 1e-3
    assert deviation < 1e-3
    step = np.stack([0 * X, 5.0 * (X > 80)], -1).astype(np.float32)
    assert flow_jump(step)[20:-20, 60:100].max() == pytest.approx(5.0)
    assert flow_jump(np.stack([X / 9, Y / 7], -1))[20:-20, 20:-20].max() < 1e-3


@pytest.mark.parametrize("offset_px", [0, 14])
def test_what_has_moved_under_a_mask_is_held_by_it_and_an_object_beside_it_is_not(offset_px: int) -> None:
    """Tissue moves 20 px down, under a rod's mask; or under a wider object that the mask covers in part."""
    shift = np.stack([0 * X, np.full_like(Y, 20.0)], -1)
    rod_now, rod_at_rest = np.abs(Y - 80) < 8, np.abs(Y - 60) < 8
    lost_area = rod_at_rest if offset_px == 0 else np.abs(Y - 60 - offset_px) < 8 + offset_px
    search = ForegroundSearch(np.ones(SHAPE, bool), 1, is_stated=True, has_masks=True)
    for k in range(4):
        confidence = np.where(lost_area & (k > 0), 0.1, 1).astype(np.float32)
        search.add(
            FrameMotion(min(k, 1) * shift, confidence, is_rest=k == 0, index=k, masked=rod_now & (k > 0))
        )
    assert bool(search.findings) is (offset_px > 0)


@pytest.mark.parametrize("radius_px", [0, 16, 25])
@pytest.mark.parametrize("peak_px", [10.0, 25.0])
def test_tissue_that_flow_loses_as_it_moves_far_is_no_object_and_another_colour_in_it_is(
    radius_px: int, peak_px: float
) -> None:
    distance_px = np.hypot(Y - 60, X - 80)
    rest, lost_area = np.full((*SHAPE, 3), 120, np.uint8), distance_px < 25
    now = np.where(distance_px[..., None] < radius_px, 190, rest).astype(np.uint8)
    search = ForegroundSearch(np.ones(SHAPE, bool), 1, is_stated=True, has_masks=True)
    for k in range(4):
        confidence = np.where(lost_area & (k > 0), 0.1, 1).astype(np.float32)
        motion = min(k, 1) * load(peak_px)
        search.add(FrameMotion(motion, confidence, is_rest=k == 0, index=k, rgb=now if k else rest))
    assert bool(search.findings) is (radius_px > 0)
