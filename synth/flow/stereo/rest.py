"""Rest disparity of a stereo pair: OpenCV's semi-global matching, then our flow to a part of a pixel.

H. Hirschmueller, "Stereo processing by semiglobal matching and mutual information", PAMI 30, 2008, in
OpenCV's blockwise form. TV-L1 refines it: masked, on local contrast, with edges kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from synth.errors import UserError
from synth.flow.tvl1 import Tvl1, one_thread

Map = NDArray[np.float32]
Flags = NDArray[np.bool_]

_STEP = 16  # OpenCV takes ranges in multiples of it, and gives sixteenths of a pixel
_BLOCK = 5  # px of a match; the penalties are OpenCV's for it
_ALIKE = 0.5  # local correlation of a match; by hand
_ENOUGH = 0.05  # share of the tissue that must match; by hand
_TRUSTED_PX = 1.5  # a refinement by more found something else; by hand


@dataclass(frozen=True)
class Rest:
    """The pair at rest, on rectified left pixels."""

    disparity: Map  # (H, W) px: the left eye's column less the right eye's; finite everywhere
    found: Flags  # (H, W), False where it was filled in from around
    epipolar_px: float
    """Median distance of what matches from its row: how far off the calibration is. NaN: not refined."""


def match(left: Map, right: Map, left_usable: Flags, right_usable: Flags, *, refine: bool = True) -> Rest:
    """Rest disparity of a rectified pair.

    Args:
        left: (n, H, W) grey levels of n rest frames, or (H, W) of one: their mean has less noise.
        right: the same of the right eye.
        left_usable: (H, W), tissue that is neither under the tool nor in glare.
        right_usable: (H, W), the same of the right eye.
        refine: to a part of a pixel; else as semi-global matching finds it.

    Raises:
        UserError: nothing matches within an eighth of the width to both sides.
    """
    left, right = (np.atleast_3d(one.T).T.mean(axis=0, dtype=np.float32) for one in (left, right))
    width = left.shape[1]
    low, high = -width // 8, width // 8
    count = max(1, -(-(high - low + 1) // _STEP)) * _STEP
    matcher = cv2.StereoSGBM.create(
        minDisparity=low,
        numDisparities=count,
        blockSize=_BLOCK,
        P1=8 * _BLOCK**2,
        P2=32 * _BLOCK**2,
        disp12MaxDiff=1,
        uniquenessRatio=5,
        speckleWindowSize=100,
        speckleRange=2,
    )
    # What lies left of the picture's reach matches too, once the right picture has room for it.
    room = count + abs(low)
    padded = [
        cv2.copyMakeBorder(_bytes(one), 0, 0, room, room, cv2.BORDER_REPLICATE) for one in (left, right)
    ]
    raw = matcher.compute(*padded)[:, room:-room].astype(np.float32) / 16
    found = (raw >= low) & left_usable
    if not found.any():
        raise UserError(f"stereo: the two eyes' rest pictures don't match between {low} and {high} px")
    filled = _filled(raw, found)
    if not refine:
        return Rest(filled, found, float("nan"))
    flow, trust = _refined(left, right, left_usable, right_usable, filled)
    better = (np.abs(-flow[0] - filled) < _TRUSTED_PX) & (trust > 0)
    sure = better & found & (trust > _ALIKE)
    if sure.sum() < _ENOUGH * left_usable.sum():
        raise UserError(f"stereo: the two eyes' rest pictures don't match between {low} and {high} px")
    off = float(np.median(np.abs(flow[1][sure])))
    return Rest(np.where(better, -flow[0], filled).astype(np.float32), found, off)


def _refined(left: Map, right: Map, left_usable: Flags, right_usable: Flags, start: Map) -> tuple[Map, Map]:
    """Flow (2, H, W) px from the left rest picture to the right one, and its confidence (H, W)."""

    def wide(field: NDArray[np.generic]) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(field, np.float32))[None, None]

    initial = torch.from_numpy(np.stack([-start, np.zeros_like(start)]))[None]
    with torch.inference_mode(), one_thread():
        flow, trust, _ = Tvl1(corrected=False).tensors(
            wide(left), wide(right), wide(left_usable), wide(right_usable), initial
        )
    return flow[0].numpy(), trust[0, 0].numpy()


def _filled(raw: Map, found: Flags) -> Map:
    """What was not found, from the nearest that was."""
    rows, columns = distance_transform_edt(~found, return_distances=False, return_indices=True)
    return np.ascontiguousarray(raw[rows, columns])


def _bytes(grey: Map) -> NDArray[np.uint8]:
    return np.asarray(np.clip(np.rint(grey), 0, 255), np.uint8)
