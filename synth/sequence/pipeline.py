"""One sequence from job to sealed store: connects fem, render and flow through plain arrays."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from synth.arguments import checked
from synth.arrays import Mask, Pixels
from synth.dataset.dataset_folder import Folder
from synth.dataset.store import Writer
from synth.errors import UserError
from synth.fem.law_choice import LAWS
from synth.fields import FIELDS, MOST_INSTRUMENTS
from synth.flow import track
from synth.flow.estimator import create
from synth.flow.segmentation import with_highlights
from synth.flow.stereo import rig
from synth.flow.stereo import stereo_track as stereo
from synth.flow.track import Track
from synth.job import identity
from synth.job.schema import Job
from synth.render.camera.camera import Camera, between
from synth.render.camera.camera_sensor import MOST_BLANK, blank_share
from synth.render.camera.video_link import transmit
from synth.sequence.published_labels import Published
from synth.sequence.rest_scene import Scene
from synth.sequence.simulation import simulate
from synth.system.stopwatch import StageCallback, Stopwatch

# Fields of a `RenderedFrame`, for one camera and for two; so are those of `store.extra` but `_PUBLISHED`.
_RENDERED = ("rgb", "flow", "visible", "tool", "glare", "depth")
_STEREO = ("rgb_right", "flow_right", "visible_right", "depth_right", "motion")
_PUBLISHED = ("flow_noisy", "intensity")
_CAMERAS = (("rgb", "tool"), ("rgb_right", "tool_right"))  # picture and instruments of each


@dataclass(frozen=True)
class _Task:
    """A sequence in rendering, as shared by all stages."""

    scene: Scene
    writer: Writer
    watch: Stopwatch
    report: StageCallback


class _Video(NamedTuple):
    """Video of one camera."""

    rgb: Pixels  # (T, H, W, 3)
    tools: Mask  # (T, H, W) pixels of the instruments


def render_sequence(job: Job, index: int, folder: Path, report: StageCallback) -> Path:
    """Computes sequence `index` and writes `folder/NNNNNN.zarr`, `.part` until sealed; returns its path.

    `report` is called with progress, stage by stage. UserError: the job cannot be carried out (surface, load,
    inverted element).
    """
    watch = Stopwatch()
    return write_scene(simulate(job, index, report, watch), folder, report, watch)


@checked
def write_scene(
    scene: Scene, folder: str | Path, report: StageCallback | None = None, watch: Stopwatch | None = None
) -> Path:
    """Renders a scene, recovers its flow and writes `folder/NNNNNN.zarr`; else as `render_sequence`."""
    job, report, watch = scene.job, report or (lambda stage, done, of: None), watch or Stopwatch()
    with watch.stage("scene"):
        renderer = scene.renderer
    _refuse_unseen(scene)
    width, height = job.render.size
    writer = Writer(Path(folder), scene.index, frames=job.frames, size=(height, width), job=scene.dataset)
    Folder(Path(folder)).refuse_replaced(scene.dataset, writer.job_identity)
    writer.put("time", scene.time)
    writer.put("force", scene.force)  # labels are in camera axes
    if writer.wants("force_of"):
        each = scene.motion.by_instrument @ scene.view.rotation.T
        writer.put("force_of", np.pad(each, ((0, 0), (0, max(MOST_INSTRUMENTS - each.shape[1], 0)), (0, 0))))
    writer.put("tissue", scene.tissue)
    writer.put("area", scene.area)
    if renderer.right is not None:
        writer.put("disparity", renderer.disparity())
    task = _Task(scene, writer, watch, report)
    videos = _render_frames(task)
    if job.sensor.bitrate_mbps is not None:  # a codec needs all frames at once
        videos = _encode(task, videos)
    if job.flow.backend != "ideal":
        with watch.stage("flow"):
            blocked = with_highlights(*videos[0])
        recovered = _recover_flow(task, videos[0].rgb, blocked)
        if writer.wants("motion_recovered"):
            _recover_motion(task, videos[0].rgb, blocked, videos[1], recovered)
    return _seal(task)


def _refuse_unseen(scene: Scene) -> None:
    """Raises UserError if most of the largest force is outside the view, so that it has no label."""
    t = scene.strongest
    label = scene.renderer.traction(scene.motion.traction[t]) * scene.area[..., None]
    size = float(np.linalg.norm(scene.force[t]))
    if np.linalg.norm(label.sum(axis=(0, 1), dtype=np.float64) - scene.force[t]) > 0.5 * size:
        raise UserError(
            f"frame {t}: most of the force of {size:.3g} mN is on tissue that the camera does not show; "
            "change the contact's place, or widen render.field_mm"
        )


def _render_frames(task: _Task) -> list[_Video]:
    """Renders every frame and writes its fields, except videos that a codec follows; a video per camera."""
    scene, writer, job = task.scene, task.writer, task.scene.job
    width, height = job.render.size
    labels = None
    if set(_PUBLISHED) & set(job.store.extra):
        rng = np.random.default_rng(scene.draw.label_seed)
        labels = Published(job.labels, scene.tissue, job.frames, rng)
    every = dict.fromkeys((*_RENDERED, *(_STEREO if job.render.stereo_mm else ()), *job.store.extra))
    later = () if job.sensor.bitrate_mbps is None else ("rgb", "rgb_right")
    names = [name for name in every if FIELDS[name].framed and name not in later]
    shape = (job.frames, height, width)
    cameras = _CAMERAS if writer.wants("rgb_right") else _CAMERAS[:1]
    videos = [_Video(np.empty((*shape, 3), np.uint8), np.empty(shape, bool)) for _ in cameras]
    poses = np.empty((job.frames, 4, 4))
    for t in range(job.frames):
        task.report("render", t, job.frames)
        with task.watch.stage("render"):
            frame = scene.frame(t)
        if t == 0:
            free = scene.tissue & ~frame.tool
            if blank_share(frame.rgb[free] if free.any() else frame.rgb) > MOST_BLANK:
                raise UserError("frame 0: its tissue is black or burnt out; change sensor.exposure or light")
        elif not frame.visible[scene.tissue].any():
            raise UserError(f"frame {t}: none of the tissue is visible any more; widen render.field_mm")
        with task.watch.stage("store"):
            made = labels.frame(t, frame.flow, frame.traction, scene.motion.force[t]) if labels else {}
            for name in names:
                writer.put_frame(name, t, made[name] if name in made else getattr(frame, name))
            writer.put_frame("traction", t, frame.traction)
        for video, (rgb, tool) in zip(videos, cameras, strict=True):
            video.rgb[t], video.tools[t] = getattr(frame, rgb), getattr(frame, tool)
        poses[t] = frame.camera.pose
    with task.watch.stage("store"):
        writer.put("camera", poses)
    return videos


def _encode(task: _Task, videos: list[_Video]) -> list[_Video]:
    """Writes and returns the videos after the job's codec."""
    job = task.scene.job
    with task.watch.stage("store"):
        link = job.fps, job.sensor.bitrate_mbps, job.sensor.chroma
        coded = [_Video(transmit(rgb, *link), tools) for rgb, tools in videos]
        for video, (name, _) in zip(coded, _CAMERAS, strict=False):
            task.writer.put(name, video.rgb)
    return coded


