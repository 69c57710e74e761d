"""Contacts anywhere on tissue wider than an opening, against the half-space's theory."""

import numpy as np
import pytest
from half_space import press_surface
from numpy.typing import NDArray

from bench.methods import load_window, physics
from bench.methods.method_interface import ForceEstimate, FrameMotion, MethodContext
from bench.methods.physics import Physics
from learn.data.grid import Grid
from synth.arrays import Floats
from synth.flow.stereo.stereo_track import Motion3D

SCALE, YOUNG_KPA = 0.5, 5.0  # mm/px
PLACES = ((np.mgrid[:80, :120] - np.array([39.5, 59.5])[:, None, None]) * SCALE)[::-1].reshape(2, -1).T
FORCE = np.array([10.0, 0.0, 30.0])  # mN


def estimate_loads(*contacts: tuple[tuple[float, float], float]) -> tuple[Physics, ForceEstimate]:
    """Of contacts, each by its place [mm] and its part of `FORCE`, on tissue of 60 x 40 mm."""
    motion = sum(
        (share * press_surface(PLACES - place, FORCE / YOUNG_KPA, 0.45) for place, share in contacts),
        np.zeros(()),
    ).reshape(80, 120, 3)
    scene = MethodContext(np.ones((80, 120), bool), SCALE, YOUNG_KPA, "stripped", living=False)
    method = Physics()
    for time, level in enumerate((0, 0.5, 1)):
        moved = (level * motion).astype(np.float32)
        seen = Motion3D(moved, np.full_like(moved, 0.01))
        frame = FrameMotion(moved[..., :2] / SCALE, np.ones((80, 120), np.float32), motion=seen, time_s=time)
        method(frame, scene, False)
    return method, method.revise(np.zeros(3, bool))[-1]


@pytest.mark.slow
def test_a_contact_far_from_the_middle_is_estimated_like_one_in_the_middle() -> None:
    """Sought about the middle alone, the second force was 0.6 of the true one and the third 0.4."""
    sizes, cells = list[float](), np.indices((48, 48))[::-1] - 23.5
    share = 0.6  # the half-space's theory is linear, as is physics of so little motion
    for place in ((0.0, 0.0), (14.0, -5.0), (-22.0, 10.0)):
        method, estimate = estimate_loads((place, share))
        # The block's walls are fixed 50 mm away, where the half-space still sinks.
        assert estimate.force_mn == pytest.approx(share * FORCE, abs=0.25 * share * 32)
        assert not method.warnings
        sizes.append(float(np.linalg.norm(estimate.force_mn)))
        density = method.map_forces()[-1]
        middle_mm = (method.centres_px[-1] - [59.5, 39.5]) * SCALE
        load_mm = [physics.GRID.pitch_mm * np.average(axis, weights=density**2) for axis in cells]
        assert middle_mm + load_mm == pytest.approx(list(place), abs=1.5)
        assert density.sum() * physics.GRID.pitch_mm**2 > 0.8 * sizes[-1]
    assert sizes == pytest.approx(3 * [sizes[0]], rel=0.05)


@pytest.mark.slow
def test_a_picture_of_the_force_shows_it_where_it_acts() -> None:
    contact = np.array([14.0, -5.0])
    motion = press_surface(PLACES - contact, FORCE / YOUNG_KPA, 0.45).reshape(80, 120, 3).astype(np.float32)
    scene = MethodContext(np.ones((80, 120), bool), SCALE, YOUNG_KPA, "stripped", living=False)
    seen = Motion3D(motion, np.full_like(motion, 0.01))
    frame = FrameMotion(motion[..., :2] / SCALE, np.ones((80, 120), np.float32), motion=seen, time_s=0.0)
    density = Physics()(frame, scene, True).density
    assert density is not None
    assert np.average(PLACES, axis=0, weights=density.ravel() ** 2) == pytest.approx(contact, abs=1.5)


