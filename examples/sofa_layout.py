"""A series as SOFA's VTKExporter writes it, with its force in a table, rendered as cortex.

python examples/sofa_layout.py folder

SOFA is not run: the layout is that of VTKExporter.cpp, with exportAtBegin, so that the first file is at rest.
Files carry no time, points move, and no field is the force of the contact, hence a table.
"""

import sys
from pathlib import Path

import numpy as np

import synth

STATES, DT_S, DENT_MM, WIDTH_MM, FORCE_MN = 9, 0.05, 2.0, 4.0, 20.0
JOB = {"sequences": 1, "frames": STATES, "fps": 1 / DT_S, "fem": {"young_kpa": 1.5}}
JOB["anatomy"] = {"craniotomy": {"point": (0, 0, 0), "direction": (0, 0, 1), "radius_mm": 12}}
HEAD = '<VTKFile type="UnstructuredGrid" version="0.1" byte_order="BigEndian">\n<UnstructuredGrid>\n'


def array(attributes: str, values: np.ndarray) -> str:
    """One array of a file, with six digits."""
    numbers = " ".join(f"{value:.6g}" for value in values.flat)
    return f'<DataArray type={attributes} format="ascii">\n{numbers}\n</DataArray>\n'


def write(folder: Path, mm: float = 1000.0, mn: float = 1000.0) -> dict:
    """A dent that grows and recedes in a block, in m and N unless given; a job's section `mechanics`."""
    across, down = np.linspace(-24, 24, 33), np.linspace(-12, 0, 7)
    rest = np.stack(np.meshgrid(across, across, down, indexing="ij"), axis=-1).reshape(-1, 3)
    ids, a, b = np.arange(len(rest)).reshape(33, 33, 7), slice(-1), slice(1, None)
    cells = np.c_[*(ids[i, j, k].ravel() for k in (a, b) for i, j in ((a, a), (b, a), (b, b), (a, b)))]
    sizes, kinds = (np.repeat(pair, len(cells)) for pair in ((2, 8), (3, 12)))  # edges, then hexahedra
    topology = array('"Int32" Name="connectivity"', np.r_[cells[:, :2].ravel(), cells.ravel()])
    topology += array('"Int32" Name="offsets"', sizes.cumsum()) + array('"UInt8" Name="types"', kinds)
    dent = DENT_MM * np.exp(-0.5 * np.square(rest[:, :2] / WIDTH_MM).sum(axis=1)) * (1 + rest[:, 2] / 12)
    head = f'{HEAD}<Piece NumberOfPoints="{len(rest)}" NumberOfCells="{len(sizes)}">\n'
    lines = ["time,fx,fy,fz,x,y,z"]
    for k, part in enumerate(np.sin(np.pi * np.arange(STATES) / (STATES - 1)) ** 2):
        points = array('"Float32" NumberOfComponents="3"', (rest - np.outer(part * dent, [0, 0, 1])) / mm)
        body = f"<Points>{points}</Points>\n<Cells>{topology}</Cells>"
        (folder / f"tissue{k}.vtu").write_text(f"{head}{body}</Piece>\n</UnstructuredGrid>\n</VTKFile>\n")
        lines.append(f"{DT_S * k},0,0,{-FORCE_MN / mn * part:.9g},0,0,0")
    (folder / "force.csv").write_text("\n".join(lines) + "\n")
    section = {"source": folder / "tissue*.vtu", "force": "force.csv", "dt_s": DT_S}
    return {**section, "unit_mm": mm, "unit_mn": mn}


if __name__ == "__main__":
    job = synth.Job.model_validate({**JOB, "mechanics": write(Path(sys.argv[1]))})
    synth.render_job(job, Path(sys.argv[1]) / "dataset")
