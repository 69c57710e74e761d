"""One sequence of a job: by how much the force is off with some settings, and what they cost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from synth.errors import UserError
from synth.fem.solver import Deformation
from synth.flow import mask_detection
from synth.flow.estimator import create
from synth.flow.track import Tracker
from synth.job.schema import Job
from synth.render.camera import camera
from synth.sequence import scenario
from synth.sequence.scene import Frame, Scene, simulate
from synth.system.stopwatch import Stopwatch
from synth.tune.force_reading import cells, fit_reading

Floats = NDArray[np.float64]
Found = TypeVar("Found")

_LOADED = 3  # frames with load that are looked at in a sequence, on the way up to its peak
_VIEW = {"field_mm", "working_distance_mm", "tilt_deg", "distortion", "calibration"}
_PHYSICS: Any = {
    **dict.fromkeys(("seed", "sequences", "frames", "fps", "anatomy", "fem"), True),
    "render": _VIEW,
}
"""What it depends on; of the view, as contacts keep to what is in it, and not on the picture's size."""


@dataclass(frozen=True)
class Measured:
    """One sequence with some settings."""

    label: Floats
    """(K, I) error of the force that the true displacement stands for, as a part of the force, in K frames of
    I instruments."""
    read: Floats
    """(K, I) the same of the recovered displacement; of the true one where none is recovered."""
    cost: Floats
    """(4,) CPU-s: physics and scene of the sequence, rendering and flow of a frame."""


class Probe:
    """The first sequence of a job at full fidelity, which other settings are measured against."""

    def __init__(self, job: Job) -> None:
        """UserError if the sequence cannot be carried out."""
        scene, _ = _simulate(job.model_dump_json(include=_PHYSICS))
        self._numbers = loaded_frames(scene.motion)
        scene, frames, _ = _render(job.model_dump_json(exclude={"flow"}), self._numbers)
        self._reading = fit_reading(scene, frames[1:])

    def measure(self, job: Job) -> Measured:
        """The sequence with the settings of `job`. UserError if they cannot carry it out."""
        scene, frames, cost = _render(job.model_dump_json(exclude={"flow"}), self._numbers)
        label = read = self._error(scene, [frame.flow for frame in frames[1:]])
        flow_s = 0.0
        if job.flow.backend != "ideal":
            flows, flow_s = _recover_flow(scene, frames, job)
            read = self._error(scene, flows)
        return Measured(label, read, np.array([*cost, flow_s]))

    def _error(self, scene: Scene, flows: list[NDArray[np.float32]]) -> Floats:
        moved = np.stack([cells(flow, scene.tissue) for flow in flows])
        return self._reading.error(scene.view.mm_per_px * moved)


def loaded_frames(motion: Deformation) -> tuple[int, ...]:
    """The rest frame and up to three others, evenly on the way to the largest load; UserError without any."""
    load = np.linalg.norm(motion.traction, axis=2) @ motion.area
    if not load.any():
        raise UserError("a sequence of the job has no frame with a load; give it more frames")
    first, peak = int(np.flatnonzero(load)[0]), int(load.argmax())
    numbers = np.linspace(first - 1, peak, _LOADED + 1).round().astype(int)[1:]
    return (0, *sorted({int(t) for t in numbers if t > 0}))


@lru_cache(maxsize=2)
def _simulate(job_json: str) -> tuple[Scene, float]:
    """The moved scene of a job's first sequence, and its CPU-s."""
    return _timed(lambda: simulate(Job.model_validate_json(job_json)))


@lru_cache(maxsize=1)  # for settings of flow alone
def _render(job_json: str, numbers: tuple[int, ...]) -> tuple[Scene, list[Frame], tuple[float, float, float]]:
    """Frames of a job's first sequence; CPU-s of its physics and scene, and of a frame."""
    job = Job.model_validate_json(job_json)
    moved, physics_s = _simulate(job.model_dump_json(include=_PHYSICS))
    own = moved.scenario
    case = replace(scenario.draw_scenario(job, 0), gesture=own.gesture, further=own.further)
    scene = replace(moved, job=job, scenario=case, view=camera.place(case.view, job.render))
    _, scene_s = _timed(lambda: scene.renderer)
    rendered = [_timed(partial(scene.frame, t)) for t in numbers]
    first_s, *others_s = (spent for _, spent in rendered)
    frame_s = min(others_s)  # what else the machine does only adds
    # The first frame also prepares what all of them need.
    return scene, [frame for frame, _ in rendered], (physics_s, scene_s + first_s - frame_s, frame_s)


def _recover_flow(scene: Scene, frames: list[Frame], job: Job) -> tuple[list[NDArray[np.float32]], float]:
    """Flow (H, W, 2) px of all frames but the first, and the CPU-s of one."""
    rgb = np.stack([frame.rgb for frame in frames])
    blocked = mask_detection.hidden(rgb, np.stack([frame.tool for frame in frames]))
    tracker = Tracker(create(job.flow.backend), rgb[0], blocked[0], scene.tissue)
    steps = [_timed(partial(tracker.step, *one)) for one in zip(rgb[1:], blocked[1:], strict=True)]
    first_s, *others_s = (spent for _, spent in steps)
    return [flow for (flow, _), _ in steps], min(others_s or [first_s])  # in a video, most start warm


def _timed(compute: Callable[[], Found]) -> tuple[Found, float]:
    """What is computed, and the CPU-s that it took."""
    watch = Stopwatch()
    with watch.stage("all"):
        found = compute()
    return found, watch.cpu_s("all")
