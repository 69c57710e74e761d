"""One scene in memory: a sequence of a job, built and deformed; frames are rendered on demand."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial

import numpy as np

from synth.arguments import checked
from synth.arrays import Floats, Map, Mask
from synth.errors import UserError, as_user_error
from synth.fem.deformation import Deformation
from synth.fem.external.read_series import read_job_series
from synth.fem.external.series import MeshSeries
from synth.fem.surface_embedding import vertex_area
from synth.flow import track
from synth.flow.estimator import Estimator
from synth.flow.stereo.calibration import read_rig
from synth.flow.stereo.rig import Rectified
from synth.flow.track import Track
from synth.geometry.brain_surface import Brain, load_brain, place_brain
from synth.geometry.triangles import Shape
from synth.job.schema import AnatomySection, Job, RenderSection
from synth.render.anatomy import surface as anatomy
from synth.render.anatomy.surface import CortexSurface, Relief
from synth.render.camera import camera, video_link
from synth.render.camera.camera import Camera
from synth.render.camera.camera_calibration import rendered, scaled
from synth.render.content import SceneContent
from synth.render.craniotomy import craniotomy
from synth.render.scene import RenderedFrame, Renderer, SceneState
from synth.sequence import scenario
from synth.sequence.randomization import randomized
from synth.sequence.scenario import Scenario
from synth.sequence.timeline import Timeline
from synth.system import camera_file


@dataclass(frozen=True, kw_only=True)
class Frame(RenderedFrame):
    """One frame of a scene: the picture, its ground truth, and the force in it.

    All attributes of a `RenderedFrame` (`rgb`, `flow`, `visible`, `depth`, `tool`, `glare`, ...; None for
    fields that the job does not store), in the units and axes of a dataset's fields, and:
    """

    index: int
    """Number of the frame; 0 is the rest frame."""
    time_s: float
    traction: Map
    """(H, W, 3) kPa on the tissue, camera axes, at the rest frame's pixels: the label. NaN: not known."""
    force: Floats
    """(3,) mN on the tissue, camera axes: the sum of traction times `Scene.area`. NaN: not known."""
    camera: Camera
    """The microscope at that time."""


@dataclass(frozen=True)
class RestScene:
    """One sequence of a job, drawn and built, before any motion; made by `at_rest`."""

    job: Job
    """The job, with keys that it randomises as drawn for this sequence."""
    index: int
    """Number of the sequence in the job."""
    scenario: Scenario
    """All numbers drawn for it."""
    surface: CortexSurface
    """The fine surface at rest, world axes; shared between sequences of one anatomy, hence read-only."""
    view: Camera
    """The microscope at rest."""
    brain: Brain | None
    """The user's brain that the surface is part of, if any, with its transform to world axes."""
    content: Callable[[RestScene], SceneContent]
    """What is drawn of it: `draw_craniotomy`, or content of your own around the same surface."""
    series: MeshSeries | None
    """Motion and load by another program, of `mechanics.source`."""
    dataset: Job
    """The job of all sequences, as given."""

    @property
    def shape(self) -> Shape:
        """Vertices (V, 3) mm and faces (F, 3) of the fine surface, counter-clockwise from outside."""
        return Shape(self.surface.vertices, self.surface.faces)

    @property
    def vertex_area(self) -> Floats:
        """(V,) mm^2 of the surface: a third of the faces at each vertex. Traction times it is force."""
        return vertex_area(*self.shape)

    @property
    def instruments(self) -> list[tuple[str, str, float]]:
        """Gesture, kind and radius of the contact in mm of each acting instrument, then of idle ones."""
        idle = [("idle", one.kind, one.radius_mm) for one in self.scenario.idle]
        if self.series is None:
            return [(one.kind, one.instrument, one.footprint_mm) for one in self.scenario.gestures] + idle
        kinds, radius = self.job.fem.names or ("probe",), self.job.fem.footprint_mm[0]
        return [("external", kinds[k % len(kinds)], radius) for k in range(self.series.tip.shape[1])] + idle

    @property
    def time(self) -> Floats:
        """(T,) s of the frames."""
        return np.arange(self.job.frames) / self.job.fps

    @cached_property
    def renderer(self) -> Renderer:
        """Renderer of this scene for any state of its surface and instruments."""
        sensor, job, content = self.scenario.appearance.sensor, self.job, self.content(self)
        drawn, own = content.tissue.shape, self.shape
        if not (np.array_equal(drawn.faces, own.faces) and np.array_equal(drawn.vertices, own.vertices)):
            raise UserError("content: its tissue must have the vertices and faces of the scene's surface")
        right = right_of(job.render, self.view)
        made = Renderer(content, self.view, sensor, job.render, job.store.extra, right)
        if not made.rest.tissue.any():
            raise UserError("render: the camera shows no tissue; change render.tilt_deg or the opening")
        return made

    @property
    def tissue(self) -> Mask:
        """(H, W) brain in the rest frame."""
        return self.renderer.rest.tissue

    @property
    def area(self) -> Map:
        """(H, W) mm^2 of rest surface in each pixel of the rest frame."""
        return self.renderer.rest.area

    @property
    def scale_mm_per_px(self) -> float:
        """Scale at the craniotomy."""
        return float(self.renderer.rest.scale_mm_per_px)


