"""Heart and breath: how far and how often the surface rises, and that no label knows of it."""

from __future__ import annotations

import numpy as np
import pytest
from dome import ANATOMY, patch
from numpy.typing import NDArray

from synth.checks import physics
from synth.fem import solver, tool
from synth.fem.material import Tissue
from synth.fem.mesh import tetrahedra
from synth.fem.pulse import Pulse
from synth.job import reader, schema
from synth.job.schema import Job
from synth.sequence import scenario

Floats = NDArray[np.float64]
RATE, FRAMES = 10.0, 61


def test_amplitude_and_rate_are_those_asked_for() -> None:
    time = np.arange(0, 100, 0.01)
    pulse = Pulse(0.4, 1.3, 0.7, 0.9, 0.25, 2.0)
    height = pulse.height(time)
    assert height[0] == 0
    wave = np.abs(np.fft.rfft(height - height.mean())) * 2 / len(time)
    hz = np.fft.rfftfreq(len(time), 0.01)
    assert sorted(hz[np.argsort(wave)[-2:]]) == pytest.approx([0.25, 1.3])
    assert wave[hz.searchsorted(0.25)] == pytest.approx(0.45, rel=1e-3)
    alone = Pulse(0.4, 1.3, 0.7, 0.0, 0.25, 2.0).height(time)
    assert np.ptp(alone) == pytest.approx(0.4, rel=1e-3)


def test_nothing_moves_unless_it_is_asked_for() -> None:
    assert all(scenario.draw(Job(), k).pulse is None for k in range(5))
    job = reader.load_job("in-vivo")
    drawn = [scenario.draw(job, k) for k in range(20)]
    assert all(one.pulse is not None and one.tissue.membrane is not None for one in drawn)
    assert all(
        0.1 <= one.pulse.heart_mm <= 0.5 and 1 <= one.pulse.heart_hz <= 1.7 for one in drawn if one.pulse
    )
    plain = scenario.draw(Job(), 3)
    beating = scenario.draw(Job.model_validate({"fem": {"pulse": {"heart_mm": 0.3}}}), 3)
    assert (beating.gesture, beating.tissue, beating.look) == (plain.gesture, plain.tissue, plain.look)


def moved(pulse: Pulse | None, law: str, **fem: object) -> solver.Deformation:
    asked = schema.Fem.model_validate({"gestures": ("pull",), "load": 0.1, "law": law} | fem)
    tissue = Tissue.draw(asked, np.random.default_rng(1))
    gesture = tool.Gesture.draw(asked, ANATOMY.craniotomy, tissue, np.random.default_rng(2))
    tets = tetrahedra.block(ANATOMY, 300, 2, tool.focus(gesture))
    return solver.deform(
        asked, tissue, gesture, tets, *patch(), FRAMES, RATE, pulse=pulse, opening=ANATOMY.craniotomy
    )


@pytest.mark.parametrize(("law", "within"), [("linear", 1e-6), ("neo-hookean", 0.1)])
def test_the_surface_rises_as_asked_and_labels_are_the_tools(law: str, within: float) -> None:
    pulse = Pulse(0.3, 1.2, 0.2, 0.5, 0.3, 1.0)
    still, beating = moved(None, law), moved(pulse, law)
    np.testing.assert_array_equal(beating.force, still.force)
    np.testing.assert_array_equal(beating.traction, still.traction)
    middle = np.hypot(*still.rest[:, :2].T) < 0.25 * ANATOMY.craniotomy.radius_mm
    rise = (beating.displacement - still.displacement)[:, middle, 2].mean(axis=1)
    height = pulse.height(still.time)
    assert np.abs(rise - height).max() <= within * np.abs(height).max()
    assert beating.residual.max() <= 2e-4
    far = np.hypot(*still.rest[:, :2].T) > 1.7 * ANATOMY.craniotomy.radius_mm
    assert np.abs((beating.displacement - still.displacement)[:, far]).max() < 0.2 * np.abs(height).max()


@pytest.mark.slow
def test_relaxing_tissue_beats_too() -> None:
    pulse = Pulse(0.3, 1.2, 0.2, 0.0, 0.3, 1.0)
    found = moved(pulse, "neo-hookean", relaxation=((0.3, 0.5),))
    assert 0.2 < np.ptp(found.displacement[:, :, 2].max(axis=1)) < 2


@pytest.mark.slow
def test_states_do_not_depend_on_how_they_were_foretold() -> None:
    """Starts from a fit of all states found end where Newton-like steps from the last one end."""
    from synth.fem import equilibrium
    from synth.fem.system import assemble

    tets = tetrahedra.block(ANATOMY, 300, 2, ((0.0, 0.0, 4.0),))
    system, rng = assemble(tets, "neo-hookean", 0.4), np.random.default_rng(0)
    top = np.hypot(*tets.points[:, :2].T) < 10
    one, other = (
        np.outer(top, way) * rng.uniform(0.5, 1, (len(top), 1)) for way in ((0, 0, 1.0), (0.7, 0, -0.7))
    )
    shares = rng.uniform(-0.15, 0.15, (12, 2))
    loads = np.stack([a * one + b * other for a, b in shares])
    named = np.full(len(loads), 0.1)
    lean = equilibrium.solve_path(system, loads, named, lean=True)
    slow = equilibrium.solve_path(system, loads, named)
    assert np.abs(lean.displacement - slow.displacement).max() <= 2e-3 * np.abs(slow.displacement).max()


def test_a_jump_is_found_in_spite_of_the_pulse() -> None:
    beating = moved(Pulse(0.6, 1.2, 0.2, 0.8, 0.3, 1.0), "neo-hookean")

    def worst(work: Floats, pulse: Floats | None) -> float:
        steps = list(physics.compliance_steps(work, beating.by_instrument, None, 1.0, pulse))
        assert len(steps) > FRAMES / 3
        return max(step / limit for _, step, limit in steps)

    assert worst(beating.energy, None) > 1  # the pulse's own motion is no jump of the tissue
    assert worst(beating.tool_work, beating.pulse_work) < 0.5
    jumped = beating.tool_work.copy()
    jumped[FRAMES // 2 :] *= 1.7
    assert worst(jumped, beating.pulse_work) > 1
    still = moved(None, "linear")
    np.testing.assert_allclose(still.tool_work, still.energy, atol=1e-9 * still.energy.max())
