"""The renderer of one moving surface under the microscope: pictures and their ground truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from synth.arrays import Array, Floats, Map, Mask, Pixels
from synth.geometry.triangles import Shape, join_shapes, normals
from synth.render import truth
from synth.render.anatomy import noise
from synth.render.appearance import light
from synth.render.camera import camera_sensor
from synth.render.camera.camera import Camera, blur_radius, disparity
from synth.render.camera.camera_sensor import CameraSensor
from synth.render.content import SceneContent
from synth.render.materials import Body, FinishMaps, Metal, Wet, stack_maps
from synth.render.mitsuba.adapter import Stage, forget, pick
from synth.render.shadow import shadow_map
from synth.render.truth import RestFrame

Variant = Literal["auto", "llvm_ad_rgb", "scalar_rgb", "cuda_ad_rgb"]

_GLARE = 0.35  # specular radiance, as a share of full scale, that hides the tissue under it
_UNSHADED = 0.995  # share of the light from which on a contact's shadow is left out
_NOTHING = Shape(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
_TEXEL = [np.full((1, 1, *shape), 0.5, np.float32) for shape in ((3,), (), (2,), (), (3,), (3,))]
_NO_METAL = Metal(FinishMaps(*_TEXEL), np.zeros((3, 3)))
_OUT_OF_SIGHT = Body(
    np.eye(3) - 1e3,
    np.array([[0, 1, 2]], np.int32),
    np.zeros((3, 2), np.float32),
    _NO_METAL,
)


@dataclass(frozen=True)
class SceneState:
    """State of the scene at one time."""

    vertices: Floats
    """(V, 3) mm, the tissue's."""
    tips: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """(2n, 3) mm, two for each of n instruments: ends of its tines."""
    shafts: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """(2n, 3) unit vectors from tip to hand."""
    camera: Camera | None = None
    """The microscope, if not in its pose at rest; with the same lens."""
    power: float = 1.0
    """Of the lamps, relative to the rest frame."""


@dataclass(frozen=True, eq=False)
class _PlacedState:
    """A state with its instruments in their place, and what they do to the tissue that they touch."""

    state: SceneState
    posed: Shape
    film: Floats | None = None  # (V,) mm of liquid; None without instruments, as the next
    share: Floats | None = None  # (V,) of the light that they leave it


@dataclass(frozen=True)
class RenderedFrame:
    """One frame and its ground truth. Optional fields that the renderer was not asked for are None."""

    rgb: Pixels
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
    flow_next_all: Map | None = None
    """(H, W, 2) px, as `flow_next`, of tissue, instruments and all else; 0 where there is nothing."""
    normals: Map | None = None
    """(H, W, 3) camera axes, this frame's pixels; 0 where there is nothing."""
    blur: Map | None = None
    """(H, W) px: radius of the circle of confusion, this frame's pixels."""
    shadow: Map | None = None
    """(H, W) share of the lamps' direct light that instruments take, this frame's pixels."""
    instrument: Array | None = None
    """(H, W) uint8, this frame's pixels: 1 + number of the instrument; 0 for none."""
    rgb_right: Pixels | None = None
    flow_right: Map | None = None
    visible_right: Mask | None = None
    depth_right: Map | None = None
    shadow_right: Map | None = None
    instrument_right: Array | None = None
    motion: Map | None = None
    """(H, W, 3) mm from the rest frame to this one, camera axes, at rest pixels; with a right camera."""
    tool_right: Mask | None = None
    """(H, W) this frame's pixels of the right camera; with one."""


