"""Mechanics of one sequence: its cortex and the volume under it, loaded and deformed."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.fem import solver
from synth.fem.mesh import tetrahedra
from synth.fem.mesh.relief import HeightMap
from synth.fem.mesh.tetrahedra import Tets
from synth.fem.solver import Deformation
from synth.fem.tool_gesture import ToolMotion
from synth.geometry.brain_surface import Brain, load_brain
from synth.geometry.triangles import Shape
from synth.job.laws import LAWS
from synth.job.schema import AnatomySection, Job
from synth.render.anatomy import surface as anatomy
from synth.render.anatomy.surface import CortexSurface, Relief
from synth.sequence.scenario import Scenario


def build(job: Job, case: Scenario) -> tuple[CortexSurface, Tets]:
    """The fine surface of a scenario and the volume under it, meshed finest under its contacts."""
    surface, brain = cortex(job, case)
    focus = [place for gesture in case.gestures for place in gesture.focus]
    mesh, slips = (job.fem.tets, focus), case.tissue.skull == "slip"
    if brain is not None:
        return surface, tetrahedra.from_brain(brain, job.anatomy, *mesh, slips=slips)
    height = HeightMap(surface.pia, surface.extent_mm)
    return surface, tetrahedra.block(job.anatomy, *mesh, height, slips=slips)


def cortex(job: Job, case: Scenario) -> tuple[CortexSurface, Brain | None]:
    """A scenario's fine surface, and the user's brain that it is part of, if any; cached, hence read-only."""
    written = job.anatomy.mesh.stat() if job.anatomy.mesh and job.anatomy.mesh.is_file() else None
    return _cortex(
        job.anatomy.opened(case.index), case.relief, written and (written.st_mtime_ns, written.st_size)
    )


@lru_cache(maxsize=4)
def _cortex(section: AnatomySection, relief: Relief, written: object) -> tuple[CortexSurface, Brain | None]:
    """As `cortex`; `written` (time and size of the file) distinguishes a mesh from one that replaced it."""
    brain = None
    if section.mesh is not None:
        brain = load_brain(section.mesh, section.craniotomy, section.attachments, section.fill_holes)
    surface = anatomy.grow(relief, section, brain.shape if brain else None)
    for value in (*vars(surface).values(), *(brain.shape if brain else ())):
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
    return surface, brain


def move(
    job: Job, case: Scenario, surface: CortexSurface, tets: Tets, motions: Sequence[ToolMotion] = ()
) -> Deformation:
    """Deformation by the scenario's gestures on that surface and volume; `motions` as in `solver.deform`."""
    return solver.deform(
        job.fem,
        case.tissue,
        case.gestures,
        tets,
        Shape(surface.vertices, surface.faces),
        job.frames,
        job.fps,
        case.pulse,
        job.anatomy.craniotomy.radius_mm,
        motions,
    )


def describe(job: Job, case: Scenario, motion: Deformation, rotation: NDArray[np.float64]) -> dict[str, Any]:
    """The attribute `mechanics` of a sequence; `rotation` (3, 3): world to camera axes."""
    timeless = job.fem.time == "quasi-static" and not job.fem.relaxation
    law_from = LAWS.source(case.tissue.law)
    special: dict[str, Any] = {"law_from": law_from} if law_from else {}
    if case.pulse is not None:
        special |= {"pulse_mm": case.pulse.height(motion.time).tolist()}
    if case.pulse is not None and timeless:
        special |= {
            "tool_work_mn_mm": motion.tool_work.tolist(),
            "pulse_work_mn_mm": motion.pulse_work.tolist(),
        }
    return special | {
        "law": case.tissue.law,
        # Whether the work of the instruments equals the stored energy.
        "elastic": timeless and case.pulse is None,
        "min_jacobian": motion.min_jacobian.tolist(),
        "energy_mn_mm": motion.energy.tolist(),
        "residual": motion.residual.tolist(),
        "instruments": [
            {
                "kind": gesture.kind,
                "force_mn": (motion.by_instrument[:, k] @ rotation.T).tolist(),
                "tip_mm": motion.tip[:, 2 * k : 2 * k + 2].tolist(),
                "shaft": motion.shaft[:, 2 * k].tolist(),
            }
            for k, gesture in enumerate(case.gestures)
        ],
    }