@pytest.mark.slow
def test_the_weaker_of_two_contacts_is_not_left_out() -> None:
    places, shares = np.array([(-2.0, 4.0), (13.0, 4.0)]), (1.0, 0.5)
    method, _ = estimate_loads(*((tuple(place), share) for place, share in zip(places, shares, strict=True)))
    x, y = (np.indices((48, 48))[::-1] - 23.5) * physics.GRID.pitch_mm
    loads = list[float]()
    for place in places:
        right, down = place - (method.centres_px[-1] - [59.5, 39.5]) * SCALE
        loads.append(float(method.map_forces()[-1][np.hypot(x - right, y - down) < 6].sum()))
    assert loads[1] == pytest.approx(0.5 * loads[0], rel=0.3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("contacts", "is_warned"),
    [
        ((((-4.0, 0.0), 1.0), ((13.0, 0.0), 0.7)), False),
        ((((-4.0, 0.0), 1.0), ((26.0, 0.0), 0.7)), True),
        ((((14.0, 0.0), 0.25),), True),  # too little motion to move the window
        ((((4.0, 0.0), 0.25),), False),
    ],
)
def test_a_contact_that_is_not_in_the_window_is_named(
    contacts: tuple[tuple[tuple[float, float], float], ...], is_warned: bool
) -> None:
    method, _ = estimate_loads(*contacts)
    assert bool(method.warnings) == is_warned


def test_a_window_stays_while_it_holds_the_places() -> None:
    still = (0.0, 0.0)
    assert load_window.place_window([(8.0, 3.0)], still) == still
    assert load_window.place_window([(8.0, 0.0), (-7.0, 0.0)], still) == still
    assert load_window.place_window([], (5.0, 3.0)) == (5.0, 3.0)


def test_a_window_is_moved_to_hold_the_strongest_places() -> None:
    places = [(12.0, 3.0), (-2.0, 3.0), (40.0, 3.0)]
    assert load_window.place_window(places, (0.0, 0.0)) == pytest.approx((5.0, 3.0), abs=0.01)
    places = [(11.0, 0.0), (-5.5, 0.0)]  # the middle would be 11 mm away
    assert load_window.place_window(places, (0.0, 0.0)) == pytest.approx((2.75, 0.0), abs=0.01)


def test_places_are_where_tissue_moves_more_than_around() -> None:
    grid = Grid(60, 60.0)
    x, y = np.meshgrid(*2 * [np.arange(60) - 29.5])

    def dent(x_mm: float, y_mm: float, depth_mm: float) -> Floats:
        return np.asarray(depth_mm * np.exp(-(np.square(x - x_mm) + np.square(y - y_mm)) / 18))

    depth = dent(10.5, 0.5, 2.0) + dent(-8.5, 5.5, 0.8) + dent(-8.5, -20.5, 0.3)
    moved, mask = np.stack([0 * depth, 0 * depth, depth]).astype(np.float32), np.ones((60, 60), np.float32)
    sure = np.full_like(moved, 0.02)
    unsure = np.where((np.abs(x) < 12) & (np.abs(y - 5.5) < 12) & (x < 0), np.float32(0.5), sure)

    def find(deviation: NDArray[np.float32], least_mm: float) -> list[load_window.Point]:
        places = load_window.find_places(moved, deviation, mask, grid, least_mm)
        return [place.point for place in places]

    assert find(sure, 0.1) == [(10.5, 0.5), (-8.5, 5.5)]
    assert find(sure, 1.0) == [(10.5, 0.5)]
    assert find(sure, 3.0) == []
    assert find(unsure, 0.1) == [(10.5, 0.5)]
    moved += np.array([0.5, 1.5, 2.0], np.float32)[:, None, None]  # as by breath: all of it
    assert find(sure, 0.1) == [(10.5, 0.5), (-8.5, 5.5)]


def test_a_grid_covers_tissue_of_any_size() -> None:
    tissue: NDArray[np.bool_] = np.zeros((50, 400), bool)
    tissue[20:30, 100:] = True
    grid = load_window.cover_tissue(tissue, (249.5, 24.5), 2.0)
    assert grid.extent_mm == pytest.approx(600.0)
    assert grid.size <= load_window.RULE.cells


def test_loads_of_frames_with_different_middles_are_joined_where_they_lie() -> None:
    nodes = load_window.index_nodes()
    loads, offsets = np.zeros((2, len(nodes), 3), np.float32), [(0, 0), (3, -2)]
    loads[0, np.flatnonzero((nodes == (4, 1)).all(axis=1))] = 2.0
    loads[1, np.flatnonzero((nodes == (1, 3)).all(axis=1))] = 5.0
    joined = load_window.join_loads(loads, offsets)
    assert joined.sum() == loads.sum()
    assert (joined[0] * joined[1]).sum() == pytest.approx(3 * 10.0)
