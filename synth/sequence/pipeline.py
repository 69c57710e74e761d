"""One sequence from job to sealed store: where fem, render and flow meet, through plain arrays."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.dataset.store import Writer
from synth.fields import FIELDS
from synth.flow import mask, track
from synth.flow.stereo import rig
from synth.flow.stereo import track as stereo
from synth.flow.track import Track
from synth.job import identity
from synth.job.schema import Job
from synth.render.camera import video_link
from synth.sequence import mechanics, scenario
from synth.sequence.published_labels import Published
from synth.sequence.scenario import Scenario
from synth.sequence.scene import Scene, estimator, simulate
from synth.system.stopwatch import StageCallback, Stopwatch

# Fields that the renderer gives by frame, and of a second lens; those of `store.extra` are attributes of its
# `RenderedFrame` as well, but for the published method's.
_RENDERED = ("rgb", "flow", "visible", "tool", "glare", "depth")
_STEREO = ("rgb_right", "flow_right", "visible_right", "depth_right", "motion")
_PUBLISHED = ("flow_noisy", "intensity")


@dataclass(frozen=True)
class _Task:
    """A sequence that is being rendered: what all stages share."""

    scene: Scene
    writer: Writer
    watch: Stopwatch
    report: StageCallback

    @property
    def job(self) -> Job:
        return self.scene.job


@dataclass(frozen=True)
class _Film:
    """What the cameras recorded, before a codec."""

    rgb: NDArray[np.uint8]
    """(T, H, W, 3)."""
    rgb_right: NDArray[np.uint8] | None
    """The same of the second lens; None where the job keeps none."""
    tools: NDArray[np.bool_]
    """(T, H, W) pixels of the instruments."""
    tools_right: NDArray[np.bool_] | None
    """The same of the second lens."""
    poses: NDArray[np.float64]
    """(T, 4, 4) mm, world to camera axes."""


def render_sequence(job: Job, index: int, folder: Path, report: StageCallback) -> Path:
    """Computes sequence `index` and writes `folder/NNNNNN.zarr`.

    Args:
        job: the dataset's job, paths resolved.
        index: which sequence, 0 <= index < job.sequences.
        folder: the dataset; the store is `NNNNNN.zarr.part` until it is sealed.
        report: told of progress, stage by stage.

    Returns:
        The sealed store's path.

    Raises:
        UserError: the job cannot be carried out (surface, load, inverted element), in one line.
    """
    watch = Stopwatch()
    return write_scene(simulate(job, index, report, watch), folder, report, watch)


def write_scene(
    scene: Scene, folder: Path, report: StageCallback | None = None, watch: Stopwatch | None = None
) -> Path:
    """Renders a scene, recovers its flow and writes `folder/NNNNNN.zarr`; else as `render_sequence`."""
    job, report, watch = scene.job, report or (lambda stage, done, of: None), watch or Stopwatch()
    with watch.stage("scene"):
        studio = scene.renderer

    width, height = job.render.size
    writer = Writer(folder, scene.index, frames=job.frames, size=(height, width), job=job)
    writer.put("time", scene.motion.time)
    writer.put("force", scene.force)  # labels are in camera axes
    writer.put("tissue", scene.tissue)
    writer.put("area", scene.area)
    if studio.right is not None:
        writer.put("disparity", studio.disparity())

    task = _Task(scene, writer, watch, report)
    film = _render_frames(task)
    film = _write_video(task, film)
    if job.flow.backend != "ideal":
        recovered = _recover_flow(task, film)
        if writer.wants("motion_recovered"):
            _recover_motion(task, film, recovered)
    return _seal(task)


def _render_frames(task: _Task) -> _Film:
    """Renders every frame and writes its fields, but for video that a codec must see whole."""
    job, scene, writer = task.job, task.scene, task.writer
    width, height = job.render.size
    labels = None
    if set(_PUBLISHED) & set(job.store.extra):
        rng = scenario.label_rng(job, scene.index)
        labels = Published.begin(job.labels, scene.tissue, job.frames, rng)
    names = [
        name
        for name in dict.fromkeys((*_RENDERED, *(_STEREO if job.render.stereo_mm else ()), *job.store.extra))
        if FIELDS[name].framed and not (_coded(job) and name.startswith("rgb"))
    ]
    rgb = np.empty((job.frames, height, width, 3), np.uint8)
    rgb_right = np.empty_like(rgb) if writer.wants("rgb_right") else None
    tools = np.empty((job.frames, height, width), bool)
    tools_right = None if rgb_right is None else np.empty_like(tools)
    poses = np.tile(np.eye(4), (job.frames, 1, 1))
    for t in range(job.frames):
        task.report("render", t, job.frames)
        with task.watch.stage("render"):
            frame = scene.frame(t)
        with task.watch.stage("store"):
            made = labels.frame(t, frame.flow, frame.traction, scene.motion.force[t]) if labels else {}
            for name in names:
                writer.put_frame(name, t, made[name] if name in made else getattr(frame, name))
            writer.put_frame("traction", t, frame.traction)
            if job.render.exr:
                writer.put_exr(t, frame.radiance)
        rgb[t], tools[t] = frame.rgb, frame.tool
        if rgb_right is not None and frame.rgb_right is not None:
            rgb_right[t] = frame.rgb_right
        if tools_right is not None and frame.tool_right is not None:
            tools_right[t] = frame.tool_right
        poses[t, :3, :3], poses[t, :3, 3] = frame.camera.rotation, frame.camera.translation
    return _Film(rgb, rgb_right, tools, tools_right, poses)


def _write_video(task: _Task, film: _Film) -> _Film:
    """Writes the cameras' poses, and video through its codec if it has one; returns the film as kept."""
    job, writer, rgb, rgb_right = task.job, task.writer, film.rgb, film.rgb_right
    with task.watch.stage("store"):
        writer.put("camera", film.poses)
        if _coded(job):
            rgb = video_link.recorded(rgb, job.sensor, job.fps)
            writer.put("rgb", rgb)
            if rgb_right is not None:
                rgb_right = video_link.recorded(rgb_right, job.sensor, job.fps)
                writer.put("rgb_right", rgb_right)
    return replace(film, rgb=rgb, rgb_right=rgb_right)


