"""Instruments of one's own: a mesh in a file, whose tip, axis and unit place it in an instrument's axes."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np

from synth.arrays import Floats, Ints
from synth.errors import Caution, UserError, as_user_error, first_line
from synth.geometry.mesh_file import read_surface
from synth.render.finish_maps import RING
from synth.render.instrument import OwnMesh, Part
from synth.system import checked_file

_KINDS = "stl", "obj", "ply"
_MOST_FACES = 100_000  # that are posed and shaded in every frame
_LONG_MM = 15.0, 600.0  # greatest extent of an instrument, or of its part that a camera sees
_SHORT_MM = 60.0  # length from its tip to the hand below which its end may show
_UNITS_MM = {"metres": 1000.0, "centimetres": 10.0, "inches": 25.4, "micrometres": 0.001}
_USUAL_MM = 180.0  # length of most microsurgical instruments
_OFF_MM = 3.0  # from a tip to the mesh; in the mouth of a tube no point is nearer
_ALONG = 0.3  # least share of its greatest extent that an instrument reaches along its axis
_TIP_MM = 1.0  # from the tip, along the axis, over which its width is measured
_WIDE_MM = 0.2, 5.0  # half the width of tips
_SHARP_DEG = 35.0  # between neighbouring faces, above which their edge stays sharp
_SLICES = 48  # of an outline


Vector = tuple[float, float, float]


@dataclass(frozen=True)
class PlacedFile:
    """A file with an instrument's mesh, and what places it in the instrument's axes; as of `place_mesh`."""

    path: Path
    tip: Vector = (0.0, 0.0, 0.0)
    axis: Vector = (0.0, 0.0, 1.0)
    up: Vector | None = None
    unit_mm: float = 1.0


def read_own_mesh(file: PlacedFile) -> OwnMesh:
    """The mesh of an instrument; the last ones are kept. UserError: it can't be read, or isn't one's."""
    return _read(file, _find_state(file.path))


def _find_state(path: Path) -> tuple[int, ...]:
    """What distinguishes a file from another one that replaced it."""
    try:
        state = path.stat()
    except OSError as error:
        raise UserError(f"fem.instrument: {path}: cannot be read ({error.strerror})") from None
    return state.st_ino, state.st_mtime_ns, state.st_size


@lru_cache(maxsize=8)
def _read(file: PlacedFile, state: object) -> OwnMesh:
    """The mesh of an instrument; `state`: of its file, so that one that replaced it is read anew."""
    name = file.path.name
    vertices, faces = read_triangles(file.path)
    try:
        points = place_mesh(vertices, faces, file.tip, file.axis, file.up, file.unit_mm)
    except ValueError as error:
        raise UserError(f"fem.instrument: {name} {error}") from None
    if (length := points[:, 2].max()) < _SHORT_MM:
        warnings.warn(
            f"fem.instrument: {name} ends {length:.3g} mm from its tip, which may show in the picture; is "
            "unit_mm right?",
            Caution,
            stacklevel=1,
        )
    for array in (points, faces):
        array.flags.writeable = False
    tip_points = points[points[:, 2] <= max(points[:, 2].min(), 0.0) + _TIP_MM]
    half = float(np.clip(np.median(np.hypot(*tip_points[:, :2].T)), *_WIDE_MM))
    return OwnMesh(Part(points, 0, faces=faces.astype(np.int32), outline=outline_mesh(points, faces)), half)


def read_triangles(path: Path) -> tuple[Floats, Ints]:
    """Points (V, 3), in the file's unit, and faces (F, 3) that turn outwards, split along sharp edges.

    UserError: the file is too large, or no mesh of triangles that can be read.
    """
    kind, label = path.suffix.lower().removeprefix("."), f"fem.instrument: {path.name}"
    if kind not in _KINDS:
        raise UserError(f"{label} is none of {', '.join(_KINDS)}; CAD programs and Blender export them")
    with as_user_error("fem.instrument"):
        data = checked_file.read_bytes(path, checked_file.LARGEST_INSTRUMENT)
    import trimesh  # here, as it is slow to import and most jobs have no mesh

    try:
        vertices, faces = read_surface(data, kind, in_order=False)
        if len(faces) and not 0 <= faces.min() <= faces.max() < len(vertices):
            raise ValueError("a face refers to a missing point")
    except Exception as error:  # readers of formats raise anything
        raise UserError(f"{label} is not a readable mesh ({first_line(error)})") from error
    if not len(faces):
        raise UserError(f"{label} contains no triangles or polygons")
    if len(faces) > _MOST_FACES:
        raise UserError(
            f"{label} has {len(faces)} faces, at most {_MOST_FACES} are drawn; decimate it in a mesh editor"
        )
    if not np.isfinite(vertices[faces]).all():
        raise UserError(f"{label} has coordinates that are not finite")
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    mesh.remove_unreferenced_vertices()
    if len(mesh.faces) < 4:
        raise UserError(f"{label} has {len(mesh.faces)} faces with an area; a body is needed")
    trimesh.repair.fix_normals(mesh, multibody=True)
    smooth = trimesh.graph.smooth_shade(mesh, angle=np.radians(_SHARP_DEG))
    return np.array(smooth.vertices, np.float64), np.array(smooth.faces, np.int64)


