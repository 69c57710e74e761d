"""Mechanics of your own: tissue as springs (Winkler), pressed in without an instrument.

    python examples/own_mechanics.py out

A result of another finite-element program takes the same way: as motion of the vertices of `rest.shape`.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import synth

DENT_MM, WIDTH_MM, DEPTH_MM = 1.5, 3.0, 20.0


class Springs:
    """A Gaussian dent in tissue whose columns resist with E / depth, each by itself."""

    def deform(self, rest: synth.RestScene, *_: object) -> synth.Deformation:
        t = np.linspace(0, 1, rest.job.frames)
        bump = np.exp(-0.5 * np.square(rest.shape.vertices[:, :2] / WIDTH_MM).sum(axis=1))
        displacement = np.outer(np.sin(np.pi * t) ** 2, bump)[..., None] * [0.0, 0.0, -DENT_MM]
        traction = rest.scenario.tissue.young_kpa / DEPTH_MM * displacement
        force = np.einsum("v,tvd->td", rest.vertex_area, traction)
        of_none = dict.fromkeys(("by_instrument", "tip", "shaft"), np.zeros((len(t), 0, 3)))
        return synth.Deformation(displacement=displacement, traction=traction, force=force, **of_none)


def main(root: Path, job: synth.Job) -> None:
    with synth.open_dataset(root, job) as folder:
        case = replace(synth.draw_scenario(job, 0), gestures=())
        synth.write_scene(synth.simulate(job, 0, case=case, mechanics=Springs()), folder)


if __name__ == "__main__":
    main(Path(sys.argv[1]), synth.load_job("tiny", ["sequences=1"]))
