"""A contact sheet of a job: some of its scenarios, and a forecast of its cost."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from synth.arrays import Floats
from synth.errors import UserError
from synth.fem import tool_gesture
from synth.fem.tool_gesture import Gesture, ToolMotion
from synth.geometry.triangles import Shape
from synth.job.schema import Job
from synth.publish.picture import Rgb, caption, tile
from synth.render.anatomy.surface import CortexSurface
from synth.render.camera.camera import resized
from synth.render.scene import SceneState
from synth.sequence import pipeline, scenario
from synth.sequence.scene import RestScene, Scene, at_rest
from synth.sequence.simulation import refuse_untouched, simulate
from synth.system.stopwatch import Stopwatch
from synth.system.terminal import ProgressCallback

TILE_PX = 320
_LEAST_VERTICES = 2000
_SHORT, _LONG = 3, 9  # frames: their difference is the cost of further load steps
_PER_SEQUENCE = "mesh", "scene"  # stages whose cost is the same for any number of frames
_IN_PICTURE = "scene", "render", "store", "flow", "stereo"  # stages whose cost grows with the picture
_GROWTH = 0.92  # power of the number of pixels; measured from 320 x 240 to 640 x 480


def draw_sheet(job: Job, count: int, report: ProgressCallback) -> tuple[Rgb, dict[str, float]]:
    """The picture (H, W, 3) of `count` scenarios spread over the job, and the job's CPU time by stage [s].

    Each is drawn just before its load, or those of `mechanics.source` under their largest. Wide pictures are
    drawn smaller, with fewer vertices; the cost is estimated from some frames of one sequence in that size.
    UserError: an impossible job.
    """
    chosen = np.unique(np.linspace(0, job.sequences - 1, count).round().astype(int)).tolist()
    width, height = job.render.size
    share = min(1.0, TILE_PX / width)
    small = (max(16, round(width * share)), max(16, round(height * share)))
    vertices = max(round(job.anatomy.vertices * share**2), min(job.anatomy.vertices, _LEAST_VERTICES))
    quick = job.model_copy(update={"anatomy": job.anatomy.model_copy(update={"vertices": vertices})})
    spent = _measure_cost(quick, chosen[len(chosen) // 2], small)  # first, as further scenes of it are cached
    tiles = []
    for done, index in enumerate(chosen):
        report(done + 1, len(chosen) + 1)
        tiles.append(_draw_scenario(quick, index, small))
    return tile(tiles), {name: job.sequences * each for name, each in spent.items()}


def _draw_scenario(job: Job, index: int, size: tuple[int, int]) -> Rgb:
    """A scenario's picture, (H, W, 3); for a stereo job those of the left and right camera side by side."""
    scene: RestScene
    if job.mechanics.source is not None:
        scene = deformed = simulate(job, index)
        state = replace(deformed.state(deformed.strongest), camera=None)
    else:
        scene = at_rest(job, index)
        ready = [poised(gesture, scene.surface) for gesture in scene.scenario.gestures]
        tips, shafts = (np.concatenate(part) for part in zip(*ready, strict=True))
        state = SceneState(scene.surface.vertices, tips, shafts)
    scene = replace(scene, view=resized(scene.view, size))
    frame = scene.renderer.render(state, scenario.frame_seeds(job, index)[0])
    picture = frame.rgb if frame.rgb_right is None else np.hstack([frame.rgb, frame.rgb_right])
    acting = " + ".join(f"{tool} {kind}" for kind, tool, _ in scene.instruments)
    return caption(picture, f"{index}  {scene.scenario.family}  {acting}", size[1] - 8)


def poised(gesture: Gesture, surface: CortexSurface) -> tuple[Floats, Floats]:
    """Tips (2, 3) mm on the surface where the gesture begins, and shafts (2, 3)."""
    touching = ToolMotion(np.zeros(1), np.zeros(1), np.zeros((1, 2)))
    shape = Shape(surface.vertices, surface.faces)
    tips, shafts = tool_gesture.pose(gesture, touching, shape, surface.vertices[None])
    return tips[0], shafts[0]


def _measure_cost(job: Job, index: int, size: tuple[int, int]) -> dict[str, float]:
    """Processor time [s] of sequence `index` by stage, from a few frames in pictures of `size`."""
    longer, watch = Stopwatch(), Stopwatch()
    first: dict[str, float] = {}  # spent on a stage before the first frame after rest

    def report(stage: str, done: int, of: int) -> None:
        if done == 1:
            first[stage] = watch.cpu_s(stage)
            first.setdefault("store", watch.cpu_s("store"))

    _simulate(job, index, _LONG, longer)
    scene = _simulate(job, index, _SHORT, watch)
    with tempfile.TemporaryDirectory() as folder:
        for part in (4, 1):  # the first one compiles
            less = max(16, size[0] // part), max(16, size[1] // part)
            small = scene.job.model_copy(update={"render": job.render.model_copy(update={"size": less})})
            drawn = replace(scene, job=small, view=resized(scene.view, less))
            timed = (report, watch) if part == 1 else ()
            shutil.rmtree(pipeline.write_scene(drawn, Path(folder), *timed))
    growth = (job.render.size[0] * job.render.size[1] / (size[0] * size[1])) ** _GROWTH
    found = {}
    for name in ("mesh", "fem", *_IN_PICTURE):
        spent = (longer if name == "mesh" else watch).cpu_s(name)
        each = (spent - first.get(name, 0.0)) / (_SHORT - 1)
        if name == "fem":
            each = max(longer.cpu_s(name) - spent, 0.0) / (_LONG - _SHORT)
        further = 0.0 if name in _PER_SEQUENCE else (job.frames - _SHORT) * each
        found[name] = (spent + further) * (growth if name in _IN_PICTURE else 1.0)
    return {name: each for name, each in found.items() if each > 0}


def _simulate(job: Job, index: int, count: int, watch: Stopwatch) -> Scene:
    """`count` of the sequence's frames: rest, largest load, last, and others between. May raise UserError."""
    if job.mechanics.source is not None:
        return simulate(job.model_copy(update={"frames": min(count, job.frames)}), index, watch=watch)
    case = scenario.draw_scenario(job, index)
    refuse_untouched(job, case)
    moves = [tool_gesture.trajectory(gesture, job.frames) for gesture in case.gestures]
    strongest = int(np.argmax(np.max([move.load for move in moves], axis=0)))
    further = np.linspace(0, job.frames - 1, count - 1).round().astype(int)
    in_time = job.fem.time == "dynamic" or job.fem.relaxation  # then frames can't be left out
    frames = np.arange(min(count, job.frames)) if in_time else np.unique([*further, strongest])
    motions = [ToolMotion(move.load[frames], move.away[frames], move.shift[frames]) for move in moves]
    short = job.model_copy(update={"frames": len(frames)})
    try:
        return simulate(short, index, watch=watch, case=case, motions=motions)
    except UserError as error:
        raise UserError(f"sequence {index}, of which frames {frames.tolist()} were tried: {error}") from None
