"""A gesture's motion, loads and labels on the fine surface; what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from dome import ANATOMY, block, patch
from pydantic import ValidationError

from synth.errors import UserError
from synth.fem import surface_embedding, tool
from synth.fem.material import Tissue
from synth.fem.mesh import tetrahedra
from synth.fem.mesh.refine import EDGES
from synth.fem.solver import Deformation, InvertedElement, deform
from synth.fem.system import assemble
from synth.fem.tool import Gesture
from synth.job import law_limits, schema


def drawn(fem: schema.Fem, tissue: Tissue, seed: int = 5) -> Gesture:
    return Gesture.draw(fem, ANATOMY.craniotomy, tissue, np.random.default_rng(seed))


def run(fem: schema.Fem, gesture: Gesture | None = None, seed: int = 5, frames: int = 12) -> Deformation:
    tissue = Tissue.draw(fem, np.random.default_rng(seed))
    gesture = gesture or drawn(fem, tissue, seed)
    return deform(fem, tissue, gesture, block(fem), *patch(), frames, 25.0)


@pytest.mark.parametrize("law", ["linear", "corotational", "stable", "neo-hookean"])
def test_traction_sums_to_the_force(law: str) -> None:
    motion = run(schema.Fem(law=law, tets=400, load=(0.02, 0.12)))
    total = np.einsum("v,tvd->td", motion.area, motion.traction)
    assert np.abs(total - motion.force).max() <= 1e-9 * np.abs(motion.force).max()
    assert np.abs(motion.force).max() > 0.05


def test_transfer_keeps_force_and_moment() -> None:
    tets = tetrahedra.block(ANATOMY, 400, 2)
    vertices, _ = patch()
    vertices = vertices + np.random.default_rng(0).uniform(
        -0.7, 0.7, vertices.shape
    )  # off the mesh's surface
    carry = surface_embedding.embed(tets, vertices)
    load = np.random.default_rng(1).normal(size=(len(vertices), 3))
    volume = carry.gather(load)
    assert np.abs(carry.value.sum(axis=1) - 1).max() <= 1e-12
    assert np.abs(volume.sum(axis=0) - load.sum(axis=0)).max() <= 1e-12 * np.abs(load).sum()
    moment = np.cross(vertices, load).sum(axis=0)
    assert np.abs(np.cross(tets.points, volume).sum(axis=0) - moment).max() <= 1e-9 * np.abs(moment).max()


def test_what_stands_out_of_the_mesh_rides_by_rotation() -> None:
    tets = tetrahedra.block(ANATOMY, 400, 2)
    vertices, _ = patch()
    above = vertices + np.array([0, 0, 1.0])
    carry = surface_embedding.embed(tets, above)
    turn, stretch = np.array([[0, -0.3, 0.2], [0.3, 0, -0.1], [-0.2, 0.1, 0]]), np.diag([0.1, -0.2, 0.4])
    moved = carry.move(tets.points @ (turn + stretch).T)
    np.testing.assert_allclose(moved, above @ turn.T + (above - carry.arm) @ stretch.T, atol=1e-10)


@pytest.mark.slow
def test_a_load_on_what_stands_out_neither_grows_nor_diverges() -> None:
    vertices, faces = patch(121, 20.0)
    bumps = vertices.copy()
    bumps[:, 2] += np.cos(np.pi * vertices[:, 0] / 2) ** 8  # ridges 1 mm high, 2 mm apart
    work = []
    for surface in (vertices, bumps):
        area = surface_embedding.vertex_area(surface, faces)
        force = np.outer(area * tool.footprint(np.zeros(2), 4.0, surface, area), [0.0, 0.0, -1.0])
        for tets in (400, 3000):
            volume = tetrahedra.block(ANATOMY, tets, 2, ((0.0, 0.0, 4.0),))
            carry = surface_embedding.embed(volume, surface)
            u = carry.move(assemble(volume, "linear", 0.4).solve(carry.gather(force)))
            work.append(np.vdot(force, u))
    assert work == pytest.approx([work[1]] * 4, rel=0.1)


@pytest.mark.parametrize("order", [1, 2])
def test_embedding_reproduces_what_the_elements_can_hold(order: int) -> None:
    tets = tetrahedra.block(ANATOMY, 400, order)
    if order == 2:
        ends = tets.points[tets.cells[:, EDGES]]
        tets.points[tets.cells[:, 4:]] = ends.mean(axis=2)  # curved sides hold no quadratic field
    rng = np.random.default_rng(0)
    faces = rng.choice(tetrahedra.boundary(tets.cells, 1), size=300)
    on = np.einsum("vc,vcd->vd", rng.dirichlet(np.ones(3), 300), tets.points[faces])
    for power in range(1, order + 1):
        carried = surface_embedding.embed(tets, on).move(tets.points**power)
        assert np.abs(carried - on**power).max() <= 1e-9 * np.abs(on).max() ** power


@pytest.mark.parametrize("kind", ["pull", "push", "slide", "grasp", "retract", "tap"])
def test_rest_frame_is_at_rest_and_the_tool_comes_touches_and_leaves(kind: str) -> None:
    fem = schema.Fem(tets=400, gestures=(kind,), load=(0.1, 0.1))
    motion = run(fem, frames=25)
    assert not motion.displacement[0].any()
    assert not motion.force[0].any()
    surface = motion.rest + motion.displacement
    apart = np.linalg.norm(motion.tip[:, :, None] - surface[:, None], axis=3).min(axis=2)
    pressed = np.linalg.norm(motion.force, axis=1)
    assert (
        apart[pressed > 0.05 * pressed.max()].max() < 0.6
    )  # half a vertex spacing: they touch while they load
    assert apart[0].min() > 3
    assert apart[-1].min() > 3
    assert np.linalg.norm(motion.shaft, axis=2) == pytest.approx(1.0)
    total = np.einsum("v,tvd->td", motion.area, motion.traction)
    assert np.abs(total - motion.force).max() <= 1e-9 * pressed.max()
    # The loaded tissue is where the instrument is.
    t = int(pressed.argmax())
    load = np.linalg.norm(motion.traction[t], axis=1) * motion.area
    centre = (load[:, None] * surface[t]).sum(axis=0) / load.sum()
    assert np.linalg.norm(motion.tip[t].mean(axis=0) - centre) < 1.0


def test_a_slide_moves_its_load_and_a_tap_comes_twice() -> None:
    slide = run(schema.Fem(tets=400, gestures=("slide",), load=(0.1, 0.1)), frames=25)
    load = np.linalg.norm(slide.traction, axis=2) * slide.area
    on = np.flatnonzero(load.sum(axis=1) > 0)
    centre = (load[on] @ slide.rest) / load[on].sum(axis=1, keepdims=True)
    assert 2.5 < np.linalg.norm(centre[-1] - centre[0]) < 8.5
    tap = np.linalg.norm(run(schema.Fem(tets=400, gestures=("tap",)), frames=60).force, axis=1)
    peaks = (tap[1:-1] > tap[:-2]) & (tap[1:-1] >= tap[2:]) & (tap[1:-1] > 0.5 * tap.max())
    assert peaks.sum() >= 2


def test_a_grasp_holds_at_two_places() -> None:
    gesture = drawn(schema.Fem(gestures=("grasp",)), Tissue(1.0, 0.4, "neo-hookean"))
    first, second = (np.array(c.force_mn) for c in gesture.contacts)
    aside = np.array(gesture.contacts[1].point_mm) - gesture.contacts[0].point_mm
    assert np.linalg.norm(aside) == pytest.approx(gesture.spread_mm)
    assert first[:2] @ aside > second[:2] @ aside  # the tips press towards each other
    assert np.linalg.norm(first + second) == pytest.approx(gesture.force_mn)


def test_the_tissue_moves_where_and_whither_it_is_pulled() -> None:
    fem = schema.Fem(tets=1600, gestures=("pull",))
    motion = run(fem)
    peak = np.linalg.norm(motion.displacement, axis=2).max(axis=1).argmax()
    at = np.linalg.norm(motion.displacement[peak], axis=1).argmax()
    assert np.linalg.norm(motion.traction[peak, at]) > 0
    assert motion.displacement[peak, at] @ motion.force[peak] > 0
    assert motion.energy[peak] == pytest.approx(motion.energy.max())


def test_motion_depends_on_force_over_stiffness_alone() -> None:
    fem = schema.Fem(tets=400)
    soft, stiff = (Tissue(young_kpa=e, poisson=0.4, law="neo-hookean") for e in (1.0, 2.5))
    one, other = (
        deform(fem, tissue, drawn(fem, tissue), block(fem), *patch(), 6, 25.0) for tissue in (soft, stiff)
    )
    np.testing.assert_allclose(one.displacement, other.displacement, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(2.5 * one.traction, other.traction, rtol=1e-12, atol=1e-15)


def test_balance_of_forces_is_reached() -> None:
    motion = run(schema.Fem(law="corotational", load=(0.1, 0.1), tets=400))
    assert motion.residual.max() <= 2e-4
    assert motion.residual.max() > 0


def test_load_past_the_laws_range_is_refused_with_the_largest_valid_value() -> None:
    for law, largest in (("linear", "0.2"), ("auto", "0.4")):
        with pytest.raises(ValidationError, match=rf"largest valid value is {largest}"):
            schema.Fem(law=law, load=(3.0, 3.0))
    gesture = replace(drawn(schema.Fem(), Tissue(1.0, 0.4, "neo-hookean")), load=3.0)
    with pytest.raises(UserError, match=r"largest valid value is 0\.4"):
        run(schema.Fem(), gesture)


def test_auto_takes_the_cheapest_law_within_the_tolerance_and_says_why() -> None:
    rng = np.random.default_rng(0)
    assert Tissue.draw(schema.Fem(load=0.05), rng).law == "linear"
    assert Tissue.draw(schema.Fem(load=0.4), rng).law == "neo-hookean"
    assert Tissue.draw(schema.Fem(load=0.05, tolerance=0.001), rng).law == "neo-hookean"
    assert "5.0%" in Tissue.draw(schema.Fem(load=0.4), rng).why
    assert Tissue.draw(schema.Fem(law="stable", load=0.05), rng).law == "stable"


def test_inverted_element_names_frame_load_and_element(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(law_limits.LARGEST_LOAD, "corotational", 10.0)
    fem = schema.Fem(law="corotational", load=(8.0, 8.0), gestures=("push",))
    with pytest.raises(InvertedElement, match=r"frame \d+: load [\d.]+ turns element \d+ inside out"):
        run(fem)


def test_contact_beyond_the_surface_is_refused() -> None:
    fem = schema.Fem(tets=400)
    gesture = drawn(fem, Tissue(1.0, 0.4, "neo-hookean"))
    away = replace(gesture.contacts[0], point_mm=(200.0, 0.0))
    with pytest.raises(UserError):
        run(fem, replace(gesture, contacts=(away,)))


def test_footprint_is_the_kernel() -> None:
    vertices, faces = patch(201, 20.0)
    flat = vertices * [1, 1, 0]
    area = surface_embedding.vertex_area(flat, faces)
    kernel = tool.footprint(np.zeros(2), 4.0, flat, area)
    peak = 3 / (np.pi * 4.0**2)  # of (1 - (r/a)^2)^2 with unit integral
    assert kernel.max() == pytest.approx(peak, rel=1e-3)
    assert kernel @ area == pytest.approx(1.0, abs=1e-14)
