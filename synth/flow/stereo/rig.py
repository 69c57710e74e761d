"""Calibrated stereo pairs: rectification of pictures and flows, and depth and motion from disparity.

The camera model is OpenCV's: K, Brown-Conrady distortion, x_right = R x_left + t. Rectified pictures are
those of two parallel pinhole cameras with one focal length and separate principal points, so that both can
view the same near field: a point at depth Z has disparity f B / Z - shift.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from synth.arrays import Floats, Map, Mask
from synth.errors import UserError

_PARALLEL = 1e-9  # rotations and offsets of at most this count as zero


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsic parameters of one camera."""

    K: Floats  # (3, 3) px
    distortion: Floats  # (n,) k1, k2, p1, p2, k3, ... in OpenCV's order


@dataclass(frozen=True)
class StereoRig:
    """A calibrated stereo pair."""

    left: Intrinsics
    right: Intrinsics
    rotation: Floats  # (3, 3): x_right = rotation @ x_left + translation
    translation: Floats  # (3,) mm
    size: tuple[int, int]  # width, height of both pictures [px]

    @property
    def baseline_mm(self) -> float:
        """Distance between the two cameras."""
        return float(np.linalg.norm(self.translation))


class Rectified:
    """Maps between the pictures of a rig and rectified ones. Cameras are numbered 0 (left) and 1 (right)."""

    def __init__(self, rig: StereoRig) -> None:
        """Raises UserError if the right camera of the rig is not to the right of the left one."""
        self.size, rotations = rig.size, _find_rotations(rig)
        # Position of the rotated right camera relative to the rotated left one.
        baseline = rotations[1] @ rig.translation
        if baseline[0] >= 0 or abs(baseline[0]) < 0.9 * rig.baseline_mm:
            raise UserError(f"stereo: the right camera is not to the right of the left one ({baseline} mm)")
        self.baseline_mm = float(-baseline[0])
        self.focal = float(rig.left.K[0, 0])
        cameras = tuple(zip((rig.left, rig.right), rotations, strict=True))
        self.K_left, K_right = (
            _centre_camera(camera, rotation, rig.size, self.focal) for camera, rotation in cameras
        )
        K_right[1, 2] = self.K_left[1, 2]
        self.shift = float(K_right[0, 2] - self.K_left[0, 2])
        self._views = tuple((*pose, K) for pose, K in zip(cameras, (self.K_left, K_right), strict=True))
        self._maps = tuple(
            cv2.initUndistortRectifyMap(camera.K, camera.distortion, rotation, K, rig.size, cv2.CV_32FC1)
            for camera, rotation, K in self._views
        )

    def picture(self, grey: Map, camera: int) -> Map:
        """Rectifies a picture (H, W) float32."""
        x, y = self._maps[camera]
        return np.asarray(cv2.remap(grey, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))

    def flags(self, mask: Mask, camera: int) -> Mask:
        """Rectifies a mask (H, W); True where all sampled pixels are True."""
        x, y = self._maps[camera]
        return np.asarray(cv2.remap(mask.astype(np.float32), x, y, cv2.INTER_LINEAR, borderValue=0) > 0.99)

    def flow(self, flow: Map) -> Map:
        """Rectifies a flow (H, W, 2) px of the left camera: (2, H, W) px."""
        x, y = self._maps[0]
        u, v = (cv2.remap(np.ascontiguousarray(flow[..., k]), x, y, cv2.INTER_LINEAR) for k in range(2))
        (offset_x, offset_y), (rest_offset_x, rest_offset_y) = self._offsets
        sampling = x + u, y + v, cv2.INTER_LINEAR
        offsets = (
            cv2.remap(part, *sampling, borderMode=cv2.BORDER_REPLICATE) for part in (offset_x, offset_y)
        )
        return np.stack([u + next(offsets) - rest_offset_x, v + next(offsets) - rest_offset_y])

    def unrectify(self, field: Map, camera: int = 0) -> Map:
        """Resamples a field (H, W) from rectified pixels to those of the camera's own picture."""
        x, y = self._inverse[camera]
        return np.asarray(cv2.remap(field, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))

    def depth(self, disparity: Map) -> Map:
        """Depth [mm] along the rectified optical axis for disparities [px], both (H, W)."""
        return np.asarray(self.focal * self.baseline_mm / np.maximum(disparity + self.shift, 1e-3))

    def motion(self, disparity: Map, change: Map, flow: Map) -> Map:
        """Motion (H, W, 3) mm in the axes of the left camera, on rectified left pixels, of a rectified flow
        (2, H, W) px, a disparity at rest and its change since, both (H, W) px."""
        height, width = disparity.shape
        before, after = self.depth(disparity), self.depth(disparity + change)
        x = np.arange(width, dtype=np.float32) - np.float32(self.K_left[0, 2])
        y = np.arange(height, dtype=np.float32)[:, None] - np.float32(self.K_left[1, 2])
        rise = after - before
        # The difference of the two positions, written as a sum of small terms to avoid cancellation.
        scaled_motion = np.stack(
            [flow[0] * after + x * rise, flow[1] * after + y * rise, self.focal * rise], axis=-1
        )
        return (scaled_motion / self.focal @ self._views[0][1]).astype(np.float32)

    @cached_property
    def _inverse(self) -> tuple[tuple[Map, Map], ...]:
        """Rectified positions x, y, each (H, W), of the pixels of each camera."""
        width, height = self.size
        grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
        maps = []
        for camera, rotation, K in self._views:
            positions = cv2.undistortPoints(
                grid.reshape(-1, 1, 2), camera.K, camera.distortion, R=rotation, P=K
            )
            maps.append(tuple(positions[:, 0].T.reshape(2, height, width).astype(np.float32)))
        return tuple(maps)

    @cached_property
    def _offsets(self) -> tuple[list[Map], list[Map]]:
        """Rectified minus original position of left pixels (x, y), and the same at rectified pixels."""
        width, height = self.size
        grid = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
        offset = [plane - position for plane, position in zip(self._inverse[0], grid, strict=True)]
        return offset, [cv2.remap(plane, *self._maps[0], cv2.INTER_LINEAR) for plane in offset]


def _find_rotations(rig: StereoRig) -> tuple[Floats, Floats]:
    """Rotations from the axes of the left and right camera to the rectified axes (Bouguet, as in OpenCV)."""
    parallel = np.abs(rig.rotation - np.eye(3)).max() < _PARALLEL
    if parallel and np.abs(rig.translation[1:]).max() < _PARALLEL:
        return np.eye(3), np.eye(3)
    left, right, *_ = cv2.stereoRectify(
        *(rig.left.K, rig.left.distortion, rig.right.K, rig.right.distortion),
        *(rig.size, rig.rotation, rig.translation[:, None]),
        flags=0,
    )
    return np.asarray(left, np.float64), np.asarray(right, np.float64)


def _centre_camera(camera: Intrinsics, rotation: Floats, size: tuple[int, int], focal: float) -> Floats:
    """K of a rectified camera that leaves the middle of the picture in place."""
    middle = (np.array(size, np.float64) - 1) / 2
    ray = cv2.undistortPoints(middle[None, None], camera.K, camera.distortion, R=rotation)[0, 0]
    x, y = middle - focal * ray
    return np.array([[focal, 0.0, x], [0.0, focal, y], [0.0, 0.0, 1.0]])
