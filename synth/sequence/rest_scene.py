"""One scene in memory: a sequence of a job, built and deformed; frames are rendered on demand."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np

from synth.arguments import checked
from synth.arrays import Floats, Map, Mask
from synth.errors import UserError
from synth.fem.deformation import Deformation
from synth.fem.external.series import MeshSeries
from synth.fem.surface_embedding import vertex_area
from synth.flow import track
from synth.flow.estimator import Estimator
from synth.flow.track import Track
from synth.geometry.brain_surface import Brain, load_brain, place_brain
from synth.geometry.skull import Attachment, Craniotomy
from synth.geometry.triangles import Shape
from synth.job.schema import Job
from synth.render.anatomy.surface import CortexSurface, Relief, grow, resize
from synth.render.camera.camera import Camera
from synth.render.camera.video_link import transmit
from synth.render.content import SceneContent
from synth.render.craniotomy import build_craniotomy
from synth.render.scene import RenderedFrame, Renderer, SceneState
from synth.sequence.draw import Draw, draw
from synth.sequence.job_instruments import read_job_instruments
from synth.sequence.job_series import read_job_series
from synth.sequence.scenario import Scenario
from synth.sequence.timeline import Timeline


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

    draw: Draw
    """The sequence as drawn and placed."""
    surface: CortexSurface
    """The fine surface at rest, world axes; shared between sequences of one anatomy, hence read-only."""
    brain: Brain | None
    """The user's brain that the surface is part of, if any, with its transform to world axes."""
    content: Callable[[RestScene], SceneContent]
    """What is drawn of it: `draw_craniotomy`, or content of your own around the same surface."""
    series: MeshSeries | None
    """Motion and load by another program, of `mechanics.source`."""

    @property
    def job(self) -> Job:
        """The job, with keys that it randomises as drawn for this sequence."""
        return self.draw.job

    @property
    def dataset(self) -> Job:
        """The job of all sequences, as given."""
        return self.draw.dataset

    @property
    def index(self) -> int:
        """Number of the sequence in the job."""
        return self.draw.index

    @property
    def scenario(self) -> Scenario:
        """All numbers drawn for it."""
        return self.draw.scenario

    @property
    def view(self) -> Camera:
        """The microscope at rest."""
        return self.draw.camera

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
        idle = [("idle", instrument.kind, instrument.radius_mm) for instrument in self.scenario.idle]
        if self.series is None:
            return [
                (gesture.kind, gesture.instrument, gesture.footprint_mm) for gesture in self.scenario.gestures
            ] + idle
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
        content_shape, surface_shape = content.tissue.shape, self.shape
        if not (
            np.array_equal(content_shape.faces, surface_shape.faces)
            and np.array_equal(content_shape.vertices, surface_shape.vertices)
        ):
            raise UserError("content: its tissue must have the vertices and faces of the scene's surface")
        section = job.render
        lens = self.draw.camera, sensor, job.store.extra, self.draw.right
        renderer = Renderer(content, *lens, spp=section.spp, variant=section.variant)
        if not renderer.rest.tissue.any():
            raise UserError("render: the camera shows no tissue; change render.tilt_deg or the opening")
        return renderer

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
        settings = case.camera_motion, case.appearance.light, self.job.fps
        return Timeline(rest, self.motion, self.view, *settings, case.idle)

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
        job, timeline = self.job, self._timeline
        state = timeline.at(t)
        exposures = timeline.exposure(t, job.sensor.shutter)
        rendered = self.renderer.render(state, self.draw.frame_seeds[t], exposures, timeline.at(t + 1))
        return Frame(
            **vars(rendered),
            index=t,
            time_s=float(self.time[t]),
            traction=self.renderer.traction(self.motion.traction[t]),
            force=self.force[t],
            camera=state.camera or self.view,
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
        estimator = self.job.flow.backend if backend is None else backend
        if estimator == "ideal":
            raise UserError("flow.backend: `ideal` recovers no flow; name an estimator")
        rgb, tools = np.stack([frame.rgb for frame in frames]), np.stack([frame.tool for frame in frames])
        rgb = transmit(rgb, self.job.fps, self.job.sensor.bitrate_mbps, self.job.sensor.chroma)
        return track.recover_flow(rgb, tools, self.tissue, estimator)


def draw_craniotomy(rest: RestScene) -> SceneContent:
    """The opening in skull and dura around the tissue, with the instruments of the gestures and the lamps."""
    case, job = rest.scenario, rest.job
    acting = [(kind, radius_mm) for gesture, kind, radius_mm in rest.instruments if gesture != "idle"]
    return build_craniotomy(
        rest.surface,
        case.appearance,
        rest.view,
        rest.draw.opening_mm,
        acting,
        case.idle,
        case.randomized,
        photo=job.appearance.photo,
        wear=job.randomize.get("instruments", 0.0),
        meshes=read_job_instruments(job.fem),
    )


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
    return build(draw(job, index, case=case), content)


def build(sequence_draw: Draw, content: Callable[[RestScene], SceneContent] | None = None) -> RestScene:
    """The surface of a sequence, grown or read, and what is drawn around it. Raises as `at_rest`."""
    anatomy, series = sequence_draw.job.anatomy, None
    if sequence_draw.job.mechanics.source is not None:
        series = read_job_series(sequence_draw.job, sequence_draw.index)
    mesh, relief, scale = anatomy.mesh, sequence_draw.scenario.relief, sequence_draw.scale
    stat = mesh.stat() if mesh and mesh.is_file() else None
    source = _SurfaceSource(
        mesh,
        anatomy.fill_holes,
        None if mesh is None and series is None else sequence_draw.craniotomy,
        sequence_draw.attachments if mesh is not None else (),
        series,
        stat and (stat.st_mtime_ns, stat.st_size),
    )
    # A procedural surface is grown in its usual size; whoever draws another organ has no veins on it.
    base_relief = replace(relief, gyrus_mm=relief.gyrus_mm / scale, sulcus_mm=relief.sulcus_mm / scale)
    sizes = sequence_draw.opening_mm / scale, anatomy.vertices, anatomy.dome_mm / scale
    surface, brain = _build_cortex(source, base_relief, *sizes, series is None or content is None)
    return RestScene(sequence_draw, resize(surface, scale), brain, content or draw_craniotomy, series)


@dataclass(frozen=True)
class _SurfaceSource:
    """The user's surface, if any."""

    mesh: Path | None
    fill_holes: bool
    craniotomy: Craniotomy | None
    attachments: tuple[Attachment, ...]
    series: MeshSeries | None
    written: tuple[int, int] | None  # time and size of the mesh's file: another may have replaced it

    def place(self) -> Brain | None:
        """The surface in world axes."""
        if self.craniotomy is None:
            return None
        if self.mesh is not None:
            return load_brain(self.mesh, self.craniotomy, self.attachments, self.fill_holes)
        assert self.series is not None
        return place_brain(self.series.points, self.series.faces, "mechanics.source", self.craniotomy)


@lru_cache(maxsize=4)
def _build_cortex(
    source: _SurfaceSource, relief: Relief, opening_mm: float, vertices: int, dome_mm: float, veined: bool
) -> tuple[CortexSurface, Brain | None]:
    """The fine surface, and the user's brain that it is part of, if any; cached, hence read-only."""
    brain = source.place()
    shape = None if brain is None else brain.shape
    surface = grow(relief, opening_mm, vertices=vertices, dome_mm=dome_mm, brain=shape, veined=veined)
    for value in (*vars(surface).values(), *((*brain.shape, brain.to_world) if brain else ())):
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
    return surface, brain
