"""Reading of a user's brain surface and its placement in world axes."""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from synth.arrays import Floats, Ints
from synth.errors import Caution, UserError, first_line
from synth.geometry.triangles import Shape, side_areas
from synth.geometry.vtk import read_vtk
from synth.job import identity
from synth.job.schema import AttachmentSection, CraniotomySection
from synth.system import checked_file

KINDS = ("obj", "stl", "ply", "off", "vtk")  # suffixes of the files that can be read

_OPEN = 0.25  # missing share of a surface's area above which it counts as open: a hemisphere lacks a half


@dataclass(frozen=True)
class Brain:
    """A surface in world axes: z out of the brain, origin at the craniotomy's centre. It may have holes."""

    shape: Shape
    to_world: Floats  # (4, 4) rigid, mm: a point p of the file is to_world @ (p, 1) in world axes
    attachments: tuple[AttachmentSection, ...]  # fixed regions inside, in world axes


def load_brain(
    path: Path,
    craniotomy: CraniotomySection,
    attachments: Sequence[AttachmentSection] = (),
    fill_holes: bool = False,
) -> Brain:
    """Reads a surface (OBJ, STL, PLY, OFF or legacy VTK, mm), merges its vertices, and places it.

    `craniotomy` and `attachments` are in the file's axes; `fill_holes` as in `read_brain`. UserError: the
    file cannot be read or closed, encloses no volume, or has no surface at the craniotomy.
    """
    assert craniotomy.point is not None  # the job requires both with a mesh
    assert craniotomy.direction is not None
    vertices, faces = read_brain(path, fill_holes)
    out = np.asarray(craniotomy.direction) / np.linalg.norm(craniotomy.direction)
    turn, origin = axes(out), np.asarray(craniotomy.point)
    placed = (vertices - origin) @ turn.T
    heights = _heights(placed, faces)
    heights = heights[np.abs(heights) <= craniotomy.radius_mm]
    if len(heights) == 0:
        raise UserError(
            f"anatomy.craniotomy: {path.name} has no surface within {craniotomy.radius_mm:g} mm of the "
            f"point, looking along the direction; `synth preview {path.name}` finds places that work"
        )
    placed[:, 2] -= heights.max()
    origin = origin + heights.max() * turn[2]
    held = tuple(
        a.model_copy(
            update={
                "point": tuple(turn @ (np.asarray(a.point) - origin)),
                "normal": None if a.normal is None else tuple(turn @ np.asarray(a.normal)),
            }
        )
        for a in attachments
    )
    to_world = np.eye(4)
    to_world[:3] = np.column_stack([turn, -turn @ origin])
    return Brain(Shape(np.ascontiguousarray(placed), faces.astype(np.int32)), to_world, held)


def read_brain(path: Path, fill_holes: bool = False) -> tuple[Floats, Ints]:
    """A surface in the file's axes, merged: vertices (V, 3) mm and faces (F, 3).

    `fill_holes`: every hole is closed by a fan of triangles, so that each edge has two faces. UserError: the
    file can't be read, encloses no volume, or a hole can't be filled.
    """
    vertices, faces = _read(path)
    if not np.isfinite(vertices).all():
        raise UserError(f"anatomy.mesh: {path.name} has coordinates that are not finite")
    if fill_holes:
        faces = _filled(vertices, faces, path.name)
    span = np.ptp(vertices, axis=0) if len(vertices) else np.zeros(3)
    if len(faces) < 4 or span.min() < 1e-3 * span.max() or _volume(vertices, faces) < 1e-3 * span.prod():
        hint = "" if fill_holes else "; if it is open, anatomy.fill_holes=true closes it"
        raise UserError(f"anatomy.mesh: {path.name} encloses no volume{hint}")
    if (open_share := _open_share(vertices, faces)) > _OPEN:
        warnings.warn(
            f"anatomy.mesh: {path.name} is open, {100 * open_share:.0f}% of its area is missing; motion may "
            "be wrong by a third: anatomy.fill_holes=true closes flat holes",
            Caution,
            stacklevel=1,  # so that it is printed only once
        )
    return vertices, faces


def axes(out: Floats) -> Floats:
    """World axes in a mesh's axes, (3, 3) rows x, y, z with z = `out` and x close to the mesh's x."""
    z = out / np.linalg.norm(out)
    helper = np.eye(3)[0] if abs(z[0]) < 0.9 else np.eye(3)[1]
    x = helper - z * (helper @ z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def _heights(vertices: Floats, faces: Ints) -> Floats:
    """Heights at which the z axis intersects the faces [mm]."""
    parts = side_areas(np.zeros(2), vertices, faces)
    whole = parts.sum(axis=1)
    hit = (np.abs(whole) > 1e-12) & ((parts >= 0).all(axis=1) | (parts <= 0).all(axis=1))
    return np.asarray((parts[hit] * vertices[faces[hit], 2]).sum(axis=1) / whole[hit])


def _read(path: Path) -> tuple[Floats, Ints]:
    kind = path.suffix.lower().removeprefix(".")
    if kind not in KINDS:
        raise UserError(f"anatomy.mesh: {path.name} is not one of {', '.join(KINDS)}")
    try:
        data = checked_file.read_bytes(path, identity.FILES["anatomy", "mesh"])
    except UserError as error:
        raise UserError(f"anatomy.mesh: {error}") from None
    import trimesh  # here, as it is slow to import and most jobs have no mesh

    try:
        if kind == "vtk":
            return _merged(*read_vtk(data))
        # From bytes, trimesh can't open further files that are named in this one.
        mesh = trimesh.load(io.BytesIO(data), file_type=kind, force="mesh", process=False)
    except Exception as error:  # readers of formats raise anything
        why = first_line(error)
        raise UserError(f"anatomy.mesh: {path.name} is not a readable surface ({why})") from error
    if not isinstance(mesh, trimesh.Trimesh):
        raise UserError(f"anatomy.mesh: {path.name} contains no surface")
    return _merged(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))


def _merged(vertices: Floats, faces: Ints) -> tuple[Floats, Ints]:
    """The surface without duplicate vertices and faces, faces without area, and vertices without faces."""
    if len(vertices) == 0 or len(faces) == 0:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    step = 1e-6 * max(float(np.ptp(vertices, axis=0).max()), 1e-12)
    _, first, place = np.unique(np.round(vertices / step), axis=0, return_index=True, return_inverse=True)
    faces = place.ravel()[faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    _, once = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[np.sort(once)]
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[first][used], faces.reshape(-1, 3)


def _filled(vertices: Floats, faces: Ints, name: str) -> Ints:
    """The faces, with a fan of triangles over each hole."""
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if not trimesh.repair.fill_holes(mesh, use_fan=True):
        odd = len(trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1))
        why = f"{odd} edges stay open" if odd else "edges have more than two faces"
        raise UserError(f"anatomy.fill_holes: {name} can't be closed ({why}); repair it in a mesh editor")
    return np.asarray(mesh.faces, np.int64)


def _open_share(vertices: Floats, faces: Ints) -> float:
    """Area of the flat lid that would close the surface over the surface's area: 0 if closed, below 1."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    areas = np.cross(b - a, c - a)  # doubled; their sum is 0 for a closed surface
    return float(np.linalg.norm(areas.sum(axis=0)) / np.linalg.norm(areas, axis=1).sum())


def _volume(vertices: Floats, faces: Ints) -> float:
    """Volume by the divergence theorem about the centroid; approximate if there are holes."""
    corner = (vertices - vertices.mean(axis=0))[faces]
    return float(abs(np.einsum("ij,ij->", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])) / 6))
