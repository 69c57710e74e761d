"""The one file that knows Mitsuba. A stage of meshes, lamps and a camera; vertices are moved in place.

Mitsuba's variant is chosen on first use and its LLVM found by `synth.llvm`: a wrong one ends the process.
"""

from __future__ import annotations

import functools
import os
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from synth import llvm
from synth.errors import UserError
from synth.render.camera import Camera

Floats = npt.NDArray[np.float64]
Map = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Wet:
    """A diffuse body under a wet coat."""

    albedo: Map
    """(n, n, 3) linear reflectance."""
    normal: Map
    """(n, n, 3) unit normals in the surface's own frame."""
    roughness: float
    """GGX alpha of the coat."""
    index: float = 1.38
    """Refractive index of the coat."""


@dataclass(frozen=True)
class Metal:
    """A brushed conductor."""

    reflectance: tuple[float, float, float]
    along: float
    """GGX alpha along the brushing (the first texture axis)."""
    across: float
    satin: float
    """Share of light that the finish scatters evenly."""


@dataclass(frozen=True)
class Body:
    """A mesh and what it is made of."""

    vertices: Floats
    """(V, 3) mm."""
    faces: npt.NDArray[np.int32]
    uv: npt.NDArray[np.float32]
    material: Wet | Metal


@dataclass(frozen=True)
class Lamp:
    """A spot light."""

    position: Floats
    """(3,) mm."""
    target: Floats
    """(3,) mm."""
    intensity: tuple[float, float, float]
    """Radiant intensity, linear RGB."""
    cutoff_deg: float
    """Half angle where its light ends."""
    beam_deg: float
    """Half angle inside which it is even."""


def pick(asked: str) -> str:
    """The variant that `asked` stands for on this machine.

    Raises:
        UserError: the machine cannot run the one asked for.
    """
    if asked == "scalar_rgb":
        return asked
    if asked == "cuda_ad_rgb":
        if not cuda():
            raise UserError("render.variant: cuda_ad_rgb needs an NVIDIA GPU and its driver; none was found")
        return asked
    found = llvm.find()
    if found is None:
        if asked == "llvm_ad_rgb":
            raise UserError("render.variant: llvm_ad_rgb needs libLLVM 17 or newer (Debian: libllvm19)")
        return "scalar_rgb"
    os.environ["DRJIT_LIBLLVM_PATH"] = found
    return "llvm_ad_rgb"


@functools.cache
def cuda() -> bool:
    """Whether an NVIDIA driver with a device is there."""
    import ctypes

    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    count = ctypes.c_int(0)
    return driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0 and count.value > 0


class Stage:
    """One Mitsuba scene."""

    def __init__(
        self,
        variant: str,
        camera: Camera,
        bodies: dict[str, Body],
        lamps: list[Lamp],
        ambient: tuple[float, float, float],
        spp: int,
        integrator: str = "direct",
        sampler: str = "multijitter",
    ) -> None:
        import mitsuba as mi

        mi.set_variant(variant)
        _register(variant)
        _limit_threads()
        self.variant = variant
        self._mi = mi
        self._spp = spp
        self._jit = "scalar" not in variant
        scene: dict[str, Any] = {
            "type": "scene",
            "integrator": _integrator(integrator),
            "ambient": {"type": "constant", "radiance": {"type": "rgb", "value": list(ambient)}},
        }
        for index, lamp in enumerate(lamps):
            scene[f"lamp{index}"] = _lamp(mi, lamp)
        for name, body in bodies.items():
            scene[name] = _mesh(mi, name, body)
        self._sensor = mi.load_dict(_lens(camera, spp, sampler))
        self._scene = mi.load_dict(scene)
        self._parameters = mi.traverse(self._scene)

    def move(self, name: str, vertices: Floats) -> None:
        """New positions (V, 3) mm of a body's vertices."""
        key = f"{name}.vertex_positions"
        self._parameters[key] = (
            self._mi.Float(vertices.astype(np.float32).ravel())
            if self._jit
            else (vertices.astype(np.float32).ravel())
        )

    def render(self, seed: int) -> Map:
        """Linear radiance (H, W, 3) float32 of the stage as it stands."""
        self._parameters.update()
        image = self._mi.render(self._scene, sensor=self._sensor, spp=self._spp, seed=seed)
        return np.array(image, dtype=np.float32)[..., :3]


def _limit_threads() -> None:
    """Workers that share a machine say how many threads each may take."""
    threads = os.environ.get("SULCUS_THREADS")
    if threads:
        import drjit as dr

        dr.set_thread_count(int(threads))


def _integrator(kind: str) -> dict[str, Any]:
    if kind == "direct":
        return {"type": "direct", "emitter_samples": 1, "bsdf_samples": 1}
    return {"type": "path", "max_depth": int(kind.removeprefix("path"))}


def _lamp(mi: Any, lamp: Lamp) -> dict[str, Any]:
    towards = lamp.target - lamp.position
    up = [0.0, 1.0, 0.0] if abs(towards[1]) < 0.9 * np.linalg.norm(towards) else [1.0, 0.0, 0.0]
    return {
        "type": "spot",
        "to_world": mi.ScalarTransform4f().look_at(
            origin=lamp.position.tolist(), target=lamp.target.tolist(), up=up
        ),
        "intensity": {"type": "rgb", "value": list(lamp.intensity)},
        "cutoff_angle": lamp.cutoff_deg,
        "beam_width": lamp.beam_deg,
        "sampling_weight": float(sum(lamp.intensity)),
    }


