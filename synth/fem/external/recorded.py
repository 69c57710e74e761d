"""Series in arrays (.npz), and runs of the published recorder.

An .npz holds `points` (S, N, 3), or `rest` (N, 3) and `displacement` (S, N, 3); one of `faces` (F, 3),
`tetrahedra` (C, 4) or `hexahedra` (C, 8), numbers of points from 0; `times` (S,) s; and if it is known a
field (S, N, 3) of forces that act on the nodes from outside, or of forces per area at rest.

A folder `run_*` of SOFA-NeuroSim-Recorder (github.com/D3MIA/SOFA-NeuroSim-Recorder, simlib/recorders.py)
holds `*_auto.npz` or `*_final.npz` with `rest`, `displacements` in mm, `times` in s and
`surface_external_forces` in N, next to the surface as OBJ, whose faces are matched by position: the arrays
name none.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from synth.arrays import Floats, Ints
from synth.errors import UserError, as_user_error
from synth.fem.external.series import MeshSeries, State, Units, assemble, find_surface
from synth.fem.external.vtk_series import force_field
from synth.geometry.mesh_file import Numbers, read_surface, whole
from synth.geometry.skin import TRIANGLE
from synth.system import checked_file

_CELLS = {"faces": TRIANGLE, "tetrahedra": 10, "hexahedra": 12}
_MOTION = ("displacement", "displacements")
_RECORDED = "surface_external_forces"
_NEAR = 1e-3  # of the extent, within which a vertex of the OBJ is one of the arrays


def find_run(folder: Path) -> Path | None:
    """The arrays of a run of the published recorder in a folder: the final ones if there are some."""
    files = sorted(folder.glob("*_final.npz")) or sorted(folder.glob("*_auto.npz"))
    return files[-1] if files else None


def read_arrays(file: Path, units: Units, force: str | None = None, recorded: bool = False) -> MeshSeries:
    """The series in an .npz; `force` and what is raised as in `read_files`.

    `recorded`: a run of the published recorder. Its forces are an "intensity", scaled so that their peak is
    the total force; they are scaled back.
    """
    held = checked_file.ArrayFile(file)
    shapes = held.shapes
    if len(shapes.get("points", ())) == 3 and shapes["points"][0]:
        moved = held["points"]
        rest = moved[0].astype(np.float64)
        with np.errstate(over="ignore", invalid="ignore"):  # refused later
            moved = moved - moved[0]
    elif "rest" in held and (name := next((one for one in _MOTION if one in held), None)):
        rest, moved = held["rest"].astype(np.float64), held[name]
    else:
        what = "needs points (S, N, 3), or rest and displacement"
        raise UserError(f"{file}: {what}; it has {', '.join(sorted(held))}")
    fields = [name for name, shape in shapes.items() if shape == moved.shape]
    name, per_area = force_field(force, fields, file)
    time = held["times"] if "times" in held else np.full(moved.shape[:1], np.nan)
    same = time.ndim == 1 and moved.shape == (*time.shape, *rest.shape)
    if not same or rest.shape[1:] != (3,) or len(time) < 2:
        given = f"points {rest.shape}, displacement {moved.shape}, times {time.shape}"
        raise UserError(f"{file}: shapes don't fit, or are of fewer than two states: {given}")
    load = None if name is None else held[name]
    if recorded:
        units = Units(mm=units.mm or 1.0, mn=units.mn or 1000.0, dt_s=units.dt_s)
        if load is not None and name == _RECORDED:
            peak, total = np.linalg.norm(load, axis=2).max(axis=1), np.linalg.norm(load.sum(axis=1), axis=1)
            share = np.divide(peak, total, out=np.zeros_like(peak), where=total > 0)
            load = load * share[:, None, None]
    with as_user_error(f"{file}: its cells"):
        named = {TRIANGLE: _faces_of(file, rest)} if recorded else {}
        cells = named or {kind: whole(held[one]) for one, kind in _CELLS.items() if one in held}
    surface = find_surface(rest, cells, file)
    states = (
        State(file, at, _double(moved[k]), None if load is None else _double(load[k]))
        for k, at in enumerate(time.tolist())
    )
    return assemble(file, surface, units, len(time), states, fields, per_area)


def _double(values: Numbers) -> Floats:
    """Values (N, 3) in double precision; what is too large for it is infinite, which is refused later."""
    with np.errstate(over="ignore"):
        return values.astype(np.float64)


def _faces_of(arrays: Path, rest: Floats) -> Ints:
    """Faces (F, 3) of the surface next to the arrays, by the numbers of their points."""
    files = sorted(arrays.parent.glob("*.obj"))
    if len(files) != 1:
        raise UserError(f"{arrays.parent}: {len(files)} OBJ files; the recorded surface, one, is needed")
    data = checked_file.read_bytes(files[0], checked_file.LARGEST_MESH)
    with as_user_error(f"{files[0]}: is not a readable surface"):
        vertices, faces = read_surface(data, "obj")
    away, nearest = cKDTree(rest).query(vertices)
    if len(away) == 0 or away.max() > _NEAR * np.ptp(rest, axis=0).max():
        raise UserError(f"{files[0]}: its vertices are not those of {arrays.name} at rest")
    return np.asarray(nearest[faces], np.int64)
