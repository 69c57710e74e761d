"""What lies about the opening hides tissue, in truth as in pictures, and is no tissue and no instrument."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from synth.job.schema import AnatomySection, Job, RenderSection
from synth.render.anatomy import surface as anatomy
from synth.render.camera import camera
from synth.render.scene import Renderer, SceneState
from synth.sequence import scenario

TIPS = np.array([[-1.0, 1.0, 0.2], [1.2, 1.4, 0.2]])
SHAFTS = np.array([[0.6, 0.3, 0.74], [0.6, 0.3, 0.74]])


def made(parts: tuple[str, ...], tool: bool = False) -> tuple[Renderer, np.ndarray]:
    render = {"size": (96, 72), "variant": "scalar_rgb", "tool": tool, "scenery": parts}
    job = Job(anatomy=AnatomySection(vertices=2500), render=RenderSection.model_validate(render))
    surface = anatomy.grow(scenario.draw_relief(job.anatomy, np.random.default_rng(4)), job.anatomy)
    view = scenario.draw_view(job.render, np.random.default_rng(4))
    appearance = replace(scenario.draw_appearance(job, "healthy", np.random.default_rng(4)), scenery=parts)
    return Renderer(surface, appearance, camera.place(view, job.render), job), surface.vertices


@pytest.mark.slow
def test_pictures_and_truth_have_it_in_the_same_place() -> None:
    """Its pixels differ from those of a scene without it, and tissue that goes under it is not seen."""
    ours, vertices = made(("retractor", "cottonoid"))
    plain, _ = made(())
    one, other = (
        ours.render(SceneState(vertices, TIPS, SHAFTS), 3),
        plain.render(SceneState(vertices, TIPS, SHAFTS), 3),
    )
    changed = np.abs(one.radiance - other.radiance).max(axis=2) > 0.05
    hidden = plain.rest.tissue & ~ours.rest.tissue
    assert changed[hidden].mean() > 0.8
    assert not one.tool.any()
    assert not (one.glare & hidden).any()
    pixel = ours.rest.scale_mm_per_px
    # Aside and into the brain: scenery stays where it is, and tissue that rises would come through it.
    aside = vertices + ours.camera.rotation[0] * 6 * pixel - np.array([0, 0, 1.5])
    moved = ours.render(SceneState(aside, TIPS, SHAFTS), 4)
    rows, columns = np.nonzero(ours.rest.tissue)
    x = np.rint(columns + moved.flow[rows, columns, 0]).astype(int)
    y = np.rint(rows + moved.flow[rows, columns, 1]).astype(int)
    within = (x > 0) & (x < 95) & (y > 0) & (y < 71)
    under = np.zeros(len(rows), bool)
    # Well inside what hides: its outline moves with the camera's height over it.
    core = (
        hidden
        & np.roll(hidden, 1, 0)
        & np.roll(hidden, -1, 0)
        & np.roll(hidden, 1, 1)
        & np.roll(hidden, -1, 1)
    )
    under[within] = core[y[within], x[within]]
    assert under.sum() > 10
    assert moved.visible[rows, columns][under].mean() < 0.05
