"""A gesture's motion, loads and labels on the fine surface; what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from dome import OPENING_MM, block, patch
from pydantic import ValidationError

from synth.errors import UserError
from synth.fem import law_choice, surface_embedding
from synth.fem.deformation import Deformation
from synth.fem.equilibrium import InvertedElement
from synth.fem.material import Tissue
from synth.fem.mesh import tetrahedra
from synth.fem.mesh.refine import EDGES
from synth.fem.solver import deform
from synth.fem.tool_gesture import Gesture
from synth.job import schema
from synth.sequence import scenario
from synth.sequence.draw import read_scheme


def draw_gesture(fem: schema.FemSection, tissue: Tissue) -> Gesture:
    return scenario.draw_gesture(fem, OPENING_MM, tissue.young_kpa, np.random.default_rng(5))


def run(fem: schema.FemSection, gesture: Gesture | None = None, frames: int = 12) -> Deformation:
    tissue = scenario.draw_tissue(fem, np.random.default_rng(5))
    return deform(
        read_scheme(fem), tissue, [gesture or draw_gesture(fem, tissue)], block(fem), patch(), frames, 25.0
    )


def test_transfer_keeps_force_and_moment() -> None:
    tets = tetrahedra.block(400)
    vertices, _ = patch()
    vertices = vertices + np.random.default_rng(0).uniform(-0.7, 0.7, vertices.shape)  # off the surface
    embedding = surface_embedding.embed(tets, vertices)
    load = np.random.default_rng(1).normal(size=(len(vertices), 3))
    volume = embedding.gather(load)
    assert np.abs(embedding.value.sum(axis=1) - 1).max() <= 1e-12
    assert np.abs(volume.sum(axis=0) - load.sum(axis=0)).max() <= 1e-12 * np.abs(load).sum()
    moment = np.cross(vertices, load).sum(axis=0)
    assert np.abs(np.cross(tets.points, volume).sum(axis=0) - moment).max() <= 1e-9 * np.abs(moment).max()


def test_embedding_reproduces_what_the_elements_can_hold() -> None:
    tets = tetrahedra.block(400)
    ends = tets.points[tets.cells[:, EDGES]]
    tets.points[tets.cells[:, 4:]] = ends.mean(axis=2)  # curved sides hold no quadratic field
    rng = np.random.default_rng(0)
    faces = rng.choice(tetrahedra.boundary(tets.cells[:, :4]), size=300)
    points = np.einsum("vc,vcd->vd", rng.dirichlet(np.ones(3), 300), tets.points[faces])
    for power in (1, 2):
        values = surface_embedding.embed(tets, points).move(tets.points**power)
        assert np.abs(values - points**power).max() <= 1e-9 * np.abs(points).max() ** power


@pytest.mark.parametrize("kind", ["pull", "slide", "tap"])
def test_rest_frame_is_at_rest_and_the_tool_comes_touches_and_leaves(kind: str) -> None:
    fem = schema.FemSection(tets=400, gestures=(kind,), load=(0.1, 0.1))
    motion = run(fem, frames=25)
    assert not motion.displacement[0].any()
    assert not motion.force[0].any()
    area, surface = surface_embedding.vertex_area(*patch()), patch().vertices + motion.displacement
    distance = np.linalg.norm(motion.tip[:, :, None] - surface[:, None], axis=3).min(axis=2)
    force = np.linalg.norm(motion.force, axis=1)
    assert distance[force > 0.05 * force.max()].max() < 0.6  # half a vertex spacing: they touch
    assert distance[[0, -1]].min() > 3
    assert np.linalg.norm(motion.shaft, axis=2) == pytest.approx(1.0)
    total = np.einsum("v,tvd->td", area, motion.traction)
    assert np.abs(total - motion.force).max() <= 1e-9 * force.max()
    assert np.max(motion.residual) <= 2e-4
    # The loaded tissue is where the instrument is, and moves its way.
    t = int(force.argmax())
    assert np.einsum("v,vd,vd->", area, motion.traction[t], motion.displacement[t]) > 0
    load = np.linalg.norm(motion.traction[t], axis=1) * area
    centre = (load[:, None] * surface[t]).sum(axis=0) / load.sum()
    assert np.linalg.norm(motion.tip[t].mean(axis=0) - centre) < 1.0


def test_motion_depends_on_force_over_stiffness_alone() -> None:
    fem = schema.FemSection(tets=400)
    tissues = [Tissue(young, 0.4, "neo-hookean") for young in (1.0, 2.5)]
    soft_motion, stiff_motion = (
        deform(read_scheme(fem), t, [draw_gesture(fem, t)], block(fem), patch(), 6, 25.0) for t in tissues
    )
    np.testing.assert_allclose(soft_motion.displacement, stiff_motion.displacement, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(2.5 * soft_motion.traction, stiff_motion.traction, rtol=1e-12, atol=1e-15)


def test_auto_takes_the_cheapest_law_within_the_tolerance() -> None:
    assert [schema.FemSection(load=load).chosen_law[0] for load in (0.05, 0.4)] == ["linear", "neo-hookean"]


def test_what_no_law_or_surface_holds_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    fem = schema.FemSection(tets=400)
    gesture = draw_gesture(fem, Tissue(1.0, 0.4, "neo-hookean"))
    with pytest.raises(ValidationError, match="linear"):
        schema.FemSection(law="linear", load=(3.0, 3.0))
    with pytest.raises(ValidationError, match=r"young_kpa\n.*Pa"):
        schema.FemSection(young_kpa=3000)
    with pytest.raises(UserError):
        run(fem, replace(gesture, load=3.0))
    far_contact = replace(gesture.contacts[0], point_mm=(200.0, 0.0))
    with pytest.raises(UserError):
        run(fem, replace(gesture, contacts=(far_contact,)))
    monkeypatch.setitem(law_choice.LARGEST_LOAD, "corotational", 10.0)
    with pytest.raises(InvertedElement):
        run(schema.FemSection(law="corotational", load=(8.0, 8.0), gestures=("push",), tets=400))
