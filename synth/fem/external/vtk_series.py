"""Series of meshes: numbered .vtu, .vtk or .vtp, collections of them (.pvd, ParaView's .series), or surfaces
(.obj, .ply, .glb) whose points move."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from synth.arrays import Floats
from synth.errors import UserError, as_user_error, did_you_mean
from synth.fem.external.series import MeshSeries, State, Units, assemble, find_surface
from synth.geometry.mesh_file import SUFFIXES, SURFACES, MeshFile, read_mesh, read_surface
from synth.geometry.skin import TRIANGLE
from synth.system import checked_file
from synth.system.series_files import COLLECTIONS, LARGEST_STATE, read_collection

MOTION_NAMES = ("displacement", "displacements", "disp", "u")  # usual names of the field, in small letters
_OTHERS = {
    ".frd": "ccx2paraview FILE vtu", ".xdmf": "pip install meshio; meshio convert FILE OUT.vtu per step",
    ".exo": "save as PVD in ParaView", ".e": "save as PVD in ParaView", ".odb": "save as VTU by odb2vtk",
    ".xplt": "plotfile type=\"vtk\" in FEBio", ".vtkhdf": "save as PVD in ParaView",
}  # fmt: skip


def read_files(source: Path, units: Units, force: str | None = None) -> MeshSeries:
    """The series of VTK files in `source`: a pattern with *, a collection, or a folder that holds either.

    `force`: the field of forces that act on the surface from outside, `nodal:NAME`, or of forces per area at
    rest, `traction:NAME`; None: forces are not known.

    UserError, with the file's name: files that are missing, damaged or of other meshes, fields that are
    missing, and what `find_surface` and `assemble` refuse.
    """
    files, times = list_states(source)
    rest = _read(files[0])
    surface = find_surface(rest.points, rest.cells, files[0])
    fields = [name for name, values in rest.point_data.items() if values.parts == 3]
    matches = [name for name in fields if name.lower() in MOTION_NAMES]
    field = matches[0] if len(matches) == 1 else None  # else the points themselves move
    load, per_area = force_field(force, fields, files[0])

    def states() -> Iterator[State]:
        for k, file in enumerate(files):
            state = rest if k == 0 else _read(file)
            is_same = [np.array_equal(state.cells.get(kind, []), nodes) for kind, nodes in rest.cells.items()]
            if not all(is_same) or len(state.cells) > len(is_same) or len(state.points) != len(rest.points):
                what = f"its mesh is not that of {files[0].name}; remeshing can't be followed"
                raise UserError(f"{file}: {what}")
            displacement = _read_field(state, field, file) if field else state.points - rest.points
            nodal_force = _read_field(state, load, file) if load else None
            yield State(file, times[k] if times else state.time, displacement, nodal_force)

    return assemble(source, surface, units, len(files), states(), fields, per_area)


def list_states(source: Path) -> tuple[list[Path], list[float] | None]:
    """Files of a series in order, two at least, and their times [s] if a collection states them."""
    if (advice := _OTHERS.get(source.suffix.lower())) is not None:
        raise UserError(f"{source}: can't be read; convert it to VTU: {advice}")
    if source.suffix in COLLECTIONS:
        files, times = zip(*read_collection(source), strict=True)
        return list(files), list(times)
    entries = list(source.iterdir() if source.is_dir() else source.parent.glob(source.name))
    lists = [file for file in entries if file.suffix in COLLECTIONS]
    if len(lists) == 1:
        return list_states(lists[0])
    members = [file for file in entries if file.suffix[1:] in SUFFIXES]
    members = members or [file for file in entries if file.suffix[1:].lower() in SURFACES]
    stems = sorted({re.sub(r"\d+$", "", file.stem) + "*" + file.suffix for file in members})
    if len(stems) > 1:
        raise UserError(f"{source}: files of several series, {', '.join(stems[:3])}; choose one of these")
    numbers = {file: re.search(r"\d+$", file.stem) for file in members}
    order = sorted((int(number[0]), file) for file, number in numbers.items() if number)
    if len(order) < 2:
        raise UserError(
            f"{source}: no series; two numbered files at least ({', '.join((*SUFFIXES, *SURFACES))})"
        )
    steps = np.diff([number for number, _ in order])
    if (gaps := np.flatnonzero(steps != steps.min())).size:
        before, after = (order[gaps[0] + k][1].name for k in (0, 1))
        raise UserError(f"{source}: a file between {before} and {after} is missing")
    return [file for _, file in order], None


def _read(file: Path) -> MeshFile:
    data = checked_file.read_bytes(file, LARGEST_STATE)
    with as_user_error(f"{file}: is not a readable mesh"):
        if (kind := file.suffix[1:].lower()) in SURFACES:
            points, faces = read_surface(data, kind)
            return MeshFile(points, {TRIANGLE: faces})
        return read_mesh(data)


def force_field(force: str | None, fields: Sequence[str], file: Path) -> tuple[str | None, bool]:
    """Name of the field in `mechanics.force`, and whether it is one per area; None if there is no force.

    UserError: it is not nodal:NAME or traction:NAME of a field.
    """
    if force is None:
        return None, False
    kind, _, name = force.partition(":")
    if kind not in ("nodal", "traction") or name not in fields:
        available = f"{file.name} has {', '.join(fields) or 'no vectors'}{did_you_mean(name, fields)}"
        raise UserError(f"mechanics.force {force}: nodal:NAME, traction:NAME or a table (.csv); {available}")
    return name, kind == "traction"


def _read_field(state: MeshFile, name: str, file: Path) -> Floats:
    values = state.point_data.get(name)
    if values is None or values.parts != 3:
        raise UserError(f"{file}: has no vectors {name} at its points")
    with as_user_error(f"{file}: {name} can't be read"):
        return np.asarray(values.read(), np.float64)
