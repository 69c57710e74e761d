"""A block of soft tissue, pressed, solved by scikit-fem, and writers of its states in engines' formats."""

import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import meshio
import numpy as np
import skfem
from skfem.models.elasticity import lame_parameters, linear_elasticity

from synth.arrays import Floats, Ints

YOUNG_KPA, POISSON, STATES, STEP_S = 1.0, 0.4, 5, 0.1
PLACE = "anatomy.craniotomy={point: [0, 0, 0], direction: [0, 0, 1], radius_mm: 10}"


@dataclass(frozen=True)
class Block:
    """States are `scale[k]` times the solution."""

    points: Floats  # (N, 3) mm
    tets: Ints  # (C, 4)
    u: Floats  # (N, 3) mm
    force: Floats  # (N, 3) mN, of the contact
    reaction: Floats  # (3,) mN of the ground
    scale: Floats  # (S,)


@lru_cache(maxsize=2)
def solve(spacing_mm: float = 3.0) -> Block:
    """A block of 48 x 48 x 18 mm on a rigid ground under a load of 5 mm radius."""
    across = np.linspace(-24, 24, round(48 / spacing_mm) + 1)
    grid = skfem.MeshTet.init_tensor(across, across, np.linspace(-18, 0, round(18 / spacing_mm) + 1))
    element = skfem.ElementVector(skfem.ElementTetP1())
    basis = skfem.Basis(grid, element, intorder=1)  # strains are constant in an element
    stiffness = skfem.asm(linear_elasticity(*lame_parameters(YOUNG_KPA, POISSON)), basis)
    top = skfem.FacetBasis(grid, element, facets=grid.facets_satisfying(lambda x: np.isclose(x[2], 0)))

    @skfem.LinearForm
    def load(v, w):  # type: ignore[no-untyped-def]
        size = np.maximum(1 - ((w.x[0] - 1) ** 2 + w.x[1] ** 2) / 25, 0)
        return size * (0.08 * v[0] - 0.24 * v[2])

    force = skfem.asm(load, top)
    ground = basis.get_dofs(lambda x: np.isclose(x[2], -18)).flatten()
    # The factorisation of a fine block takes three times as long as iterations to 1e-11.
    solver = skfem.solver_iter_pcg(rtol=1e-11) if spacing_mm < 3 else skfem.solver_direct_scipy()
    u = skfem.solve(*skfem.condense(stiffness, force, D=ground), solver=solver)
    nodes = basis.nodal_dofs
    reaction = (stiffness @ u - force)[nodes].T.sum(axis=0)
    scale = np.sin(np.pi * np.arange(STATES) / (STATES - 1)).round(12)
    return Block(grid.p.T, grid.t.T, u[nodes].T, force[nodes].T, reaction, scale)


