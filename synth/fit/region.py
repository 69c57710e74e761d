"""Where a photograph shows cortex that can be measured: found in the picture, or a mask by hand."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from synth.flow import mask

Picture = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

_SIDE_PX = 240  # of the small picture that the outline is found in
_MIDDLE = 0.35  # squared radius of the ellipse that is taken for cortex at first, half sides are 1
_BLACK_L = 20.0
_BLOODY = 0.42  # green over red (sRGB): wide places below it are blood, muscle or a flap of dura
_ROUNDS = 6
_INSET = 0.008  # widths by which the outline is drawn in


def find_cortex(rgb: Picture) -> Mask:
    """(H, W): the exposed cortex, without instruments and dark border.

    What is like the middle of the picture and not like its edge (C. Rother et al., "GrabCut", 2004), less
    what is black, blue, soaked with blood or found to be an instrument; the largest piece of it.
    """
    height, width = rgb.shape[:2]
    scale = min(1.0, _SIDE_PX / max(height, width))
    small = cv2.medianBlur(cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), 5)
    tool = mask.tool(
        cv2.resize(rgb, None, fx=min(1.0, 3 * scale), fy=min(1.0, 3 * scale), interpolation=cv2.INTER_AREA)
    )
    off = _never_cortex(small) | (cv2.resize(tool.astype(np.uint8), small.shape[1::-1]) > 0)
    y, x = np.mgrid[: small.shape[0], : small.shape[1]] / np.array(small.shape[:2])[:, None, None] * 2 - 1
    middle = x**2 + y**2 < _MIDDLE
    label = np.where(middle, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    label[off] = cv2.GC_BGD
    if not (middle & ~off).any():
        return np.zeros((height, width), bool)
    cv2.setRNGSeed(1)  # of the colour clusters' first guess
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(np.ascontiguousarray(small[..., ::-1]), label, None, *models, _ROUNDS, cv2.GC_INIT_WITH_MASK)
    found = _largest(label == cv2.GC_PR_FGD)
    inset = 2 * max(1, round(_INSET * small.shape[1])) + 1
    found = cv2.erode(found.astype(np.uint8), np.ones((inset, inset), np.uint8), borderValue=1)
    whole = cv2.resize(found, (width, height), interpolation=cv2.INTER_LINEAR) > 0
    return np.asarray(whole & ~(cv2.resize(tool.astype(np.uint8), (width, height)) > 0))


def _never_cortex(small: Picture) -> Mask:
    """Black, blue, or red over a width that no artery has."""
    lab = cv2.cvtColor(small.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    red, green, blue = (small[..., k].astype(np.float32) for k in range(3))
    bloody = (green < _BLOODY * red).astype(np.uint8)
    bloody = cv2.morphologyEx(bloody, cv2.MORPH_OPEN, np.ones((7, 7), np.uint8)) > 0
    return np.asarray((lab[..., 0] < _BLACK_L) | (blue > 1.1 * red) | bloody)


def _largest(mask_: Mask) -> Mask:
    """The largest connected piece, its small gaps closed."""
    count, label, stats, _ = cv2.connectedComponentsWithStats(mask_.astype(np.uint8))
    if count < 2:
        return mask_
    piece = (label == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))).astype(np.uint8)
    return np.asarray(cv2.morphologyEx(piece, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)) > 0)
