"""The renderer of one moving surface under the microscope: pictures and their ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from synth.geometry.triangles import Shape, joined, normals
from synth.job.schema import Job
from synth.render import instrument, truth
from synth.render.anatomy import noise, rim, scenery, texture
from synth.render.anatomy.surface import CortexSurface
from synth.render.appearance import light, reflection
from synth.render.appearance.appearance import Appearance
from synth.render.camera import camera_sensor
from synth.render.camera.camera import Camera, blur_radius, right_camera
from synth.render.mitsuba.adapter import Body, Metal, Stage, Wet, forget, pick
from synth.render.truth import RestFrame
from synth.system.jit import vectorised

Floats = npt.NDArray[np.float64]
Map = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

_RIM_ROUGHNESS, _RIM_DRY = 0.09, 0.35
_MIRRORED_PX = 48  # resolution of the wound in steel's reflections, as fine as its finish resolves
_SATIN = 0.10  # share of light that steel's finish scatters diffusely
_DULL = 0.8  # finish of a retractor, between steel (0) and black (1), against glare
_AMBIENT = 0.05  # share of the lamps' light that comes from all directions
_GLARE = 0.35  # specular radiance, as a share of full scale, that hides the tissue under it


@dataclass(frozen=True)
class SceneState:
    """State of the scene at one time."""

    vertices: Floats  # (V, 3) mm, the surface
    tips: Floats  # (2n, 3) mm, two for each of n instruments: ends of its tines
    shafts: Floats  # (2n, 3) unit vectors from tip to hand
    camera: Camera | None = None  # the microscope, if not in its pose at rest; with the same lens
    power: float = 1.0  # of the lamps, relative to the rest frame


@dataclass(frozen=True)
class RenderedFrame:
    """One frame and its ground truth. Fields that are not in the job's `store.extra` are None."""

    rgb: npt.NDArray[np.uint8]
    """(H, W, 3) sRGB."""
    radiance: Map
    """(H, W, 3) linear, before the sensor."""
    flow: Map
    """(H, W, 2) px from the rest frame to this one, at rest pixels; 0 off the tissue."""
    visible: Mask
    """(H, W) whether the rest pixel's material point is visible in this frame."""
    depth: Map
    """(H, W) mm along the optical axis; 0 where there is nothing."""
    tool: Mask
    """(H, W) this frame's pixels."""
    glare: Mask
    """(H, W) this frame's pixels: a specular highlight hides the tissue."""
    flow_next: Map | None = None
    """(H, W, 2) px from this frame to the next, at this frame's pixels; 0 off the tissue."""
    normals: Map | None = None
    """(H, W, 3) camera axes, this frame's pixels; 0 where there is nothing."""
    blur: Map | None = None
    """(H, W) px: radius of the circle of confusion, this frame's pixels."""
    rgb_right: npt.NDArray[np.uint8] | None = None
    flow_right: Map | None = None
    visible_right: Mask | None = None
    depth_right: Map | None = None
    motion: Map | None = None
    """(H, W, 3) mm from the rest frame to this one, camera axes, at rest pixels; with a right camera."""
    tool_right: Mask | None = None
    """(H, W) this frame's pixels of the right camera; with one."""


