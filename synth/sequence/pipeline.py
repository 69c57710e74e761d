"""One sequence from job to sealed store: connects fem, render and flow through plain arrays."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import chain, starmap
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from synth.arguments import checked
from synth.arrays import Array, Mask, Pixels
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
from synth.job import identity
from synth.job.schema import Job
from synth.render.camera.camera import Camera, between
from synth.render.camera.camera_sensor import MOST_BLANK, blank_share
from synth.render.camera.video_link import transmit
from synth.render.scene import Renderer
from synth.sequence.published_labels import PublishedLabels
from synth.sequence.rest_scene import Scene
from synth.sequence.simulation import simulate
from synth.system.stopwatch import StageCallback, Stopwatch

# Fields of a `RenderedFrame`, for one camera and for two; so are those of `store.extra` but `_PUBLISHED`.
_RENDERED = ("rgb", "flow", "visible", "tool", "glare", "depth")
_STEREO = ("rgb_right", "flow_right", "visible_right", "depth_right", "motion")
_PUBLISHED = ("flow_noisy", "intensity")
_CAMERAS = (("rgb", "tool"), ("rgb_right", "tool_right"))  # picture and instruments of each


class _Values(NamedTuple):
    """What is to be stored: a whole field, or its frame `t`."""

    name: str
    values: Array
    t: int | None = None


class _Video(NamedTuple):
    """Video of one camera."""

    rgb: Pixels  # (T, H, W, 3)
    tools: Mask  # (T, H, W) pixels of the instruments


@dataclass(frozen=True)
class _Task:
    """A sequence in rendering, as shared by all stages."""

    scene: Scene
    renderer: Renderer
    field_names: frozenset[str]
    """Names of the fields that the job stores."""
    watch: Stopwatch
    report: StageCallback


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
    _refuse_unseen(scene, renderer)
    width, height = job.render.size
    task = _Task(scene, renderer, frozenset(job.stored_fields), watch, report)
    rest_fields = _measure_rest(task)
    writer = Writer(Path(folder), scene.index, frames=job.frames, size=(height, width), job=scene.dataset)
    Folder(Path(folder)).refuse_replaced(scene.dataset, writer.job_identity)
    for name, values, t in chain(starmap(_Values, rest_fields.items()), _run(task)):
        with watch.stage("store"):
            if t is None:
                writer.put(name, values)
            else:
                writer.put_frame(name, t, values)
    return writer.seal(**_describe(scene, renderer), timings=watch.report())


def _run(task: _Task) -> Iterator[_Values]:
    """All stages in their order: frames, codec, recovered flow and motion."""
    job, videos = task.scene.job, list[_Video]()
    yield from _render_frames(task, videos)
    if job.sensor.bitrate_mbps is not None:  # a codec needs all frames at once
        link = job.fps, job.sensor.bitrate_mbps, job.sensor.chroma
        with task.watch.stage("store"):
            videos = [_Video(transmit(rgb, *link), tools) for rgb, tools in videos]
        yield from (_Values(name, video.rgb) for video, (name, _) in zip(videos, _CAMERAS, strict=False))
    if job.flow.backend != "ideal":
        yield from _recover_motion(task, videos)


def _refuse_unseen(scene: Scene, renderer: Renderer) -> None:
    """Raises UserError if most of the largest force is outside the view, so that it has no label."""
    t, force = scene.strongest, scene.force
    label = renderer.traction(scene.motion.traction[t]) * renderer.rest.area[..., None]
    size = float(np.linalg.norm(force[t]))
    if np.linalg.norm(label.sum(axis=(0, 1), dtype=np.float64) - force[t]) > 0.5 * size:
        raise UserError(
            f"frame {t}: most of the force of {size:.3g} mN is on tissue that the camera does not show; "
            "change the contact's place, or widen render.field_mm"
        )


def _measure_rest(task: _Task) -> dict[str, Array]:
    """Fields of the whole sequence that need no picture; labels are in camera axes."""
    scene, rest = task.scene, task.renderer.rest
    forces = scene.motion.by_instrument @ scene.view.rotation.T
    missing = max(MOST_INSTRUMENTS - forces.shape[1], 0)
    fields = {
        "time": scene.time,
        "force": scene.force,
        "force_of": np.pad(forces, ((0, 0), (0, missing), (0, 0))),
        "tissue": rest.tissue,
        "area": rest.area,
    }
    if task.renderer.right is not None:
        fields["disparity"] = task.renderer.disparity()
    return fields


def _render_frames(task: _Task, videos: list[_Video]) -> Iterator[_Values]:
    """Every frame's fields, except videos that a codec follows; adds a video per camera."""
    scene, job, tissue = task.scene, task.scene.job, task.renderer.rest.tissue
    width, height = job.render.size
    labels = None
    if set(_PUBLISHED) & set(job.store.extra):
        rng = np.random.default_rng(scene.draw.label_seed)
        labels = PublishedLabels(job.labels, tissue, job.frames, rng)
    candidates = dict.fromkeys((*_RENDERED, *(_STEREO if job.render.stereo_mm else ()), *job.store.extra))
    deferred = () if job.sensor.bitrate_mbps is None else ("rgb", "rgb_right")
    names = [name for name in candidates if FIELDS[name].framed and name not in deferred]
    shape = (job.frames, height, width)
    cameras = _CAMERAS if "rgb_right" in task.field_names else _CAMERAS[:1]
    videos += [_Video(np.empty((*shape, 3), np.uint8), np.empty(shape, bool)) for _ in cameras]
    poses = np.empty((job.frames, 4, 4))
    for t in range(job.frames):
        task.report("render", t, job.frames)
        with task.watch.stage("render"):
            frame = scene.frame(t)
        if t == 0:
            clear = tissue & ~frame.tool
            if blank_share(frame.rgb[clear] if clear.any() else frame.rgb) > MOST_BLANK:
                raise UserError("frame 0: its tissue is black or burnt out; change sensor.exposure or light")
        elif not frame.visible[tissue].any():
            raise UserError(f"frame {t}: none of the tissue is visible any more; widen render.field_mm")
        published = labels.frame(t, frame.flow, frame.traction, scene.motion.force[t]) if labels else {}
        for name in names:
            yield _Values(name, published[name] if name in published else getattr(frame, name), t)
        yield _Values("traction", frame.traction, t)
        for video, (rgb, tool) in zip(videos, cameras, strict=True):
            video.rgb[t], video.tools[t] = getattr(frame, rgb), getattr(frame, tool)
        poses[t] = frame.camera.pose
    yield _Values("camera", poses)


