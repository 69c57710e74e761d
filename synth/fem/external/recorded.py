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
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from synth.arrays import Floats, Ints
from synth.errors import UserError, as_user_error
from synth.fem.external.series import MeshSeries, Units, assemble, find_surface
from synth.fem.external.vtk_series import force_field
from synth.geometry.skin import TRIANGLE
from synth.system import checked_file

_CELLS = {"faces": TRIANGLE, "tetrahedra": 10, "hexahedra": 12}
_RECORDED = "surface_external_forces"
_NEAR = 1e-3  # of the extent, within which a vertex of the OBJ is one of the arrays


def find_run(folder: Path) -> Path | None:
    """The arrays of a run of the published recorder in a folder: the final ones if there are some."""
    found = sorted(folder.glob("*_final.npz")) or sorted(folder.glob("*_auto.npz"))
    return found[-1] if found else None


def read_arrays(file: Path, units: Units, force: str | None = None, recorded: bool = False) -> MeshSeries:
    """The series in an .npz; `force` as in `read_files`.

    `recorded`: a run of the published recorder. Its forces are an "intensity", scaled so that their peak is
    the total force; they are scaled back.

    Raises UserError as `read_files`.
    """
    held = checked_file.read_arrays(file)
    if "points" in held and held["points"].ndim == 3 and len(held["points"]):
        rest, moved = held["points"][0].astype(np.float64), held["points"] - held["points"][0]
    elif {"rest", "displacement"} <= set(held) or {"rest", "displacements"} <= set(held):
        rest, moved = held["rest"].astype(np.float64), held.get("displacement", held.get("displacements"))
    else:
        has = ", ".join(sorted(held))
        raise UserError(f"{file}: needs points (S, N, 3), or rest and displacement; it has {has}")
    assert moved is not None
    fields = [name for name, one in held.items() if one.shape == moved.shape]
    of = force_field(force, fields, file)
    time = held.get("times", (units.dt_s or np.nan) * np.arange(len(moved)))
    if (
        moved.shape[1:] != rest.shape
        or rest.shape[1:] != (3,)
        or time.shape != moved.shape[:1]
        or len(time) < 2
    ):
        shapes = f"points {rest.shape}, displacement {moved.shape}, times {time.shape}"
        raise UserError(f"{file}: shapes don't fit, or are of fewer than two states: {shapes}")
    if not (np.diff(time) > 0).all():
        raise UserError(f"{file}: its times don't rise, or are missing (times, or mechanics.dt_s)")
    cells = {kind: held[name].astype(np.int64) for name, kind in _CELLS.items() if name in held}
    surface = find_surface(rest, {TRIANGLE: _faces_of(file, rest)} if recorded else cells, file)
    moved = np.array([surface.pick(one, file) for one in moved.astype(np.float64)], np.float32)
    load = None
    if of is not None:
        load = np.array([surface.total(one) for one in held[of[1]].astype(np.float64)], np.float32)
        if recorded and of[1] == _RECORDED:
            peak, total = np.linalg.norm(load, axis=2).max(axis=1), np.linalg.norm(load.sum(axis=1), axis=1)
            load *= np.divide(peak, total, out=np.zeros_like(peak), where=total > 0)[:, None, None]
    if recorded:
        units = Units(mm=units.mm or 1.0, mn=units.mn or 1000.0)
    per_area = of is not None and of[0] == "traction"
    states = (np.asarray(time, np.float64), moved, fields, load, per_area)
    return assemble(file, rest[surface.nodes], surface.faces, units, *states)


def _faces_of(arrays: Path, rest: Floats) -> Ints:
    """Faces (F, 3) of the surface next to the arrays, by the numbers of their points."""
    import trimesh

    found = sorted(arrays.parent.glob("*.obj"))
    if len(found) != 1:
        raise UserError(f"{arrays.parent}: {len(found)} OBJ files; the recorded surface, one, is needed")
    with as_user_error(f"{found[0]}: is not a readable surface"):
        mesh = trimesh.load(found[0], force="mesh", process=False)
    away, nearest = cKDTree(rest).query(np.asarray(mesh.vertices))
    if len(away) == 0 or away.max() > _NEAR * np.ptp(rest, axis=0).max():
        raise UserError(
            f"{found[0]}: is not the surface of {arrays.name}: vertices differ from those at rest"
        )
    faces: NDArray[Any] = nearest[np.asarray(mesh.faces)]
    return faces.astype(np.int64)
