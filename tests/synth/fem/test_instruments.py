"""Instruments given by the job, several at once: labels that add up, forces in place of loads."""

from typing import Any

import numpy as np
import pytest
from dome import OPENING_MM, block, patch
from pydantic import ValidationError

import synth
from synth.fem import solver, tool_gesture
from synth.fem.material import Tissue
from synth.fem.surface_embedding import vertex_area
from synth.job import schema
from synth.sequence import scenario

PUSH = {
    "gesture": "push",
    "place": [4.0, 0.0],
    "direction": [0.0, 0.6, -0.8],
    "load": 0.1,
    "footprint_mm": 3.5,
    "timing": [0.1, 0.3, 0.6, 0.9],
}
PULL = {"gesture": "pull", "place": [-5.0, 1.0], "force_mn": 1.5, "direction": [0, 0, 2]}


def job(*crew: dict[str, Any], **fem: Any) -> synth.Job:
    return synth.Job.model_validate({"seed": 3, "sequences": 20, "fem": {"instrument_list": crew, **fem}})


def test_given_values_are_used_and_the_others_drawn() -> None:
    given = job(PUSH, PULL)
    cases = [scenario.draw_scenario(given, index) for index in range(20)]
    for case in cases:
        push, pull = case.gestures
        assert (push.kind, push.point_mm, push.load, push.footprint_mm) == ("push", (4.0, 0.0), 0.1, 3.5)
        assert push.direction == pytest.approx((0.0, 0.6, -0.8))
        assert push.timing == (0.1, 0.3, 0.6, 0.9)
        assert push.force_mn == pytest.approx(0.1 * case.tissue.young_kpa * 3.5**2)
        assert (pull.kind, pull.point_mm, pull.direction) == ("pull", (-5.0, 1.0), pytest.approx((0, 0, 1)))
        assert pull.force_mn == pytest.approx(1.5)
        assert 3 <= pull.footprint_mm <= 6
        assert tool_gesture.clearance(push, pull) >= 0
    for drawn in ("azimuth_deg", "hover_mm"):
        assert len({getattr(case.gestures[0], drawn) for case in cases}) == 20
    assert len({case.gestures[1].timing for case in cases}) == 20


@pytest.mark.parametrize(
    "wrong",
    [{"place": [11, 0]}, {"gesture": "slide", "direction": [0, 0, -1]}, {"load": 0.1, "force_mn": 1}],
)
def test_contradictions_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match="instrument_list"):
        job(wrong)


@pytest.mark.parametrize("law", ["linear", "neo-hookean"])
def test_labels_of_two_instruments_add_up_and_both_touch(law: str) -> None:
    fem = schema.FemSection(law=law, tets=400, load=(0.1, 0.15), instruments=2, gestures=("pull", "push"))
    rng, frames, tissue = np.random.default_rng(3), 17, Tissue(1.0, 0.4, law)
    gestures = scenario.draw_gestures(fem, OPENING_MM, tissue.young_kpa, rng, rng)
    tets, surface = block(fem), patch()
    motion = solver.deform(fem, tissue, gestures, tets, surface, frames, 25.0)
    area = vertex_area(*surface)
    np.testing.assert_allclose(motion.by_instrument.sum(axis=1), motion.force, atol=1e-12)
    moved = surface.vertices + motion.displacement
    for k, gesture in enumerate(gestures):
        centre = np.asarray(gesture.contacts[0].point_mm)
        mine = np.linalg.norm(surface.vertices[:, :2] - centre, axis=1) < 1.1 * gesture.footprint_mm
        theirs = (
            np.linalg.norm(surface.vertices[:, :2] - gestures[1 - k].contacts[0].point_mm, axis=1)
            < gestures[1 - k].footprint_mm
        )
        if not (mine & theirs).any():
            part = np.einsum("v,tvd->td", area[mine], motion.traction[:, mine])
            np.testing.assert_allclose(part, motion.by_instrument[:, k], atol=1e-9)
        pressed = np.linalg.norm(motion.by_instrument[:, k], axis=1)
        apart = np.linalg.norm(motion.tip[:, 2 * k : 2 * k + 2, None] - moved[:, None], axis=3).min(axis=2)
        assert apart[pressed > 0.05 * pressed.max()].max() < 0.6  # half a vertex spacing
        assert apart[0].min() > 3
    if law == "linear":
        alone = [solver.deform(fem, tissue, [g], tets, surface, frames, 25.0).displacement for g in gestures]
        np.testing.assert_allclose(motion.displacement, sum(alone), atol=1e-8)


def test_a_force_replaces_the_load() -> None:
    fem = schema.FemSection(force_mn=(3.0, 5.0), young_kpa=(2.0, 3.0), footprint_mm=(3.0, 4.0))
    assert fem.largest_load == pytest.approx(5.0 / 18)
    for seed in range(20):
        tissue = scenario.draw_tissue(fem, np.random.default_rng(seed))
        gesture = scenario.draw_gesture(fem, OPENING_MM, tissue.young_kpa, np.random.default_rng(seed))
        force = np.linalg.norm(gesture.contacts[0].force_mn)
        assert 3.0 <= force <= 5.0
        assert force == pytest.approx(gesture.load * tissue.young_kpa * gesture.footprint_mm**2)
    assert schema.FemSection(force_mn=0.2).chosen_law[0] == "linear"
