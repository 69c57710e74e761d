"""Limits of the renderer: every case must yield a correct frame or a clear error, never a wrong label."""

from collections.abc import Callable, Mapping
from typing import Any

import cv2
import numpy as np

from evidence import report
from evidence.render.case import Case, case
from evidence.study import Study
from synth.errors import UserError
from synth.job.schema import Job
from synth.render.scene import SceneState

Changes = dict[str, Any]


def measure(seed: int = 11) -> dict[str, Any]:
    """Steep folds, grazing views, extreme sizes: a correct frame or a clear error."""
    rows: list[dict[str, Any]] = []
    for name, (sections, change) in CASES.items():
        render = {"size": (160, 120), **sections.get("render", {})}
        try:
            ours = case(Job.model_validate({**sections, "seed": seed, "render": render}), 0)
            row = {"outcome": "frame", **checked(ours, change(ours) if change else {})}
        except UserError as error:
            row = {"outcome": "clear error", "error": str(error)}
        rows.append({"case": name, "passed": row.get("worst_px", 0.0) < 1e-2, **row})
    return {"seed": seed, "cases": rows}


def page(found: Mapping[str, Any]) -> report.Page:
    """A table of all cases."""
    rows = found["cases"]
    words = [f"**{sum(row['passed'] for row in rows)} of {len(rows)} cases passed.**"]
    return report.Page("Rendering: limits", found, (), [report.Section("", rows)], words)


def checked(ours: Case, changes: Changes) -> dict[str, Any]:
    """Error of a frame's flow against OpenCV's projection of the same material points, and visibility."""
    posed = {"vertices": ours.moved(2.0), "tips": ours.held(2.0), "shafts": ours.shafts} | changes
    rest, lens = ours.renderer.rest, ours.renderer.camera
    shot = ours.renderer.render(SceneState(posed["vertices"], posed["tips"], posed["shafts"]), seed=3)
    for array in (shot.radiance, shot.flow, shot.depth, rest.area):
        assert np.isfinite(array).all()
    assert not (shot.visible & ~rest.tissue).any()
    assert not (shot.glare & shot.tool).any()
    faces = ours.renderer.content.tissue.faces[rest.face[rest.tissue]]
    points = np.einsum("nk,nkc->nc", rest.bary[rest.tissue], posed["vertices"][faces])
    turn, _ = cv2.Rodrigues(lens.rotation)
    there, _ = cv2.projectPoints(points, turn, lens.translation, lens.K, lens.distortion)
    expected = there[:, 0] - np.argwhere(rest.tissue)[:, ::-1]
    return {
        "worst_px": float(np.abs(expected - shot.flow[rest.tissue]).max()),
        "tissue": float(rest.tissue.mean()),
        "visible": float(shot.visible[rest.tissue].mean()),
    }


def _steep(ours: Case) -> Changes:
    """A wall steeper than the line of sight: the surface folds over itself in the image."""
    wall = np.where(np.abs(ours.vertices[:, 0]) < 2, 6.0, 0.0)
    return {"vertices": ours.vertices + wall[:, None] * np.array([0.0, 0.0, 1.0])}


def _degenerate(ours: Case) -> Changes:
    """Faces of zero area, and all vertices at one place of the texture."""
    ours.renderer.content.tissue.uv[:] = 0.5
    vertices = ours.vertices.copy()
    vertices[5000:5400] = vertices[5000]
    return {"vertices": vertices}


def _filled_view(ours: Case) -> Changes:
    """An instrument directly in front of the lens."""
    towards = ours.renderer.camera.centre / np.linalg.norm(ours.renderer.camera.centre)
    close = 240 * towards + np.array([[0.5, 0, 0], [-0.5, 0, 0]])
    return {"tips": close, "shafts": np.array([[1.0, 0, 0.05], [-1.0, 0, 0.05]])}


CASES: dict[str, tuple[Changes, Callable[[Case], Changes] | None]] = {
    "steep fold": ({"render": {"tilt_deg": 20.0}}, _steep),
    "tilt 60 deg, aperture 30 mm": ({"render": {"tilt_deg": 60.0, "aperture_mm": 30.0}}, None),
    "tilt 85 deg": ({"render": {"tilt_deg": 85.0}}, None),
    "tool fills the view": ({}, _filled_view),
    "strong distortion": ({"render": {"distortion": (-8.0, 30.0, 0.02, -0.02, 0.0)}}, None),
    "folding distortion": ({"render": {"distortion": (-200.0, 0.0, 0.0, 0.0, 0.0)}}, None),
    "3840 x 2160, spp 1": ({"render": {"size": (3840, 2160), "spp": 1}}, None),
    "over-exposed, all glare": ({"sensor": {"exposure": 30.0}, "light": {"glare": 1.0}}, None),
    "200k vertices": ({"anatomy": {"vertices": 200_000}}, None),
    "16 x 16, 400 vertices": ({"render": {"size": (16, 16)}, "anatomy": {"vertices": 400}}, None),
    "degenerate faces and maps": ({}, _degenerate),
}


STUDY = Study(
    measure, "render/stability/stability.json", page, needs=("mesh", "mechanics", "picture", "truth")
)
