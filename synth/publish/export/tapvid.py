"""Export to TAP-Vid and TAPVid-3D (github.com/google-deepmind/tapnet): tracks of points through a video.

Coordinates as there: (0, 0) is the corner of the top-left pixel, whose centre is at (0.5, 0.5).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from synth.arrays import Array, Ints
from synth.checks import optics, stereo_checks
from synth.dataset.store import Dataset, Sequence
from synth.errors import UserError
from synth.publish.export.encoding import as_png
from synth.render.camera.camera import depth_of, rays

_POINTS = 1024


def write_tracks(dataset: Dataset, target: Path) -> None:
    """Writes `NNNNNN.npz` per sequence, without pickles: tracks of tissue points queried in frame 0.

    TAP-Vid: `video` (T, H, W, 3) uint8, `points` (N, T, 2) float32 x and y over (W, H), `occluded` (N, T).
    The content of its pickles is `{path.stem: dict(np.load(path)) for path in folder.glob("*.npz")}`.

    TAPVid-3D, for stereo datasets: `tracks_XYZ` (T, N, 3) m in axes of each frame's camera, `visibility` (T,
    N), `queries_xyt` (N, 3) px and frame, `fx_fy_cx_cy` (4,) px, `images_jpeg_bytes` (T,) PNGs. In addition,
    `distortion` (5,) (k1, k2, p1, p2, k3), which a pinhole projection neglects.

    Tracks are the ground truth: in space and picture they agree to 1e-3 px, or to the attribute
    `summary.rounding_px` where flow is stored as float16. STIR (github.com/athaddius/STIRLoader) uses the
    first and last frame only. Raises UserError if no tissue is visible in frame 0 of a sequence.
    """
    for sequence in dataset:
        pixels = _choose(sequence)
        columns, rows = pixels.T
        frames = range(sequence.frames)
        places = np.stack([pixels + 0.5 + sequence["flow"][t][rows, columns] for t in frames])
        visible = np.stack([sequence["visible"][t][rows, columns] for t in frames])
        video = sequence["rgb"][:]
        arrays = {
            "video": video,
            "points": (places / sequence.size[::-1]).astype(np.float32).swapaxes(0, 1),
            "occluded": ~visible.T,
        }
        if "motion" in sequence:
            arrays |= _in_depth(sequence, pixels)
            arrays["visibility"] = visible
            arrays["queries_xyt"] = np.insert(pixels + 0.5, 2, 0, axis=1).astype(np.float32)
            arrays["images_jpeg_bytes"] = np.array([as_png(picture) for picture in video])
        np.savez_compressed(target / f"{sequence.index:06d}.npz", **arrays)


def _choose(sequence: Sequence) -> Ints:
    """Pixels (N, 2) as x, y: a square grid of up to `_POINTS` on tissue visible in frame 0."""
    visible = sequence["tissue"][:] & sequence["visible"][0]
    step = max(1, int(np.ceil(np.sqrt(visible.sum() / _POINTS))))
    grid = np.zeros_like(visible)
    grid[step // 2 :: step, step // 2 :: step] = True
    pixels = np.argwhere(visible & grid)[:, ::-1]
    if not len(pixels):
        raise UserError(f"{sequence.path}: shows no tissue in frame 0")
    return pixels


def _in_depth(sequence: Sequence, pixels: Ints) -> dict[str, Array]:
    """Tracks of pixels (N, 2) of frame 0 in space, and the camera's intrinsics."""
    view, right = optics.camera_of(sequence), stereo_checks.right_of(sequence)
    (fx, _, cx), (_, fy, cy), _ = view.K
    columns, rows = pixels.T
    directions = rays(view, pixels.astype(np.float64))
    rest = directions * depth_of(view, right, directions, sequence["disparity"][:][rows, columns])[:, None]
    tracks = np.stack([rest + sequence["motion"][t][rows, columns] for t in range(sequence.frames)])
    return {
        "tracks_XYZ": (tracks / 1000).astype(np.float32),
        "fx_fy_cx_cy": np.array([fx, fy, cx + 0.5, cy + 0.5]),
        "distortion": view.distortion,
    }
