"""Pulse of heart and breath: the surface rises as far as requested, and labels do not change."""

import numpy as np
import pytest
from dome import ANATOMY, OPENING_MM, patch

from synth.fem import solver
from synth.fem.deformation import Deformation
from synth.fem.mesh import tetrahedra
from synth.fem.pulse import Pulse
from synth.job import schema
from synth.sequence import scenario

RATE, FRAMES = 10.0, 61


def moved(pulse: Pulse | None, law: str, **fem: object) -> Deformation:
    section = schema.FemSection.model_validate({"gestures": ("pull",), "load": 0.1, "law": law} | fem)
    tissue = scenario.draw_tissue(section, np.random.default_rng(1))
    gesture = scenario.draw_gesture(section, OPENING_MM, tissue.young_kpa, np.random.default_rng(2))
    tets = tetrahedra.block(ANATOMY, 300, gesture.focus)
    return solver.deform(section, tissue, [gesture], tets, patch(), FRAMES, RATE, pulse, OPENING_MM)


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
