"""A stage of meshes, lamps and a camera in Mitsuba; vertices are moved in place.

Only this package imports Mitsuba. The variant is chosen on first use; `synth.system.llvm` finds its LLVM,
since an unsuitable one would crash the process.
"""

from __future__ import annotations

import ctypes
import functools
import gc
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import cv2
import numpy as np

from synth.arrays import Array, Floats, Indices, Map
from synth.errors import UserError
from synth.geometry.triangles import Shape, normals
from synth.render.camera.camera import Camera
from synth.render.materials import Body, Lamp, Metal, Wet, read_map
from synth.render.mitsuba.direct_light import trace
from synth.render.mitsuba.edge_filter import soften
from synth.render.mitsuba.lens import Compiled, Scalar
from synth.system import cache, gpu, llvm

_REGISTER = 64  # bytes of a vector register
_LACQUER = 1.7  # refractive index of coats, glossier than plain plastic's 1.5
_GLOSS = 0.88  # of a liquid's surface, as of `principled`
_LAMPS = 2, 6, 12  # numbers of lamps, each with a kernel of its own


def pick(variant: str) -> str:
    """The variant to use on this machine for `render.variant`; UserError: the machine cannot run it."""
    if variant == "scalar_rgb":
        return variant
    # All scenes of a job share kernels; by default Dr.Jit would cache them in the user's home without limit.
    with suppress(OSError):  # no writable folder: compiled anew in every process
        os.environ.setdefault("DRJIT_CACHE_DIR", str(cache.folder("kernels")))
    os.environ.setdefault("DRJIT_CACHE_MAXSIZE", str(cache.LIMIT_BYTES))
    if variant == "cuda_ad_rgb":
        if reason := gpu.obstacle(gpu.probe()):
            raise UserError(f"render.variant: cuda_ad_rgb: {reason}")
        return variant
    library = llvm.find()
    if library is None:
        if variant == "llvm_ad_rgb":
            raise UserError("render.variant: llvm_ad_rgb needs libLLVM 17 or newer (Debian: libllvm19)")
        return "scalar_rgb"
    os.environ["DRJIT_LIBLLVM_PATH"] = library
    return "llvm_ad_rgb"


class Stage:
    """One Mitsuba scene."""

    def __init__(
        self,
        variant: str,
        camera: Camera,
        bodies: dict[str, Body],
        lamps: Sequence[Lamp],
        spp: int,
        integrator: str = "direct",
    ) -> None:
        import mitsuba as mi

        mi.set_variant(variant)
        self._jit = "scalar" not in variant
        if self._jit:
            _register_glow(variant)
        if threads := os.environ.get("SULCUS_THREADS"):  # where several workers share a machine
            import drjit as dr

            dr.set_thread_count(int(threads))
        self.variant = variant
        self._bodies = bodies
        scene: dict[str, Any] = {
            "type": "scene",
            # A GPU may sort paths by what they hit, which changes the order of sums and so their last bits.
            "allow_thread_reordering": False,
        }
        if integrator == "direct":
            # Lamps are small: directions sampled from a surface's scattering hardly ever hit one.
            scene["integrator"] = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}
        else:
            scene["integrator"] = {"type": "path", "max_depth": int(integrator.removeprefix("path"))}
        scene |= {f"lamp{index}": _lamp(mi, lamp) for index, lamp in enumerate(lamps)}
        # Lamps that are hardly ever sampled and emit nothing: their number is compiled into the kernel.
        count = next((size for size in _LAMPS if size >= len(lamps)), len(lamps))
        scene |= {f"lamp{index}": _lamp(mi, lamps[0], 1e-6) for index in range(len(lamps), count)}
        scene |= {name: _mesh(mi, name, body) for name, body in bodies.items()}
        self._lens = (Compiled if self._jit else Scalar)(camera, spp)
        self._layered, self._size = self._jit and integrator == "direct", camera.size
        self._mm_per_px = camera.mm_per_px
        self._scene = mi.load_dict(scene)
        self._parameters = mi.traverse(self._scene)

    def move(
        self, name: str, vertices: Floats, *, film: Floats | None = None, glow: Floats | None = None
    ) -> None:
        """Moves a body's vertices (V, 3) mm; `film` and `glow` as of `Body` and `Metal`."""
        import mitsuba as mi

        attributes = {
            "positions": vertices,
            "normals": _film_normals(vertices, self._bodies[name].faces, film),
        }
        if glow is not None:
            attributes["glow"] = _mirror_glow(mi, self._bodies[name], glow)
        for key, values in attributes.items():
            flat = _align(values, np.float32)
            self._parameters[f"{name}.vertex_{key}"] = mi.Float(flat) if self._jit else flat

    def render(self, seed: int, camera: Camera | None = None) -> Map:
        """Linear radiance (H, W, 3) float32 of the stage as it is, from a camera with the same lens."""
        self._parameters.update()
        if camera is not None:
            self._lens.place(camera)
        lens = self._lens
        if self._layered:
            light = trace(self._scene, lens.sensor, self._size, "metal", lens.spp, seed)
            radiance = soften(light, lens.spp, self._mm_per_px)
        else:
            import mitsuba as mi

            image = mi.render(self._scene, sensor=lens.sensor, spp=lens.spp, seed=seed)
            radiance = lens.develop(np.array(image, dtype=np.float32)[..., :3])
        if self.variant.startswith("llvm"):
            # Memory goes back after each frame: allocating anew is cheap on a CPU, unlike on a GPU.
            import drjit as dr

            dr.flush_malloc_cache()
        return radiance


