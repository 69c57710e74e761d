"""Several instruments at once: labels that add up; loads given as force."""

from __future__ import annotations

import numpy as np
import pytest
from dome import OPENING_MM, block, patch

from synth.fem import solver
from synth.fem.material import Tissue
from synth.fem.tool_gesture import Gesture
from synth.job import schema
from synth.sequence import scenario

TISSUE = Tissue(1.0, 0.4, "neo-hookean")


def drawn(fem: schema.FemSection, seed: int) -> tuple[Gesture, ...]:
    rng = np.random.default_rng(seed)
    return scenario.draw_gestures(fem, OPENING_MM, TISSUE.young_kpa, rng, rng)


@pytest.mark.parametrize("law", ["linear", "neo-hookean"])
def test_labels_of_two_instruments_add_up_and_both_touch(law: str) -> None:
    fem = schema.FemSection(law=law, tets=400, load=(0.1, 0.15), instruments=2, gestures=("pull", "push"))
    gestures, frames = drawn(fem, 3), 17
    tissue = Tissue(1.0, 0.4, law)
    tets, surface = block(fem), patch()
    motion = solver.deform(fem, tissue, gestures, tets, surface, frames, 25.0)
    np.testing.assert_allclose(motion.by_instrument.sum(axis=1), motion.force, atol=1e-12)
    moved = motion.rest + motion.displacement
    for k, gesture in enumerate(gestures):
        centre = np.asarray(gesture.contacts[0].point_mm)
        mine = np.linalg.norm(motion.rest[:, :2] - centre, axis=1) < 1.1 * gesture.footprint_mm
        theirs = (
            np.linalg.norm(motion.rest[:, :2] - gestures[1 - k].contacts[0].point_mm, axis=1)
            < gestures[1 - k].footprint_mm
        )
        if not (mine & theirs).any():
            part = np.einsum("v,tvd->td", motion.area[mine], motion.traction[:, mine])
            np.testing.assert_allclose(part, motion.by_instrument[:, k], atol=1e-9)
        pressed = np.linalg.norm(motion.by_instrument[:, k], axis=1)
        apart = np.linalg.norm(motion.tip[:, 2 * k : 2 * k + 2, None] - moved[:, None], axis=3).min(axis=2)
        assert apart[pressed > 0.05 * pressed.max()].max() < 0.6  # half a vertex spacing
        assert apart[0].min() > 3
    if law == "linear":
        alone = [solver.deform(fem, tissue, [g], tets, surface, frames, 25.0).displacement for g in gestures]
        np.testing.assert_allclose(motion.displacement, sum(alone), atol=1e-8)


def test_a_force_takes_the_place_of_the_load() -> None:
    fem = schema.FemSection(force_mn=(3.0, 5.0), young_kpa=(2.0, 3.0), footprint_mm=(3.0, 4.0))
    assert fem.largest_load == pytest.approx(5.0 / 18)
    for seed in range(20):
        tissue = scenario.draw_tissue(fem, np.random.default_rng(seed))
        gesture = scenario.draw_gesture(fem, OPENING_MM, tissue.young_kpa, np.random.default_rng(seed))
        force = np.linalg.norm(gesture.contacts[0].force_mn)
        assert 3.0 <= force <= 5.0
        assert force == pytest.approx(gesture.load * tissue.young_kpa * gesture.footprint_mm**2)
    assert schema.FemSection(force_mn=0.2).chosen_law[0] == "linear"