@dataclass(frozen=True)
class Scene(RestScene):
    """One sequence of a job, built and deformed, made by `simulate`. Frames are rendered on demand."""

    motion: Deformation
    """Motion of the surface, its load and the instruments over T frames."""

    @cached_property
    def _timeline(self) -> Timeline:
        case, rest = self.scenario, self.surface.vertices
        moving = case.camera_motion, case.appearance.light, self.job.fps
        return Timeline(rest, self.motion, self.view, *moving, case.idle)

    @cached_property
    def _seeds(self) -> list[int]:
        return scenario.frame_seeds(self.job, self.index)

    def __len__(self) -> int:
        return self.job.frames

    @property
    def force(self) -> Floats:
        """(T, 3) mN on the tissue, camera axes; NaN where it isn't known."""
        return self.motion.force @ self.view.rotation.T

    @property
    def strongest(self) -> int:
        """The frame of the largest force, or of the largest motion where it isn't known."""
        size = self.motion.displacement if np.isnan(self.motion.force).any() else self.motion.force
        return int(np.linalg.norm(size.reshape(len(size), -1), axis=1).argmax())

    @property
    def young_kpa(self) -> float | None:
        """Young's modulus of the tissue; None where another program's is not stated."""
        low, high = self.job.fem.young_kpa
        return self.scenario.tissue.young_kpa if self.series is None or low == high else None

    def state(self, t: int) -> SceneState:
        """Surface, instruments and microscope in frame `t`."""
        return self._timeline.at(t)

    @checked
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
            time_s=float(self.time[t]),
            traction=self.renderer.traction(self.motion.traction[t]),
            force=self.force[t],
            camera=now.camera or self.view,
        )

    def frames(self) -> Iterator[Frame]:
        """Renders the frames in order, one at a time."""
        return (self.frame(t) for t in range(len(self)))

    @checked
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
        rgb = video_link.recorded(rgb, self.job.sensor, self.job.fps)
        return track.recover_flow(rgb, tools, self.tissue, chosen)


def draw_craniotomy(rest: RestScene) -> SceneContent:
    """The opening in skull and dura around the tissue, with the instruments of the gestures and the lamps."""
    case = rest.scenario
    drawn = [one[1:] for one in rest.instruments if one[0] != "idle"]
    given = rest.surface, case.appearance, rest.view, rest.job, drawn
    return craniotomy(*given, case.idle, case.randomized)


