"""Where a photograph shows cortex that can be measured: found in the picture, or a mask by hand."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from synth.flow import mask

Picture = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

_SIDE_PX = 240  # of the small picture that the outline is found in
_MIDDLE = 0.6  # squared radius of the ellipse that is taken for cortex at first, half sides are 1
_BLACK_L = 20.0
_BLOODY = 0.42  # green over red (sRGB)
_VESSEL_MM = 3.0  # no vessel is wider: what is bloody, or apart by more, is something else
_PIECE = 0.15  # of the largest piece's area: smaller ones are no cortex
_ROUNDS = 6
_INSET = 0.008  # widths by which the outline is drawn in


def find_cortex(rgb: Picture, mm_per_px: float) -> Mask:
    """(H, W): the exposed cortex, without instruments and dark border.

    What is like the middle of the picture and not like its edge (C. Rother et al., "GrabCut", 2004), with the
    vessels between, less what is black, blue, soaked with blood or found to be an instrument.

    Args:
        rgb: (H, W, 3) sRGB.
        mm_per_px: its scale.
    """
    height, width = rgb.shape[:2]
    scale = min(1.0, _SIDE_PX / max(height, width))
    small = cv2.medianBlur(cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), 5)
    finer = min(1.0, 3 * scale)
    tool = mask.tool(cv2.resize(rgb, None, fx=finer, fy=finer, interpolation=cv2.INTER_AREA)).astype(np.uint8)
    wide = _disc(_VESSEL_MM / mm_per_px * scale / 2)
    never = _never_cortex(small, wide) | (cv2.resize(tool, small.shape[1::-1]) > 0)
    y, x = np.mgrid[: small.shape[0], : small.shape[1]] / np.array(small.shape[:2])[:, None, None] * 2 - 1
    middle = x**2 + y**2 < _MIDDLE
    if not (middle & ~never).any():
        return np.zeros((height, width), bool)
    label = np.where(middle, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    label[never] = cv2.GC_BGD
    cv2.setRNGSeed(1)  # of the colour clusters' first guess
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(np.ascontiguousarray(small[..., ::-1]), label, None, *models, _ROUNDS, cv2.GC_INIT_WITH_MASK)
    found = (_pieces(label == cv2.GC_PR_FGD, wide) & ~never).astype(np.uint8)
    inset = 2 * max(1, round(_INSET * small.shape[1])) + 1
    found = cv2.erode(found, np.ones((inset, inset), np.uint8), borderValue=1)
    whole, off = (cv2.resize(one, (width, height)) > 0 for one in (found, tool))
    return np.asarray(whole & ~off)


def _never_cortex(small: Picture, wide: npt.NDArray[np.uint8]) -> Mask:
    """Black, blue, or red over a width that no artery has."""
    lab = cv2.cvtColor(small.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    red, green, blue = (small[..., k].astype(np.float32) for k in range(3))
    bloody = cv2.morphologyEx((green < _BLOODY * red).astype(np.uint8), cv2.MORPH_OPEN, wide) > 0
    return np.asarray((lab[..., 0] < _BLACK_L) | (blue > 1.1 * red) | bloody)


def _pieces(found: Mask, wide: npt.NDArray[np.uint8]) -> Mask:
    """The large pieces with the vessels that part them."""
    count, label, stats, _ = cv2.connectedComponentsWithStats(found.astype(np.uint8))
    if count < 2:
        return found
    area = stats[:, cv2.CC_STAT_AREA]
    large = area >= _PIECE * area[1:].max()
    large[0] = False
    side = len(wide)
    padded = np.pad(large[label].astype(np.uint8), side, mode="edge")
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, wide)[side:-side, side:-side]
    return np.asarray(closed > 0)


def _disc(radius: float) -> npt.NDArray[np.uint8]:
    side = 2 * max(1, round(radius)) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)
