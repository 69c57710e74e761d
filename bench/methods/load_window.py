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

from bench.methods import compliance, posterior
from learn.data.grid import Grid, GridView
from synth.arrays import Floats, Ints, Map, Mask

Offset = tuple[int, int]
"""Of the middle of a frame's loads from the tissue's, in nodes along x and y."""

Point = tuple[float, float]
"""Camera x, y; where not said otherwise from the middle of the tissue [mm]."""


@dataclass(frozen=True)
class Place:
    """A place that moves more than the tissue around it."""

    point: Point
    motion_mm: float  # that is sure


@dataclass(frozen=True)
class WindowRule:
    """Constants of the window, by hand."""

    apart_mm: float = 6.0  # least distance of two places
    weakest: float = 0.2  # least motion of a place over that of the frame's strongest
    most: int = 8  # places of a frame
    smooth_mm: float = 1.5  # standard deviation of the means of motion
    doubt: float = 2.0  # deviations of motion that are taken off its size
    reach_mm: float = 8.6  # largest distance of the places in a window from its middle, but for whole nodes
    pitch_mm: float = 1.0  # of the grid on which they are sought
    cells: int = 128  # of that grid, at most
    moving_mm: float = 0.4
    """Least motion of a place that moves a window, beyond the tissue's own: flow errs by as much at
    instruments."""
    seen_mm: float = 0.1  # least motion, likewise, of a place that is named if it isn't reached
    named: float = 0.5  # its motion over that of the video's strongest place


RULE = WindowRule()


class LoadWindow:
    """The window of a video, frame by frame."""

    def __init__(self, view: GridView, own_motion_mm: float, is_movable: bool) -> None:
        """`view`: of the grid that physics observes, about the tissue's middle; `own_motion_mm`: of the
        tissue, at most."""
        self.offset: Offset = (0, 0)
        self._middle_view, self._view = view, view
        self._own_mm = own_motion_mm
        self._whole: GridView | None = None  # a grid that covers the tissue; None: the window stays
        if is_movable:
            grid = cover_tissue(view.tissue, view.centre_px, view.scale_mm_per_px)
            self._whole = GridView(view.tissue, view.scale_mm_per_px, grid)
        self._strongest_mm = 0.0  # largest motion of a place so far
        self._beyond = list[Place]()  # places of the last frame that the window doesn't reach
        self._missed = list[tuple[float, float]]()  # of such in two frames: motion, distance from the middle

    def follow(self, moved: Map, deviation: Map) -> None:
        """Moves the window to the places that move. `moved`, `deviation`: (C, H, W) mm."""
        if self._whole is None:
            return
        view, node_mm = self._whole, compliance.NODE_MM
        on_grid = view.mean(moved), view.mean(deviation), view.mask
        places = find_places(*on_grid, view.grid, RULE.seen_mm + self._own_mm)
        moving = [place.point for place in places if place.motion_mm >= RULE.moving_mm + self._own_mm]
        middle = place_window(moving, self.find_middle())
        self.offset = round(middle[0] / node_mm), round(middle[1] / node_mm)
        self._strongest_mm = max(self._strongest_mm, *(place.motion_mm for place in places), 0.0)
        self._notice(places)

    def _notice(self, places: Sequence[Place]) -> None:
        """Remembers places that a window did not reach in two frames in turn: in one, flow may be wrong."""
        middle, before = self.find_middle(), self._beyond
        self._beyond = [p for p in places if measure_distance(p.point, middle) > posterior.MODEL.reach_mm]
        for place in self._beyond:
            if any(measure_distance(place.point, other.point) < RULE.apart_mm for other in before):
                self._missed.append((place.motion_mm, measure_distance(place.point, middle)))

    def find_middle(self) -> Point:
        """The middle of the window."""
        return self.offset[0] * compliance.NODE_MM, self.offset[1] * compliance.NODE_MM

    def locate(self, offset: Offset) -> Point:
        """x, y [px] of the middle of the window at an offset."""
        (x, y), step_px = self._middle_view.centre_px, compliance.NODE_MM / self._middle_view.scale_mm_per_px
        return x + offset[0] * step_px, y + offset[1] * step_px

    @property
    def view(self) -> GridView:
        """The grid that physics observes, about the window's middle."""
        middle, centre_px = self._middle_view, self.locate(self.offset)
        if self.offset == (0, 0):
            self._view = middle
        elif self._view.centre_px != centre_px:
            self._view = GridView(middle.tissue, middle.scale_mm_per_px, middle.grid, centre_px)
        return self._view

    @property
    def warnings(self) -> list[str]:
        """Motion that no window reached."""
        least_mm = RULE.named * self._strongest_mm
        distances_mm = [distance_mm for motion_mm, distance_mm in self._missed if motion_mm >= least_mm]
        if not distances_mm:
            return []
        fault = f"tissue moves {max(distances_mm):.0f} mm from where loads are sought, too"
        return [f"{fault}: a part of the force may be missing; draw tissue.png around one contact"]