def _recover_flow(task: _Task, rgb: Pixels, blocked: Mask) -> Track:
    """Recovers flow with the job's estimator and writes it.

    As in a real pipeline, its inputs are pictures (T, H, W, 3) and masks (T, H, W) of instruments; glare is
    detected in the pictures.
    """
    job, writer = task.scene.job, task.writer
    task.report("flow", 0, job.frames)
    with task.watch.stage("flow"):
        recovered = track.track(create(job.flow.backend), rgb, blocked, task.scene.tissue)
    with task.watch.stage("store"):
        writer.put("flow_recovered", recovered.flow)
        writer.put("flow_confidence", recovered.confidence)
    return recovered


def _recover_motion(task: _Task, left: Pixels, left_blocked: Mask, right: _Video, flow: Track) -> None:
    """Recovers motion in three dimensions from the left camera's flow and both videos, and writes it."""
    scene, writer, job = task.scene, task.writer, task.scene.job
    lens = scene.renderer.right
    assert lens is not None
    with task.watch.stage("stereo"):
        blocked = left_blocked, with_highlights(*right)
        pair = rig.StereoRig(
            rig.Intrinsics(scene.view.K, scene.view.distortion),
            rig.Intrinsics(lens.K, lens.distortion),
            *between(scene.view, lens),
            size=job.render.size,
        )
        still = stereo.still_frames(flow.flow, scene.tissue)
        rest = left[:still], right.rgb[:still]
        tracker = stereo.StereoTracker(pair, *rest, blocked[0][0], blocked[1][0], scene.tissue)
    for t in range(job.frames):
        task.report("stereo", t, job.frames)
        with task.watch.stage("stereo"):
            if t == 0:
                moved = stereo.Moved.nothing(scene.tissue.shape)
            else:
                now = left[t], right.rgb[t], blocked[0][t], blocked[1][t]
                moved = tracker.step(*now, flow.flow[t], flow.confidence[t])
        with task.watch.stage("store"):
            writer.put_frame("motion_recovered", t, moved.motion)
            writer.put_frame("motion_deviation", t, moved.deviation)


