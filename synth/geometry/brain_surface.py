"""Reading of a user's brain surface and its placement in world axes."""

from __future__ import annotations

import base64
import re
import warnings
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from synth.arrays import Floats, Ints
from synth.errors import Caution, UserError, as_user_error, first_line
from synth.geometry.mesh_file import SUFFIXES, read_mesh, read_surface
from synth.geometry.skin import skin
from synth.geometry.skull import Attachment, Craniotomy
from synth.geometry.triangles import Shape, side_areas
from synth.system import checked_file

_KINDS = ("obj", "stl", "ply", "off", *SUFFIXES, "gii")  # suffixes of the files that can be read
_FREESURFER = b"\xff\xff\xfe"  # what its surfaces start with; suffixes vary, and links to them are followed
_CENTRE = rb"valid\s*=\s*1\b[\s\S]*?\ncras\s*=([^\n]*)"  # in a footer of FreeSurfer's

_BRAIN_MM = 20.0, 400.0  # greatest extent: of a small phantom, of more than a head
_UNITS_MM = {"metres": 1000.0, "centimetres": 10.0, "inches": 25.4, "micrometres": 0.001}
_CLICKED_MM = 0.03  # a point read in a viewer is that close to the surface, or closer than its mirrors
_STEEPEST = 0.5  # cosine of the angle between an opening's direction and the normal of the surface in it
_THIN = 0.1  # share of the area that both sides of a sheet, which cancel, leave
_STATED = rb"SPACE(?:=|\s+1\s+1\s+string\s+)([RL][AP][SI])\b"  # in a header or comment of 3D Slicer's
_OPEN = 0.25  # missing share of a surface's area above which it counts as open: a hemisphere lacks a half


@dataclass(frozen=True)
class Brain:
    """A surface in world axes: z out of the brain, origin at the craniotomy's centre. It may have holes."""

    shape: Shape
    to_world: Floats  # (4, 4) rigid, mm: a point p of the file (RAS if it states one) is to_world @ (p, 1)
    attachments: tuple[Attachment, ...]  # fixed regions inside, in world axes


def load_brain(
    path: Path,
    craniotomy: Craniotomy,
    attachments: Sequence[Attachment] = (),
    fill_holes: bool = False,
) -> Brain:
    """Reads a surface (of a format of `anatomy.mesh`, mm), merges its vertices, and places it.

    `craniotomy` and `attachments` are in the file's axes; `fill_holes` as in `read_brain`. UserError: the
    file cannot be read or closed, encloses no volume, or has no surface at the craniotomy.
    """
    return place_brain(*read_brain(path, fill_holes), path.name, craniotomy, attachments)


def place_brain(
    vertices: Floats,
    faces: Ints,
    name: str,
    craniotomy: Craniotomy,
    attachments: Sequence[Attachment] = (),
) -> Brain:
    """Places a surface of vertices (V, 3) mm and faces (F, 3) as `load_brain`; `name` is used in messages."""
    out = np.asarray(craniotomy.direction) / np.linalg.norm(craniotomy.direction)
    rotation, origin = axes(out), np.asarray(craniotomy.point)
    placed = (vertices - origin) @ rotation.T
    heights = _heights(placed, faces)
    heights = heights[np.abs(heights) <= craniotomy.radius_mm]
    _check_place(name, vertices[faces], origin, out, craniotomy.radius_mm if len(heights) else 0.0)
    placed[:, 2] -= heights.max()
    origin = origin + heights.max() * rotation[2]
    placed_attachments = tuple(_transform(attachment, rotation, origin) for attachment in attachments)
    to_world = np.eye(4)
    to_world[:3] = np.column_stack([rotation, -rotation @ origin])
    return Brain(Shape(np.ascontiguousarray(placed), faces.astype(np.int32)), to_world, placed_attachments)


def _transform(attachment: Attachment, rotation: Floats, origin: Floats) -> Attachment:
    """An attachment of a surface's own axes in axes turned by (3, 3) about an origin (3,) mm."""
    x, y, z = rotation @ (attachment.point - origin)
    normal = None if attachment.normal is None else tuple(rotation @ np.asarray(attachment.normal))
    return replace(attachment, point=(x, y, z), normal=normal)