def forget() -> None:
    """Frees the memory of deleted stages, whose Python plugins and scenes refer to each other."""
    gc.collect()
    _freeze_modules()
    if "drjit" in sys.modules:
        import drjit as dr

        dr.flush_malloc_cache()
    # glibc would hold free pages after maps are painted.
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
        trim(0)


@functools.cache
def _freeze_modules() -> None:
    """Excludes objects older than the first stage from later collections, which saves 0.15 CPU-s each."""
    gc.freeze()


@functools.cache
def _register_glow(variant: str) -> None:
    """Registers an emitter `sulcus_glow` that is visible but never sampled, in one compiled variant.

    With a texture `mirror` it is a surface of that reflectance in which the radiance is seen.

    Mitsuba's own area light with a sampling weight of 0 is not sampled either, but its sampling would still
    be compiled, with the mesh's number of faces in the code, which takes a kernel for every scene.
    """
    import drjit as dr
    import mitsuba as mi

    class Glow(mi.Emitter):
        """An emitter of a texture's radiance to the side of the normals."""

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.radiance = props["radiance"]
            self.mirror = props.get("mirror", None)
            self.m_flags = mi.EmitterFlags.Surface | mi.EmitterFlags.SpatiallyVarying

        def eval(self, si: Any, active: Any = True) -> Any:
            radiance = self.radiance.eval(si, active)
            if self.mirror is not None:
                radiance *= self.mirror.eval(si, active)
            return dr.select(mi.Frame3f.cos_theta(si.wi) > 0, radiance, 0)

        def sample_direction(self, it: Any, sample: Any, active: Any = True) -> tuple[Any, Any]:
            return dr.zeros(mi.DirectionSample3f), dr.zeros(mi.Color3f)

        def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return mi.Float(0)

        def eval_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return mi.Color3f(0)

        def bbox(self) -> Any:
            return self.get_shape().bbox()

        def traverse(self, callback: Any) -> None:
            callback.put("radiance", self.radiance, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return "SulcusGlow[]"

    mi.register_emitter("sulcus_glow", Glow)


def _lamp(mi: Any, lamp: Lamp, weight: float = 1.0) -> dict[str, Any]:
    direction = lamp.target - lamp.position
    up = [0.0, 1.0, 0.0] if abs(direction[1]) < 0.9 * np.linalg.norm(direction) else [1.0, 0.0, 0.0]
    to_world = mi.ScalarTransform4f().look_at(lamp.position.tolist(), lamp.target.tolist(), up)
    to_world = to_world @ mi.ScalarTransform4f().scale([lamp.radius, lamp.radius, 1.0])
    value = (lamp.intensity * (weight == 1) / (np.pi * lamp.radius**2)).tolist()
    # Equal weights: each lamp has half of a pixel's strata, and the choice makes no noise.
    light = {"type": "area", "radiance": {"type": "rgb", "value": value}, "sampling_weight": weight}
    return {"type": "disk", "to_world": to_world, "light": light}


def _mesh(mi: Any, name: str, body: Body) -> Any:
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(_material(mi, body.material))
    # Light that is not of a lamp: reflections of metal, ambient light on tissue.
    # Visible, but never sampled as a lamp, since its weight is 0.
    emitter: dict[str, Any] = {"type": "sulcus_glow", "sampling_weight": 0.0}
    if isinstance(body.material, Metal):
        emitter["radiance"] = {"type": "mesh_attribute", "name": "vertex_glow"}
        emitter["mirror"] = _bitmap(mi, body.material.maps.mirror)
    else:
        albedo = cv2.resize(body.material.maps.albedo, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        emitter["radiance"] = _bitmap(mi, albedo * np.asarray(body.material.ambient, np.float32))
    if "scalar" in mi.variant():
        emitter = {"type": "area", "radiance": emitter["radiance"], "sampling_weight": 0.0}
    properties["glow"] = mi.load_dict(emitter)
    options = {"has_vertex_normals": True, "has_vertex_texcoords": True, "props": properties}
    mesh = mi.Mesh(name, vertex_count=len(body.vertices), face_count=len(body.faces), **options)
    if isinstance(body.material, Metal):
        mesh.add_attribute("vertex_glow", 3, _align(_mirror_glow(mi, body, body.material.glow), np.float32))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = _align(body.vertices, np.float32)
    parameters["vertex_normals"] = _align(_film_normals(body.vertices, body.faces, body.film), np.float32)
    parameters["faces"] = _align(body.faces, np.uint32)
    parameters["vertex_texcoords"] = _align(body.uv, np.float32)
    parameters.update()
    return mesh


def _mirror_glow(mi: Any, body: Body, glow: Floats) -> Floats:
    """The radiance (V, 3) of a metal body's `vertex_glow`: that mirrored, which the scalar variant's own area
    light takes at vertices as by the maps there."""
    if "scalar" not in mi.variant() or not isinstance(body.material, Metal):
        return glow
    return np.asarray(glow * read_map(body.material.maps.mirror, body.uv))


def _film_normals(vertices: Floats, faces: Indices, film: Floats | None) -> Floats:
    """Unit normals (V, 3) of a mesh under a film of heights (V,) mm."""
    if film is not None:
        vertices = vertices.copy()
        vertices[:, 2] += film
    return normals(Shape(vertices, faces))


def _align(values: Array, kind: type[np.generic]) -> Array:
    """The values as one row of a type, in memory aligned to vector registers.

    Dr.Jit uses NumPy's memory in place, and compiles separate kernels for aligned and unaligned arrays.
    """
    size = values.size * np.dtype(kind).itemsize
    buffer = np.empty(size + _REGISTER, np.uint8)
    start = -buffer.ctypes.data % _REGISTER
    flat = buffer[start : start + size].view(kind)
    flat[:] = values.ravel()
    return flat


def _material(mi: Any, material: Wet | Metal) -> dict[str, Any]:
    if isinstance(material, Metal):
        maps, (along, across) = material.maps, np.moveaxis(material.maps.rough, -1, 0)
        # B. Burley, "Physically based shading at Disney", 2012: a conductor where metallic, of
        # alpha = roughness^2 / aspect along and roughness^2 aspect across; aspect^2 = 1 - 0.9 anisotropic.
        steel: dict[str, Any] = {"type": "principled", "base_color": _bitmap(mi, maps.base)}
        steel |= {"metallic": _bitmap(mi, maps.bare), "roughness": _bitmap(mi, (along * across) ** 0.25)}
        steel |= {"anisotropic": _bitmap(mi, (1 - across / along) / 0.9)}
        steel |= {"clearcoat": _bitmap(mi, maps.wet), "clearcoat_gloss": _GLOSS, "eta": _LACQUER}
        encoded_normals = maps.normal * np.float32(0.5) + np.float32(0.5)
        normal_map = {"type": "normalmap", "normalmap": _bitmap(mi, encoded_normals), "steel": steel}
        return {"type": "twosided", "bent": normal_map}
    encoded_normals = material.maps.normal * np.float32(0.5) + np.float32(0.5)
    albedo = mi.load_dict(_bitmap(mi, material.maps.albedo))  # shared by both coats
    plastic = {"type": "roughplastic", "distribution": "ggx", "nonlinear": True}
    plastic |= {"diffuse_reflectance": albedo, "int_ior": material.index}
    film = {"type": "blendbsdf", "weight": _bitmap(mi, material.maps.dry)}
    film |= {"smooth": plastic | {"alpha": material.roughness}}
    film |= {"rough": plastic | {"alpha": material.dry_roughness}}
    normal_map = {"type": "normalmap", "normalmap": _bitmap(mi, encoded_normals), "film": film}
    return {"type": "twosided", "bent": normal_map}


def _bitmap(mi: Any, image: Map) -> dict[str, Any]:
    texels = image.reshape(*image.shape[:2], -1)
    source: dict[str, Any]
    if "scalar" in mi.variant():
        source = {"bitmap": mi.Bitmap(np.ascontiguousarray(texels, np.float32))}
    else:  # in place, in a quarter of the time: a bitmap is copied and converted first
        source = {"data": mi.TensorXf(_align(texels, np.float32).reshape(texels.shape))}
    # Not `accel`: a GPU's texture units interpolate with 8 bits of fraction.
    options = {"raw": True, "filter_type": "bilinear", "wrap_mode": "clamp", "accel": False}
    return {"type": "bitmap", **source, **options}
