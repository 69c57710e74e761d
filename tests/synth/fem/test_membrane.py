"""The membrane: force, stiffness and work follow from its energy; the pulse lifts the surface alone."""

from dataclasses import replace

import numpy as np
import pytest
from dome import ANATOMY, OPENING_MM, patch
from scipy.spatial.transform import Rotation

from synth.fem import solver
from synth.fem.deformation import Deformation
from synth.fem.material import Pia
from synth.fem.membrane import Membrane, MembraneSheet, cover
from synth.fem.mesh import tetrahedra
from synth.fem.mesh.tetrahedra import Tets
from synth.fem.pulse import Pulse
from synth.fem.surface_embedding import vertex_area
from synth.job import schema
from synth.sequence import scenario
from synth.sequence.draw import read_scheme

Floats = np.ndarray


@pytest.fixture(scope="module")
def tets() -> Tets:
    return tetrahedra.block(250, ((2.0, 1.0, 4.0),))


def pull_sheet(sheet: Membrane, u: Floats) -> tuple[float, Floats]:
    force = np.zeros_like(u)
    return sheet.pull(u, force), force


@pytest.mark.parametrize("linear", [True, False])
def test_force_is_the_slope_of_energy_and_stiffness_that_of_force_at_rest(tets: Tets, linear: bool) -> None:
    sheet = cover(tets, MembraneSheet(20.0, 1.03), linear=linear)
    rng, h = np.random.default_rng(0), 1e-6
    u, direction = rng.normal(0, 0.15, tets.points.shape), rng.normal(size=tets.points.shape)
    upper_energy, lower_energy = (
        pull_sheet(sheet, u + h * direction)[0],
        pull_sheet(sheet, u - h * direction)[0],
    )
    assert float(np.vdot(pull_sheet(sheet, u)[1], direction)) == pytest.approx(
        (upper_energy - lower_energy) / (2 * h), rel=1e-6
    )
    slope = (pull_sheet(sheet, h * direction)[1] - pull_sheet(sheet, -h * direction)[1]) / (2 * h)
    derivative = (sheet.rest_stiffness() @ direction.ravel()).reshape(-1, 3)
    np.testing.assert_allclose(derivative, slope, atol=1e-7 * np.abs(slope).max())


def test_stretch_pull_and_wrinkles_are_those_of_the_textbook() -> None:
    """Tension of an incompressible neo-Hookean sheet: even stretch, uniaxial tension, compression."""
    flat = tetrahedra.block(250, dome_mm=1e9)
    sheet = cover(flat, MembraneSheet(6.0, 1.0), linear=False)
    area = float(sheet.weight.sum())
    assert area == pytest.approx(1e4, rel=1e-9)
    plan = flat.points * [1.0, 1.0, 0.0]
    c = 1.1**2
    assert pull_sheet(sheet, 0.1 * plan)[0] / area == pytest.approx(2 * c + c**-2 - 3, rel=1e-6)
    # Held at its width it bears more than free to narrow; narrower still, no less.
    for side_strain in (0.0, -0.2):
        displacement = plan * [0.1, 0.0, 0.0] + plan * [0.0, side_strain, 0.0]
        free_energy = c + 2 / np.sqrt(c) - 3
        held_energy = c + 1 + 1 / c - 3
        assert pull_sheet(sheet, displacement)[0] / area == pytest.approx(
            held_energy if side_strain == 0 else free_energy, rel=1e-6
        )
    energy, force = pull_sheet(sheet, -0.1 * plan)
    assert abs(energy) / area < 1e-12
    assert np.abs(force).max() < 1e-12
    turn = Rotation.from_rotvec([0.3, 0.5, -0.2]).as_matrix()
    assert pull_sheet(sheet, flat.points @ turn.T - flat.points)[0] / area < 1e-12


@pytest.mark.parametrize("stiffening", [0.0, 20.0])
def test_stiffness_at_large_strain_is_the_slope_of_force(tets: Tets, stiffening: float) -> None:
    sheet = cover(tets, MembraneSheet(20.0, 1.03, stiffening), linear=False)
    rng, h = np.random.default_rng(0), 1e-7
    u, direction = rng.normal(0, 0.15, tets.points.shape), rng.normal(size=tets.points.shape)
    upper_pull, lower_pull = pull_sheet(sheet, u + h * direction), pull_sheet(sheet, u - h * direction)
    assert float(np.vdot(pull_sheet(sheet, u)[1], direction)) == pytest.approx(
        (upper_pull[0] - lower_pull[0]) / (2 * h), rel=1e-5
    )
    slope = (upper_pull[1] - lower_pull[1]) / (2 * h)
    derivative = (sheet.stiffness_at(u) @ direction.ravel()).reshape(-1, 3)
    np.testing.assert_allclose(derivative, slope, atol=1e-5 * np.abs(slope).max())
    rest_difference = (sheet.stiffness_at(0 * u) - sheet.rest_stiffness()).toarray()
    assert not rest_difference.any()
    matrix = sheet.stiffness_at(u).toarray()
    assert np.linalg.eigvalsh(matrix).min() >= -1e-9 * np.abs(matrix).max()


