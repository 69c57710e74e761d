"""The microscope's lens for Mitsuba: `camera.rays` with an aperture.

Compiled variants have a sensor plugin with the exact distortion. In the scalar variant a plugin in Python
would take twenty times as long as the rendering, so there Mitsuba's thin lens renders the undistorted picture
at twice the resolution, which is then warped.
"""

from __future__ import annotations

import functools
from typing import Any

import cv2
import numpy as np

from synth.arrays import Map
from synth.errors import UserError
from synth.render.camera import camera as cameras
from synth.render.camera.camera import Camera


class Compiled:
    """The exact lens, for compiled variants."""

    def __init__(self, camera: Camera, spp: int) -> None:
        import mitsuba as mi

        _register(mi.variant())
        self.spp = spp
        sampler = {"type": "multijitter", "sample_count": spp}
        lens = {"type": "sulcus_lens", "aperture": camera.aperture_mm}
        self.sensor = mi.load_dict(lens | {"film": _film(*camera.size), "sampler": sampler})
        self.place(camera)

    def place(self, camera: Camera) -> None:
        """Moves the lens to the camera's pose, with its intrinsics."""
        self.sensor.place(camera)

    def develop(self, image: Map) -> Map:
        """The picture (H, W, 3) of the film, which is the same here."""
        return image