def at_rest(
    job: Job,
    index: int = 0,
    *,
    case: Scenario | None = None,
    content: Callable[[RestScene], SceneContent] | None = None,
) -> RestScene:
    """Draws sequence `index` of a job and builds its surface and renderer.

    The renderer takes any state, `scene.renderer.render(SceneState(vertices, tips, shafts), seed)`: two tips
    and shafts of each of `instruments`, idle ones last. `case`: a scenario instead of the drawn one;
    `content`: what is drawn around the surface and of it, `draw_craniotomy` if None. UserError: the job's
    surface or calibration cannot be used.
    """
    case = case or scenario.draw_scenario(job, index)
    dataset, job = job, randomized(job, index)
    view = camera.place(case.view, job.render)
    if job.render.calibration is not None:
        case = replace(case, view=camera.calibrated(case.view, view))
    mesh, series = job.anatomy.mesh, None
    if job.mechanics.source is not None:
        series = read_job_series(job, index)
        tissue = replace(case.tissue, law="external", why="mechanics.source", membrane=None)
        case = replace(case, gestures=(), pulse=None, tissue=tissue)
    about = mesh.stat() if mesh and mesh.is_file() else None
    written = about and (about.st_mtime_ns, about.st_size)
    bare = content is not None  # whoever draws another organ has no veins on it
    scale = case.randomized.scale if case.randomized is not None else 1.0
    section, relief = anatomy.shrunk(job.anatomy.opened(case.index), case.relief, scale)
    surface, brain = _cortex(section, relief, written, series, bare)
    surface = anatomy.resized(surface, scale)
    return RestScene(job, index, case, surface, view, brain, content or draw_craniotomy, series, dataset)


def refuse_unfit(render: RenderSection) -> None:
    """Raises UserError for a calibration that can't be read, or whose cameras don't show the opening."""
    if render.calibration is not None:
        right_of(render, camera.place(scenario.draw_view(render, np.random.default_rng(0)), render))


def right_of(render: RenderSection, view: Camera) -> Callable[[Camera], Camera] | None:
    """The right camera of the left one in any pose, by the job's stereo calibration; None without one.

    `view`: the left camera at rest; its picture may have another size than those of the calibration.
    Raises UserError for a pair that is none, or whose right camera does not show the opening's centre.
    """
    if render.calibration is None or not camera_file.find_baseline_mm(render.calibration):
        return None
    with as_user_error("render.calibration"):
        pair = read_rig(render.calibration, render.size)
    scale = np.diag(view.K)[:2] / np.diag(pair.left.K)[:2]
    K = scaled(pair.right.K, scale)
    lens = rendered(pair.right.distortion, render.calibration)
    turn, shift = pair.rotation, pair.translation
    place = partial(camera.calibrated_right, K=K, distortion=lens, rotation=turn, translation=shift)
    Rectified(pair)  # refuses a right camera that is not to the right
    right = place(view)
    at = camera.project(right, np.zeros((1, 3)))[0]
    if right.translation[2] <= 0 or (at < 0).any() or (at >= right.size).any():
        raise UserError(
            f"render.calibration: the opening, {view.translation[2]:.4g} mm away, is at ({at[0]:.0f}, "
            f"{at[1]:.0f}) px for the right camera, outside its picture; change render.working_distance_mm"
        )
    return place


@lru_cache(maxsize=4)
def _cortex(
    section: AnatomySection, relief: Relief, written: object, series: MeshSeries | None, bare: bool
) -> tuple[CortexSurface, Brain | None]:
    """The fine surface, and the user's brain that it is part of, if any; cached, hence read-only.

    `written` (time and size of the brain's file) distinguishes a mesh from one that replaced it.
    """
    brain = None
    if section.mesh is not None:
        brain = load_brain(section.mesh, section.craniotomy, section.attachments, section.fill_holes)
    elif series is not None:
        brain = place_brain(series.points, series.faces, "mechanics.source", section.craniotomy)
    surface = anatomy.grow(relief, section, brain.shape if brain else None, series is None or not bare)
    for value in (*vars(surface).values(), *((*brain.shape, brain.to_world) if brain else ())):
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
    return surface, brain
