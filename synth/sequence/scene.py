"""One scene in memory: a sequence of a job, built and deformed; frames are rendered on demand."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from synth.errors import UserError
from synth.fem.solver import Deformation
from synth.fem.tool_gesture import ToolMotion
from synth.flow import track
from synth.flow.estimator import Estimator
from synth.flow.track import Track
from synth.job.reader import as_job
from synth.job.schema import Job
from synth.render.anatomy.surface import CortexSurface
from synth.render.camera import camera, video_link
from synth.render.camera.camera import Camera
from synth.render.scene import RenderedFrame, Renderer
from synth.sequence import mechanics, scenario
from synth.sequence.scenario import Scenario
from synth.sequence.timeline import Timeline
from synth.system.stopwatch import StageCallback, Stopwatch

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Frame(RenderedFrame):
    """One frame of a scene: the picture, its ground truth, and the force in it.

    All attributes of a `RenderedFrame` (`rgb`, `flow`, `visible`, `depth`, `tool`, `glare`, ...; None for
    fields that the job does not store), in the units and axes of a dataset's fields, and:
    """

    index: int
    """Number of the frame; 0 is the rest frame."""
    time_s: float
    traction: NDArray[np.float32]
    """(H, W, 3) kPa on the tissue, camera axes, at the rest frame's pixels: the label."""
    force: Floats
    """(3,) mN on the tissue, camera axes: the sum of traction times `Scene.area`."""
    camera: Camera
    """The microscope at that time."""


@dataclass(frozen=True)
class RestScene:
    """One sequence of a job, drawn and built, before any motion; made by `at_rest`."""

    job: Job
    index: int
    """Number of the sequence in the job."""
    scenario: Scenario
    """All numbers drawn for it."""
    surface: CortexSurface
    """The fine surface at rest, world axes; shared between sequences of one anatomy, hence read-only."""
    view: Camera
    """The microscope at rest."""

    @cached_property
    def renderer(self) -> Renderer:
        """Renderer of this scene for any state of its surface and instruments."""
        kinds = [gesture.kind for gesture in self.scenario.gestures]
        return Renderer(self.surface, self.scenario.appearance, self.view, self.job, kinds)

    @property
    def tissue(self) -> NDArray[np.bool_]:
        """(H, W) brain in the rest frame."""
        return self.renderer.rest.tissue

    @property
    def area(self) -> NDArray[np.float32]:
        """(H, W) mm^2 of rest surface in each pixel of the rest frame."""
        return self.renderer.rest.area

    @property
    def scale_mm_per_px(self) -> float:
        """Scale at the craniotomy."""
        return float(self.renderer.rest.scale_mm_per_px)


