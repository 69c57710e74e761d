"""Where loads are sought on tissue wider than the opening of `compliance`: about the places that move.

An instrument shows as a place that moves more than the tissue around it. Of several such places the window
holds as many as fit, the strongest first; it stays where it is while it holds them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter

from bench.methods import compliance
from learn.data.grid import Grid, GridView
from synth.arrays import Floats, Ints, Map, Mask

Offset = tuple[int, int]
"""Of the middle of a frame's loads from the tissue's, in nodes along x and y."""

Point = tuple[float, float]
"""Camera x, y from the middle of the tissue [mm]."""


@dataclass(frozen=True)
class Place:
    """A place that moves more than the tissue around it."""

    point: Point
    motion_mm: float  # that is sure


@dataclass(frozen=True)
class WindowRule:
    """Constants of the window, by hand."""

    apart_mm: float = 6.0  # least distance of two places
    weakest: float = 0.2  # least motion of a place over that of the strongest
    smooth_mm: float = 1.5  # standard deviation of the means of motion
    doubted: float = 2.0  # deviations of motion that are taken off its size
    reach_mm: float = 9.0  # largest distance of the places in a window from its middle
    pitch_mm: float = 1.0  # of the grid on which they are sought
    cells: int = 128  # of that grid, at most
    moving_mm: float = 0.4
    """Least motion of a place, beyond the tissue's own: flow errs by as much at instruments."""
    named: float = 0.5  # motion of a place out of reach that is named, over the video's largest


RULE = WindowRule()


class LoadWindow:
    """The window of a video, frame by frame."""

    def __init__(self, view: GridView, own_mm: float | None) -> None:
        """`view`: of the grid that physics observes, about the tissue's middle; `own_mm`: the tissue's own
        motion; None: the window stays."""
        self.offset: Offset = (0, 0)
        self._views, self._wide_view = {self.offset: view}, None
        if own_mm is not None:
            grid = cover_tissue(view.tissue, view.centre_px, view.scale_mm_per_px)
            self._wide_view = GridView(view.tissue, view.scale_mm_per_px, grid)
            self._least_mm = RULE.moving_mm + own_mm
        self._middle: Point = (0.0, 0.0)
        self._strongest_mm = 0.0  # largest motion of a place so far
        self._missed = list[tuple[float, float]]()  # places not reached: motion, distance from the middle

    def follow(self, moved: Map, deviation: Map) -> None:
        """Moves the window to the places that move. `moved`, `deviation`: (C, H, W) mm."""
        if (view := self._wide_view) is None:
            return
        on_grid = view.mean(moved), view.mean(deviation), view.mask
        places = find_places(*on_grid, view.grid, self._least_mm)
        self._middle, missed = place_window(places, self._middle)
        x, y = (round(value / compliance.NODE_MM) for value in self._middle)
        self.offset = x, y
        self._strongest_mm = max(self._strongest_mm, *(place.motion_mm for place in places), 0.0)
        self._missed += [(place.motion_mm, measure_distance(place.point, self._middle)) for place in missed]

    @property
    def view(self) -> GridView:
        """The grid that physics observes, about the window's middle in whole nodes."""
        if self.offset not in self._views:
            view = self._views[0, 0]
            step_px = compliance.NODE_MM / view.scale_mm_per_px
            x, y = (
                start + number * step_px for start, number in zip(view.centre_px, self.offset, strict=True)
            )
            self._views[self.offset] = GridView(view.tissue, view.scale_mm_per_px, view.grid, (x, y))
        return self._views[self.offset]

    @property
    def warnings(self) -> list[str]:
        """Motion that no window held."""
        least_mm = RULE.named * self._strongest_mm
        distances_mm = [distance_mm for motion_mm, distance_mm in self._missed if motion_mm >= least_mm]
        if not distances_mm:
            return []
        fault = f"tissue moves {max(distances_mm):.0f} mm from where loads are sought, too"
        return [f"{fault}: a part of the force may be missing"]