class Scalar:
    """Mitsuba's thin lens on a larger, finer film, and the warp to the recorded picture."""

    def __init__(self, camera: Camera, spp: int) -> None:
        self._fine = 2 if spp >= 4 else 1
        self.spp = max(1, spp // self._fine**2)
        self._fitted: list[float] = []  # intrinsics at the last fit
        self.place(camera)

    def _fit(self, camera: Camera) -> None:
        """Sets the larger film's size, and the positions of the picture's pixels on it."""
        width, height = camera.size
        fx, fy = camera.K[0, 0], camera.K[1, 1]
        # Centres of fine pixels, and their positions on a film whose principal point is its middle.
        step = 1 / self._fine
        columns = (np.arange(width * self._fine) + 0.5) * step - 0.5
        rows = (np.arange(height * self._fine) + 0.5) * step - 0.5
        x, y = np.meshgrid((columns - camera.K[0, 2]) / fx, (rows - camera.K[1, 2]) / fy)
        flat = cameras.undistort(np.stack([x.ravel(), y.ravel()], axis=1), camera.distortion)
        positions = (flat * fx * self._fine).reshape(*x.shape, 2)
        half = np.ceil(np.abs(positions).max(axis=(0, 1))).astype(int) + 1
        self._positions = (positions + half - 0.5).astype(np.float32)
        self._film = _film(*(2 * half).tolist())
        self._fov = float(np.rad2deg(2 * np.arctan(self._film["width"] / (2 * fx * self._fine))))

    def place(self, camera: Camera) -> None:
        """Moves the lens to the camera's pose."""
        import mitsuba as mi

        if (intrinsics := [*camera.K.ravel(), *camera.distortion]) != self._fitted:
            self._fit(camera)
            self._fitted = intrinsics
        to_world = np.eye(4)
        # Mitsuba's cameras have x to the left and y up.
        to_world[:3, :3] = (camera.rotation * np.array([[-1.0], [-1.0], [1.0]])).T
        to_world[:3, 3] = camera.centre
        lens = {"type": "perspective", "fov": self._fov, "fov_axis": "x", "near_clip": 1.0, "far_clip": 1e4}
        if camera.aperture_mm > 0:
            lens |= {"type": "thinlens", "aperture_radius": camera.aperture_mm}
            lens |= {"focus_distance": camera.focus_mm}
        sampler = {"type": "multijitter", "sample_count": self.spp}
        options = {
            "to_world": mi.ScalarTransform4f(to_world.tolist()),
            "film": self._film,
            "sampler": sampler,
        }
        self.sensor = mi.load_dict(lens | options)

    def develop(self, image: Map) -> Map:
        """The recorded picture (H, W, 3) of a larger, finer film."""
        fine = cv2.remap(image, self._positions, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        size = (fine.shape[1] // self._fine, fine.shape[0] // self._fine)
        return np.asarray(cv2.resize(fine, size, interpolation=cv2.INTER_AREA), np.float32)


def _film(width: int, height: int) -> dict[str, Any]:
    # A box filter does not mix pixels, so sums have one order on any number of threads: the same bytes.
    options = {"rfilter": {"type": "box"}, "pixel_format": "rgb", "component_format": "float32"}
    return {"type": "hdrfilm", "width": width, "height": height, **options}


_NAMES = "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"


def _undistort(goal_x: Any, goal_y: Any, v: dict[str, Any], rounds: int) -> tuple[Any, Any]:
    """Normalised coordinates that distortion coefficients `v` take to the goal."""
    x, y = goal_x, goal_y
    for _ in range(rounds):  # each reduces the error by the size of the distortion
        r2 = x * x + y * y
        radial = 1 + r2 * (v["k1"] + r2 * (v["k2"] + r2 * v["k3"]))
        radial = radial / (1 + r2 * (v["k4"] + r2 * (v["k5"] + r2 * v["k6"])))
        dx = 2 * v["p1"] * x * y + v["p2"] * (r2 + 2 * x * x)
        dy = 2 * v["p2"] * x * y + v["p1"] * (r2 + 2 * y * y)
        x, y = (goal_x - dx) / radial, (goal_y - dy) / radial
    return x, y


def _coefficients(camera: Camera) -> dict[str, float]:
    return dict(zip(_NAMES, [*camera.distortion.tolist(), 0.0, 0.0, 0.0], strict=False))


def _count_rounds(camera: Camera) -> int:
    """Rounds of `_undistort` after which it is off by less than 0.01 px, on a grid over the picture."""
    axis = np.linspace(0, 1, 17)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2) * camera.size - 0.5
    x, y = (grid - camera.K[:2, 2]).T / np.diag(camera.K)[:2, None]
    exact = cameras.undistort(np.stack([x, y], axis=1), camera.distortion).T
    for rounds in range(6, 120, 6):
        points = np.stack(_undistort(x, y, _coefficients(camera), rounds))
        if not np.abs(points - exact).max() * camera.K[0, 0] > 0.01:
            return rounds
    raise UserError("the lens distorts too strongly for compiled variants: set render.variant=scalar_rgb")


@functools.cache
def _register(variant: str) -> None:
    """Registers the sensor `sulcus_lens`, a thin lens with distortion, in one variant."""
    import drjit as dr
    import mitsuba as mi

    class Lens(mi.Sensor):
        """`camera.rays` for film samples, with an aperture."""

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.aperture, self.fitted = float(props["aperture"]), list[float]()
            size = self.film().size()
            self.width, self.height = int(size[0]), int(size[1])

        def place(self, camera: Camera) -> None:
            """Sets pose and intrinsics."""
            if (intrinsics := [*camera.K.ravel(), *camera.distortion]) != self.fitted:  # not for every frame
                self.rounds, self.fitted = _count_rounds(camera), intrinsics

            # As data: a literal in the code would compile it anew for every scene.
            def data(values: Any) -> list[Any]:
                return [dr.opaque(mi.Float, float(value)) for value in values]

            self.rows = [mi.Vector3f(*data(row)) for row in camera.rotation]
            self.centre = mi.Point3f(*data(camera.centre))
            (fx, _, cx), (_, fy, cy), _ = camera.K
            v = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, **_coefficients(camera)}
            v |= {"aperture": self.aperture, "focus": camera.focus_mm}
            self.v = dict(zip(v, data(v.values()), strict=True))
            self.around = mi.ScalarPoint3f(*camera.centre.tolist())

        def sample_ray_differential(
            self, time: Any, wavelength: Any, position: Any, aperture: Any, active: Any = True
        ) -> tuple[Any, Any]:
            v = self.v
            x = (position.x * self.width - 0.5 - v["cx"]) / v["fx"]
            y = (position.y * self.height - 0.5 - v["cy"]) / v["fy"]
            x, y = _undistort(x, y, v, self.rounds)
            lens = mi.warp.square_to_uniform_disk_concentric(aperture) * v["aperture"]
            right, down, forward = self.rows
            origin = self.centre + right * lens.x + down * lens.y
            focus_point = self.centre + (right * x + down * y + forward) * v["focus"]
            ray = mi.Ray3f(mi.Point3f(origin), dr.normalize(mi.Vector3f(focus_point - origin)), time)
            return mi.RayDifferential3f(ray), mi.Color3f(1.0)

        def bbox(self) -> Any:
            box = mi.ScalarBoundingBox3f()
            box.expand(self.around)
            return box

        def to_string(self) -> str:
            return "SulcusLens[]"

    mi.register_sensor("sulcus_lens", Lens)
