"""A sequence for measurements of the renderer alone: its renderer and a plain pull, without the physics."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from synth.arrays import Floats
from synth.job.schema import Job
from synth.render.scene import Renderer, SceneState
from synth.sequence.rest_scene import at_rest
from synth.tune.search import change_job


@dataclass(frozen=True)
class Case:
    """A renderer and the motion of its surface and instrument."""

    renderer: Renderer
    vertices: Floats  # (V, 3) mm at rest
    tips: Floats  # (2, 3) mm
    shafts: Floats  # (2, 3)
    centre: Floats  # (2,) mm: where the tissue is held

    def move_surface(self, lift_mm: float) -> Floats:
        """The surface pulled up by a Gaussian of 3 mm width, and laterally by a third of that."""
        r2 = ((self.vertices[:, :2] - self.centre) ** 2).sum(axis=1)
        pull = lift_mm * np.exp(-r2 / 18.0)
        return np.asarray(self.vertices + pull[:, None] * np.array([0.3, 0.15, 1.0]))

    def move_tips(self, lift_mm: float) -> Floats:
        """The tips, which move with the tissue."""
        return self.tips + lift_mm * np.array([0.3, 0.15, 1.0])

    def state(self, lift_mm: float = 0.0) -> SceneState:
        """Surface and instrument, pulled up by `lift_mm`."""
        return SceneState(self.move_surface(lift_mm), self.move_tips(lift_mm), self.shafts)


def case(job: Job, index: int) -> Case:
    """Sequence `index` of a job with a plain pull as its load."""
    scene = at_rest(change_job(job, {"fem.instrument_list": [{"gesture": "pull"}]}), index)
    surface = replace(scene.surface, uv=scene.surface.uv.copy())  # `stability` modifies it
    scene = replace(scene, surface=surface)
    rng = np.random.default_rng([job.seed, index])
    centre = rng.uniform(-4, 4, 2)
    azimuth, lift = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(35, 55))
    shaft = np.array([np.cos(azimuth) * np.cos(lift), np.sin(azimuth) * np.cos(lift), np.sin(lift)])
    side = 1.1 * np.array([-np.sin(azimuth), np.cos(azimuth)])
    flat = np.stack([centre + side, centre - side])
    height = surface.vertices[cKDTree(surface.vertices[:, :2]).query(flat)[1], 2]
    tips = np.concatenate([flat, height[:, None]], axis=1)
    return Case(scene.renderer, surface.vertices, tips, np.stack([shaft, shaft]), centre)