def write(folder: Path, form: str, mm: float = 1.0, mn: float = 1.0, spacing_mm: float = 3.0) -> Path:
    """Writes the block's states and returns the source; `mm`, `mn`: in the unit of the files.

    `form`: `ascii`, numbered .vtu as of SOFA, without time; `binary`, .pvd with .vtu; `vtk`, .vtk.series with
    legacy files; `moving`, numbered .vtu whose points move; `npz`; `points`, an .npz with moving points;
    `recorder`, a run of the published recorder.
    """
    block = solve(spacing_mm)
    folder.mkdir(exist_ok=True, parents=True)
    rest, u, force = block.points / mm, block.u / mm, block.force / mn
    times = STEP_S * np.arange(STATES)
    displacement, loads = (np.multiply.outer(block.scale, field) for field in (u, force))
    if form in ("npz", "points"):
        motion = (
            {"rest": rest, "displacement": displacement} if form == "npz" else {"points": rest + displacement}
        )
        np.savez(folder / "s.npz", **motion, contact=loads, times=times, tetrahedra=block.tets)
        return folder / "s.npz"
    if form == "recorder":
        top = np.unique(np.flatnonzero(np.isclose(rest[:, 2], 0)))
        faces = meshio.Mesh(rest, [("tetra", block.tets)])
        outer = [face for face in _faces(faces.cells[0].data) if set(face) <= set(top.tolist())]
        order = {node: k for k, node in enumerate(top.tolist())}
        lines = [f"v {x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in rest[top]]
        lines += [f"f {order[a] + 1} {order[b] + 1} {order[c] + 1}\n" for a, b, c in outer]
        (folder / "surface.obj").write_text("".join(lines))
        size, total = np.linalg.norm(loads, axis=2).max(axis=1), np.linalg.norm(loads.sum(axis=1), axis=1)
        intensity = loads * (total / np.maximum(size, 1e-12))[:, None, None] / 1000
        arrays = {
            "rest": rest[top],
            "frames": rest[top] + displacement[:, top],
            "displacements": displacement[:, top],
        }
        arrays |= {"times": times, "surface_external_forces": intensity[:, top]}
        np.savez(folder / "brain_surface_0a_final.npz", **arrays)
        (folder / "brain_surface_0a_meta.json").write_text(json.dumps({"E": YOUNG_KPA}))
        return folder
    names = []
    for k in range(STATES):
        points = rest + displacement[k] if form == "moving" else rest
        fields = {"contact": loads[k]} | ({} if form == "moving" else {"displacement": displacement[k]})
        names.append(f"block_{k}.{'vtk' if form == 'vtk' else 'vtu'}")
        if form in ("ascii", "moving"):
            (folder / names[-1]).write_text(ascii_vtu(points, block.tets, fields))
        else:
            mesh = meshio.Mesh(points, [("tetra", block.tets)], point_data=fields)
            mesh.write(folder / names[-1], file_format="vtk42" if form == "vtk" else "vtu")
    if form == "binary":
        sets = "".join(f'<DataSet timestep="{t}" file="{n}"/>' for t, n in zip(times, names, strict=True))
        text = f'<VTKFile type="Collection"><Collection>{sets}</Collection></VTKFile>'
        (folder / "block.pvd").write_text(text)
        return folder / "block.pvd"
    if form == "vtk":
        files = [{"name": n, "time": float(t)} for t, n in zip(times, names, strict=True)]
        (folder / "block.vtk.series").write_text(json.dumps({"file-series-version": "1.0", "files": files}))
        return folder / "block.vtk.series"
    return folder / "block_*.vtu"


def ascii_vtu(points: Floats, tets: Ints, fields: dict[str, Floats]) -> str:
    """A file as SOFA's VTKExporter writes it: ASCII, and BigEndian, which means nothing there."""

    def array(name: str, values: np.ndarray, kind: str) -> str:
        parts = values.shape[1] if values.ndim == 2 else 1
        text = " ".join(f"{value:.9g}" for value in values.ravel().tolist())
        about = f'type="{kind}" Name="{name}" NumberOfComponents="{parts}" format="ascii"'
        return f"<DataArray {about}>{text}</DataArray>"

    count = len(tets)
    cells = array("connectivity", tets.ravel(), "Int32") + array(
        "offsets", 4 * np.arange(1, count + 1), "Int32"
    )
    cells += array("types", np.full(count, 10), "UInt8")
    data = "".join(array(name, values, "Float64") for name, values in fields.items())
    return (
        '<?xml version="1.0"?><VTKFile type="UnstructuredGrid" version="0.1" byte_order="BigEndian">'
        f'<UnstructuredGrid><Piece NumberOfPoints="{len(points)}" NumberOfCells="{count}">'
        f"<Points>{array('Points', points, 'Float64')}</Points><Cells>{cells}</Cells>"
        f"<PointData>{data}</PointData></Piece></UnstructuredGrid></VTKFile>"
    )


def _faces(tets: Ints) -> list[tuple[int, ...]]:
    """Corners of the faces of all tetrahedra that only one has."""
    all_faces = np.concatenate(
        [tets[:, list(corners)] for corners in ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3))]
    )
    _, first, count = np.unique(np.sort(all_faces, axis=1), axis=0, return_index=True, return_counts=True)
    return [tuple(face) for face in all_faces[first[count == 1]].tolist()]
