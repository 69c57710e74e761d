"""Features of a frame that don't need the true force: size and kind of its motion, and its confidence."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from synth.arrays import Floats, Map, Mask

MOTION = ("log motion", "divergence", "uniform share", "spread", "confidence", "tissue share")
DEPTH = ("log depth motion", "confidence of depth", "uniform share of depth")  # of stereo
ESTIMATE = ("log size", "log area")  # of the force estimate

FLOOR_MM = 0.005  # added to motion before its logarithm; under the noise of any flow
RESTING_MM = 0.02  # root mean square of motion under which a frame is not judged
_REACH_MM = 10.0  # length by which a divergence is multiplied to a motion
_ACROSS = 32  # blocks of cells along the grid's edge
_LOW_SHARE = 0.02  # of the training data's force; smaller forces are not distinguished


def motion_names(depth: bool) -> tuple[str, ...]:
    """Names of `motion_features`, monocular or with stereo `depth`."""
    return MOTION + DEPTH * depth


def motion_features(displacement: Map, mask: Map, confidence: Map | None, extent_mm: float) -> Floats:
    """Features of each frame, (T, F), in the order of `motion_names`.

    `displacement`: (T, 2 or 3, N, N) mm; `mask`: (N, N) 0/1, tissue; `confidence`: (T, 1 or 2, N, N) in 0..1,
    None: 1.
    """
    inside = mask > 0
    shift, weight = _coarse(displacement * inside, inside)
    # If the tissue is smaller than a block: the blocks that hold most of it.
    is_tissue = weight > (0.5 if (weight > 0.5).any() else 0.99 * weight.max())
    u = np.moveaxis(shift, 1, -1)[:, is_tissue].astype(np.float64)
    squared = np.square(u[..., :2]).sum(-1)
    motion = np.sqrt(squared.mean(1))
    stretch = _REACH_MM * _divergence(shift[:, :2], is_tissue, extent_mm / weight.shape[0])
    means = np.ones((len(u), displacement.shape[1] - 1))  # of the confidence over the tissue
    if confidence is not None:
        means = np.asarray(confidence[..., inside].mean(-1, dtype=np.float64))
    columns = [
        np.log(motion + FLOOR_MM),
        np.log((stretch + FLOOR_MM) / (motion + FLOOR_MM)),
        np.linalg.norm(u[..., :2].mean(1), axis=-1) / (motion + FLOOR_MM),
        np.sqrt(squared).mean(1) / (motion + FLOOR_MM),
        means[:, 0],
        np.full(len(u), inside.mean()),
    ]
    if displacement.shape[1] == 3:
        depth = np.sqrt(np.square(u[..., 2]).mean(1))
        columns += [
            np.log((depth + FLOOR_MM) / (motion + FLOOR_MM)),
            means[:, 1],
            # Breathing lifts the whole surface, an instrument only the tissue near it.
            np.abs(u[..., 2].mean(1)) / (depth + FLOOR_MM),
        ]
    return np.stack(columns, axis=1)


def is_moving(motion: Floats) -> Mask:
    """(T,) whether the motion of frames with `motion_features` (T, F) is above `RESTING_MM`."""
    return np.asarray(motion[:, 0] > np.log(RESTING_MM + FLOOR_MM))


def estimate_features(size: Floats, magnitude: Map, cell_mm2: float) -> Floats:
    """`ESTIMATE` of each frame, (T, 2), from the force's size (T,), as a share of the training data's, and
    its map (T, N, N), any unit."""
    flat = magnitude.reshape(len(magnitude), -1).astype(np.float64)
    area = cell_mm2 * flat.sum(1) ** 2 / np.maximum(np.square(flat).sum(1), 1e-30)
    return np.stack([np.log(size + _LOW_SHARE), np.log(area + 1.0)], axis=1)


def _coarse(values: Map, inside: Mask) -> tuple[Floats, Floats]:
    """Means over the tissue of blocks of cells, (T, C, n, n), and each block's share of tissue, (n, n)."""
    block = max(1, len(inside) // _ACROSS)
    n = len(inside) // block
    cut = slice(0, n * block)

    def pool(a: NDArray[np.floating | np.bool_]) -> Floats:
        parts = a[..., cut, cut].reshape(*a.shape[:-2], n, block, n, block)
        return np.asarray(parts.mean(axis=(-3, -1), dtype=np.float64))

    share = pool(inside)
    return pool(values) / np.where(share > 0, share, 1.0), share


def _divergence(shift: Floats, is_tissue: Mask, pitch_mm: float) -> Floats:
    """(T,) root mean square of the divergence of (T, 2, n, n), by forward differences in the tissue."""
    is_inside = is_tissue[:-1, :-1] & is_tissue[:-1, 1:] & is_tissue[1:, :-1]
    if not is_inside.any():
        return np.zeros(len(shift))
    across = np.diff(shift[:, 0], axis=2)[:, :-1][:, is_inside]
    down = np.diff(shift[:, 1], axis=1)[:, :, :-1][:, is_inside]
    return np.asarray(np.sqrt(np.square((across + down) / pitch_mm).mean(1)))
