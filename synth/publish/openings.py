"""Suggested craniotomies of a user's brain: even places of its surface, drawn and as lines of a job."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy import stats
from scipy.spatial import ConvexHull, cKDTree

from synth.arrays import Floats, Indices, Pixels
from synth.errors import UserError
from synth.geometry.brain_surface import axes, read_brain
from synth.job import job_writer
from synth.job.schema import AnatomySection, CraniotomySection, FemSection, Job
from synth.render.anatomy.surface import LEAST_FILLED, MARGIN_MM
from synth.sequence.fem_mechanics import build_volume
from synth.sequence.rest_scene import at_rest

_PLACES = 250
_PER_MM2, _MOST_SAMPLES = 1.5, 600_000  # samples on the surface: some in every pixel of the height map
_PIXEL_MM = 2.0
_UNDER_SKULL_MM = 8.0  # greatest depth below the convex hull of a place that is accessible from outside
_LEAST_SURFACE = 0.97  # share of the opening with surface
_STEEPEST_MM = 4.0  # rms deviation from a dome; larger with a cleft in the opening
_FLAT = 0.01  # median distance from the best plane over the radius: twice as much for a dome of 70 mm radius
_APART = 2.0  # least distance of two places in radii: closer ones would show the same tissue
_TILE_PX, _BLUE = 360, (11, 83, 148)


@dataclass(frozen=True)
class Opening:
    """A suggested craniotomy, in the file's coordinates [mm]."""

    point: Floats  # (3,) on the surface
    direction: Floats  # (3,) unit vector outwards: the normal of the surface's mean plane in the opening
    relief_mm: float  # rms deviation of the surface from a smooth dome over the opening: its gyri and sulci
    flat: bool  # mostly flat: a plane where the surface was cut off

    def craniotomy(self, radius_mm: float) -> CraniotomySection:
        """The section of a job."""
        x, y, z = np.round(self.point, 2).tolist()
        u, v, w = np.round(self.direction, 3).tolist()
        return CraniotomySection(point=(x, y, z), direction=(u, v, w), radius_mm=radius_mm)


def find_openings(mesh: Path, radius_mm: float, count: int, fill_holes: bool = False) -> list[Opening]:
    """At most `count` separate openings, the most even first; each has been meshed as in a job.

    UserError: the file cannot be used, or no opening of that radius works.
    """
    openings: list[Opening] = []
    why = "the surface is too small or too steep"
    for opening in sorted(
        _sample_openings(mesh, radius_mm, fill_holes), key=lambda opening: (opening.flat, opening.relief_mm)
    ):
        if any(np.linalg.norm(opening.point - other.point) < _APART * radius_mm for other in openings):
            continue
        craniotomy = opening.craniotomy(radius_mm)
        section = AnatomySection(
            mesh=mesh.resolve(), fill_holes=fill_holes, vertices=2500, craniotomy=craniotomy
        )
        job = Job(anatomy=section, fem=FemSection(tets=400))  # a coarse mesh, to test whether it is possible
        try:
            build_volume(at_rest(job))
        except UserError as error:
            why = str(error)
            continue
        openings.append(opening)
        if len(openings) == count:
            break
    if not openings:
        raise UserError(f"{mesh.name}: no opening of {radius_mm:g} mm radius works ({why}); reduce --radius")
    return openings


def as_job(mesh: Path, openings: Sequence[Opening], radius_mm: float, fill_holes: bool = False) -> str:
    """Lines of a job with the first opening, and the others as a comment below `also`."""
    first, *others = (opening.craniotomy(radius_mm).model_dump(mode="json") for opening in openings)
    lines = [
        "anatomy:",
        f"  mesh: {job_writer.scalar(mesh)}",
        *(["  fill_holes: true"] if fill_holes else []),
    ]
    lines += ["  craniotomy:", f"    radius_mm: {radius_mm:g}"]
    lines += [f"    point: {first['point']}", f"    direction: {first['direction']}"]
    lines += ["    # also:  # the next best; sequences use them in turn"] if others else []
    lines += [
        f"    #   - {{point: {section['point']}, direction: {section['direction']}}}" for section in others
    ]
    return "\n".join(lines)