@dataclass(frozen=True)
class Scene(RestScene):
    """One sequence of a job, built and deformed; `simulate` makes it. Frames are rendered on demand."""

    motion: Deformation
    """Surface, loads and instruments over T frames, world axes: `displacement` (T, V, 3) mm."""

    @cached_property
    def _timeline(self) -> Timeline:
        case = self.scenario
        return Timeline(self.motion, self.view, case.camera_motion, case.appearance.light, self.job.fps)

    @cached_property
    def _seeds(self) -> list[int]:
        return scenario.frame_seeds(self.job, self.index)

    def __len__(self) -> int:
        return self.job.frames

    @property
    def force(self) -> Floats:
        """(T, 3) mN on the tissue, camera axes."""
        return self.motion.force @ self.view.rotation.T

    @property
    def strongest(self) -> int:
        """The frame of the largest force."""
        return int(np.linalg.norm(self.motion.force, axis=1).argmax())

    @property
    def young_kpa(self) -> float:
        """Young's modulus of the tissue."""
        return self.scenario.tissue.young_kpa

    def frame(self, t: int) -> Frame:
        """Renders frame `t`, 0 <= t < T, independently of other frames.

        Raises:
            UserError: there is no such frame.
        """
        if not 0 <= t < len(self):
            raise UserError(f"frame {t}: the scene has frames 0 to {len(self) - 1}")
        job, line = self.job, self._timeline
        now = line.at(t)
        lit = line.exposure(t, job.sensor.shutter)
        rendered = self.renderer.render(now, self._seeds[t], lit, line.at(t + 1))
        return Frame(
            **vars(rendered),
            index=t,
            time_s=float(self.motion.time[t]),
            traction=self.renderer.traction(self.motion.traction[t]),
            force=self.force[t],
            camera=now.camera or self.view,
        )

    def frames(self) -> Iterator[Frame]:
        """Renders the frames in order, one at a time."""
        return (self.frame(t) for t in range(len(self)))

    def recover_flow(self, frames: Sequence[Frame], backend: str | Estimator | None = None) -> Track:
        """Recovers flow (T, H, W, 2) px from the pictures, with its confidence (T, H, W) and trust (T,).

        As in a real pipeline, its inputs are pictures (after the job's codec) and instrument masks; glare is
        detected in the pictures.

        Args:
            frames: of this scene, from the rest frame on.
            backend: an estimator or its name; the job's if None.

        Raises:
            UserError: no such estimator, or frames that do not begin at rest.
        """
        if not frames or frames[0].index != 0:
            raise UserError("recover_flow: the frames must begin with the rest frame, number 0")
        chosen = self.job.flow.backend if backend is None else backend
        if chosen == "ideal":
            raise UserError("flow.backend: `ideal` recovers no flow; name an estimator")
        rgb, tools = np.stack([one.rgb for one in frames]), np.stack([one.tool for one in frames])
        if self.job.sensor.bitrate_mbps is not None:
            rgb = video_link.recorded(rgb, self.job.sensor, self.job.fps)
        return track.recover_flow(rgb, tools, self.tissue, chosen)


def at_rest(
    job: Job, index: int = 0, gestures: Sequence[str] | None = None, *, case: Scenario | None = None
) -> RestScene:
    """Draws sequence `index` of a job and builds its surface and renderer.

    The renderer accepts any state: `scene.renderer.render(SceneState(vertices, tips, shafts), seed)`.

    Args:
        job: the job.
        index: number of the sequence.
        gestures: kinds of gesture whose instruments are shown instead of the drawn ones.
        case: a scenario to use instead of the drawn one.

    Raises:
        UserError: the job's surface or calibration cannot be used.
    """
    case = case or scenario.draw_scenario(job, index)
    if gestures is not None:
        first, *further = (replace(case.gesture, kind=kind) for kind in gestures)
        case = replace(case, gesture=first, further=tuple(further))
    view = camera.place(case.view, job.render)
    if job.render.calibration is not None:
        case = replace(case, view=camera.calibrated(case.view, view))
    return RestScene(job, index, case, mechanics.cortex(job, case)[0], view)


def simulate(
    job: Job | str | Path,
    index: int = 0,
    report: StageCallback | None = None,
    watch: Stopwatch | None = None,
    *,
    case: Scenario | None = None,
    motions: Sequence[ToolMotion] = (),
) -> Scene:
    """Builds sequence `index` of a job and simulates its gestures; nothing is rendered or written yet.

    Without `case` and `motions` the scene is the one that `synth render` computes for that job and index.

    Args:
        job: the job, or its file or name as for `load_job`; its `sequences` only limits `index`.
        index: number of the sequence, 0 <= index < job.sequences.
        report: called with progress, stage by stage.
        watch: adds up the time of each stage.
        case: a scenario to use instead of the drawn one; its camera motion may be any dataclass with a method
            `at` like that of `CameraMotion`.
        motions: of its instruments, over T frames each, instead of the gestures' own trajectories.

    Raises:
        UserError: no such sequence, or a job that cannot be carried out (surface, load, inverted element).
    """
    job = as_job(job)
    if index not in range(job.sequences):
        raise UserError(f"sequence {index}: the job has sequences 0 to {job.sequences - 1}")
    report, watch = report or (lambda stage, done, of: None), watch or Stopwatch()
    report("mesh", 0, 1)
    with watch.stage("mesh"):
        rest = at_rest(job, index, case=case)
        surface, tets = mechanics.build(job, rest.scenario)
    report("fem", 0, 1)
    with watch.stage("fem"):
        motion = mechanics.move(job, rest.scenario, surface, tets, motions)
    return Scene(**vars(rest), motion=motion)
