"""Where a brain's surface could be opened: places all over it, judged by how evenly they fill the opening."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from synth.geometry.brain_surface import axes
from synth.render.anatomy.surface import LEAST_FILLED, MARGIN_MM

Floats = NDArray[np.float64]

_UNDER_SKULL_MM = 8.0  # how far below its convex hull the surface may lie and still be reached from outside
_PIXEL_MM = 2.0
_PER_MM2 = 1.5  # samples of the surface: every pixel of it then holds some
_MOST_SAMPLES = 600_000
_WHOLE = 0.97  # of the opening itself must be surface
_FLAT = 0.01  # of the radius, median from the best plane: over a dome of 70 mm radius it is twice as much
_STEEPEST_MM = 4.0  # rms departure from a dome; a cleft in the opening has more


@dataclass(frozen=True)
class Site:
    """One place, judged. Coordinates are the file's [mm]."""

    point: Floats
    """(3,) on the surface."""
    direction: Floats
    """(3,) unit vector outwards: the normal of the surface's mean plane in the opening."""
    filled: float
    """Share of the opening, rim's reach included, under which there is surface."""
    relief_mm: float
    """How far the surface departs from a smooth dome over the opening, rms; its gyri and sulci."""
    fault: str
    """Why it can't be opened there; empty if it can."""
    cut: bool = False
    """Most of it is flat: a wall that the surface was cut at, rather than cortex."""


class Ground:
    """A surface as points all over it, with those that a skull would lie on."""

    def __init__(self, vertices: Floats, faces: NDArray[np.integer]) -> None:
        """Samples a surface: vertices (V, 3) mm, faces (F, 3); the same each time."""
        corner = vertices[faces]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        area = 0.5 * np.linalg.norm(normal, axis=1)
        count = int(np.clip(_PER_MM2 * area.sum(), 2_000, _MOST_SAMPLES))
        rng = np.random.default_rng(0)
        face = rng.choice(len(faces), count, p=area / area.sum())
        u, v = np.sqrt(rng.uniform(size=count)), rng.uniform(size=count)
        parts = np.stack([1 - u, u * (1 - v), u * v], axis=1)
        self.points = np.einsum("nk,nkd->nd", parts, corner[face])
        """(n, 3) mm."""
        self._tree = cKDTree(self.points)
        self._planes = _hull(vertices)
        self._below, self._plane = _above(self.points, self._planes)

    def spread(self, count: int) -> NDArray[np.int64]:
        """`count` points under the skull, far from one another: farthest-point sampling, (count,) indices."""
        outer = np.flatnonzero(self._below > -_UNDER_SKULL_MM)
        places = self.points[outer]
        chosen = [int(np.linalg.norm(places - places.mean(axis=0), axis=1).argmax())]
        away = np.full(len(places), np.inf)
        while len(chosen) < min(count, len(places)):
            away = np.minimum(away, ((places - places[chosen[-1]]) ** 2).sum(axis=1))
            chosen.append(int(away.argmax()))
        return outer[chosen]

    def outward(self, index: int) -> Floats:
        """(3,) the normal of the hull over a point: a first guess of the way out."""
        return np.asarray(self._planes[self._plane[index], :3])

    def nearest(self, point: Floats) -> int:
        """The sample nearest to a point (3,) mm."""
        return int(self._tree.query(point)[1])

    def judge(self, point: Floats, direction: Floats, radius_mm: float, *, turned: bool = True) -> Site:
        """An opening at a point (3,) mm of the surface, looked at from a direction (3,).

        `turned`: the direction is a guess, which the surface's own mean plane corrects.
        """
        half = radius_mm + MARGIN_MM
        near = self.points[self._tree.query_ball_point(point, np.sqrt(2) * half + 1.5 * half)]
        out = direction / np.linalg.norm(direction)
        for step in range(3 if turned else 1):
            turn = axes(out)
            x, y, height = _map((near - point) @ turn.T, half)
            there = np.isfinite(height) & (np.hypot(x, y) < radius_mm)
            if step == 2 or not turned or there.sum() < 12:
                break
            slope = np.linalg.lstsq(_columns(x[there], y[there])[:, :3], height[there], rcond=None)[0]
            out = np.array([-slope[1], -slope[2], 1.0]) @ turn
            out /= np.linalg.norm(out)
        inside = np.hypot(x, y) < radius_mm
        filled, whole = float(np.isfinite(height).mean()), float(np.isfinite(height[inside]).mean())
        if there.sum() < 12:
            return Site(point, out, filled, np.inf, "there is hardly any surface")
        columns = _columns(x[there], y[there])
        dome = columns @ np.linalg.lstsq(columns, height[there], rcond=None)[0]
        relief = float(np.sqrt(np.mean((height[there] - dome) ** 2)))
        middle = height[there][np.hypot(x, y)[there].argmin()]
        flat = _off_plane(columns[:, :3], height[there]) < _FLAT * radius_mm
        return Site(point + middle * turn[2], out, filled, relief, _fault(filled, whole, relief), flat)