class Renderer:
    """Renderer of one scene. Every frame depends on its arguments alone.

    Args:
        surface: the cortex at rest.
        appearance: its appearance.
        camera: the microscope at rest.
        job: render settings, opening and photograph.
        gestures: kind of each instrument's gesture, for which a suitable instrument is shown.

    Raises:
        UserError: the variant cannot run here, or the photograph cannot be read.
    """

    def __init__(
        self,
        surface: CortexSurface,
        appearance: Appearance,
        camera: Camera,
        job: Job,
        gestures: Sequence[str] = ("pull",),
    ) -> None:
        forget()  # earlier renderers
        self.variant = pick(job.render.variant)
        self.surface, self.camera = surface, camera
        self._appearance, self._render, self._extra = appearance, job.render, job.store.extra
        self._rim = rim.build(surface, job.anatomy.craniotomy.radius_mm, appearance, camera.mm_per_px)
        self._coat = texture.cortex(
            surface,
            appearance,
            texture.resolution(surface.chart.extent_mm, camera.mm_per_px),
            job.appearance.photo,
            rim.shade(self._rim, surface),
        )
        hand = np.random.default_rng([appearance.rim_seed, 2])
        kinds = instrument.choose(gestures if job.render.tool else (), hand)
        self._tool = instrument.build(kinds, instrument.finish(kinds, hand))
        """Empty where the job shows no instruments."""
        self._blade = self._retractor()
        rest = Shape(surface.vertices, surface.faces)
        self._static = joined(self._rim.shape, self._blade)
        """Rim and retractor, which never move."""
        self.rest = truth.trace_rest(camera, rest, self._static)
        self.right: Camera | None = None
        """The right camera at rest, if the job has one."""
        self._right_rest: RestFrame | None = None
        if job.render.stereo_mm:
            self.right = right_camera(camera, job.render.stereo_mm)
            self._right_rest = truth.trace_rest(self.right, rest, self._static)
        self.lamps = light.lamps(camera, appearance.light)
        dull = np.full(len(self._blade.vertices), _DULL, np.float32)
        self._coating = np.concatenate([self._tool.coat, dull])
        """(V,) of `_steel`: 0 polished, 1 coated black, in between dull."""
        self._theatre = self._surroundings()
        self._stage: Stage | None = None

    def render(
        self,
        state: SceneState,
        seed: int,
        shutter: Sequence[SceneState] = (),
        after: SceneState | None = None,
    ) -> RenderedFrame:
        """Picture and ground truth of one frame.

        Args:
            state: the scene at the frame's time, for the ground truth.
            seed: of light paths and sensor noise.
            shutter: states while the shutter is open, over which the picture averages; `state` if none.
            after: the next frame's state, for the flow to it.
        """
        camera = state.camera or self.camera
        radiance, radiance_right = self._gathered(shutter or (state,), seed)
        shapes = (Shape(state.vertices, self.surface.faces), self._static, self._posed(state))
        own = truth.trace_frame(camera, self.rest, *shapes)
        extra: dict[str, Any] = {}
        if "flow_next" in self._extra:
            there = after or state
            extra["flow_next"] = truth.forward_flow(
                own.hits, self.surface.faces, there.vertices, there.camera or self.camera
            )
        if "normals" in self._extra:
            extra["normals"] = truth.normal_map(camera, own.hits, shapes)
        if "blur" in self._extra:
            extra["blur"] = blur_radius(camera, own.depth)
        if self._right_rest is not None:
            lens = right_camera(camera, self._render.stereo_mm)
            other = truth.trace_frame(lens, self._right_rest, *shapes)
            picture = self.develop(radiance_right, seed + 1)
            extra |= {"rgb_right": picture, "flow_right": other.flow, "visible_right": other.visible}
            extra |= {"depth_right": other.depth, "tool_right": other.tool, "motion": own.motion}
        return RenderedFrame(
            rgb=self.develop(radiance, seed),
            radiance=radiance,
            flow=own.flow,
            visible=own.visible,
            depth=own.depth,
            tool=own.tool,
            glare=self._glare(radiance, own.hits, state),
            **extra,
        )

    def disparity(self) -> Map:
        """Rest disparity (H, W) px without distortion, see `synth.fields`; 0 off the tissue.

        Raises:
            ValueError: the job has no right camera.
        """
        if self.right is None:
            raise ValueError("the job is monocular")
        width, height = self.camera.size
        depth = self.rest.points[:, 2].reshape(height, width)
        shift = self.right.K[0, 2] - self.camera.K[0, 2]
        away = np.where(self.rest.tissue, depth, 1.0)
        wide = self.camera.K[0, 0] * self._render.stereo_mm / away - shift
        return np.where(self.rest.tissue, wide, 0.0).astype(np.float32)

    def traction(self, nodal: Floats) -> Map:
        """Traction (V, 3) kPa, world axes, at rest pixels: (H, W, 3) kPa, camera axes; 0 off tissue."""
        return truth.at_rest_pixels(self.rest, self.surface.faces, nodal @ self.camera.rotation.T)

    def stage(self, state: SceneState, spp: int, integrator: str = "direct") -> Stage:
        """A Mitsuba stage of a state, with bodies `cortex`, `rim` and `tool`."""
        return Stage(self.variant, self.camera, self._bodies(state), self.lamps, spp, integrator)

    def move(self, stage: Stage, state: SceneState) -> None:
        """Moves a stage to another state."""
        stage.move("cortex", state.vertices, film=self._film(state))
        if self._tool.parts:
            steel = self._steel(state)
            stage.move("tool", steel.vertices, glow=self._mirrored(steel))

    def develop(self, radiance: Map, seed: int) -> npt.NDArray[np.uint8]:
        """The recorded picture (H, W, 3) of a radiance (H, W, 3)."""
        return camera_sensor.record(radiance, self._appearance.sensor, np.random.default_rng([seed, 1]))

    def _posed(self, state: SceneState) -> Shape:
        return Shape(instrument.pose(self._tool, state.tips, state.shafts), self._tool.faces)

    def _film(self, state: SceneState) -> Floats:
        return instrument.film(self._tool, state.tips, state.vertices)

    def _gathered(self, states: Sequence[SceneState], seed: int) -> tuple[Map, Map]:
        """Mean radiance over some states in the camera and in the right one, which is 0 if there is none."""
        left: list[Map] = []
        right: list[Map] = []
        for k, state in enumerate(states):
            camera = state.camera or self.camera
            power = np.float32(state.power)
            if self._stage is None:
                self._stage = self.stage(state, self._render.spp)
            else:
                self.move(self._stage, state)
            left.append(power * self._expose(self._stage, camera, seed + 7919 * k))
            if self.right is not None:
                other = right_camera(camera, self._render.stereo_mm)
                right.append(power * self._expose(self._stage, other, seed + 1 + 7919 * k))
        return (
            np.asarray(np.mean(left, axis=0), np.float32),
            np.asarray(np.mean(right or np.zeros_like(left), axis=0), np.float32),
        )

    def _expose(self, stage: Stage, camera: Camera, seed: int) -> Map:
        spot = light.spot(camera, self.camera, self._appearance.light)
        return stage.render(seed % 2**32, camera) * spot[..., None]

    def _bodies(self, state: SceneState) -> dict[str, Body]:
        """All bodies of the scene with their materials."""
        surface, appearance = self.surface, self._appearance
        pixels = texture.resolution(self._rim.extent_mm, 2.2 * self.camera.mm_per_px)
        frame = rim.paint(self._rim, appearance, pixels)
        ambient = _AMBIENT * appearance.light.power * light.blackbody(appearance.light.kelvin)
        wet = Wet(self._coat, appearance.roughness, appearance.dry_roughness, ambient, appearance.fluid_index)
        dura = Wet(frame, _RIM_ROUGHNESS, _RIM_DRY, ambient)
        bodies = {
            "cortex": Body(state.vertices, surface.faces, surface.uv, wet, self._film(state)),
            "rim": Body(*self._rim.shape, self._rim.uv, dura),
        }
        if self._tool.parts or "retractor" in self._render.scenery:
            steel = self._steel(state)
            metal = Metal(reflection.tint(self._coating, _SATIN), glow=self._mirrored(steel))
            uv = np.zeros((len(steel.vertices), 2), np.float32)
            bodies["tool"] = Body(steel.vertices, steel.faces, uv, metal)
        return bodies

    def _retractor(self) -> Shape:
        """The blade over the rim; if there is no instrument either, an invisible face.

        A scene always has a mesh of steel with a face: with or without a retractor kernels are the same.
        """
        if "retractor" in self._appearance.scenery:
            points = np.concatenate([self.surface.vertices, self._rim.shape.vertices])
            return scenery.retractor(
                self._rim.edge, points, np.random.default_rng([self._appearance.rim_seed, 5])
            )
        if self._tool.parts:
            return Shape(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
        return Shape(np.full((3, 3), -1e3), np.array([[0, 1, 2]], np.int32))

    def _steel(self, state: SceneState) -> Shape:
        """All steel as one mesh, instruments first."""
        return joined(self._posed(state), self._blade)

    def _surroundings(self) -> reflection.Theatre:
        """Surroundings that steel mirrors: the cortex with the rim around it, coarse, and the lamps."""
        extent = self.surface.chart.extent_mm  # close enough to the projection for the finish
        small = cv2.resize(self._coat.albedo, (_MIRRORED_PX, _MIRRORED_PX), interpolation=cv2.INTER_AREA)
        axis = noise.centres(_MIRRORED_PX, extent)
        inside = rim.inside(self._rim, *np.meshgrid(axis, axis))[..., None]
        around = 0.5 * (
            np.asarray(self._appearance.dura_albedo) + np.asarray(self._appearance.surroundings_albedo)
        )
        wound = (small * inside + around.astype(np.float32) * (1 - inside)).astype(np.float32)
        lit = self._appearance.light.power * light.blackbody(self._appearance.light.kelvin)
        return reflection.Theatre(wound, extent, tuple(self.lamps), lit, self._appearance.rim_seed)

    def _mirrored(self, steel: Shape) -> Floats:
        return reflection.glow(steel, self._coating, self.camera.centre, self._theatre)

    def _glare(self, radiance: Map, hits: truth.Hits, state: SceneState) -> Mask:
        """Pixels (H, W) of tissue whose radiance exceeds what diffuse reflection can reach."""
        height, width = radiance.shape[:2]
        faces = self.surface.faces
        on = (hits.face >= 0) & (hits.face < len(faces))
        face, bary = hits.face[on], hits.bary[on]
        uv = truth.blend(faces, face, bary, self.surface.uv)
        albedo = noise.sample(self._coat.albedo, uv - 0.5, 1.0)
        light_in = truth.blend(faces, face, bary, state.power * self._irradiance(state.vertices))
        spot = light.spot(state.camera or self.camera, self.camera, self._appearance.light).ravel()[on]
        diffuse = spot * _mean(albedo * light_in)
        excess = _mean(radiance.reshape(-1, 3))[on] - 1.05 * diffuse
        glare = np.zeros(height * width, bool)
        glare[on] = excess * self._appearance.sensor.exposure > _GLARE
        return glare.reshape(height, width)

    def _irradiance(self, vertices: Floats) -> Floats:
        """Radiance (V, 3) of a white diffuser at each vertex, unshadowed."""
        normal = normals(Shape(vertices, self.surface.faces))
        total = np.zeros((len(vertices), 3))
        for lamp in self.lamps:
            _add_light(vertices, normal, lamp.position, lamp.intensity, total)
        return total


def _mean(colour: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Mean (N,) of colours (N, 3), in their type; over so short an axis `np.mean` takes ten times as long."""
    return np.asarray((colour[:, 0] + colour[:, 1] + colour[:, 2]) / colour.dtype.type(3))


@vectorised
def _add_light(vertices: Floats, normal: Floats, lamp: Floats, intensity: Floats, total: Floats) -> None:
    """Adds a white diffuser's radiance by a lamp at vertices to `total` (V, 3), in NumPy's order of sums."""
    for n in range(len(vertices)):
        x, y, z = lamp[0] - vertices[n, 0], lamp[1] - vertices[n, 1], lamp[2] - vertices[n, 2]
        distance = np.sqrt(x * x + y * y + z * z)
        facing = max((normal[n, 0] * x + normal[n, 2] * z + normal[n, 1] * y) / distance, 0.0)
        share = facing / (np.pi * (distance * distance))
        for k in range(3):
            total[n, k] += share * intensity[k]