def _coded(job: Job) -> bool:
    """Whether video goes through a codec, which sees all of it at once."""
    return job.sensor.bitrate_mbps is not None


def _recover_flow(task: _Task, film: _Film) -> Track:
    """Follows the video with the job's estimator and writes what it finds.

    It has what a real pipeline has: the tool's outline, and glare as the picture shows it.
    """
    job, writer = task.job, task.writer
    task.report("flow", 0, job.frames)
    with task.watch.stage("flow"):
        tissue = task.scene.tissue
        recovered = track.recover_flow(film.rgb, film.tools, tissue, estimator(job.flow))
    with task.watch.stage("store"):
        for t in range(job.frames):
            writer.put_frame("flow_recovered", t, recovered.flow[t])
            writer.put_frame("flow_confidence", t, recovered.confidence[t])
    return recovered


def _recover_motion(task: _Task, film: _Film, left: Track) -> None:
    """Adds the right eye to the left one's flow and writes motion in three dimensions, frame by frame."""
    job, writer, scene = task.job, task.writer, task.scene
    studio = scene.renderer
    if film.rgb_right is None or film.tools_right is None or studio.right is None:
        raise ValueError("there is no second lens")
    blocked = mask.hidden(film.rgb, film.tools), mask.hidden(film.rgb_right, film.tools_right)
    with task.watch.stage("stereo"):
        pair = rig.StereoRig(
            left=rig.Eye(scene.view.K, scene.view.distortion),
            right=rig.Eye(studio.right.K, studio.right.distortion),
            rotation=np.eye(3),
            translation=np.array([-job.render.stereo_mm, 0.0, 0.0]),
            size=job.render.size,
        )
        still = stereo.still_frames(left.flow, studio.rest.tissue)
        eyes = film.rgb[:still], film.rgb_right[:still]
        tracker = stereo.StereoTracker(pair, *eyes, blocked[0][0], blocked[1][0], studio.rest.tissue)
    for t in range(job.frames):
        task.report("stereo", t, job.frames)
        with task.watch.stage("stereo"):
            seen = left.flow[t], left.confidence[t]
            if t == 0:
                moved = stereo.Moved.nothing(scene.tissue.shape)
            else:
                eyes = film.rgb[t], film.rgb_right[t]
                moved = tracker.step(*eyes, blocked[0][t], blocked[1][t], *seen)
        with task.watch.stage("store"):
            writer.put_frame("motion_recovered", t, moved.motion)
            writer.put_frame("motion_deviation", t, moved.deviation)


def _seal(task: _Task) -> Path:
    """Seals the store with what was drawn and measured as its attributes; returns its path."""
    scene = task.scene
    case, view = scene.scenario, scene.view
    return task.writer.seal(
        scenario=case.as_dict(),
        anatomy_id=identity.identify_anatomy(task.job, case.relief.seed),
        **_opening(task.job, case),
        K=view.K.tolist(),
        distortion=view.distortion.tolist(),
        rotation=view.rotation.tolist(),
        translation=view.translation.tolist(),
        scale_mm_per_px=scene.scale_mm_per_px,
        young_kpa=case.tissue.young_kpa,
        poisson=case.tissue.poisson,
        mechanics=mechanics.describe(task.job, case, scene.motion, view.rotation),
        variant=scene.renderer.variant,
        timings=task.watch.report(),
        **_second_lens(task),
    )


def _opening(job: Job, case: Scenario) -> dict[str, Any]:
    """The attribute `opening_id` of a sequence on a user's brain."""
    named = identity.identify_opening(job, case.anatomy)
    return {} if named is None else {"opening_id": named}


def _second_lens(task: _Task) -> dict[str, Any]:
    """The attribute `right` of a stereo sequence: K, distortion and pose of the second lens at rest."""
    lens = task.scene.renderer.right
    if lens is None:
        return {}
    return {
        "right": {
            "baseline_mm": task.job.render.stereo_mm,
            "K": lens.K.tolist(),
            "distortion": lens.distortion.tolist(),
            "rotation": lens.rotation.tolist(),
            "translation": lens.translation.tolist(),
        }
    }
