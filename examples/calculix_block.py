"""A block of liver, pressed by a ball: solved by CalculiX, rendered with true flow and force.

python examples/calculix_block.py folder    (CalculiX: apt-get install calculix-ccx)
"""

import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
from felupe_membrane import paint_speckles

import synth

YOUNG_KPA, POISSON, DENT_MM, CONTACT_MM, STATES = 4.0, 0.45, 2.5, 8.0, 6
JOB = {"sequences": 1, "frames": STATES, "fps": 10, "fem": {"young_kpa": YOUNG_KPA}}
JOB["anatomy"] = {"craniotomy": {"point": (0, 0, 0), "direction": (0, 0, 1), "radius_mm": 15}}


def solve(folder: Path, mm: float = 1.0, mn: float = 1000.0, fine: int = 8) -> dict:
    """Solves it in units of `mm` and `mn` (1000: N), and writes the states; a job's section `mechanics`."""
    x = np.arange(-fine, fine + 1) / fine * (9 + 15 * np.linspace(-1, 1, 2 * fine + 1) ** 4)
    rest = np.stack(np.meshgrid(x, x, 0.75 * x[: fine + 1], indexing="ij"), axis=-1).reshape(-1, 3)
    ids, a, b = np.arange(len(rest)).reshape(len(x), len(x), -1), slice(-1), slice(1, None)
    cells = np.c_[*(ids[i, j, k].ravel() for k in (a, b) for i, j in ((a, a), (b, a), (b, b), (a, b)))]
    top, distance = np.isclose(rest[:, 2:], 0), np.hypot(rest[:, 0], rest[:, 1]) / CONTACT_MM
    ball = np.flatnonzero(top[:, 0] & (distance < 1))
    axis, dent = np.full_like(ball, 3), -DENT_MM / mm * (1 - 0.7 * distance[ball] ** 2)  # a ball
    young = YOUNG_KPA * mm**2 / mn
    law = f"*HYPERELASTIC,NEO HOOKE\n{young / 4 / (1 + POISSON):.9g},{6 * (1 - 2 * POISSON) / young:.9g}"
    deck = {
        "*NODE": np.c_[1 : len(rest) + 1, rest / mm],
        "*ELEMENT,TYPE=C3D8,ELSET=ALL": np.c_[1 : len(cells) + 1, cells + 1],
        "*NSET,NSET=GROUND": ids[..., 0].ravel() + 1,
        f"*MATERIAL,NAME=M\n{law}\n*SOLID SECTION,ELSET=ALL,MATERIAL=M\n*BOUNDARY\nGROUND,1,3": [],
        f"*STEP,NLGEOM\n*STATIC,DIRECT\n1,{STATES - 1}\n*BOUNDARY": np.c_[ball + 1, axis, axis, dent],
        "*NODE FILE\nU,RF\n*NODE PRINT,NSET=GROUND,TOTALS=ONLY\nRF\n*END STEP": [],
    }
    with (folder / "block.inp").open("w") as file:
        for head, rows in deck.items():
            np.savetxt(file, rows, "%.9g", ",", header=head, comments="")
    subprocess.run(["ccx", "block"], cwd=folder, check=True, stdout=subprocess.DEVNULL)
    fields = {"DISP": [0 * rest], "FORC": [0 * rest]}
    for part in (folder / "block.frd").read_text().split("\n -4")[1:]:  # one field of one state
        lines = [line for line in part.splitlines() if line.startswith(" -1")]
        fields[part.split()[0]].append([[float(line[k : k + 12]) for k in (13, 25, 37)] for line in lines])
    arrays = {"rest": rest / mm, "displacement": fields["DISP"], "contact": np.where(top, fields["FORC"], 0)}
    np.savez(folder / "block.npz", **arrays, hexahedra=cells, times=0.1 * np.arange(STATES))
    return {"source": folder / "block.npz", "unit_mm": mm, "unit_mn": mn, "force": "nodal:contact"}


liver = partial(paint_speckles, dark=(0.22, 0.045, 0.035), pale=(0.55, 0.3, 0.15), roughness=0.15)

if __name__ == "__main__":
    job = synth.Job.model_validate({**JOB, "mechanics": solve(Path(sys.argv[1]))})
    with synth.open_dataset(Path(sys.argv[1]) / "dataset", job) as folder:
        synth.write_scene(synth.simulate(job, content=liver), folder)