def cover_tissue(tissue: Mask, centre_px: Sequence[float], scale_mm_per_px: float) -> Grid:
    """A grid about a tissue's centre that reaches to its farthest pixels. `tissue`: (H, W)."""
    rows, columns = np.nonzero(tissue)
    far_px = max(np.abs(columns - centre_px[0]).max(), np.abs(rows - centre_px[1]).max()) + 0.5
    extent_mm = 2 * float(far_px) * scale_mm_per_px
    return Grid(min(int(np.ceil(extent_mm / RULE.pitch_mm)), RULE.cells), extent_mm)


def find_places(moved: Map, deviation: Map, mask: Map, grid: Grid, least_mm: float) -> list[Place]:
    """The places that surely move, and otherwise than most of the tissue, more than what is around them and
    by `least_mm` or more; the strongest first.

    `moved`, `deviation`: (C, N, N) mm on the grid; `mask`: (N, N) above 0.5 where there is tissue.
    """
    inside = mask > 0.5
    common = np.median(moved[:, inside], axis=1)[:, None, None]
    # Without the common motion still tissue would move, too.
    least2 = np.minimum(np.square(moved).sum(axis=0), np.square(moved - common).sum(axis=0))
    doubt2 = np.square(RULE.doubt * deviation).sum(axis=0)
    sure_mm = np.sqrt(np.maximum(least2 - doubt2, 0.0))
    # Less at the tissue's border, where motion is often wrong.
    size_mm = inside * gaussian_filter(inside * sure_mm, RULE.smooth_mm / grid.pitch_mm, mode="constant")
    around = 2 * round(RULE.apart_mm / grid.pitch_mm) + 1
    is_place = size_mm == maximum_filter(size_mm, around, mode="constant")
    is_place &= size_mm >= max(least_mm, RULE.weakest * float(size_mm.max()))
    rows, columns = np.nonzero(is_place)
    order = np.argsort(-size_mm[is_place], kind="stable")[: RULE.most]
    points = (np.stack([columns, rows], axis=1) - (grid.size - 1) / 2) * grid.pitch_mm
    return [Place((float(points[k, 0]), float(points[k, 1])), float(size_mm[is_place][k])) for k in order]


def place_window(places: Sequence[Point], middle: Point) -> Point:
    """The window's middle for the places of a frame, the strongest first; `middle`: of the frame before."""
    held_points = list[Point]()
    for point in places:
        if _enclose([*held_points, point])[1] <= RULE.reach_mm:
            held_points.append(point)
    if any(measure_distance(point, middle) > RULE.reach_mm for point in held_points):
        return _enclose(held_points)[0]
    return middle


def measure_distance(first: Point, second: Point) -> float:
    """Distance of two points [mm]."""
    return float(np.hypot(first[0] - second[0], first[1] - second[1]))


def _enclose(given: Sequence[Point]) -> tuple[Point, float]:
    """Middle and radius of the least circle around points."""
    points: Floats = np.array(given)
    (x, y), radius = cv2.minEnclosingCircle(points.astype(np.float32))
    return (float(x), float(y)), float(radius)


def index_nodes() -> Ints:
    """Column and row (K, 2) of the nodes that bear loads, from the middle one."""
    return np.rint(compliance.lattice().nodes / compliance.NODE_MM).astype(int)


def join_loads(loads: Map, offsets: Sequence[Offset]) -> Map:
    """Loads (T, K, 3) at the nodes about each frame's offset as (T, 3 N) at nodes that all frames share."""
    nodes = index_nodes()
    places = (nodes[None] + np.array(offsets)[:, None]).reshape(-1, 2)
    shared, index = np.unique(places, axis=0, return_inverse=True)
    joined = np.zeros((len(loads), len(shared), 3), np.float32)
    joined[np.repeat(np.arange(len(loads)), len(nodes)), index.ravel()] = loads.reshape(-1, 3)
    return joined.reshape(len(loads), -1)
