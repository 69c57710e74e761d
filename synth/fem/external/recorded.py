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
from synth.geometry.mesh_file import Numbers, as_integers, read_surface
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
    arrays = checked_file.ArrayFile(file)
    shapes = arrays.shapes
    if len(shapes.get("points", ())) == 3 and shapes["points"][0]:
        displacement = arrays["points"]
        rest = displacement[0].astype(np.float64)
        with np.errstate(over="ignore", invalid="ignore"):  # refused later
            displacement = displacement - displacement[0]
    elif "rest" in arrays and (name := next((key for key in _MOTION if key in arrays), None)):
        rest, displacement = arrays["rest"].astype(np.float64), arrays[name]
    else:
        what = "needs points (S, N, 3), or rest and displacement"
        raise UserError(f"{file}: {what}; it has {', '.join(sorted(arrays))}")
    fields = [name for name, shape in shapes.items() if shape == displacement.shape]
    name, per_area = force_field(force, fields, file)
    time = arrays["times"] if "times" in arrays else np.full(displacement.shape[:1], np.nan)
    is_consistent = time.ndim == 1 and displacement.shape == (*time.shape, *rest.shape)
    if not is_consistent or rest.shape[1:] != (3,) or len(time) < 2:
        shape_text = f"points {rest.shape}, displacement {displacement.shape}, times {time.shape}"
        raise UserError(f"{file}: shapes don't fit, or are of fewer than two states: {shape_text}")
    load = None if name is None else arrays[name]
    if recorded:
        units = Units(mm=units.mm or 1.0, mn=units.mn or 1000.0, dt_s=units.dt_s)
        if load is not None and name == _RECORDED:
            peak, total = np.linalg.norm(load, axis=2).max(axis=1), np.linalg.norm(load.sum(axis=1), axis=1)
            share = np.divide(peak, total, out=np.zeros_like(peak), where=total > 0)
            load = load * share[:, None, None]
    with as_user_error(f"{file}: its cells"):
        surface_cells = {TRIANGLE: _read_faces(file, rest)} if recorded else {}
        cells = surface_cells or {
            kind: as_integers(arrays[key]) for key, kind in _CELLS.items() if key in arrays
        }
    surface = find_surface(rest, cells, file)
    states = (
        State(file, time_s, _to_double(displacement[k]), None if load is None else _to_double(load[k]))
        for k, time_s in enumerate(time.tolist())
    )
    return assemble(file, surface, units, len(time), states, fields, per_area)


def _to_double(values: Numbers) -> Floats:
    """Values (N, 3) in double precision; what is too large for it is infinite, which is refused later."""
    with np.errstate(over="ignore"):
        return values.astype(np.float64)


def _read_faces(arrays: Path, rest: Floats) -> Ints:
    """Faces (F, 3) of the surface next to the arrays, by the numbers of their points."""
    files = sorted(arrays.parent.glob("*.obj"))
    if len(files) != 1:
        raise UserError(f"{arrays.parent}: {len(files)} OBJ files; the recorded surface, one, is needed")
    data = checked_file.read_bytes(files[0], checked_file.LARGEST_MESH)
    with as_user_error(f"{files[0]}: is not a readable surface"):
        vertices, faces = read_surface(data, "obj")
    distance, nearest = cKDTree(rest).query(vertices)
    if len(distance) == 0 or distance.max() > _NEAR * np.ptp(rest, axis=0).max():
        raise UserError(f"{files[0]}: its vertices are not those of {arrays.name} at rest")
    return np.asarray(nearest[faces], np.int64)