def place_mesh(
    vertices: Floats,
    faces: Ints,
    tip: Vector,
    axis: Vector,
    up: Vector | None,
    unit_mm: float,
) -> Floats:
    """Points (V, 3) mm of an instrument in its own axes: tip at the origin, z to the hand, x up.

    `vertices`, `tip`: in the file's unit; `axis`, `up`: in its axes. ValueError says what doesn't fit: a
    length that no instrument has, a tip off the mesh, an axis that points from the hand to the tip.
    """
    span = unit_mm * np.ptp(vertices, axis=0).max()
    if not _LONG_MM[0] <= span <= _LONG_MM[1]:
        unit, factor = min(_UNITS_MM.items(), key=lambda item: abs(np.log(item[1] * span / _USUAL_MM)))
        plausible = _LONG_MM[0] <= factor * span <= _LONG_MM[1]
        hint = f"; if it is in {unit}, unit_mm is {factor * unit_mm:g}" if plausible else "; state unit_mm"
        raise ValueError(f"is {span:.3g} mm long, instruments are {_LONG_MM[0]:g} to {_LONG_MM[1]:g}{hint}")
    z = np.asarray(axis) / np.linalg.norm(axis)
    level = np.asarray(up if up is not None else (0.0, 0.0, 1.0))
    if up is None and abs(z[2]) > 0.99:
        level = np.array([1.0, 0.0, 0.0])
    x = level / np.linalg.norm(level)
    x = x - (x @ z) * z
    if (size := np.linalg.norm(x)) < 0.1:
        raise ValueError("has its direction up along its axis; up points from the tissue, across the shaft")
    x /= size
    points = np.ascontiguousarray(unit_mm * (vertices - np.asarray(tip)) @ np.stack([x, np.cross(z, x), z]).T)
    if (gap := _distance(points[faces])) > _OFF_MM:
        point = (vertices[np.linalg.norm(points, axis=1).argmin()]).round(3).tolist()
        ends = [vertices[k].round(3).tolist() for k in (points[:, 2].argmin(), points[:, 2].argmax())]
        raise ValueError(
            f"has its tip {gap:.3g} mm outside of the mesh; its nearest point is {point}, its ends along the "
            f"axis are {ends[0]} and {ends[1]} (state tip, in the file's unit)"
        )
    backward, forward = -points[:, 2].min(), points[:, 2].max()
    if forward < max(backward, _ALONG * span):
        raise ValueError(
            f"reaches {forward:.3g} mm from its tip along its axis, {backward:.3g} mm against it, and is "
            f"{span:.3g} mm long; axis points from the tip to the hand"
        )
    return points


def outline_mesh(vertices: Floats, faces: Ints) -> Floats:
    """Rings (R * RING, 3) mm, round, that enclose slices of a mesh across z, and two past its ends."""
    sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    start, end = np.moveaxis(vertices[np.unique(sides, axis=0)], 1, 0)
    bounds = np.linspace(vertices[:, 2].min(), vertices[:, 2].max(), _SLICES + 1)
    rise = end[:, 2] - start[:, 2]
    safe_rise = np.where(np.abs(rise) < 1e-9, 1.0, rise)
    turn = np.linspace(0, 2 * np.pi, RING, endpoint=False)
    rings = []
    for low, high in pairwise(bounds):
        cuts = np.sort([(low - start[:, 2]) / safe_rise, (high - start[:, 2]) / safe_rise], axis=0).clip(0, 1)
        level = np.abs(rise) < 1e-9
        cuts[:, level] = [[0.0], [1.0]]
        crossed = (np.maximum(start[:, 2], end[:, 2]) >= low) & (np.minimum(start[:, 2], end[:, 2]) <= high)
        if not crossed.any():
            continue
        segments = start[crossed] + cuts[:, crossed, None] * (end - start)[crossed]
        points = segments.reshape(-1, 3)[:, :2]
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        radius = np.linalg.norm(points - middle, axis=1).max()
        ring = middle + radius * np.column_stack([np.cos(turn), np.sin(turn)])
        rings.append(np.column_stack([ring, np.full(RING, 0.5 * (low + high))]))
    step = np.array([0.0, 0.0, bounds[1] - bounds[0]])
    return np.concatenate([rings[0] - step, *rings, rings[-1] + step])  # whose ends are within its texture


def _distance(corners: Floats) -> float:
    """Distance of the origin from triangles (F, 3, 3)."""
    from trimesh.triangles import closest_point

    nearest = np.asarray(closest_point(corners, np.zeros((len(corners), 3))))
    return float(np.linalg.norm(nearest, axis=1).min())