def read_brain(path: Path, fill_holes: bool = False) -> tuple[Floats, Ints]:
    """A surface in the file's axes, merged: vertices (V, 3) mm and faces (F, 3). A stated space becomes RAS.

    `fill_holes`: every hole is closed by a fan of triangles, so that each edge has two faces. UserError: the
    file can't be read, isn't in mm, encloses no volume, or a hole can't be filled.
    """
    vertices, faces = _read(path)
    if not np.isfinite(vertices).all():
        raise UserError(f"anatomy.mesh: {path.name} has coordinates that are not finite")
    if not len(faces):
        raise UserError(f"anatomy.mesh: {path.name} contains no triangles or polygons")
    span = np.ptp(vertices, axis=0)
    if not _BRAIN_MM[0] <= span.max() <= _BRAIN_MM[1]:
        unit, factor = min(_UNITS_MM.items(), key=lambda unit: abs(np.log(unit[1] * span.max() / 150)))
        match = _BRAIN_MM[0] <= factor * span.max() <= _BRAIN_MM[1]
        hint = f"if it is in {unit}, multiply its coordinates by {factor:g}" if match else "convert it to mm"
        raise UserError(f"anatomy.mesh: {path.name} is {span.max():.3g} mm long, a brain 100 to 200; {hint}")
    faces = _orient(vertices, faces)
    if fill_holes:
        faces = _fill_holes(vertices, faces, path.name)
    is_flat = len(faces) < 4 or span.min() < 1e-3 * span.max()
    if is_flat or abs(_volumes(vertices, faces).sum()) < 1e-3 * span.prod():
        hint = "" if fill_holes else "; if it is open, anatomy.fill_holes=true closes it"
        raise UserError(f"anatomy.mesh: {path.name} encloses no volume{hint}")
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    areas = np.cross(b - a, c - a)  # doubled; their sum is that of the missing flat lid, 0 if closed
    open_share = np.linalg.norm(areas.sum(axis=0)) / np.linalg.norm(areas, axis=1).sum()
    if open_share > _OPEN:
        warnings.warn(
            f"anatomy.mesh: {path.name} is open, {100 * open_share:.0f}% of its area is missing; motion may "
            "be wrong by a third: anatomy.fill_holes=true closes flat holes",
            Caution,
            stacklevel=1,  # so that it is printed only once
        )
    return vertices, faces


def _check_place(name: str, corners: Floats, point: Floats, out: Floats, radius_mm: float) -> None:
    """Raises UserError for an opening off the surface, in other axes, or that doesn't face outwards.

    `corners`: (F, 3, 3) of the faces; `radius_mm`: 0 if nothing is met along the direction.
    """
    from trimesh.triangles import closest_point

    def find_nearest(place: Floats) -> tuple[float, Floats, int]:
        closest = np.asarray(closest_point(corners, np.broadcast_to(place, (len(corners), 3))))
        distances = np.linalg.norm(closest - place, axis=1)
        return float(distances.min()), closest[distances.argmin()], int(distances.argmin())

    def text(vector: Floats) -> str:
        return "[" + ", ".join(f"{x:.2f}" for x in vector) + "]"

    (gap, foot, face), mirrors = find_nearest(point), []
    for what, sign in (("x and y", [-1, -1, 1]), ("x", [-1, 1, 1]), ("y", [1, -1, 1]), ("z", [1, 1, -1])):
        mirrors.append(
            (find_nearest(point * sign)[0], f"; with {what} negated, {text(point * sign)}, it is ")
        )
    mirror_gap, hint = min(mirrors)
    if gap > radius_mm or gap > _CLICKED_MM + 3 * mirror_gap:
        hint = f"{hint}{mirror_gap:.2g} mm off (other axes?)" if mirror_gap < max(1.0, gap) / 3 else ""
        raise UserError(
            f"anatomy.craniotomy.point: {text(point)} is {gap:.2g} mm off the surface of {name}{hint}. "
            f"The nearest point is {text(foot)}; `synth preview {name}` finds places"
        )
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    centroids = corners.mean(axis=1)
    in_opening = np.linalg.norm(centroids - foot, axis=1) <= radius_mm
    normal = normals[in_opening].sum(axis=0)
    if np.linalg.norm(normal) < _THIN * np.linalg.norm(normals[in_opening], axis=1).sum():
        normal = normals[in_opening & (normals @ normals[face] > 0)].sum(axis=0)
    normal *= np.sign(((centroids - centroids.mean(axis=0)) * normals).sum())  # all may face inwards
    if normal.any() and out @ normal < _STEEPEST * np.linalg.norm(normal):
        heading = "into the tissue" if out @ normal < 0 else "along the surface"
        raise UserError(
            f"anatomy.craniotomy.direction: {text(out)} points {heading} of {name} at "
            f"{text(point)}; outwards is {text(normal / np.linalg.norm(normal))} (are both in the same axes?)"
        )


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
    total = parts.sum(axis=1)
    hit = (np.abs(total) > 1e-12) & ((parts >= 0).all(axis=1) | (parts <= 0).all(axis=1))
    return np.asarray((parts[hit] * vertices[faces[hit], 2]).sum(axis=1) / total[hit])


