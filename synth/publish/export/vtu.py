"""Export for ParaView and other solvers: the deforming surface as VTK files (.vtu), a .pvd per sequence."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from synth.arrays import Array, Floats
from synth.dataset.folder import Folder
from synth.dataset.store import Dataset
from synth.errors import UserError
from synth.geometry.skin import TRIANGLE
from synth.geometry.triangles import Shape
from synth.render.camera import camera
from synth.sequence.scene import Scene
from synth.sequence.simulation import simulate

_ROUNDING = 1e-3  # relative: another processor's last digits


def write_surfaces(dataset: Dataset, target: Path) -> None:
    """Writes `NNNNNN.pvd` and `NNNNNN/TTTT.vtu` of each sequence: its surface at rest, in world axes [mm].

    At points: `displacement` [mm], `traction` [kPa] and the nodal `force` [mN] if it is known, `flow` [px] in
    the left camera. Stores hold pixels, so each sequence is simulated again. UserError: it then differs, as
    one made by Python code does.
    """
    job = Folder(dataset.root).job()
    for sequence in dataset:
        scene, name = simulate(job, sequence.index), f"{sequence.index:06d}"
        if "force" in sequence and not np.allclose(sequence["force"][:], scene.force, _ROUNDING, 1e-6):
            raise UserError(f"{sequence.path}: can't be simulated again from the dataset's job")
        (target / name).mkdir()
        lines = []
        for t in range(sequence.frames):
            (target / name / f"{t:04d}.vtu").write_text(vtu(scene.shape, _fields(scene, t)), "utf-8")
            lines.append(f'<DataSet timestep="{scene.time[t]:.9g}" file="{name}/{t:04d}.vtu"/>\n')
        text = f'<VTKFile type="Collection"><Collection>\n{"".join(lines)}</Collection></VTKFile>\n'
        (target / f"{name}.pvd").write_text(text, "utf-8")


def _fields(scene: Scene, t: int) -> dict[str, Floats]:
    """Fields (V, n) of frame t at the surface's vertices."""
    motion, rest, now = scene.motion, scene.shape.vertices, scene.state(t)
    moved = camera.project(now.camera or scene.view, now.vertices) - camera.project(scene.view, rest)
    found = {"displacement": motion.displacement[t], "flow": np.pad(moved, ((0, 0), (0, 1)))}
    if not np.isnan(scene.force).any():
        found |= {"traction": motion.traction[t], "force": scene.vertex_area[:, None] * motion.traction[t]}
    return found


def vtu(shape: Shape, fields: Mapping[str, Floats]) -> str:
    """A mesh of triangles with vectors (V, 3) at its points, as the text of a .vtu file."""

    def array(name: str, kind: str, values: Array) -> str:
        data = np.ascontiguousarray(values, np.dtype(kind.lower()).newbyteorder("<")).tobytes()
        coded = base64.b64encode(np.array(len(data), "<u8").tobytes() + data).decode()
        parts = values.shape[1] if values.ndim == 2 else 1
        about = f'type="{kind}" Name="{name}" NumberOfComponents="{parts}" format="binary"'
        return f"<DataArray {about}>{coded}</DataArray>\n"

    count = len(shape.faces)
    cells = [
        array("connectivity", "Int64", shape.faces.ravel()),
        array("offsets", "Int64", 3 * np.arange(1, count + 1)),
        array("types", "UInt8", np.full(count, TRIANGLE)),
    ]
    return (
        '<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian" header_type="UInt64">\n'
        f'<UnstructuredGrid><Piece NumberOfPoints="{len(shape.vertices)}" NumberOfCells="{count}">\n'
        f"<Points>{array('points', 'Float64', shape.vertices)}</Points>\n<Cells>{''.join(cells)}</Cells>\n"
        f"<PointData>{''.join(array(name, 'Float32', one) for name, one in fields.items())}</PointData>\n"
        "</Piece></UnstructuredGrid></VTKFile>\n"
    )
