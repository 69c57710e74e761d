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


def pulled(sheet: Membrane, u: Floats) -> tuple[float, Floats]:
    out = np.zeros_like(u)
    return sheet.pull(u, out), out


@pytest.mark.parametrize("linear", [True, False])
def test_force_is_the_slope_of_energy_and_stiffness_that_of_force_at_rest(tets: Tets, linear: bool) -> None:
    sheet = cover(tets, MembraneSheet(20.0, 1.03), linear=linear)
    rng, h = np.random.default_rng(0), 1e-6
    u, way = rng.normal(0, 0.15, tets.points.shape), rng.normal(size=tets.points.shape)
    more, less = pulled(sheet, u + h * way)[0], pulled(sheet, u - h * way)[0]
    assert float(np.vdot(pulled(sheet, u)[1], way)) == pytest.approx((more - less) / (2 * h), rel=1e-6)
    slope = (pulled(sheet, h * way)[1] - pulled(sheet, -h * way)[1]) / (2 * h)
    found = (sheet.rest_stiffness() @ way.ravel()).reshape(-1, 3)
    np.testing.assert_allclose(found, slope, atol=1e-7 * np.abs(slope).max())


def test_stretch_pull_and_wrinkles_are_those_of_the_textbook(tets: Tets) -> None:
    """Tension of an incompressible neo-Hookean sheet: even stretch, uniaxial tension, compression."""
    flat = tetrahedra.block(250, dome_mm=1e9)
    sheet = cover(flat, MembraneSheet(6.0, 1.0), linear=False)
    area = float(sheet.weight.sum())
    assert area == pytest.approx(1e4, rel=1e-9)
    at = flat.points * [1.0, 1.0, 0.0]
    c = 1.1**2
    assert pulled(sheet, 0.1 * at)[0] / area == pytest.approx(2 * c + c**-2 - 3, rel=1e-6)
    for aside in (0.0, -0.2):  # held at its width it bears more than free to narrow; narrower still, no less
        along = at * [0.1, 0.0, 0.0] + at * [0.0, aside, 0.0]
        free = c + 2 / np.sqrt(c) - 3
        held = c + 1 + 1 / c - 3
        assert pulled(sheet, along)[0] / area == pytest.approx(held if aside == 0 else free, rel=1e-6)
    energy, force = pulled(sheet, -0.1 * at)
    assert abs(energy) / area < 1e-12
    assert np.abs(force).max() < 1e-12
    turn = Rotation.from_rotvec([0.3, 0.5, -0.2]).as_matrix()
    assert pulled(sheet, flat.points @ turn.T - flat.points)[0] / area < 1e-12


@pytest.mark.parametrize("stiffening", [0.0, 20.0])
def test_stiffness_at_large_strain_is_the_slope_of_force(tets: Tets, stiffening: float) -> None:
    sheet = cover(tets, MembraneSheet(20.0, 1.03, stiffening), linear=False)
    rng, h = np.random.default_rng(0), 1e-7
    u, way = rng.normal(0, 0.15, tets.points.shape), rng.normal(size=tets.points.shape)
    more, less = pulled(sheet, u + h * way), pulled(sheet, u - h * way)
    assert float(np.vdot(pulled(sheet, u)[1], way)) == pytest.approx((more[0] - less[0]) / (2 * h), rel=1e-5)
    slope = (more[1] - less[1]) / (2 * h)
    found = (sheet.stiffness_at(u) @ way.ravel()).reshape(-1, 3)
    np.testing.assert_allclose(found, slope, atol=1e-5 * np.abs(slope).max())
    at_rest = (sheet.stiffness_at(0 * u) - sheet.rest_stiffness()).toarray()
    assert not at_rest.any()
    whole = sheet.stiffness_at(u).toarray()
    assert np.linalg.eigvalsh(whole).min() >= -1e-9 * np.abs(whole).max()