def _recover_motion(task: _Task, videos: Sequence[_Video]) -> Iterator[_Values]:
    """Flow by the job's estimator, and with two cameras motion in three dimensions.

    As in a real pipeline, its inputs are pictures and masks of instruments; glare is detected in the
    pictures.
    """
    job, tissue = task.scene.job, task.renderer.rest.tissue
    task.report("flow", 0, job.frames)
    with task.watch.stage("flow"):
        masks = [with_highlights(*video) for video in videos]
        flow_track = track.track(create(job.flow.backend), videos[0].rgb, masks[0], tissue)
    yield _Values("flow_recovered", flow_track.flow)
    yield _Values("flow_confidence", flow_track.confidence)
    if "motion_recovered" not in task.field_names:
        return
    with task.watch.stage("stereo"):
        left, right = task.renderer.camera, task.renderer.right
        assert right is not None
        pair = rig.StereoRig(
            rig.Intrinsics(left.K, left.distortion),
            rig.Intrinsics(right.K, right.distortion),
            *between(left, right),
            size=job.render.size,
        )
        still_count = stereo.still_frames(flow_track.flow, tissue)
        rest = videos[0].rgb[:still_count], videos[1].rgb[:still_count]
        tracker = stereo.StereoTracker(pair, *rest, masks[0][0], masks[1][0], tissue)
    for t in range(job.frames):
        task.report("stereo", t, job.frames)
        with task.watch.stage("stereo"):
            if t == 0:
                stereo_motion = stereo.Motion3D.zeros(tissue.shape)
            else:
                views = videos[0].rgb[t], videos[1].rgb[t], masks[0][t], masks[1][t]
                stereo_motion = tracker.step(*views, flow_track.flow[t], flow_track.confidence[t])
        yield _Values("motion_recovered", stereo_motion.motion, t)
        yield _Values("motion_deviation", stereo_motion.deviation, t)


def _describe(scene: Scene, renderer: Renderer) -> dict[str, Any]:
    """Attributes of the sequence."""
    case, job, view = scene.scenario, scene.job, scene.view
    series = None if scene.series is None else scene.series.points.tobytes()
    attributes: dict[str, Any] = {
        "scenario": asdict(case),
        "anatomy_id": identity.identify_anatomy(job, case.relief.seed, series),
        **_lens(view),
        "scale_mm_per_px": float(renderer.rest.scale_mm_per_px),
        "young_kpa": (young_kpa := scene.young_kpa),
        "poisson": None if young_kpa is None else case.tissue.poisson,
        "mechanics": _mechanics(scene),
        "variant": renderer.variant,
    }
    if scene.brain is not None:
        anatomy = attributes["anatomy_id"]
        attributes["opening_id"] = identity.identify_opening(job, case.index, anatomy)
        attributes["mesh_to_world"] = scene.brain.to_world.tolist()
    if renderer.right is not None:
        attributes["right"] = {"baseline_mm": job.render.stereo_mm, **_lens(renderer.right)}
    return attributes


def _mechanics(scene: Scene) -> dict[str, Any]:
    """The attribute `mechanics` of a sequence; what its mechanics did not compute is absent."""
    case, motion, fem = scene.scenario, scene.motion, scene.job.fem
    forces, has_force = motion.by_instrument, "force" in scene.job.stored_fields
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
                **({"force_mn": (forces[:, k] @ scene.view.rotation.T).tolist()} if has_force else {}),
                "tip_mm": motion.tip[:, 2 * k : 2 * k + 2].tolist(),
                "shaft": motion.shaft[:, 2 * k].tolist(),
            }
            for k, (kind, instrument, _) in enumerate(scene.instruments[: motion.tip.shape[1] // 2])
        ],
    }


def _lens(camera: Camera) -> dict[str, Any]:
    """Attributes of a camera at rest: intrinsics and pose."""
    return {name: getattr(camera, name).tolist() for name in ("K", "distortion", "rotation", "translation")}
