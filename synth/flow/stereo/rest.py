"""Rest disparity of a stereo pair: OpenCV's semi-global matching, refined to subpixels by TV-L1 flow.

H. Hirschmueller, "Stereo processing by semiglobal matching and mutual information", PAMI 30, 2008, in
OpenCV's blockwise form. The refinement uses masks and local contrast, and preserves edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from synth.arrays import Map, Mask, Pixels
from synth.errors import UserError
from synth.flow.image import flags, luminance
from synth.flow.stereo.rig import Rectified, StereoRig
from synth.flow.tvl1 import Tvl1, TVL1Settings

_STEP = 16  # OpenCV requires ranges in multiples of it and returns sixteenths of a pixel
_MIN_TISSUE = 0.05  # share of the picture, below which its mask is in doubt
_BLOCK = 5  # px, side of the matched blocks; the penalties are those that OpenCV suggests for it
_MIN_CORRELATION = 0.5  # least local correlation of a match; chosen by hand
_MIN_MATCHED = 0.05  # share of the tissue that must match; chosen by hand
_MAX_REFINEMENT_PX = 1.5  # largest plausible change by the refinement; chosen by hand


@dataclass(frozen=True)
class Rest:
    """Rest disparity on rectified left pixels."""

    disparity: Map  # (H, W) px: left column minus right column; finite everywhere
    matched: Mask  # (H, W), False where it was filled from the surroundings
    epipolar_px: float  # median distance of matches from their row: calibration error; NaN: not refined


def match(left: Map, right: Map, left_usable: Mask, right_usable: Mask, *, refine: bool = True) -> Rest:
    """Rest disparity of a rectified pair of grey levels (H, W), or (n, H, W) of n frames, which are averaged.

    `left_usable`, `right_usable`: (H, W), unmasked tissue, and unmasked pixels of the right picture;
    `refine`: to subpixels. UserError: too little matches within an eighth of the width to both sides.
    """
    left, right = (np.atleast_3d(picture.T).T.mean(axis=0, dtype=np.float32) for picture in (left, right))
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
    # Padding lets pixels near the left and right borders match too.
    pad = count + abs(low)
    levels = (np.clip(np.rint(picture), 0, 255).astype(np.uint8) for picture in (left, right))
    padded = [cv2.copyMakeBorder(level, 0, 0, pad, pad, cv2.BORDER_REPLICATE) for level in levels]
    disparity = matcher.compute(*padded)[:, pad:-pad].astype(np.float32) / 16
    matched = (disparity >= low) & left_usable
    details, share = f"at disparities from {low} to {high} px", float(left_usable.mean())
    if share < _MIN_TISSUE:
        details += f" on the tissue, which is {100 * share:.2g}% of the picture: is tissue.png right?"
    error = UserError(f"stereo: the left and right rest pictures do not match {details}")
    if not matched.any():
        raise error
    # From the nearest match.
    filled = disparity[tuple(distance_transform_edt(~matched, return_distances=False, return_indices=True))]
    if not refine:
        return Rest(filled, matched, float("nan"))
    flow, trust = _refine(left, right, left_usable, right_usable, filled)
    refined = (np.abs(-flow[0] - filled) < _MAX_REFINEMENT_PX) & (trust > 0)
    reliable = refined & matched & (trust > _MIN_CORRELATION)
    if reliable.sum() < _MIN_MATCHED * left_usable.sum():
        raise error
    row_error_px = float(np.median(np.abs(flow[1][reliable])))
    return Rest(np.where(refined, -flow[0], filled).astype(np.float32), matched, row_error_px)


def measure_scale(rig: StereoRig, left: Pixels, right: Pixels, tissue: Mask | None = None) -> float:
    """Millimetres per pixel of the left picture, (H, W, 3) like the right one, on the tissue (H, W), or in
    the picture's middle half.

    UserError: the pictures differ in size or do not match.
    """
    height, width = left.shape[:2]
    if right.shape != left.shape:
        raise UserError(f"stereo: pictures {left.shape[:2]} and {right.shape[:2]} differ")
    if tissue is None:
        tissue = np.zeros((height, width), bool)
        tissue[height // 4 : -height // 4, width // 4 : -width // 4] = True
    rectified = Rectified(rig)
    depth = find_depth(rectified, left, right, rectified.flags(tissue, 0))
    return float(np.nanmedian(depth)) / rectified.focal


def find_depth(rectified: Rectified, left: Pixels, right: Pixels, usable: Mask) -> Map:
    """Depth (H, W) mm on rectified left pixels, to a sixteenth of a pixel; NaN where nothing matches.

    `left`, `right`: (H, W, 3), not rectified; `usable`: rectified left pixels to match. UserError: none do.
    """
    left_grey, right_grey = (
        rectified.picture(luminance(picture), camera) for camera, picture in enumerate((left, right))
    )
    rest = match(left_grey, right_grey, usable, np.full(usable.shape, True), refine=False)
    return np.where(rest.matched, rectified.depth(rest.disparity), np.nan).astype(np.float32)


def _refine(left: Map, right: Map, left_usable: Mask, right_usable: Mask, disparity: Map) -> tuple[Map, Map]:
    """Flow (2, H, W) px from the left to the right rest picture, and its agreement (H, W)."""
    initial = np.stack([-disparity, np.zeros_like(disparity)])
    pictures = np.ascontiguousarray(left), np.ascontiguousarray(right)
    usable = flags(left_usable), flags(right_usable)
    # A disparity isn't the flow of a frame before: it is smoothed as a whole.
    settings = TVL1Settings(large_px=np.inf)
    flow, trust, _ = Tvl1(settings, corrected=False).estimate_uncorrected(*pictures, *usable, initial)
    return flow, trust
