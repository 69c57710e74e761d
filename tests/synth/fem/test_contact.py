"""A rigid tip: its shape, what the contact gives as label, what is refused; half-space in tests/evidence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from dome import ANATOMY, patch
from pydantic import ValidationError

from synth.errors import UserError
from synth.fem.contact import Tip
from synth.fem.material import Tissue
from synth.fem.mesh import tetrahedra
from synth.fem.solver import Deformation, deform
from synth.fem.tool import Gesture, focus
from synth.job import schema
from synth.job.law_limits import depth_of_load, load_of_depth

TISSUE = Tissue(1.5, 0.4, "neo-hookean")


def run(seed: int = 5, frames: int = 14, gesture: Gesture | None = None, **fem: object) -> Deformation:
    section = schema.Fem.model_validate({"tets": 400, "load": (0.2, 0.2)} | fem)
    gesture = gesture or drawn(section, seed)
    tets = tetrahedra.block(ANATOMY, section.tets, 2, focus(gesture))
    return deform(section, TISSUE, gesture, tets, *patch(121, 36.0), frames, 25.0)


def drawn(section: schema.Fem, seed: int = 5) -> Gesture:
    return Gesture.draw(section, ANATOMY.craniotomy, TISSUE, np.random.default_rng(seed))


@pytest.mark.parametrize("shape", ["flat", "sphere"])
def test_a_tips_gap_has_the_gradient_that_it_says(shape: str) -> None:
    tip = Tip.named(shape, 4.0)
    at = np.random.default_rng(0).uniform([-3.9, -3.9, -1], [3.9, 3.9, 0.6], (400, 3))
    _, normal, bend = tip.gap(at)
    for axis in range(3):
        for side, values in ((normal[:, axis], 0), (bend[:, axis], 1)):
            step = np.zeros(3)
            step[axis] = 1e-6
            change = (tip.gap(at + step)[values] - tip.gap(at - step)[values]) / 2e-6
            # The edge's curvature sets in at once.
            smooth = np.abs(np.hypot(*at.T[:2]) - tip.flat_mm) > 1e-3
            np.testing.assert_allclose(change[smooth], side[smooth], atol=1e-6)
    level = np.column_stack([np.zeros((3, 2)), [-0.5, 0.0, 0.3]])
    np.testing.assert_allclose(tip.gap(level)[0], [0.5, 0.0, -0.3])


def test_depth_and_load_on_the_half_space_are_each_others_inverse() -> None:
    for tip in ("flat", "sphere"):
        assert load_of_depth(tip, depth_of_load(tip, 0.3, 0.4), 0.4) == pytest.approx(0.3)
    assert depth_of_load("flat", 0.4, 0.4) == pytest.approx(0.168)


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["flat", "sphere"])
@pytest.mark.parametrize("kind", ["push", "slide"])
def test_the_label_is_what_the_contact_found(kind: str, shape: str) -> None:
    motion = run(contact="rigid", gestures=(kind,), tip=shape)
    total = np.einsum("v,tvd->td", motion.area, motion.traction)
    np.testing.assert_allclose(total, motion.force, atol=1e-9 * np.abs(motion.force).max())
    assert not motion.displacement[0].any()
    assert not motion.force[0].any()
    assert motion.residual.max() <= 2e-4
    loaded = np.linalg.norm(motion.force, axis=1) > 0
    # Nothing pulls: traction is along the inward normal, but for friction and the tip's slope.
    assert (motion.traction[loaded][..., 2] <= 1e-9).all()
    work = np.vdot(motion.area[:, None] * motion.traction[6], motion.displacement[6])
    assert work > 0
    section = schema.Fem.model_validate({"load": (0.2, 0.2), "contact": "rigid", "gestures": (kind,)})
    asked = np.asarray(drawn(section).contacts[0].force_mn)
    way = np.array([0.0, 0.0, -1.0]) if kind == "slide" else asked / np.linalg.norm(asked)
    assert (motion.force @ way).max() == pytest.approx(asked @ way, rel=1e-6)


@pytest.mark.slow
def test_without_friction_a_press_leaves_nothing_and_its_work_is_stored() -> None:
    motion = run(contact="rigid", gestures=("push",), friction=0.0, frames=40)
    load = motion.area[:, None] * motion.traction
    steps = [
        0.5 * np.vdot(load[t] + load[t - 1], motion.displacement[t] - motion.displacement[t - 1])
        for t in range(1, 40)
    ]
    done, most = np.append(0.0, np.cumsum(steps)), motion.energy.max()
    assert np.abs(done - motion.energy).max() <= 5e-3 * most
    assert abs(done[-1]) <= 5e-3 * most
    assert np.abs(motion.displacement[-1]).max() <= 1e-3 * np.abs(motion.displacement).max()


@pytest.mark.slow
def test_a_depth_is_reached_and_takes_about_the_half_spaces_load() -> None:
    motion = run(contact="rigid", gestures=("push",), friction=0.0, depth_mm=(0.4, 0.4), footprint_mm=(4, 4))
    assert np.abs(motion.displacement[..., 2]).max() == pytest.approx(0.4, rel=0.1)
    load = np.linalg.norm(motion.force, axis=1).max() / (TISSUE.young_kpa * 16)
    assert load == pytest.approx(load_of_depth("flat", 0.1, 0.4), rel=0.25)  # rounded edge, dome, fixed walls


def test_what_is_pulled_stays_a_traction() -> None:
    gesture = drawn(schema.Fem(gestures=("pull",), load=(0.2, 0.2)))
    one, other = (run(gesture=gesture, contact=way) for way in ("traction", "rigid"))
    np.testing.assert_array_equal(one.displacement, other.displacement)
    np.testing.assert_array_equal(one.traction, other.traction)


def test_a_rigid_press_is_drawn_within_coulombs_cone() -> None:
    for seed in range(20):
        section = schema.Fem(contact="rigid", gestures=("push", "slide", "tap"), friction=0.2)
        force = np.asarray(drawn(section, seed).contacts[0].force_mn)
        assert np.hypot(*force[:2]) <= 0.2 * -force[2] * (1 + 1e-9)


@pytest.mark.parametrize(
    ("fem", "match"),
    [
        ({"depth_mm": (0.1, 0.2)}, "needs contact: rigid"),
        ({"contact": "rigid", "time": "dynamic"}, "quasi-static"),
        ({"contact": "rigid", "gestures": ("pull",)}, "push, slide, tap"),
        ({"contact": "rigid", "depth_mm": (0.1, 0.2)}, "alone"),
        (
            {"contact": "rigid", "depth_mm": (1.0, 3.0), "gestures": ("push",)},
            r"largest valid value is 0\.504",
        ),
    ],
)
def test_what_rigid_contact_is_not_for_is_refused(fem: dict[str, object], match: str) -> None:
    with pytest.raises(ValidationError, match=match):
        schema.Fem.model_validate(fem)


def test_a_tip_off_the_surface_is_refused() -> None:
    gesture = drawn(schema.Fem(contact="rigid", gestures=("push",), load=(0.2, 0.2)))
    away = replace(gesture.contacts[0], point_mm=(200.0, 0.0))
    with pytest.raises(UserError, match="touches"):
        run(gesture=replace(gesture, contacts=(away,)), contact="rigid")
