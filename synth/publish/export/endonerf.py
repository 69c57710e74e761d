"""Export to the layout of EndoNeRF (github.com/med-air/EndoNeRF), for reconstructions of deforming tissue.

A folder per sequence: `images/`, `depth/` and `masks/` as NNNNNN.png, and `poses_bounds.npy` (T, 17): in each
row the camera's pose 3 x 5 (axes right, up, backward; its position; height, width, focal length), then
nearest and farthest depth. These programs assume a pinhole camera with a central principal point, to which
all pictures are resampled.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from synth.arrays import Array, Floats, Map
from synth.checks import optics, stereo_checks
from synth.dataset.store import Dataset, Sequence
from synth.errors import UserError
from synth.publish.export.encoding import write_png
from synth.render.camera.camera import Camera, between

UNIT_MM = 0.01  # one step of a depth picture, and the unit of lengths: 16 bits reach to 655 mm

_TO_OPENGL = np.diag([1.0, -1.0, -1.0])


class _Maps(NamedTuple):
    """Positions in the recorded picture of the pixels of the pinhole's (cv2.remap), each (H, W)."""

    x: Map
    y: Map

    def smooth(self, picture: Array) -> Array:
        return np.asarray(cv2.remap(picture, self.x, self.y, cv2.INTER_CUBIC))

    def nearest(self, picture: Array, outside: float = 0) -> Array:
        return np.asarray(cv2.remap(picture, self.x, self.y, cv2.INTER_NEAREST, borderValue=outside))


def write_scenes(dataset: Dataset, target: Path) -> None:
    """Writes a folder per sequence, named by its index, with `images_right/`, rectified, of a right camera.

    Masks are white where there is no tissue: on the instrument and outside the recorded picture. World axes
    are those of frame 0's camera. `scene.json` contains unit, focal length, baseline and force. Raises
    UserError if a sequence has no depth, or its camera moved in a way that is not stored.
    """
    for sequence in dataset:
        if "depth" not in sequence:
            raise UserError(f"{sequence.path}: has no depth; remove it from the job's store.without")
        folder = target / f"{sequence.index:06d}"
        left = optics.camera_of(sequence)
        focal = float(left.K[0, 0])
        bounds = _write_pictures(sequence, _maps(left, focal), folder)
        lens, views = np.array([[*sequence.size, focal]]).T, optics.camera_poses(sequence)
        transforms = (_pose(views[0] @ np.linalg.inv(view)) for view in views)  # to the camera of frame 0
        poses = [np.concatenate([pose, lens], axis=1).ravel() for pose in transforms]
        np.save(folder / "poses_bounds.npy", np.concatenate([poses, bounds], axis=1))
        metadata: dict[str, Any] = {
            "unit_mm": UNIT_MM,
            "focal_px": focal,
            "fps": sequence.attrs["fps"],
            "force_mn": sequence["force"][:].tolist() if "force" in sequence else None,
            "young_kpa": sequence.attrs["young_kpa"],
        }
        if "rgb_right" in sequence:
            right = stereo_checks.right_of(sequence)
            maps = _maps(right, focal, between(left, right)[0].T)
            for t in range(sequence.frames):
                write_png(folder / "images_right" / f"{t:06d}.png", maps.smooth(sequence["rgb_right"][t]))
            metadata["baseline_mm"] = sequence.attrs["right"]["baseline_mm"]
        (folder / "scene.json").write_text(json.dumps(metadata, indent=1), "utf-8")


def _maps(view: Camera, focal: float, turn: Floats = np.eye(3)) -> _Maps:
    """Maps from a pinhole with the principal point (W // 2, H // 2), which these programs assume, turned."""
    K = np.array([[focal, 0, view.size[0] // 2], [0, focal, view.size[1] // 2], [0, 0, 1]], np.float64)
    x, y = cv2.initUndistortRectifyMap(view.K, view.distortion, turn, K, view.size, cv2.CV_32FC1)
    return _Maps(np.asarray(x, np.float32), np.asarray(y, np.float32))


def _write_pictures(sequence: Sequence, maps: _Maps, folder: Path) -> Floats:
    """Images, depth and masks; returns nearest and farthest depth by frame, (T, 2)."""
    bounds = []
    for t in range(sequence.frames):
        depth = np.round(maps.nearest(sequence["depth"][t]) / UNIT_MM)
        if depth.max() > np.iinfo(np.uint16).max:
            raise UserError(f"{sequence.path}: depth exceeds 16 bits at {UNIT_MM:g} mm")
        covered = maps.nearest(sequence["tool"][t].astype(np.uint8), outside=1).astype(bool) | (depth == 0)
        write_png(folder / "images" / f"{t:06d}.png", maps.smooth(sequence["rgb"][t]))
        write_png(folder / "depth" / f"{t:06d}.png", depth.astype(np.uint16))
        write_png(folder / "masks" / f"{t:06d}.png", covered)
        depths = depth[~covered]
        bounds.append([depths.min(), depths.max()] if depths.size else [0.0, 0.0])
    return np.array(bounds)


def _pose(pose: Floats) -> Floats:
    """A transform (4, 4) in mm and OpenCV axes as (3, 4) in axes right, up, backward and the scene's unit."""
    rotation = _TO_OPENGL @ pose[:3, :3] @ _TO_OPENGL
    return np.concatenate([rotation, (_TO_OPENGL @ pose[:3, 3:]) / UNIT_MM], axis=1)