def cover_tissue(tissue: Mask, centre_px: Sequence[float], scale_mm_per_px: float) -> Grid:
    """A grid about a tissue's centre that reaches to its farthest pixels. `tissue`: (H, W)."""
    rows, columns = np.nonzero(tissue)
    far_px = max(np.abs(columns - centre_px[0]).max(), np.abs(rows - centre_px[1]).max()) + 0.5
    extent_mm = 2 * float(far_px) * scale_mm_per_px
    return Grid(min(int(np.ceil(extent_mm / RULE.pitch_mm)), RULE.cells), extent_mm)


def find_places(moved: Map, deviation: Map, mask: Map, grid: Grid, least_mm: float) -> list[Place]:
    """The places that surely move more than what is around them, and by `least_mm` or more; the strongest
    first.

    `moved`, `deviation`: (C, N, N) mm on the grid; `mask`: (N, N) above 0.5 where there is tissue.
    """
    inside = (mask > 0.5).astype(np.float64)
    doubt_mm = RULE.doubted * np.linalg.norm(deviation, axis=0)
    sure_mm = np.sqrt(np.maximum(np.square(np.linalg.norm(moved, axis=0)) - np.square(doubt_mm), 0.0))
    # Less at the tissue's border, where motion is often wrong.
    size_mm = inside * gaussian_filter(inside * sure_mm, RULE.smooth_mm / grid.pitch_mm, mode="constant")
    around = 2 * round(RULE.apart_mm / grid.pitch_mm) + 1
    is_place = size_mm == maximum_filter(size_mm, around, mode="constant")
    is_place &= size_mm >= max(least_mm, RULE.weakest * float(size_mm.max()))
    rows, columns = np.nonzero(is_place)
    order = np.argsort(-size_mm[is_place], kind="stable")
    points = (np.stack([columns, rows], axis=1) - (grid.size - 1) / 2) * grid.pitch_mm
    return [Place((float(points[k, 0]), float(points[k, 1])), float(size_mm[is_place][k])) for k in order]


def place_window(places: Sequence[Place], middle: Point) -> tuple[Point, list[Place]]:
    """The window's middle for the places of a frame, and those that it does not reach.

    `places`: the strongest first; `middle`: of the frame before.
    """
    held, missed = list[Point](), list[Place]()
    for place in places:
        if _enclose([*held, place.point])[1] <= RULE.reach_mm:
            held.append(place.point)
        else:
            missed.append(place)
    if any(measure_distance(point, middle) > RULE.reach_mm for point in held):
        middle = _enclose(held)[0]
    return middle, missed


def measure_distance(first: Point, second: Point) -> float:
    """Distance of two points [mm]."""
    return float(np.hypot(first[0] - second[0], first[1] - second[1]))


def _enclose(given: Sequence[Point]) -> tuple[Point, float]:
    """Middle and radius of the least circle around points."""
    points: Floats = np.array(given)
    (x, y), radius = cv2.minEnclosingCircle(points.astype(np.float32))
    return (float(x), float(y)), float(radius)


def number_nodes() -> Ints:
    """Column and row (K, 2) of the nodes that bear loads, from the middle one."""
    return np.rint(compliance.lattice().nodes / compliance.NODE_MM).astype(int)


def join_loads(loads: Map, offsets: Sequence[Offset]) -> Map:
    """Loads (T, K, 3) at the nodes about each frame's offset as (T, 3 N) at nodes that all frames share."""
    nodes = number_nodes()
    places = (nodes[None] + np.array(offsets)[:, None]).reshape(-1, 2)
    shared, index = np.unique(places, axis=0, return_inverse=True)
    joined = np.zeros((len(loads), len(shared), 3), np.float32)
    joined[np.repeat(np.arange(len(loads)), len(nodes)), index.ravel()] = loads.reshape(-1, 3)
    return joined.reshape(len(loads), -1)