def draw_openings(mesh: Path, openings: Sequence[Opening], radius_mm: float, fill_holes: bool) -> Pixels:
    """Picture (H, W, 3) of the brain from six sides, with the outline and number (from 1) of each opening."""
    vertices, faces = read_brain(mesh, fill_holes)
    corners, middle = vertices[faces], (vertices.max(axis=0) + vertices.min(axis=0)) / 2
    scale = 0.9 * _TILE_PX / np.ptp(vertices, axis=0).max()
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    angle = np.linspace(0, 2 * np.pi, 49)
    circle = radius_mm * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    tiles = []
    for side in (*np.eye(3), *-np.eye(3)):
        projection = axes(side)[:2].T * [scale, -scale]

        def pixel(points: Floats, projection: Floats = projection) -> Indices:
            return np.asarray(np.rint((points - middle) @ projection + _TILE_PX / 2), np.int32)

        tile = np.zeros((_TILE_PX, _TILE_PX, 3), np.uint8)
        order = np.argsort(corners.mean(axis=1) @ side)  # back to front
        shade = 60 + 170 * np.abs(normal @ side)[order]
        for triangle, grey in zip(pixel(corners[order]), shade.tolist(), strict=True):
            cv2.fillConvexPoly(tile, triangle, (grey, 0.85 * grey, 0.8 * grey))
        for number, opening in enumerate(openings, 1):
            if opening.direction @ side > 0.15:  # facing this side
                cv2.polylines(
                    tile, [pixel(opening.point + circle @ axes(opening.direction)[:2])], True, _BLUE, 2
                )
                x, y = pixel(opening.point).tolist()
                cv2.putText(tile, str(number), (x - 6, y + 6), cv2.FONT_HERSHEY_SIMPLEX, 0.6, _BLUE, 2)
        name = f"from {'-' if side.min() < 0 else ''}{'xyz'[int(np.abs(side).argmax())]}"
        cv2.putText(tile, name, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255))
        tiles.append(tile)
    return np.vstack([np.hstack(tiles[:3]), np.hstack(tiles[3:])])


def _sample_openings(mesh: Path, radius_mm: float, fill_holes: bool) -> Iterator[Opening]:
    """Openings at random places close to the convex hull, which approximates the skull."""
    import trimesh  # here, as most jobs have no mesh

    surface = trimesh.Trimesh(*read_brain(mesh, fill_holes), process=False)
    count = int(np.clip(_PER_MM2 * surface.area, 2_000, _MOST_SAMPLES))
    points = np.asarray(trimesh.sample.sample_surface(surface, count, seed=0)[0])  # in random order
    planes = np.unique(np.round(ConvexHull(points).equations, 9), axis=0)
    places = points[: 20 * _PLACES]
    heights = places @ planes[:, :3].T + planes[:, 3]
    tree = cKDTree(points)
    for k in np.flatnonzero(heights.max(axis=1) > -_UNDER_SKULL_MM)[:_PLACES]:
        opening = _judge(points, tree, places[k], planes[heights[k].argmax(), :3], radius_mm)
        if opening is not None:
            yield opening


def _judge(points: Floats, tree: cKDTree, point: Floats, out: Floats, radius_mm: float) -> Opening | None:
    """The opening at a point (3,) with an initial direction `out` (3,); None if it is not suitable."""
    half_mm = radius_mm + MARGIN_MM
    neighbours = points[tree.query_ball_point(point, 2.5 * half_mm)]
    for realigned in (True, True, False):
        turn = axes(out)
        x, y, height = _height_map((neighbours - point) @ turn.T, half_mm)
        inside = np.hypot(x, y) < radius_mm
        covered = inside & np.isfinite(height)
        if covered.sum() < 12:
            return None
        x, y, z = x[covered], y[covered], height[covered]
        plane = np.stack([np.ones_like(x), x, y], axis=1)
        coefficients = np.linalg.lstsq(plane, z, rcond=None)[0]
        if realigned:
            out = np.array([-coefficients[1], -coefficients[2], 1.0]) @ turn
            out /= np.linalg.norm(out)
    dome = np.concatenate([plane, np.stack([x**2, x * y, y**2], axis=1)], axis=1)
    relief = float(np.std(z - dome @ np.linalg.lstsq(dome, z, rcond=None)[0]))
    filled, share = np.isfinite(height).mean(), covered.sum() / inside.sum()
    if filled < LEAST_FILLED or share < _LEAST_SURFACE or relief > _STEEPEST_MM:
        return None
    middle = point + z[np.hypot(x, y).argmin()] * turn[2]
    return Opening(middle, out, relief, bool(np.median(np.abs(z - plane @ coefficients)) < _FLAT * radius_mm))


def _height_map(points: Floats, half_mm: float) -> tuple[Floats, Floats, Floats]:
    """x, y and greatest height (n, n) mm in each pixel of a square, NaN without a point.

    Points deeper than 3/4 of the square's side are of the brain's far side, as in the renderer.
    """
    across, down, up = points[points[:, 2] > -1.5 * half_mm].T
    edges = np.linspace(-half_mm, half_mm, 1 + int(np.ceil(2 * half_mm / _PIXEL_MM)))
    height = stats.binned_statistic_2d(down, across, up, "max", [edges, edges]).statistic
    return *np.meshgrid(*[(edges[1:] + edges[:-1]) / 2] * 2), height
