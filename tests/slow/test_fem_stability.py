"""Stability of the mechanics and errors at its limits: a law's range, odd steps, slivers, random scenes."""

from dataclasses import replace
from typing import Any

import numpy as np
import pressed_brain as fem_case
import pytest

from synth.errors import UserError
from synth.fem.equilibrium import InvertedElement, NoEquilibrium
from synth.fem.law_choice import LARGEST_LOAD, LEAST_JACOBIAN
from synth.fem.mesh import tetrahedra
from synth.fem.mesh.element import quality
from synth.fem.system import assemble
from synth.job import schema
from synth.sequence.simulation import simulate

CONTACT = fem_case.CONTACTS[0]
LIVING = {
    "membrane": {"probability": 0.7},
    "pulse": {"heart_mm": (0.0, 0.5), "breath_mm": (0.0, 0.6)},
    "poisson": (0.4, 0.49),
    "skull": ("bonded", "slip"),
    "instruments": (1, 2),
}


def random_scene(index: int, **fem: Any) -> None:
    sections = {"seed": 0, "sequences": 10**6, "frames": 12, "anatomy": {"vertices": 10_000}}
    job = schema.Job.model_validate({**sections, "fem": {"tets": 500, **fem}})
    scene = simulate(job, index)
    case, motion = scene.scenario, scene.motion
    assert motion.energy is not None
    assert motion.min_jacobian is not None
    for numbers in (motion.displacement, motion.traction, motion.tip, motion.energy):
        assert np.isfinite(numbers).all()
    assert motion.min_jacobian.min() > LEAST_JACOBIAN
    force = np.einsum("v,tvd->td", scene.vertex_area, motion.traction)
    assert np.abs(force - motion.force).max() <= 1e-9 * np.abs(motion.force).max()
    if case.pulse is None:  # displacement per force, frame to frame, while the force is even
        size, peak = np.linalg.norm(force, axis=1), np.linalg.norm(motion.displacement, axis=2).max(axis=1)
        steps = np.abs(np.diff(np.log(np.maximum(peak, 1e-9) / np.maximum(size, 1e-9))))
        even = (size[1:] > 0.05 * size.max()) & (np.abs(np.diff(size)) < 0.02 * size.max())
        assert steps[even].max(initial=0.0) < np.log(1.25)


SLIDES = {"gestures": ["slide"]}


@pytest.mark.parametrize(
    ("fem", "count"),
    [
        pytest.param({}, 2, id="default"),
        pytest.param(SLIDES, 3, id="slides"),
        pytest.param(LIVING, 3, id="living"),
        *(pytest.param(fem, 8, marks=pytest.mark.trial) for fem in ({}, SLIDES, LIVING)),
    ],
)
def test_random_scenes_are_whole_and_step_evenly(fem: dict[str, Any], count: int) -> None:
    for index in range(count):
        random_scene(index, **fem)


@pytest.mark.parametrize(("law", "load"), [("corotational", 0.8), ("linear", 3.0), ("neo-hookean", 3.0)])
def test_a_push_past_a_laws_range_is_refused(law: str, load: float) -> None:
    case = fem_case.brain(fem_case.patch(10_000), law, 500, CONTACT)
    assert np.isfinite(fem_case.solve_displacement(case, LARGEST_LOAD[law], "push", 8)).all()
    with pytest.raises((InvertedElement, NoEquilibrium)):
        fem_case.solve_displacement(case, load, "push", 8)


def test_equilibrium_does_not_depend_on_the_steps_to_it() -> None:
    surface = fem_case.patch(10_000)
    for law in ("corotational", "neo-hookean"):
        case = fem_case.brain(surface, law, 500, CONTACT)
        slow = fem_case.solve_displacement(case, 0.15, "push", 40)
        for steps in (1, 5):
            assert (
                fem_case.error(fem_case.solve_displacement(case, 0.15, "push", steps), slow, surface) < 1e-3
            )


def test_quadratic_elements_hardly_lock_and_slivers_are_refused() -> None:
    surface = fem_case.patch(10_000)
    for poisson in (0.4, 0.499):
        fine, coarse = (fem_case.brain(surface, "linear", tets, CONTACT, poisson) for tets in (2000, 500))
        exact = fem_case.solve_displacement(fine, 0.1, "push", 1)
        assert fem_case.error(fem_case.solve_displacement(coarse, 0.1, "push", 1), exact, surface) < 0.15
    mesh = tetrahedra.block(500, (CONTACT,))
    # A corner of the tetrahedron nearest to 6 mm under the contact, pressed flat.
    cell = np.linalg.norm(mesh.points[mesh.cells[:, :4]].mean(axis=1) - [0, 0, -6.0], axis=1).argmin()
    points, corners = mesh.points.copy(), mesh.cells[cell, :4]
    points[corners[0]] = points[corners[1:]].mean(axis=0)
    assert quality(points[corners][None]).max() < 0.01
    with pytest.raises(UserError):
        assemble(replace(mesh, points=points), "linear", 0.4)