def test_a_strip_and_a_balloon_stiffen_as_in_closed_form() -> None:
    """W = S/(6 b) (exp(b X) - 1); X is l^2 + 2/l - 3 of a strip, 2 l^2 + 1/l^4 - 3 of a balloon's wall."""
    flat, b, h = tetrahedra.block(250, dome_mm=1e9), 30.0, 1e-6
    sheet = cover(flat, MembraneSheet(3.0, 1.0, b), linear=False)
    area, plan = float(sheet.weight.sum()), flat.points * [1.0, 1.0, 0.0]

    def tension(stretch: float, axes: list[float]) -> float:
        """mN/mm: slope of the energy by the stretch."""
        upper_energy, lower_energy = (
            pull_sheet(sheet, (stretch - 1 + side * h) * plan * axes + plan * [0, side_strain, 0])[0]
            for side in (1, -1)
        )
        return (upper_energy - lower_energy) / (2 * h * area)

    for stretch in (1.001, 1.1, 1.2):
        side_strain = -0.4  # aside it wrinkles
        power = np.exp(b * (stretch**2 + 2 / stretch - 3))
        assert tension(stretch, [1, 0, 0]) == pytest.approx((stretch - stretch**-2) * power, rel=1e-5)
        side_strain = 0.0
        power = np.exp(b * (2 * stretch**2 + stretch**-4 - 3))
        assert tension(stretch, [1, 1, 0]) == pytest.approx(2 * (stretch - stretch**-5) * power, rel=1e-5)
    assert abs(pull_sheet(sheet, -0.1 * plan)[0]) < 1e-12  # slack


@pytest.mark.slow
def test_work_over_a_load_cycle_is_the_stored_energy() -> None:
    """The instruments' work while loading equals the stored energy, and comes back in unloading."""
    sheet = schema.MembraneSection(probability=1)
    fem = schema.FemSection(gestures=("push",), load=(0.25, 0.25), membrane=sheet)
    tissue = replace(scenario.draw_tissue(fem, np.random.default_rng(1)), membrane=Pia(300.0, 0.1, 1.02))
    gesture = scenario.draw_gesture(fem, OPENING_MM, tissue.young_kpa, np.random.default_rng(2))
    tets = tetrahedra.block(700, gesture.focus)
    motion = solver.deform(read_scheme(fem), tissue, [gesture], tets, patch(121), 97, 25.0)
    assert motion.energy is not None
    force = vertex_area(*patch(121))[:, None] * motion.traction
    step = np.diff(motion.displacement, axis=0)
    work = np.r_[0, np.cumsum(0.5 * np.einsum("tvd,tvd->t", force[1:] + force[:-1], step))]
    assert motion.energy.max() > 0
    assert np.abs(work - motion.energy).max() <= 5e-3 * motion.energy.max()
    assert abs(motion.energy[-1]) <= 1e-6 * motion.energy.max()


RATE, FRAMES = 10.0, 61


def deform_surface(pulse: Pulse | None, law: str, **fem: object) -> Deformation:
    section = schema.FemSection.model_validate({"gestures": ("pull",), "load": 0.1, "law": law} | fem)
    tissue = scenario.draw_tissue(section, np.random.default_rng(1))
    gesture = scenario.draw_gesture(section, OPENING_MM, tissue.young_kpa, np.random.default_rng(2))
    tets = tetrahedra.block(300, gesture.focus)
    return solver.deform(
        read_scheme(section), tissue, [gesture], tets, patch(), FRAMES, RATE, pulse, OPENING_MM
    )


@pytest.mark.parametrize(("law", "tolerance"), [("linear", 1e-6), ("neo-hookean", 0.1)])
def test_the_surface_rises_as_requested_and_labels_stay(law: str, tolerance: float) -> None:
    pulse = Pulse(0.3, 1.2, 0.2, 0.5, 0.3, 1.0)
    still, pulsing = deform_surface(None, law), deform_surface(pulse, law)
    np.testing.assert_array_equal(pulsing.force, still.force)
    np.testing.assert_array_equal(pulsing.traction, still.traction)
    middle_vertices = np.hypot(*patch().vertices[:, :2].T) < 0.25 * ANATOMY.craniotomy.radius_mm
    rise = (pulsing.displacement - still.displacement)[:, middle_vertices, 2].mean(axis=1)
    height = pulse.height(np.arange(FRAMES) / RATE)
    assert np.abs(rise - height).max() <= tolerance * np.abs(height).max()
    assert np.max(pulsing.residual) <= 2e-4
    far_vertices = np.hypot(*patch().vertices[:, :2].T) > 1.7 * ANATOMY.craniotomy.radius_mm
    assert (
        np.abs((pulsing.displacement - still.displacement)[:, far_vertices]).max()
        < 0.2 * np.abs(height).max()
    )