def _seal(task: _Task) -> Path:
    """Seals the store with its attributes; returns its path."""
    scene = task.scene
    case, extra = scene.scenario, dict[str, Any]()
    series = None if scene.series is None else scene.series.points.tobytes()
    anatomy = identity.identify_anatomy(scene.job, case.relief.seed, series)
    if scene.brain is not None:
        extra["opening_id"] = identity.identify_opening(scene.job, case.index, anatomy)
        extra["mesh_to_world"] = scene.brain.to_world.tolist()
    if (right := scene.renderer.right) is not None:
        extra["right"] = {"baseline_mm": scene.job.render.stereo_mm, **_lens(right)}
    return task.writer.seal(
        scenario=case.as_dict(),
        anatomy_id=anatomy,
        **_lens(scene.view),
        scale_mm_per_px=scene.scale_mm_per_px,
        young_kpa=scene.young_kpa,
        poisson=None if scene.young_kpa is None else case.tissue.poisson,
        mechanics=_mechanics(scene),
        variant=scene.renderer.variant,
        timings=task.watch.report(),
        **extra,
    )


def _mechanics(scene: Scene) -> dict[str, Any]:
    """The attribute `mechanics` of a sequence; what its mechanics did not compute is absent."""
    case, motion, fem = scene.scenario, scene.motion, scene.job.fem
    forces, known = motion.by_instrument, "force" in scene.job.stored_fields
    timeless = fem.time == "quasi-static" and not fem.relaxation
    law_from = LAWS.source(case.tissue.law)
    series = {"min_jacobian": motion.min_jacobian, "energy_mn_mm": motion.energy, "residual": motion.residual}
    if case.pulse is not None:
        series["pulse_mm"] = case.pulse.height(scene.time)
        if timeless:
            series |= {"tool_work_mn_mm": motion.tool_work, "pulse_work_mn_mm": motion.pulse_work}
    if scene.series is not None:
        series["work_mn_mm"] = motion.tool_work
    return {
        "law": case.tissue.law,
        **({"law_from": law_from} if law_from else {}),
        # Whether the work of the instruments equals the stored energy.
        "elastic": timeless and case.pulse is None and scene.series is None,
        **{name: values.tolist() for name, values in series.items() if values is not None},
        **({"cautions": list(motion.cautions)} if motion.cautions else {}),
        "instruments": [
            {
                "kind": kind,
                "instrument": instrument,
                **({"force_mn": (forces[:, k] @ scene.view.rotation.T).tolist()} if known else {}),
                "tip_mm": motion.tip[:, 2 * k : 2 * k + 2].tolist(),
                "shaft": motion.shaft[:, 2 * k].tolist(),
            }
            for k, (kind, instrument, _) in enumerate(scene.instruments[: motion.tip.shape[1] // 2])
        ],
    }


def _lens(camera: Camera) -> dict[str, Any]:
    """Attributes of a camera at rest: intrinsics and pose."""
    return {name: getattr(camera, name).tolist() for name in ("K", "distortion", "rotation", "translation")}