def _read(path: Path) -> tuple[Floats, Ints]:
    with as_user_error("anatomy.mesh"):
        data = checked_file.read_bytes(path, checked_file.LARGEST_MESH)
    kind = path.suffix.lower().removeprefix(".")
    if data.startswith(_FREESURFER):
        kind = "freesurfer"
    elif kind not in _KINDS:
        kinds = f"{', '.join(_KINDS)}, nor a surface of FreeSurfer's such as lh.pial"
        hint = "gunzip unpacks it" if kind == "gz" else "3D Slicer converts most others"
        raise UserError(f"anatomy.mesh: {path.name} is none of {kinds}; {hint}")

    header = re.search(_STATED, data[:4096])
    space, offset = header[1].decode() if header else "", np.zeros(3)
    try:
        if kind in ("gii", "freesurfer"):
            vertices, faces, offset = _read_neuroimaging(path, data)
        elif kind in SUFFIXES:
            file = read_mesh(data)
            vertices, faces, space = file.points, skin(file.points, file.cells), file.space or space
            if space and not re.fullmatch("[RL][AP][SI]", space):
                raise ValueError(f"it states the space {space}; RAS or LPS is needed")
        else:
            vertices, faces = read_surface(data, kind, in_order=False)
        if len(faces) and not 0 <= faces.min() <= faces.max() < len(vertices):
            raise ValueError("a face refers to a missing point")
    except ModuleNotFoundError as error:
        raise UserError(f"anatomy.mesh: {path.name} needs {error.name}: pip install {error.name}") from None
    except Exception as error:  # readers of formats raise anything
        reason = first_line(error)
        raise UserError(f"anatomy.mesh: {path.name} is not a readable surface ({reason})") from error
    if space not in ("", "RAS"):
        vertices = vertices * [1 if c in "RAS" else -1 for c in space]
        warnings.warn(
            f"anatomy.mesh: {path.name} states the space {space}: points and directions are in RAS, as 3D "
            "Slicer shows them",
            Caution,
            stacklevel=1,
        )
    if offset.any():
        note = f"scanner RAS is this plus {offset.round(2).tolist()}"
        what = f"{path.name} and points on it are in surface RAS, SurfaceRAS in freeview"
        warnings.warn(f"anatomy.mesh: {what}; {note}", Caution, stacklevel=1)
    return _merge(vertices, faces)