def survey(ground: Ground, radius_mm: float, count: int = 300) -> list[Site]:
    """Places all over a surface, the best first: those that can be opened, cortex before cut walls, the
    evenest before others."""
    found = [ground.judge(ground.points[k], ground.outward(k), radius_mm) for k in ground.spread(count)]
    return sorted(found, key=lambda site: (bool(site.fault), site.cut, site.relief_mm))


def by_distance(ground: Ground, point: Floats, radius_mm: float, count: int = 200) -> Iterator[Site]:
    """Cortex that can be opened, from the place nearest to a point (3,) mm on; judged as it is asked for."""
    places = ground.spread(count)
    away = np.linalg.norm(ground.points[places] - point, axis=1)
    for k in places[np.argsort(away)]:
        site = ground.judge(ground.points[k], ground.outward(k), radius_mm)
        if not site.fault and not site.cut:
            yield site


def apart(sites: list[Site], least_mm: float) -> list[Site]:
    """Those that lie at least so far from every better one, in their order."""
    kept: list[Site] = []
    for site in sites:
        if all(np.linalg.norm(site.point - other.point) >= least_mm for other in kept):
            kept.append(site)
    return kept


def _off_plane(columns: Floats, height: Floats) -> float:
    """Median distance from the plane that fits half of the heights (n,) best, by least trimmed squares.

    Started from each half of the disc, as an edge may lie to any side.
    """
    x, y, found = columns[:, 1], columns[:, 2], np.inf
    for kept in (x < 0, x > 0, y < 0, y > 0):
        for _ in range(8):
            if kept.sum() < 6:
                break
            off = np.abs(height - columns @ np.linalg.lstsq(columns[kept], height[kept], rcond=None)[0])
            found = min(found, float(np.median(off)))
            kept = off <= np.median(off)
    return found


def _fault(filled: float, whole: float, relief: float) -> str:
    if filled < LEAST_FILLED:
        return f"the surface fills {filled:.0%} of the opening and what is round it, under {LEAST_FILLED:.0%}"
    if whole < _WHOLE:
        return f"the surface fills {whole:.0%} of the opening itself"
    if relief > _STEEPEST_MM:
        return f"the surface departs by {relief:.1f} mm (rms) from a dome: there is a cleft or an edge"
    return ""


def _map(placed: Floats, half: float) -> tuple[Floats, Floats, Floats]:
    """Highest point (n, n) mm over each pixel of a square, NaN where there is none, and the pixels' x, y.

    As the renderer sees a brain: what lies deeper than three quarters of the square's side is its far side.
    """
    side = int(np.ceil(2 * half / _PIXEL_MM))
    cell = np.floor((placed[:, :2] + half) / (2 * half) * side).astype(np.int64)
    seen = ((cell >= 0) & (cell < side)).all(axis=1) & (placed[:, 2] > -1.5 * half)
    height = np.full((side, side), -np.inf)
    np.maximum.at(height, (cell[seen, 1], cell[seen, 0]), placed[seen, 2])
    middles = (np.arange(side) + 0.5) / side * 2 * half - half
    x, y = np.meshgrid(middles, middles)
    return x, y, np.where(np.isfinite(height), height, np.nan)


def _columns(x: Floats, y: Floats) -> Floats:
    return np.stack([np.ones_like(x), x, y, x**2, x * y, y**2], axis=1)


def _hull(vertices: Floats) -> Floats:
    """Planes (n, 4) of the convex hull, pointing outwards."""
    try:
        return np.unique(np.round(ConvexHull(vertices).equations, 9), axis=0)
    except QhullError:  # flat: from both of its sides
        _, _, axis = np.linalg.svd(vertices - vertices.mean(axis=0), full_matrices=False)
        level = float(vertices.mean(axis=0) @ axis[2])
        return np.array([[*axis[2], -level], [*-axis[2], level]])


def _above(points: Floats, planes: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """The plane nearest above each point: signed distance (n,), at most 0 inside, and which."""
    best, which = np.full(len(points), -np.inf), np.zeros(len(points), np.int64)
    for k, plane in enumerate(planes):
        signed = points @ plane[:3] + plane[3]
        closer = signed > best
        best[closer], which[closer] = signed[closer], k
    return best, which
