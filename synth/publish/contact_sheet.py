"""A contact sheet of a job: some of its scenarios, and a forecast of its cost."""

from __future__ import annotations

import itertools
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from synth.arrays import Floats
from synth.dataset.store import open_sequence
from synth.fem import tool_gesture
from synth.fem.tool_gesture import Gesture, ToolMotion
from synth.geometry.triangles import Shape
from synth.job.schema import Job
from synth.publish.picture import Rgb, caption, tile
from synth.render.anatomy.surface import CortexSurface
from synth.render.scene import SceneState
from synth.sequence import pipeline, scenario
from synth.sequence.scene import at_rest
from synth.system.terminal import ProgressCallback

_TILE_PX = 320
_PROBES = 3  # sequences that are computed with few frames, after one for the compilation
_SHORT, _LONG = 3, 9  # frames: their difference is the cost of further frames


def draw_sheet(job: Job, count: int, report: ProgressCallback) -> tuple[Rgb, dict[str, float]]:
    """The picture (H, W, 3) of `count` scenarios spread over the job, and the job's CPU time by stage [s].

    Each is drawn just before its load: nothing is deformed, the sheet shows anatomy, appearance, light, view
    and instrument. The cost is measured on a few sequences with few frames. UserError: an impossible job.
    """
    chosen = np.unique(np.linspace(0, job.sequences - 1, count).round().astype(int))
    width, height = job.render.size
    scale = min(1.0, _TILE_PX / width)
    small = (max(16, round(width * scale)), max(16, round(height * scale)))
    quick = job.model_copy(
        update={
            "render": job.render.model_copy(update={"size": small}),
            "anatomy": job.anatomy.model_copy(update={"vertices": min(job.anatomy.vertices, 20_000)}),
        }
    )
    parts = itertools.count(1)

    def step() -> None:
        report(next(parts), len(chosen) + _PROBES + 1)

    tiles = []
    for index in chosen.tolist():
        tiles.append(_draw_scenario(quick, index))
        step()
    return tile(tiles), _measure_cost(job, step)


def _draw_scenario(job: Job, index: int) -> Rgb:
    """A scenario's picture, (H, W, 3); for a stereo job those of the left and right camera side by side."""
    scene = at_rest(job, index)
    gestures = scene.scenario.gestures
    ready = [poised(gesture, scene.surface) for gesture in gestures]
    tips, shafts = (np.concatenate(part) for part in zip(*ready, strict=True))
    state = SceneState(scene.surface.vertices, tips, shafts)
    frame = scene.renderer.render(state, scenario.frame_seeds(job, index)[0])
    picture = frame.rgb if frame.rgb_right is None else np.hstack([frame.rgb, frame.rgb_right])
    label = f"{index}  {scene.scenario.family}  {' + '.join(one.kind for one in gestures)}"
    return caption(picture, label, job.render.size[1] - 8)


def poised(gesture: Gesture, surface: CortexSurface) -> tuple[Floats, Floats]:
    """Tips (2, 3) mm on the surface where the gesture begins, and shafts (2, 3)."""
    touching = ToolMotion(np.zeros(1), np.zeros(1), np.zeros((1, 2)))
    shape = Shape(surface.vertices, surface.faces)
    tips, shafts = tool_gesture.pose(gesture, touching, shape, surface.vertices[None])
    return tips[0], shafts[0]


def _measure_cost(job: Job, step: Callable[[], None]) -> dict[str, float]:
    """Processor time [s] of the whole job by stage, without the start of workers.

    The gesture is the same for any number of frames, so frames of a short sequence cost as much, except for
    the larger load steps. `step` is called after each part.
    """
    chosen = np.unique(np.linspace(0, job.sequences - 1, _PROBES).round().astype(int)).tolist()
    total: dict[str, float] = {}
    more = max(job.frames - _LONG, 0) / (_LONG - _SHORT)
    with tempfile.TemporaryDirectory() as folder:
        _stages(job, chosen[0], 2, folder)
        step()
        for index in chosen:
            long = _stages(job, index, min(job.frames, _LONG), folder)
            short = _stages(job, index, _SHORT, folder) if more else long
            for name, spent in long.items():
                each = spent + max(more * (spent - short[name]), 0.0)
                total[name] = total.get(name, 0.0) + job.sequences / len(chosen) * each
            step()
    return total


def _stages(job: Job, index: int, frames: int, folder: str) -> dict[str, float]:
    """Processor time [s] of a sequence with that number of frames, by stage."""
    short = job.model_copy(update={"frames": frames})
    path = pipeline.render_sequence(short, index, Path(folder), lambda stage, done, of: None)
    spent_s = open_sequence(path).stages_cpu_s
    shutil.rmtree(path)
    return spent_s