def test_a_strip_and_a_balloon_stiffen_as_in_closed_form() -> None:
    """W = S/(6 b) (exp(b X) - 1); X is l^2 + 2/l - 3 of a strip, 2 l^2 + 1/l^4 - 3 of a balloon's wall."""
    flat, b, h = tetrahedra.block(250, dome_mm=1e9), 30.0, 1e-6
    sheet = cover(flat, MembraneSheet(3.0, 1.0, b), linear=False)
    area, at = float(sheet.weight.sum()), flat.points * [1.0, 1.0, 0.0]

    def tension(stretch: float, way: list[float]) -> float:
        """mN/mm: slope of the energy by the stretch."""
        up, down = (
            pulled(sheet, (stretch - 1 + side * h) * at * way + at * [0, free, 0])[0] for side in (1, -1)
        )
        return (up - down) / (2 * h * area)

    for stretch in (1.001, 1.1, 1.2):
        free = -0.4  # aside it wrinkles
        power = np.exp(b * (stretch**2 + 2 / stretch - 3))
        assert tension(stretch, [1, 0, 0]) == pytest.approx((stretch - stretch**-2) * power, rel=1e-5)
        free = 0.0
        power = np.exp(b * (2 * stretch**2 + stretch**-4 - 3))
        assert tension(stretch, [1, 1, 0]) == pytest.approx(2 * (stretch - stretch**-5) * power, rel=1e-5)
    assert abs(pulled(sheet, -0.1 * at)[0]) < 1e-12  # slack


@pytest.mark.slow
def test_work_over_a_load_cycle_is_the_stored_energy() -> None:
    """The instruments' work while loading equals the stored energy, and comes back in unloading."""
    sheet = schema.MembraneSection(probability=1)
    fem = schema.FemSection(gestures=("push",), load=(0.25, 0.25), membrane=sheet)
    tissue = replace(scenario.draw_tissue(fem, np.random.default_rng(1)), membrane=Pia(300.0, 0.1, 1.02))
    gesture = scenario.draw_gesture(fem, OPENING_MM, tissue.young_kpa, np.random.default_rng(2))
    tets = tetrahedra.block(700, gesture.focus)
    found = solver.deform(read_scheme(fem), tissue, [gesture], tets, patch(121), 97, 25.0)
    assert found.energy is not None
    force = vertex_area(*patch(121))[:, None] * found.traction
    step = np.diff(found.displacement, axis=0)
    work = np.r_[0, np.cumsum(0.5 * np.einsum("tvd,tvd->t", force[1:] + force[:-1], step))]
    assert found.energy.max() > 0
    assert np.abs(work - found.energy).max() <= 5e-3 * found.energy.max()
    assert abs(found.energy[-1]) <= 1e-6 * found.energy.max()


RATE, FRAMES = 10.0, 61


def moved(pulse: Pulse | None, law: str, **fem: object) -> Deformation:
    section = schema.FemSection.model_validate({"gestures": ("pull",), "load": 0.1, "law": law} | fem)
    tissue = scenario.draw_tissue(section, np.random.default_rng(1))
    gesture = scenario.draw_gesture(section, OPENING_MM, tissue.young_kpa, np.random.default_rng(2))
    tets = tetrahedra.block(300, gesture.focus)
    return solver.deform(
        read_scheme(section), tissue, [gesture], tets, patch(), FRAMES, RATE, pulse, OPENING_MM
    )


@pytest.mark.parametrize(("law", "within"), [("linear", 1e-6), ("neo-hookean", 0.1)])
def test_the_surface_rises_as_requested_and_labels_stay(law: str, within: float) -> None:
    pulse = Pulse(0.3, 1.2, 0.2, 0.5, 0.3, 1.0)
    still, pulsing = moved(None, law), moved(pulse, law)
    np.testing.assert_array_equal(pulsing.force, still.force)
    np.testing.assert_array_equal(pulsing.traction, still.traction)
    middle = np.hypot(*patch().vertices[:, :2].T) < 0.25 * ANATOMY.craniotomy.radius_mm
    rise = (pulsing.displacement - still.displacement)[:, middle, 2].mean(axis=1)
    height = pulse.height(np.arange(FRAMES) / RATE)
    assert np.abs(rise - height).max() <= within * np.abs(height).max()
    assert np.max(pulsing.residual) <= 2e-4
    far = np.hypot(*patch().vertices[:, :2].T) > 1.7 * ANATOMY.craniotomy.radius_mm
    assert np.abs((pulsing.displacement - still.displacement)[:, far]).max() < 0.2 * np.abs(height).max()