def _read_neuroimaging(path: Path, data: bytes) -> tuple[Floats, Ints, Floats]:
    """Vertices (V, 3) mm, faces (F, 3) and offset (3,) mm to scanner RAS, of GIfTI or FreeSurfer."""
    from nibabel import freesurfer, gifti

    offset = np.zeros(3)
    if data.startswith(_FREESURFER):
        with np.errstate(over="raise"):  # of counts
            vertices, faces = freesurfer.read_geometry(path)
        if stated := re.search(_CENTRE, data):
            offset = np.array(stated[1].split(), np.float64)
    else:
        _refuse_expansion(data)
        image = gifti.GiftiImage.from_bytes(data)  # which can't open further files
        groups = [image.get_arrays_from_intent(f"NIFTI_INTENT_{kind}") for kind in ("POINTSET", "TRIANGLE")]
        if [[array.data.shape[1:] for array in arrays] for arrays in groups] != [[(3,)], [(3,)]]:
            raise ValueError("one list of points and one of triangles are needed, as in a .surf.gii")
        points, vertices, faces = groups[0][0], groups[0][0].data, groups[1][0].data
        if points.coordsys is None or points.coordsys.dataspace != 1:  # 1: NIFTI_XFORM_SCANNER_ANAT
            offset = np.array([float(points.meta.get(f"VolGeomC_{axis}", 0)) for axis in "RAS"])
    return np.asarray(vertices, np.float64), np.asarray(faces, np.int64), offset


def _refuse_expansion(data: bytes) -> None:
    """ValueError if the compressed arrays of a GIfTI file expand to more than a file may have."""
    budget = checked_file.LARGEST_MESH
    for text in re.findall(rb"<Data>([^<]*)</Data>", data) if b"GZipBase64Binary" in data else ():
        unpacker, packed = zlib.decompressobj(), base64.b64decode(text)
        while packed and not unpacker.eof:
            budget -= len(unpacker.decompress(packed, 1 << 20))
            packed = unpacker.unconsumed_tail
            if budget < 0:
                raise ValueError("its arrays expand to more than 1 GB")


def _orient(vertices: Floats, faces: Ints) -> Ints:
    """The faces; if neighbours are oriented differently or bodies cancel, turned until all face outwards."""
    import trimesh

    mesh, count = trimesh.Trimesh(vertices, faces, process=False), len(faces)
    first, other = mesh.face_adjacency.T
    start, end = mesh.face_adjacency_edges[:, :, None].swapaxes(0, 1)
    runs = [
        ((faces[f] == start) & (np.roll(faces[f], -1, axis=1) == end)).any(axis=1) for f in (first, other)
    ]
    alike = runs[0] != runs[1]  # neighbours pass along their edge in opposite directions
    # Faces as they are and, from `count`, turned: each is linked to what its neighbours then are.
    links = np.array([[first, first + count], [other + count * ~alike, other + count * alike]]).reshape(2, -1)
    graph = coo_array((np.ones(2 * len(first)), links), shape=(2 * count, 2 * count))
    label = connected_components(graph, directed=False)[1].reshape(2, count)
    turned, body = label[0] > label[1], label.min(axis=0)
    volumes = np.bincount(body, np.where(turned, -1, 1) * _volumes(vertices, faces))
    if turned.any() or abs(volumes.sum()) < 0.1 * np.abs(volumes).sum():
        faces = np.where((turned ^ (volumes[body] < 0))[:, None], faces[:, ::-1], faces)
    return faces


def _merge(vertices: Floats, faces: Ints) -> tuple[Floats, Ints]:
    """The surface without duplicate vertices and faces, faces without area, and vertices without faces."""
    if len(vertices) == 0 or len(faces) == 0:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    step = 1e-6 * max(float(np.ptp(vertices, axis=0).max()), 1e-12)
    _, first, place = np.unique(np.round(vertices / step), axis=0, return_index=True, return_inverse=True)
    faces = place.ravel()[faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    _, unique_faces = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[np.sort(unique_faces)]
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[first][used], faces.reshape(-1, 3)


def _fill_holes(vertices: Floats, faces: Ints, name: str) -> Ints:
    """The faces, with a fan of triangles over each hole."""
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if not trimesh.repair.fill_holes(mesh, use_fan=True):
        open_edges = len(trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1))
        reason = f"{open_edges} edges stay open" if open_edges else "edges have more than two faces"
        raise UserError(f"anatomy.fill_holes: {name} can't be closed ({reason}); repair it in a mesh editor")
    return np.asarray(mesh.faces, np.int64)


def _volumes(vertices: Floats, faces: Ints) -> Floats:
    """Signed volumes between faces and centroid (F,) mm^3; their sum is the volume if there are no holes."""
    corner = (vertices - vertices.mean(axis=0))[faces]
    return np.asarray(np.einsum("ij,ij->i", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])) / 6)
