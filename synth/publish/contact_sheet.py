"""A contact sheet of a job: some of its scenarios."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from synth.arrays import Floats
from synth.fem import tool_gesture
from synth.fem.tool_gesture import Gesture, ToolMotion
from synth.geometry.triangles import Shape
from synth.job.schema import Job
from synth.publish.picture import Rgb, caption, tile
from synth.render.anatomy.surface import CortexSurface
from synth.render.camera.camera import resize
from synth.render.idle import with_idle
from synth.render.scene import SceneState
from synth.sequence.rest_scene import RestScene, at_rest
from synth.sequence.simulation import simulate
from synth.system.terminal import ProgressCallback

TILE_PX = 320
_LEAST_VERTICES = 2000


def draw_sheet(job: Job, count: int, report: ProgressCallback) -> Rgb:
    """The picture (H, W, 3) of `count` scenarios spread over the job.

    Each is drawn just before its load, or those of `mechanics.source` under their largest. Wide pictures are
    drawn smaller, with fewer vertices. UserError: an impossible job.
    """
    indices = np.unique(np.linspace(0, job.sequences - 1, count).round().astype(int)).tolist()
    width, height = job.render.size
    share = min(1.0, TILE_PX / width)
    tile_size = (max(16, round(width * share)), max(16, round(height * share)))
    vertices = max(round(job.anatomy.vertices * share**2), min(job.anatomy.vertices, _LEAST_VERTICES))
    coarse_job = job.model_copy(update={"anatomy": job.anatomy.model_copy(update={"vertices": vertices})})
    tiles = []
    for position, index in enumerate(indices):
        report(position, len(indices))
        tiles.append(_draw_scenario(coarse_job, index, tile_size))
    return tile(tiles)


def _draw_scenario(job: Job, index: int, size: tuple[int, int]) -> Rgb:
    """A scenario's picture, (H, W, 3); for a stereo job those of the left and right camera side by side."""
    scene: RestScene
    if job.mechanics.source is not None:
        scene = deformed = simulate(job, index)
        state = replace(deformed.state(deformed.strongest), camera=None)
    else:
        scene = at_rest(job, index)
        poses = [pose_touching(gesture, scene.surface) for gesture in scene.scenario.gestures]
        stacks = (np.concatenate(part) for part in zip(*poses, strict=True))
        tips, shafts = with_idle(scene.scenario.idle, 0.0, *stacks)
        state = SceneState(scene.surface.vertices, tips, shafts)
    sensor, ratio = scene.scenario.appearance.sensor, size[0] / job.render.size[0]
    sensor = replace(sensor, blur=ratio * sensor.blur)  # which is in px of the whole picture
    case = replace(scene.scenario, appearance=replace(scene.scenario.appearance, sensor=sensor))
    scaled_draw = replace(scene.draw, camera=resize(scene.view, size), scenario=case)
    scene = replace(scene, draw=scaled_draw)
    frame = scene.renderer.render(state, scaled_draw.frame_seeds[0])
    picture = frame.rgb if frame.rgb_right is None else np.hstack([frame.rgb, frame.rgb_right])
    names = " + ".join(f"{tool} {kind}" for kind, tool, _ in scene.instruments if kind != "idle")
    return caption(picture, f"{index}  {scene.scenario.family}  {names}", size[1] - 8)


def pose_touching(gesture: Gesture, surface: CortexSurface) -> tuple[Floats, Floats]:
    """Tips (2, 3) mm on the surface where the gesture begins, and shafts (2, 3)."""
    touching = ToolMotion(np.zeros(1), np.zeros(1), np.zeros((1, 2)))
    shape = Shape(surface.vertices, surface.faces)
    tips, shafts = tool_gesture.pose(gesture, touching, shape, surface.vertices[None])
    return tips[0], shafts[0]