class Renderer:
    """Renderer of one scene. Every frame depends on its arguments alone.

    Args:
        content: what is drawn.
        camera: the microscope at rest.
        sensor: its chip and video processor.
        extra: names of optional fields of a `RenderedFrame` to fill.
        right: the right camera of the left one in any pose; none if None.
        spp: light paths per pixel.
        variant: of Mitsuba; `auto` is llvm_ad_rgb if LLVM works, else scalar_rgb.

    Raises:
        UserError: the variant cannot run here.
        ValueError: the tissue is of metal.
    """

    def __init__(
        self,
        content: SceneContent,
        camera: Camera,
        sensor: CameraSensor = CameraSensor(),
        extra: Sequence[str] = (),
        right: Callable[[Camera], Camera] | None = None,
        *,
        spp: int = 4,
        variant: Variant = "auto",
    ) -> None:
        forget()  # earlier renderers
        self.variant = pick(variant)
        self.content, self.camera = content, camera
        self._sensor, self._spp, self._extra = sensor, spp, extra
        if not isinstance(content.tissue.material, Wet):
            raise ValueError("the tissue's material must be Wet")
        self._wet = content.tissue.material
        self._static = join_shapes(_NOTHING, *(body.shape for body in content.static))
        metal = [(body, body.material) for body in content.static if isinstance(body.material, Metal)]
        # A face of metal at least, if out of sight: with and without instruments kernels are the same.
        self._static_metal = metal or (
            [] if content.instruments is not None else [(_OUT_OF_SIGHT, _NO_METAL)]
        )
        self.rest = truth.trace_rest(camera, content.tissue.shape, self._static)
        self.right: Camera | None = None
        """The right camera at rest, if there is one."""
        self._right_rest: RestFrame | None = None
        self._right_of = right
        if right is not None:
            self.right = right(camera)
            self._right_rest = truth.trace_rest(self.right, content.tissue.shape, self._static)
        self._stage: Stage | None = None

    def render(
        self,
        state: SceneState,
        seed: int,
        shutter: Sequence[SceneState] = (),
        after: SceneState | None = None,
    ) -> RenderedFrame:
        """Pixels and ground truth of one frame.

        `state`: the scene at the frame's time, for the ground truth; `seed`: of light paths and sensor noise;
        `shutter`: states while it is open, over which the picture averages, `state` if none; `after`: that of
        the next frame, for the flow to it.
        """
        camera = state.camera or self.camera
        placed = self._place(state)
        radiance, *right_radiances = self._gather([self._place(shot) for shot in shutter] or [placed], seed)
        faces = self.content.tissue.faces
        shapes = (Shape(state.vertices, faces), self._static, placed.posed)
        frame = truth.trace_frame(camera, self.rest, *shapes)
        radiance = self._shade(radiance, frame.hits, placed.share)
        extra: dict[str, Any] = {}
        if "flow_next" in self._extra:
            next_state = after or state
            next_camera = next_state.camera or self.camera
            extra["flow_next"] = truth.forward_flow(frame.hits, faces, next_state.vertices, next_camera)
        if "flow_next_all" in self._extra:
            next_state = after or state
            scene = join_shapes(
                Shape(next_state.vertices, faces), self._static, self._pose_instruments(next_state)
            )
            next_camera = next_state.camera or self.camera
            extra["flow_next_all"] = truth.forward_flow(frame.hits, scene.faces, scene.vertices, next_camera)
        if "normals" in self._extra:
            extra["normals"] = truth.normal_map(camera, frame.hits, shapes)
        if "blur" in self._extra:
            extra["blur"] = blur_radius(camera, frame.depth)
        extra |= self._shading(frame.hits, shapes, "")
        if self._right_of is not None and self._right_rest is not None:
            right = truth.trace_frame(self._right_of(camera), self._right_rest, *shapes)
            picture = self.develop(self._shade(right_radiances[0], right.hits, placed.share), seed + 1)
            extra |= {"rgb_right": picture, "flow_right": right.flow, "visible_right": right.visible}
            extra |= {"depth_right": right.depth, "tool_right": right.tool, "motion": frame.motion}
            extra |= self._shading(right.hits, shapes, "_right")
        return RenderedFrame(
            rgb=self.develop(radiance, seed),
            radiance=radiance,
            flow=frame.flow,
            visible=frame.visible,
            depth=frame.depth,
            tool=frame.tool,
            glare=self._glare(radiance, frame.hits, state),
            **extra,
        )

    def disparity(self) -> Map:
        """Rest disparity (H, W) px without distortion, see `synth.fields`; 0 off the tissue.

        Raises:
            ValueError: there is no right camera.
        """
        if self.right is None:
            raise ValueError("the scene is monocular")
        tissue, disparity_px = self.rest.tissue, np.zeros(self.rest.tissue.shape, np.float32)
        disparity_px[tissue] = disparity(self.camera, self.right, self.rest.points[tissue.ravel()])
        return disparity_px

    def traction(self, nodal: Floats) -> Map:
        """Traction (V, 3) kPa, world axes, at rest pixels: (H, W, 3) kPa, camera axes; 0 off tissue."""
        return truth.at_rest_pixels(self.rest, self.content.tissue.faces, nodal @ self.camera.rotation.T)

    def stage(self, state: SceneState, spp: int, integrator: str = "direct") -> Stage:
        """A Mitsuba stage of a state: bodies `tissue`, `metal`, and `static0` onwards."""
        return self._set_stage(self._place(state), spp, integrator)

    def _set_stage(self, placed: _PlacedState, spp: int, integrator: str = "direct") -> Stage:
        vertices = placed.state.vertices
        tissue = self.content.tissue
        if (hidden := self.content.hidden) is not None:
            tissue = replace(tissue, faces=tissue.faces[~hidden])
        bodies = {"tissue": replace(tissue, vertices=vertices, film=placed.film)}
        wet_bodies = (body for body in self.content.static if isinstance(body.material, Wet))
        bodies |= {f"static{k}": body for k, body in enumerate(wet_bodies)}
        shape, glow = self._metal(placed.posed)
        textures = [(body.uv, metal.maps) for body, metal in self._static_metal]
        if (instruments := self.content.instruments) is not None:
            textures.insert(0, (instruments.uv, instruments.maps))
        uv, maps = stack_maps(textures)
        bodies["metal"] = Body(*shape, uv, Metal(maps, glow))
        return Stage(self.variant, self.camera, bodies, self.content.lamps, spp, integrator)

    def move(self, stage: Stage, state: SceneState) -> None:
        """Moves a stage to another state."""
        self._move(stage, self._place(state))

    def _move(self, stage: Stage, placed: _PlacedState) -> None:
        stage.move("tissue", placed.state.vertices, film=placed.film)
        if self.content.instruments is not None:
            shape, glow = self._metal(placed.posed)
            stage.move("metal", shape.vertices, glow=glow)

    def develop(self, radiance: Map, seed: int) -> Pixels:
        """The recorded picture (H, W, 3) of a radiance (H, W, 3)."""
        return camera_sensor.record(radiance, self._sensor, np.random.default_rng([seed, 1]))

    def _pose_instruments(self, state: SceneState) -> Shape:
        """The instruments."""
        instruments = self.content.instruments
        return _NOTHING if instruments is None else instruments.pose(state.tips, state.shafts)

    def _shading(self, hits: truth.Hits, shapes: Sequence[Shape], camera: str) -> dict[str, Array]:
        """Optional fields of instruments and shadows at a camera's hits of shapes, instruments last."""
        arrays: dict[str, Array] = {}
        if (name := f"shadow{camera}") in self._extra:
            arrays[name] = shadow_map(hits, shapes, self.content.lamps, self.camera.size)
        if (name := f"instrument{camera}") in self._extra:
            instruments, size = self.content.instruments, self.camera.size[::-1]
            owner = np.zeros(0, int) if instruments is None else instruments.owner
            first = sum(len(shape.faces) for shape in shapes[:-1])
            number = np.concatenate([np.zeros(first, np.uint8), (owner + 1).astype(np.uint8), [np.uint8(0)]])
            arrays[name] = number[hits.face].reshape(size)  # the last one is that of no hit, face -1
        return arrays

    def _place(self, state: SceneState) -> _PlacedState:
        posed, instruments = self._pose_instruments(state), self.content.instruments
        if instruments is None:
            return _PlacedState(state, posed)
        return _PlacedState(state, posed, *instruments.touch(posed, state.vertices))

    def _shade(self, radiance: Map, hits: truth.Hits, shade: Floats | None) -> Map:
        """The radiance (H, W, 3) less the light that contacts take from the tissue.

        Light that would have come to there by scattering in tissue and between tissue and steel, of which the
        renderer has none but a blurred albedo.
        """
        if shade is None or shade.min() >= _UNSHADED:
            return radiance
        faces = self.content.tissue.faces
        # Of the pixels on tissue, those on a face with a shaded corner.
        is_shaded = np.append((shade < _UNSHADED)[faces].any(axis=1), False)
        pixels = np.flatnonzero(is_shaded[np.where(hits.face < len(faces), hits.face, -1)])
        share = truth.blend(faces, hits.face[pixels], hits.bary[pixels], shade[:, None])
        result = radiance.reshape(-1, 3).copy()
        result[pixels] *= share.astype(np.float32)
        return result.reshape(radiance.shape)

    def _gather(self, states: Sequence[_PlacedState], seed: int) -> list[Map]:
        """Mean radiance over some states, in the camera and in the right one if there is one."""
        shots: list[list[Map]] = []
        for k, placed in enumerate(states):
            state = placed.state
            if self._stage is None:
                self._stage = self._set_stage(placed, self._spp)
            else:
                self._move(self._stage, placed)
            cameras = [state.camera or self.camera]
            if self._right_of is not None:
                cameras.append(self._right_of(cameras[0]))
            shots.append([])
            for side, camera in enumerate(cameras):
                radiance = self._stage.render((seed + side + 7919 * k) % 2**32, camera)
                shots[-1].append(np.float32(state.power) * (radiance * self._spot(camera)[..., None]))
        return [np.asarray(np.mean(exposures, axis=0), np.float32) for exposures in zip(*shots, strict=True)]

    def _spot(self, camera: Camera) -> Map:
        if camera is self.camera:
            return self._spot_at_rest
        return light.spot(camera, self.camera, self.content.spot)

    @cached_property
    def _spot_at_rest(self) -> Map:
        return light.spot(self.camera, self.camera, self.content.spot)

    def _metal(self, posed: Shape) -> tuple[Shape, Floats]:
        """All metal as one mesh, instruments first, and the surroundings (V, 3) that it mirrors."""
        parts = [(body.shape, metal.glow) for body, metal in self._static_metal]
        if (instruments := self.content.instruments) is not None:
            parts.insert(0, (posed, instruments.glow(posed)))
        return join_shapes(*(shape for shape, _ in parts)), np.concatenate([glow for _, glow in parts])

    def _glare(self, radiance: Map, hits: truth.Hits, state: SceneState) -> Mask:
        """Pixels (H, W) of tissue whose radiance exceeds what diffuse reflection can reach."""
        height, width = radiance.shape[:2]
        tissue = self.content.tissue
        level = _mean(radiance.reshape(-1, 3)) * self._sensor.exposure
        # Of darker pixels, which are most, the diffuse part doesn't matter.
        pixels = np.flatnonzero((hits.face >= 0) & (hits.face < len(tissue.faces)) & (level > _GLARE))
        face, bary = hits.face[pixels], hits.bary[pixels]
        uv = truth.blend(tissue.faces, face, bary, tissue.uv)
        albedo = noise.sample(self._wet.maps.albedo, uv - 0.5, 1.0)
        normal = normals(Shape(state.vertices, tissue.faces))
        irradiance = np.zeros((len(normal), 3))  # as radiance of a white diffuser at vertices, unshadowed
        for lamp in self.content.lamps:
            ray = lamp.position - state.vertices
            distance2 = np.einsum("vc,vc->v", ray, ray)
            facing = np.maximum(np.einsum("vc,vc->v", normal, ray) / np.sqrt(distance2), 0)
            irradiance += (facing / (np.pi * distance2))[:, None] * lamp.intensity
        light_in = truth.blend(tissue.faces, face, bary, state.power * irradiance)
        spot = self._spot(state.camera or self.camera).ravel()[pixels]
        diffuse = spot * _mean(albedo * light_in)
        glare = np.zeros(height * width, bool)
        glare[pixels] = level[pixels] - 1.05 * self._sensor.exposure * diffuse > _GLARE
        return glare.reshape(height, width)


def _mean(colour: Array) -> Array:
    """Mean (N,) of colours (N, 3), in their type; over so short an axis `np.mean` takes ten times as long."""
    return np.asarray((colour[:, 0] + colour[:, 1] + colour[:, 2]) / colour.dtype.type(3))
