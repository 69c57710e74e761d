"""Likeness of crops: kernel distance and coverage by hand, lengths of drawn vessels."""

import cv2
import numpy as np
import pytest

from evidence.appearance.likeness import find_covered, kernel_distance, vessel_lengths

MM_PER_PX = 0.055


def test_kernel_distance_is_zero_of_one_distribution_and_grows_with_a_shift() -> None:
    rng = np.random.default_rng(0)
    values = rng.standard_normal((3, 400, 8))
    d_same, d_near, d_far = (kernel_distance(values[0], values[1] + shift) for shift in (0.0, 0.3, 1.0))
    assert abs(d_same) < 0.05 < d_near < d_far


def test_kernel_distance_of_single_values_is_that_of_the_definition() -> None:
    a, b = np.array([[1.0], [2.0]]), np.array([[0.0], [3.0]])
    within = 27.0 + 1.0  # (1 * 2 + 1)^3 and (0 * 3 + 1)^3
    between = np.mean([1.0, 64.0, 1.0, 343.0])
    assert kernel_distance(a, b) == pytest.approx(within - 2 * between)


def test_coverage_counts_crops_with_a_rendered_one_among_their_neighbours() -> None:
    theirs = np.arange(8.0)[:, None]
    alone = np.eye(8, dtype=bool)
    assert find_covered(theirs, theirs + 0.1, alone, k=1).all()
    assert np.flatnonzero(find_covered(theirs, np.array([[2.1]]), alone, k=1)).tolist() == [2, 3]
    assert not find_covered(theirs, np.array([[100.0]]), alone).any()


def test_what_overlaps_is_no_neighbour() -> None:
    theirs, ours = np.array([[0.0], [0.1], [5.0], [9.0]]), np.array([[1.5]])
    apart, overlapping = np.eye(4, dtype=bool), np.eye(4, dtype=bool)
    overlapping[:2, :2] = True
    assert find_covered(theirs, ours, apart, k=1).tolist() == [False, False, True, False]
    assert find_covered(theirs, ours, overlapping, k=1).tolist() == [True, True, True, False]


@pytest.mark.parametrize(("calibre_mm", "place"), [(0.22, 1), (0.5, 2)])
def test_lengths_of_drawn_vessels(calibre_mm: float, place: int) -> None:
    """Three straight vessels across a field: their length over its area, in their calibre."""
    side, finer = 160, 8
    large = np.full((side * finer, side * finer, 3), (240, 200, 160), np.uint8)
    width = round(calibre_mm / MM_PER_PX * finer)
    for y in (0.25, 0.5, 0.75):
        middle = round(y * side * finer)
        cv2.line(large, (0, middle), (side * finer, middle), (200, 80, 60), width)
    picture = cv2.resize(large, (side, side), interpolation=cv2.INTER_AREA)
    inside = np.zeros((side, side), bool)
    inside[10:-10, 10:-10] = True
    lengths, line = vessel_lengths(picture, inside, MM_PER_PX)
    expected = 3 / (140 * MM_PER_PX)  # each vessel is as long as the field
    assert lengths[place] == pytest.approx(expected, rel=0.25)
    assert lengths.sum() == pytest.approx(lengths[place], rel=0.2)
    assert line.shape == (3 * side, 3 * side)
