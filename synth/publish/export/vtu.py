"""Export for ParaView and other solvers: the deforming surface and volume as VTK's .vtu and .pvd."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from synth.arrays import Array, Floats
from synth.dataset.dataset_folder import Folder
from synth.dataset.store import Dataset
from synth.errors import UserError
from synth.geometry.skin import TRIANGLE
from synth.job import identity
from synth.render.camera import camera
from synth.sequence.fem_mechanics import FemMechanics
from synth.sequence.rest_scene import Scene
from synth.sequence.simulation import simulate

_TET = 24  # quadratic, in VTK
_ROUNDING = 1e-3  # relative: another processor's last digits


def write_meshes(dataset: Dataset, target: Path) -> None:
    """Writes `NNNNNN.pvd` and `NNNNNN/TTTT.vtu` of each sequence: its surface at rest, in world axes [mm].

    At points: `displacement` [mm], `traction` [kPa] and the nodal `force` [mN] if it is known, `flow` [px] in
    the left camera. With our own mechanics also `NNNNNN-volume.pvd`, with `displacement` and Cauchy's
    `stress` [kPa] xx yy zz xy yz xz. Stores hold pixels, so each sequence is simulated again. UserError: it
    then differs, as one made by Python code does.
    """
    job = Folder(dataset.root).job()
    name_of_job = identity.identify_job(job)  # once: it reads every file of a series
    mechanics = FemMechanics(inside=True) if job.mechanics.source is None else None
    for sequence in dataset:
        scene, name = simulate(job, sequence.index, mechanics=mechanics), f"{sequence.index:06d}"
        stored_force, force = sequence["force"][:] if "force" in sequence else scene.force, scene.force
        unchanged = stored_force.shape == force.shape and np.allclose(
            stored_force, force, _ROUNDING, 1e-6, equal_nan=True
        )
        if not unchanged or sequence.attrs["job"] != name_of_job:
            raise UserError(f"{sequence.path}: can't be simulated again from the dataset's job")
        surface_meshes = ((*scene.shape, TRIANGLE, _fields(scene, t)) for t in range(len(scene)))
        _write(target, name, scene.time, surface_meshes)
        if (volume := scene.motion.volume) is not None:
            states = zip(volume.displacement, volume.stress, strict=True)
            volume_meshes = (
                (volume.points, volume.cells, _TET, {"displacement": u, "stress": s}) for u, s in states
            )
            _write(target, f"{name}-volume", scene.time, volume_meshes)


def _write(
    target: Path, name: str, times: Floats, meshes: Iterable[tuple[Floats, Array, int, dict[str, Floats]]]
) -> None:
    """Writes a collection of meshes, as `vtu` takes them, one per time [s]."""
    (target / name).mkdir()
    lines = []
    for t, (time, mesh) in enumerate(zip(times, meshes, strict=True)):
        (target / name / f"{t:04d}.vtu").write_text(vtu(*mesh), "utf-8")
        lines.append(f'<DataSet timestep="{time:.9g}" file="{name}/{t:04d}.vtu"/>\n')
    text = f'<VTKFile type="Collection"><Collection>\n{"".join(lines)}</Collection></VTKFile>\n'
    (target / f"{name}.pvd").write_text(text, "utf-8")


def _fields(scene: Scene, t: int) -> dict[str, Floats]:
    """Fields (V, n) of frame t at the surface's vertices."""
    motion, rest, state = scene.motion, scene.shape.vertices, scene.state(t)
    flow = camera.project(state.camera or scene.view, state.vertices) - camera.project(scene.view, rest)
    fields = {"displacement": motion.displacement[t], "flow": np.pad(flow, ((0, 0), (0, 1)))}
    if not np.isnan(scene.force).any():
        fields |= {"traction": motion.traction[t], "force": scene.vertex_area[:, None] * motion.traction[t]}
    return fields


def vtu(points: Floats, cells: Array, kind: int, fields: Mapping[str, Floats]) -> str:
    """A mesh of cells (C, n) of one of VTK's kinds with fields (N, k) at points (N, 3), as a .vtu file."""

    def array(name: str, dtype: str, values: Array) -> str:
        data = np.ascontiguousarray(values, np.dtype(dtype.lower()).newbyteorder("<")).tobytes()
        encoded = base64.b64encode(np.array(len(data), "<u8").tobytes() + data).decode()
        components = values.shape[1] if values.ndim == 2 else 1
        attributes = f'type="{dtype}" Name="{name}" NumberOfComponents="{components}" format="binary"'
        return f"<DataArray {attributes}>{encoded}</DataArray>\n"

    count, nodes = cells.shape
    parts = [
        array("connectivity", "Int64", cells.ravel()),
        array("offsets", "Int64", nodes * np.arange(1, count + 1)),
        array("types", "UInt8", np.full(count, kind)),
    ]
    return (
        '<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian" header_type="UInt64">\n'
        f'<UnstructuredGrid><Piece NumberOfPoints="{len(points)}" NumberOfCells="{count}">\n'
        f"<Points>{array('points', 'Float64', points)}</Points>\n<Cells>{''.join(parts)}</Cells>\n"
        f"<PointData>{''.join(array(name, 'Float32', data) for name, data in fields.items())}</PointData>\n"
        "</Piece></UnstructuredGrid></VTKFile>\n"
    )
