"""Limits of the renderer: every case yields a correct frame or a clear error, never a wrong label."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from synth.errors import UserError
from synth.job.schema import Job
from synth.render.scene import SceneState
from synth.sequence.rest_scene import RestScene, at_rest

Changes = dict[str, Any]


def lift_surface(scene: RestScene) -> Changes:
    """Arguments of a state: the surface pulled up by a Gaussian of 2 mm under an instrument."""
    centre = np.zeros(2)
    lift = 2.0 * np.exp(-((scene.surface.vertices[:, :2] - centre) ** 2).sum(axis=1) / 18.0)
    vertices = scene.surface.vertices + lift[:, None] * np.array([0.3, 0.15, 1.0])
    tip = vertices[np.linalg.norm(scene.surface.vertices[:, :2] - centre, axis=1).argmin()]
    tips = tip + np.array([[1.1, 0.0, 0.0], [-1.1, 0.0, 0.0]])
    shafts = np.array([[0.5, 0.5, 0.7], [0.5, 0.5, 0.7]]) / 0.995
    return {"vertices": vertices, "tips": tips, "shafts": shafts}


def fold(scene: RestScene) -> Changes:
    """A wall steeper than the line of sight: the surface folds over itself in the image."""
    wall = np.where(np.abs(scene.surface.vertices[:, 0]) < 2, 6.0, 0.0)
    return {"vertices": scene.surface.vertices + wall[:, None] * np.array([0.0, 0.0, 1.0])}


def degenerate(scene: RestScene) -> Changes:
    """Faces of zero area, and all vertices at one place of the texture."""
    scene.renderer.content.tissue.uv[:] = 0.5
    vertices = scene.surface.vertices.copy()
    vertices[5000:5400] = vertices[5000]
    return {"vertices": vertices}


def fill_view(scene: RestScene) -> Changes:
    """An instrument directly in front of the lens."""
    towards = scene.renderer.camera.centre / np.linalg.norm(scene.renderer.camera.centre)
    close = 240 * towards + np.array([[0.5, 0, 0], [-0.5, 0, 0]])
    return {"tips": close, "shafts": np.array([[1.0, 0, 0.05], [-1.0, 0, 0.05]])}


LARGE = "3840 x 2160, spp 1"  # takes a minute

CASES: dict[str, tuple[Changes, Callable[[RestScene], Changes] | None]] = {
    "steep fold": ({"render": {"tilt_deg": 20.0}}, fold),
    "tilt 60 deg, aperture 30 mm": ({"render": {"tilt_deg": 60.0, "aperture_mm": 30.0}}, None),
    "tilt 85 deg": ({"render": {"tilt_deg": 85.0}}, None),
    "tool fills the view": ({}, fill_view),
    "strong distortion": ({"render": {"distortion": (-8.0, 30.0, 0.02, -0.02, 0.0)}}, None),
    "folding distortion": ({"render": {"distortion": (-200.0, 0.0, 0.0, 0.0, 0.0)}}, None),
    LARGE: ({"render": {"size": (3840, 2160), "spp": 1}}, None),
    "over-exposed, all glare": ({"sensor": {"exposure": 30.0}, "light": {"glare": 1.0}}, None),
    "200k vertices": ({"anatomy": {"vertices": 200_000}}, None),
    "16 x 16, 400 vertices": ({"render": {"size": (16, 16)}, "anatomy": {"vertices": 400}}, None),
    "degenerate faces and maps": ({}, degenerate),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.trial] * (name == LARGE)) for name in CASES]
)
def test_a_hard_case_gives_true_labels_or_a_clear_error(name: str) -> None:
    """Flow agrees with OpenCV's projection of the same material points."""
    sections, change = CASES[name]
    render = {"size": (160, 120), **sections.get("render", {})}
    pull = {"instrument_list": [{"gesture": "pull"}]}
    try:
        scene = at_rest(Job.model_validate({**sections, "seed": 11, "render": render, "fem": pull}), 0)
        scene = replace(scene, surface=replace(scene.surface, uv=scene.surface.uv.copy()))  # is changed
        state = lift_surface(scene) | (change(scene) if change else {})
        shot = scene.renderer.render(SceneState(**state), seed=3)
    except UserError:
        return
    rest, lens = scene.renderer.rest, scene.renderer.camera
    for array in (shot.radiance, shot.flow, shot.depth, rest.area):
        assert np.isfinite(array).all()
    assert not (shot.visible & ~rest.tissue).any()
    assert not (shot.glare & shot.tool).any()
    faces = scene.renderer.content.tissue.faces[rest.face[rest.tissue]]
    points = np.einsum("nk,nkc->nc", rest.bary[rest.tissue], state["vertices"][faces])
    turn, _ = cv2.Rodrigues(lens.rotation)
    image_px, _ = cv2.projectPoints(points, turn, lens.translation, lens.K, lens.distortion)
    expected = image_px[:, 0] - np.argwhere(rest.tissue)[:, ::-1]
    assert np.abs(expected - shot.flow[rest.tissue]).max() < 1e-2