def _mesh(mi: Any, name: str, body: Body) -> Any:
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(_material(mi, body.material))
    mesh = mi.Mesh(
        name,
        vertex_count=len(body.vertices),
        face_count=len(body.faces),
        has_vertex_normals=True,
        has_vertex_texcoords=True,
        props=properties,
    )
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = body.vertices.astype(np.float32).ravel()
    parameters["faces"] = body.faces.astype(np.uint32).ravel()
    parameters["vertex_texcoords"] = body.uv.astype(np.float32).ravel()
    parameters.update()
    return mesh


def _material(mi: Any, material: Wet | Metal) -> dict[str, Any]:
    if isinstance(material, Metal):
        return {
            "type": "twosided",
            "satin": {
                "type": "blendbsdf",
                "weight": material.satin,
                "brushed": {
                    "type": "roughconductor",
                    "material": "none",
                    "distribution": "ggx",
                    "alpha_u": material.along,
                    "alpha_v": material.across,
                    "specular_reflectance": {"type": "rgb", "value": list(material.reflectance)},
                },
                "scattered": {
                    "type": "diffuse",
                    "reflectance": {"type": "rgb", "value": list(material.reflectance)},
                },
            },
        }
    encoded = material.normal * np.float32(0.5) + np.float32(0.5)
    return {
        "type": "twosided",
        "bent": {
            "type": "normalmap",
            "normalmap": _bitmap(mi, encoded),
            "coat": {
                "type": "roughplastic",
                "distribution": "ggx",
                "diffuse_reflectance": _bitmap(mi, material.albedo),
                "alpha": material.roughness,
                "int_ior": material.index,
                "nonlinear": True,
            },
        },
    }


def _bitmap(mi: Any, image: Map) -> dict[str, Any]:
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(image, np.float32)),
        "raw": True,
        "filter_type": "bilinear",
        "wrap_mode": "clamp",
    }


def _lens(camera: Camera, spp: int, sampler: str) -> dict[str, Any]:
    width, height = camera.size
    lens: dict[str, Any] = {
        "type": "sulcus_lens",
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
            "component_format": "float32",
        },
        "sampler": {"type": sampler, "sample_count": spp},
        "aperture": camera.aperture_mm,
        "focus": camera.focus_mm,
    }
    for row in range(3):
        for column in range(3):
            lens[f"r{row}{column}"] = float(camera.rotation[row, column])
        lens[f"c{row}"] = float(camera.centre[row])
    for name, value in zip(("k1", "k2", "p1", "p2", "k3"), camera.distortion, strict=True):
        lens[name] = float(value)
    lens |= {"fx": float(camera.K[0, 0]), "fy": float(camera.K[1, 1])}
    lens |= {"cx": float(camera.K[0, 2]), "cy": float(camera.K[1, 2])}
    return lens


@functools.cache
def _register(variant: str) -> None:
    """Makes the thin lens with Brown-Conrady distortion known to one variant."""
    import drjit as dr
    import mitsuba as mi

    class Lens(mi.Sensor):
        """`camera.rays` for film samples, with a lens of some width."""

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.v = {name: props[name] for name in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")}
            self.aperture, self.focus = props["aperture"], props["focus"]
            self.rows = [mi.ScalarVector3f(*(props[f"r{row}{c}"] for c in range(3))) for row in range(3)]
            self.centre = mi.ScalarPoint3f(*(props[f"c{row}"] for row in range(3)))
            size = self.film().size()
            self.width, self.height = int(size[0]), int(size[1])

        def sample_ray(
            self, time: Any, wavelength: Any, position: Any, aperture: Any, active: Any = True
        ) -> tuple[Any, Any]:
            v = self.v
            goal_x = (position.x * self.width - 0.5 - v["cx"]) / v["fx"]
            goal_y = (position.y * self.height - 0.5 - v["cy"]) / v["fy"]
            x, y = goal_x, goal_y
            for _ in range(6):  # each round gains a factor of the distortion itself
                r2 = x * x + y * y
                radial = 1 + r2 * (v["k1"] + r2 * (v["k2"] + r2 * v["k3"]))
                dx = 2 * v["p1"] * x * y + v["p2"] * (r2 + 2 * x * x)
                dy = 2 * v["p2"] * x * y + v["p1"] * (r2 + 2 * y * y)
                x, y = (goal_x - dx) / radial, (goal_y - dy) / radial
            lens = mi.warp.square_to_uniform_disk_concentric(aperture) * self.aperture
            right, down, forward = self.rows
            origin = self.centre + right * lens.x + down * lens.y
            sharp = self.centre + (right * x + down * y + forward) * self.focus
            ray = mi.Ray3f(mi.Point3f(origin), dr.normalize(mi.Vector3f(sharp - origin)), time)
            return ray, mi.Color3f(1.0)

        def sample_ray_differential(
            self, time: Any, wavelength: Any, position: Any, aperture: Any, active: Any = True
        ) -> tuple[Any, Any]:
            ray, weight = self.sample_ray(time, wavelength, position, aperture, active)
            return mi.RayDifferential3f(ray), weight

        def bbox(self) -> Any:
            box = mi.ScalarBoundingBox3f()
            box.expand(self.centre)
            return box

        def to_string(self) -> str:
            return "SulcusLens[]"

    mi.register_sensor("sulcus_lens", Lens)
