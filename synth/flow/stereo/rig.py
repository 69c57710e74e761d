"""The two cameras of a stereo pair, their pictures brought onto common rows, and what disparity means in mm.

Camera model as OpenCV's: K, Brown-Conrady distortion, x_right = R x_left + t. Rectified pictures are those of
two parallel pinholes with one focal length, each with its own principal point, so that both may look at the
same field from near: a point at depth Z has disparity f B / Z - shift.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from synth.errors import UserError

Floats = NDArray[np.float64]
Map = NDArray[np.float32]

_PARALLEL = 1e-9  # rotations nearer to none than this are none


@dataclass(frozen=True)
class Eye:
    """One camera."""

    K: Floats  # (3, 3) px
    distortion: Floats  # (n,) k1, k2, p1, p2, k3, ... as OpenCV orders them.


@dataclass(frozen=True)
class StereoRig:
    """A calibrated stereo pair."""

    left: Eye
    right: Eye
    rotation: Floats  # (3, 3): x_right = rotation @ x_left + translation
    translation: Floats  # (3,) mm
    size: tuple[int, int]  # width, height of both pictures [px]

    @property
    def baseline_mm(self) -> float:
        """Distance of the two lenses."""
        return float(np.linalg.norm(self.translation))


class Rectified:
    """Maps between a rig's pictures and the rectified ones, whose rows are epipolar lines."""

    def __init__(self, rig: StereoRig) -> None:
        """`rig`: the pair. UserError: its right camera is not to the right of the left one."""
        self.size, turns = rig.size, _turns(rig)
        # Where the turned right lens sits, seen from the turned left one.
        across = turns[1] @ rig.translation
        if across[0] >= 0 or abs(across[0]) < 0.9 * rig.baseline_mm:
            raise UserError(f"stereo: the second camera is not to the right of the first ({across} mm)")
        self.baseline_mm = float(-across[0])
        self.focal = float(rig.left.K[0, 0])
        eyes = tuple(zip((rig.left, rig.right), turns, strict=True))
        self.K_left, K_right = (_middle(eye, turn, rig.size, self.focal) for eye, turn in eyes)
        K_right[1, 2] = self.K_left[1, 2]
        self.shift = float(K_right[0, 2] - self.K_left[0, 2])
        self._views = tuple((*one, K) for one, K in zip(eyes, (self.K_left, K_right), strict=True))
        self._maps = tuple(
            cv2.initUndistortRectifyMap(eye.K, eye.distortion, turn, K, rig.size, cv2.CV_32FC1)
            for eye, turn, K in self._views
        )

    def picture(self, grey: Map, eye: int) -> Map:
        """A rectified picture (H, W) float32 of one (H, W) float32 of eye 0 (left) or 1 (right)."""
        x, y = self._maps[eye]
        return np.asarray(cv2.remap(grey, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))

    def flags(self, mask: NDArray[np.bool_], eye: int) -> NDArray[np.bool_]:
        """A rectified mask (H, W): True only where all that it is read from is."""
        x, y = self._maps[eye]
        return np.asarray(cv2.remap(mask.astype(np.float32), x, y, cv2.INTER_LINEAR, borderValue=0) > 0.99)

    def flow(self, flow: Map, eye: int = 0) -> Map:
        """An eye's flow (H, W, 2) px, in rectified pixels: (2, H, W)."""
        x, y = self._maps[eye]
        u, v = (cv2.remap(np.ascontiguousarray(flow[..., k]), x, y, cv2.INTER_LINEAR) for k in range(2))
        (along, down), (along_here, down_here) = self._offsets[eye]
        there = x + u, y + v, cv2.INTER_LINEAR
        ahead = (cv2.remap(part, *there, borderMode=cv2.BORDER_REPLICATE) for part in (along, down))
        return np.stack([u + next(ahead) - along_here, v + next(ahead) - down_here])

    def back(self, field: Map, eye: int = 0) -> Map:
        """A field (H, W) on an eye's rectified pixels, on its own: (H, W)."""
        x, y = self._inverse[eye]
        return np.asarray(cv2.remap(field, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))

    def depth(self, disparity: Map) -> Map:
        """Depth [mm] along the rectified axis of disparities [px], both (H, W)."""
        return np.asarray(self.focal * self.baseline_mm / np.maximum(disparity + self.shift, 1e-3))

    def motion(self, disparity: Map, change: Map, flow: Map) -> Map:
        """Motion (H, W, 3) mm in the left camera's axes at rectified left pixels.

        Args:
            disparity: (H, W) px at rest.
            change: (H, W) px since then.
            flow: (2, H, W) px, rectified.
        """
        height, width = disparity.shape
        before, after = self.depth(disparity), self.depth(disparity + change)
        x = np.arange(width, dtype=np.float32) - np.float32(self.K_left[0, 2])
        y = np.arange(height, dtype=np.float32)[:, None] - np.float32(self.K_left[1, 2])
        rise = after - before
        # The difference as a sum of small parts: two large ones would lose digits.
        found = np.stack([flow[0] * after + x * rise, flow[1] * after + y * rise, self.focal * rise], axis=-1)
        return (found / self.focal @ self._views[0][1]).astype(np.float32)

    @cached_property
    def _inverse(self) -> tuple[tuple[Map, Map], ...]:
        """For every pixel of an eye, where it lies in its rectified picture: x, y, each (H, W)."""
        width, height = self.size
        grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
        found = []
        for eye, turn, K in self._views:
            there = cv2.undistortPoints(grid.reshape(-1, 1, 2), eye.K, eye.distortion, R=turn, P=K)
            found.append(tuple(there[:, 0].T.reshape(2, height, width).astype(np.float32)))
        return tuple(found)

    @cached_property
    def _offsets(self) -> list[tuple[list[Map], list[Map]]]:
        """By eye, how far its pixels lie from their rectified place; and both at rectified pixels."""
        width, height = self.size
        grid = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
        found = []
        for inverse, maps in zip(self._inverse, self._maps, strict=True):
            offset = [part - own for part, own in zip(inverse, grid, strict=True)]
            found.append((offset, [cv2.remap(part, *maps, cv2.INTER_LINEAR) for part in offset]))
        return found


def _turns(rig: StereoRig) -> tuple[Floats, Floats]:
    """Rotations of the left and right camera's axes onto the rectified ones (Bouguet's, as in OpenCV)."""
    parallel = np.abs(rig.rotation - np.eye(3)).max() < _PARALLEL
    if parallel and np.abs(rig.translation[1:]).max() < _PARALLEL:
        return np.eye(3), np.eye(3)
    left, right, *_ = cv2.stereoRectify(
        *(rig.left.K, rig.left.distortion, rig.right.K, rig.right.distortion),
        *(rig.size, rig.rotation, rig.translation[:, None]),
        flags=0,
    )
    return np.asarray(left, np.float64), np.asarray(right, np.float64)


def _middle(eye: Eye, turn: Floats, size: tuple[int, int], focal: float) -> Floats:
    """K of a rectified eye: what was in the middle of the picture stays there."""
    middle = (np.array(size, np.float64) - 1) / 2
    ray = cv2.undistortPoints(middle[None, None], eye.K, eye.distortion, R=turn)[0, 0]
    x, y = middle - focal * ray
    return np.array([[focal, 0.0, x], [0.0, focal, y], [0.0, 0.0, 1.0]])
