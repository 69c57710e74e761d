"""The microscope camera: one model for rays, ground truth, flow and bench.

OpenCV axes (x right, y down, z away), `K` 3x3, Brown-Conrady distortion (k1, k2, p1, p2, k3, and k4, k5, k6
of OpenCV's rational model), the centre of the top-left pixel at (0, 0). D. C. Brown, "Close-range camera
calibration", 1971.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from synth.arrays import Floats, Map
from synth.errors import UserError
from synth.render.camera import camera_calibration
from synth.system.jit import argument_types, inlined, vectorised

_NEWTON, _ROUNDING = 20, 1e-14
_BORDER = 65  # points on a side of the picture


@dataclass(frozen=True)
class CameraView:
    """Pose and field of the microscope in one sequence."""

    field_mm: float  # width of the field of view at the craniotomy [mm]; a calibration's, where there is one
    working_distance_mm: float
    tilt_deg: float  # angle between the optical axis and the craniotomy's normal
    azimuth_deg: float  # direction of that tilt
    roll_deg: float  # rotation of the picture about the optical axis
    focus_mm: float  # distance of the plane in focus beyond the craniotomy's centre
    off_centre: tuple[float, float] = (0.0, 0.0)  # principal point from the picture's middle, in its widths


@dataclass(frozen=True)
class Lens:
    """What is the same in all sequences of a camera."""

    size: tuple[int, int] = (640, 480)
    """Width, height [px]."""
    aperture_mm: float = 4.0
    """Radius of the lens aperture; 0 is a pinhole."""
    distortion: tuple[float, ...] = (0.0,) * 5
    """Brown-Conrady k1, k2, p1, p2, k3, and k4, k5, k6 if there are 8."""
    K: Floats | None = None
    """(3, 3) px of a calibrated camera; None: that of the view's field."""

    def focal_px(self, view: CameraView) -> float:
        """Focal length across [px]."""
        return self.size[0] * view.working_distance_mm / view.field_mm if self.K is None else self.K[0, 0]

    def mm_per_px(self, view: CameraView) -> float:
        """Size of a pixel at the craniotomy's centre, across the optical axis."""
        return float(view.working_distance_mm / self.focal_px(view))


