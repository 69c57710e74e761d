"""Frames with an instrument in view and its exact mask, rendered to train and to test the tool mask.

Appearance, view, instruments and their poses are random; the tissue is at rest, without physics, which takes
a fifth of the time of a sequence's frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from synth.job.schema import Job
from synth.render.scene import SceneState
from synth.sequence import scenario
from synth.sequence.scene import at_rest

FRAMES = 6  # frames a scene; the last shows no instrument
_FAMILIES = ("healthy", "pale", "hyperaemic", "oedematous", "calf")
_GESTURES = ("pull", "push", "slide", "retract")  # together they use every instrument
_AWAY_MM = 300.0  # outside every view


@dataclass(frozen=True)
class Frame:
    """One image and its instrument mask."""

    scene: int
    rgb: NDArray[np.uint8]  # (H, W, 3) sRGB
    tool: NDArray[np.bool_]  # (H, W)


def frames(scenes: range, seed: int) -> Iterator[Frame]:
    """`FRAMES` frames of each scene; scenes differ in anatomy, appearance, view, instrument and poses."""
    job = Job.model_validate(
        {
            "seed": seed,
            "sequences": scenes.stop,
            "frames": FRAMES,
            "anatomy": {"vertices": 12000},
            "appearance": {"families": _FAMILIES},
            "light": {"glare": (0.0, 0.8)},
            "render": {"size": (320, 240), "field_mm": (22, 38), "spp": 4},
        }
    )
    for index in scenes:
        yield from _scene(job, index)


def _scene(job: Job, index: int) -> Iterator[Frame]:
    rng = np.random.default_rng([job.seed, index])
    hands = [str(kind) for kind in rng.choice(_GESTURES, size=1 + (rng.random() < 0.2))]
    scene = at_rest(job, index, hands)
    vertices = scene.surface.vertices
    for k, seed in enumerate(scenario.frame_seeds(job, index)):
        poses = [_pose(vertices, job.anatomy.craniotomy.radius_mm, rng) for _ in hands]
        tips, shafts = np.concatenate([p[0] for p in poses]), np.concatenate([p[1] for p in poses])
        if k == FRAMES - 1:
            tips = tips + np.array([0.0, 0.0, _AWAY_MM])
        shot = scene.renderer.render(SceneState(vertices, tips, shafts), seed)
        yield Frame(index, shot.rgb, shot.tool)


def _pose(
    vertices: NDArray[np.float64], radius_mm: float, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """An instrument's two tips (2, 3) mm over the opening, and directions of its shafts (2, 3)."""
    around, far = rng.uniform(0, 2 * np.pi), 0.95 * radius_mm * np.sqrt(rng.uniform())
    over = far * np.array([np.cos(around), np.sin(around)])
    near = vertices[np.argmin(np.linalg.norm(vertices[:, :2] - over, axis=1))]
    azimuth, rise = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(30, 70))
    shaft = np.array([np.cos(rise) * np.cos(azimuth), np.cos(rise) * np.sin(azimuth), np.sin(rise)])
    side = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    tip = near + max(0.0, rng.uniform(-6, 12)) * shaft  # in contact a third of the time
    spread = rng.uniform(0.3, 9.0)
    return tip + np.array([[0.5], [-0.5]]) * spread * side, np.stack([shaft, shaft])