@dataclass(frozen=True)
class Camera:
    """A thin lens with distortion; its centre rays are those of the pinhole."""

    K: Floats
    """(3, 3) px."""
    distortion: Floats
    """(5,) k1, k2, p1, p2, k3, or (8,) with k4, k5, k6."""
    rotation: Floats
    """(3, 3) world to camera."""
    translation: Floats
    """(3,) mm: x_camera = rotation @ x_world + translation."""
    size: tuple[int, int]
    """Width, height [px]."""
    aperture_mm: float
    """Radius of the lens aperture; 0 is a pinhole."""
    focus_mm: float
    """Depth of the plane in focus."""
    mm_per_px: float
    """Size of a pixel at the craniotomy's centre, across the optical axis."""

    @property
    def centre(self) -> Floats:
        """(3,) mm: the lens, in world axes."""
        return -self.rotation.T @ self.translation

    @property
    def pose(self) -> Floats:
        """(4, 4) mm: world to camera axes, homogeneous."""
        return np.block([[self.rotation, self.translation[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


def place(view: CameraView, lens: Lens) -> Camera:
    """The camera of `view`, looking at the world's origin from its working distance."""
    width, height = lens.size
    tilt, azimuth, roll = np.deg2rad([view.tilt_deg, view.azimuth_deg, view.roll_deg])
    backward = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])
    # Any axis across the view is a start; roll makes the orientation uniform.
    right = np.cross([0.0, 1.0, 0.0], backward)
    right /= np.linalg.norm(right)
    up = np.cross(backward, right)
    frame = np.stack([right, -up, -backward])
    c, s = np.cos(roll), np.sin(roll)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ frame
    K = lens.K
    if K is None:
        focal = lens.focal_px(view)
        x, y = (width - 1) / 2 + width * view.off_centre[0], (height - 1) / 2 + width * view.off_centre[1]
        K = np.array([[focal, 0.0, x], [0.0, focal, y], [0.0, 0.0, 1.0]])
    return Camera(
        K=K,
        distortion=np.asarray(lens.distortion, np.float64),
        rotation=rotation,
        translation=np.array([0.0, 0.0, view.working_distance_mm]),
        size=(width, height),
        aperture_mm=lens.aperture_mm,
        focus_mm=view.working_distance_mm + view.focus_mm,
        mm_per_px=lens.mm_per_px(view),
    )


def state_field(view: CameraView, lens: Camera) -> CameraView:
    """The view with the field and principal point of the calibrated camera that `place` returned for it."""
    width, _ = lens.size
    x, y = (lens.K[:2, 2] - (np.array(lens.size) - 1) / 2) / width
    field_mm = float(width * view.working_distance_mm / lens.K[0, 0])
    return replace(view, field_mm=field_mm, off_centre=(float(x), float(y)))


def visible_radius(camera: Camera) -> float:
    """Radius [mm] of the largest circle around the craniotomy's centre, in its plane, that is in the picture.
    Raises as `rays`."""
    (width, height), side = camera.size, np.linspace(-0.5, 0.5, _BORDER)
    sides = [(x, y) for x in side for y in (-0.5, 0.5)]
    edge = np.array(sides + [(y, x) for x, y in sides])
    pixels = edge * (width, height) + 0.5 * np.array([width - 1, height - 1])
    directions = rays(camera, pixels) @ camera.rotation
    # A ray that does not come down to the plane meets it very far away.
    points = camera.centre - directions * (camera.centre[2] / np.minimum(directions[:, 2], -1e-9))[:, None]
    return float(np.hypot(points[:, 0], points[:, 1]).min())


def resize(camera: Camera, size: tuple[int, int]) -> Camera:
    """The camera with pictures of another size (width, height) px of the same field."""
    scale = np.array(size) / camera.size
    K = camera_calibration.scale_intrinsics(camera.K, scale)
    return replace(camera, K=K, size=size, mm_per_px=camera.mm_per_px / float(scale[0]))


def right_camera(camera: Camera, baseline_mm: float) -> Camera:
    """The right camera of a stereo pair; its principal point is shifted so that both show the same field."""
    K = camera.K.copy()
    K[0, 2] += K[0, 0] * baseline_mm / camera.translation[2]
    return replace(camera, K=K, translation=camera.translation - np.array([baseline_mm, 0.0, 0.0]))


def place_right(
    camera: Camera, K: Floats, distortion: Floats, rotation: Floats, translation: Floats
) -> Camera:
    """The right camera of a calibrated pair, focused on the same plane: x_right = rotation @ x_left +
    translation, (3, 3) and (3,) mm."""
    right_translation = rotation @ camera.translation + translation
    return replace(
        camera,
        K=K,
        distortion=distortion,
        rotation=rotation @ camera.rotation,
        translation=right_translation,
        focus_mm=float(right_translation[2] + camera.focus_mm - camera.translation[2]),
        mm_per_px=float(right_translation[2] / K[0, 0]),
    )


def between(left: Camera, right: Camera) -> tuple[Floats, Floats]:
    """Rotation (3, 3) and translation (3,) mm from the axes of the left camera to those of the right one."""
    turn = right.rotation @ left.rotation.T
    return turn, right.translation - turn @ left.translation


def disparity(left: Camera, right: Camera, points: Floats) -> Floats:
    """Column [px] of points (N, 3) mm, left camera's axes, in the left picture less that in the right one,
    (N,), without distortion."""
    turn, shift = between(left, right)
    right_points = points @ turn.T + shift
    (x, z), (x_right, z_right) = (coordinates[:, ::2].T for coordinates in (points, right_points))
    left_column, right_column = (
        left.K[0, 0] * x / z + left.K[0, 2],
        right.K[0, 0] * x_right / z_right + right.K[0, 2],
    )
    return np.asarray(left_column - right_column)


def depth_of(left: Camera, right: Camera, directions: Floats, disparity_px: Floats) -> Floats:
    """Depth (N,) mm in the left camera of points on its rays `directions` (N, 3), z = 1, by disparities."""
    turn, shift = between(left, right)
    right_directions = directions @ turn.T
    x = (left.K[0, 0] * directions[:, 0] + left.K[0, 2] - disparity_px - right.K[0, 2]) / right.K[0, 0]
    return np.asarray((x * shift[2] - shift[0]) / (right_directions[:, 0] - x * right_directions[:, 2]))


def blur_radius(camera: Camera, depth: npt.NDArray[np.floating]) -> Map:
    """Radius of the circle of confusion [px] of points at depths (...) mm; 0 where depth is 0."""
    distance = np.maximum(depth, 1e-9)
    radius = camera.K[0, 0] * camera.aperture_mm * np.abs(1 / distance - 1 / camera.focus_mm)
    return np.where(depth > 0, radius, 0.0).astype(np.float32)


def to_camera(camera: Camera, points: Floats) -> Floats:
    """World points (N, 3) mm in camera axes (N, 3) mm."""
    return points @ camera.rotation.T + camera.translation


def project(camera: Camera, points: Floats) -> Floats:
    """Pixels (N, 2) of world points (N, 3) mm, in the recorded (distorted) picture."""
    return to_pixels(camera, to_camera(camera, points))


def to_pixels(camera: Camera, local: Floats) -> Floats:
    """Pixels (N, 2) of points (N, 3) mm in camera axes."""
    flat = _distort(local[:, :2] / local[:, 2:], camera.distortion)
    return flat * np.diag(camera.K)[:2] + camera.K[:2, 2]


def rays(camera: Camera, pixels: Floats) -> Floats:
    """Centre rays (N, 3) of pixels (N, 2): camera axes, z = 1, so that distance along them is depth.
    UserError: the distortion folds the picture over itself, so that a pixel has no ray."""
    flat = undistort((pixels - camera.K[:2, 2]) / np.diag(camera.K)[:2], camera.distortion)
    return np.concatenate([flat, np.ones((len(flat), 1))], axis=1)


def pixel_grid(size: tuple[int, int]) -> Floats:
    """Pixel centres (H*W, 2), row by row."""
    width, height = size
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    return np.stack([columns.ravel(), rows.ravel()], axis=1)


def undistort(flat: Floats, distortion: Floats) -> Floats:
    """Inverse of Brown-Conrady on normalised coordinates (N, 2), by Newton's method to rounding."""
    if not distortion.any():
        return flat.copy()
    points = np.empty(flat.shape)
    if _undistort(np.ascontiguousarray(flat), _pad_coefficients(distortion), points):
        return points
    raise UserError("render.distortion: folds the picture over itself (or the calibration's does)")


def _distort(flat: Floats, distortion: Floats) -> Floats:
    if not distortion.any():
        return flat
    points = np.empty(flat.shape)
    _distort_all(np.ascontiguousarray(flat), _pad_coefficients(distortion), points)
    return points


def _pad_coefficients(distortion: Floats) -> Floats:
    """All coefficients (8,), those of the rational model 0 if they are not given."""
    return np.concatenate([distortion, np.zeros(8 - len(distortion))])


@inlined
def _radial_factor(r2: float, k: Floats) -> tuple[float, float]:
    """The radial factor at a squared radius, and twice its derivative by it; coefficients (8,)."""
    top = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    bottom = 1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
    rise, fall = k[0] + r2 * (2 * k[1] + 3 * k[4] * r2), k[5] + r2 * (2 * k[6] + 3 * k[7] * r2)
    return top / bottom, 2 * (rise - top / bottom * fall) / bottom


@inlined
def _distort_point(x: float, y: float, k: Floats) -> tuple[float, float]:
    """A point as distorted by coefficients (8,)."""
    r2 = x * x + y * y
    radial, _ = _radial_factor(r2, k)
    across = x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x)
    down = y * radial + 2 * k[3] * x * y + k[2] * (r2 + 2 * y * y)
    return across, down


@argument_types("f8[:,::1], f8[::1], f8[:,::1]")
@vectorised
def _distort_all(flat: Floats, k: Floats, out: Floats) -> None:
    for n in range(len(flat)):
        out[n, 0], out[n, 1] = _distort_point(flat[n, 0], flat[n, 1], k)


@argument_types("f8[:,::1], f8[::1], f8[:,::1]")
@vectorised
def _undistort(flat: Floats, k: Floats, out: Floats) -> bool:
    """Whether all points (N, 2) were found."""
    converged = True
    for n in range(len(flat)):
        x, y = flat[n, 0], flat[n, 1]
        for _ in range(_NEWTON):
            u, v = _distort_point(x, y, k)
            u, v = u - flat[n, 0], v - flat[n, 1]
            if abs(u) < _ROUNDING and abs(v) < _ROUNDING:
                break
            # The Jacobian, which is symmetric.
            r2 = x * x + y * y
            radial, growth = _radial_factor(r2, k)
            b = growth * x * y + 2 * k[2] * x + 2 * k[3] * y
            a = radial + growth * x * x + 2 * k[2] * y + 6 * k[3] * x
            d = radial + growth * y * y + 2 * k[3] * x + 6 * k[2] * y
            determinant = a * d - b * b
            x, y = x - (d * u - b * v) / determinant, y - (a * v - b * u) / determinant
        u, v = _distort_point(x, y, k)
        converged &= abs(u - flat[n, 0]) < 1e-9 and abs(v - flat[n, 1]) < 1e-9  # not if they are NaN
        out[n, 0], out[n, 1] = x, y
    return converged
