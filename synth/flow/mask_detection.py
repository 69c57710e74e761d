"""Detection of specular highlights, instruments and exposed cortex in single frames."""

from __future__ import annotations

import cv2
import numpy as np

from synth.arrays import Mask, Pixels
from synth.flow import toolnet

# Chosen by hand on renders and photographs of cortex; `mask_selection` rejects false positives.
_CLIPPED = 240.0  # grey levels: two channels above it have no texture left
_ABOVE = 45.0  # grey levels of a highlight above the local median
_SOME = 0.1  # mean probability above which a grey body counts as an instrument
_OUTLINE_PX = 240  # longer side of the downsampled picture in which the cortex is segmented
_MIDDLE = 0.6  # squared radius of the initial ellipse of cortex, in half sides of the picture
_BLACK, _BLOODY = 60, 0.42  # grey levels; ratio of green to red (sRGB)
_VESSEL_MM = 3.0  # widest vessel: larger red areas are pooled blood
_INSET_PX = 5  # px of the downsampled picture, kernel by which the outline is eroded
_SHRINK = 4  # factor of downsampling for the local median


def glare(rgb: Pixels, dilate_px: int = 1) -> Mask:
    """Mask (H, W) of the specular highlights of `rgb` (H, W, 3) uint8, grown by `dilate_px`.

    A highlight is much brighter than the local median. Brightness is that of the darkest channel, because a
    highlight has the colour of the lamp and tissue lacks blue.
    """
    red, green, blue = (np.ascontiguousarray(rgb[..., k]) for k in range(3))
    least, most = np.minimum(red, green), np.maximum(red, green)
    whiteness = np.minimum(least, blue)
    second = np.maximum(least, np.minimum(most, blue))
    height, width = whiteness.shape
    size = max(1, width // _SHRINK), max(1, height // _SHRINK)
    small = cv2.resize(whiteness, size, interpolation=cv2.INTER_AREA)
    window = max(3, (max(height, width) // (4 * _SHRINK)) | 1)
    median = cv2.resize(cv2.medianBlur(small, window), (width, height), interpolation=cv2.INTER_LINEAR)
    bright = (whiteness.astype(np.float32) > median + _ABOVE) | (second > _CLIPPED)
    return _grow(bright, dilate_px)


def tool(rgb: Pixels) -> Mask:
    """Instrument mask (H, W) of `rgb` (H, W, 3) uint8, grown by 2 px."""
    return _grow(both(rgb, toolnet.load()), 2)


def both(rgb: Pixels, net: toolnet.ToolNet) -> Mask:
    """Instruments (H, W): pixels of high probability, and whole grey bodies (steel) of some probability."""
    probable = toolnet.probability(net, rgb)
    count, label = cv2.connectedComponents(grey_bodies(rgb).astype(np.uint8))
    size = np.bincount(label.ravel(), minlength=count)
    inside = np.bincount(label.ravel(), weights=probable.ravel(), minlength=count)
    keep = inside > _SOME * size
    keep[0] = False
    return np.asarray((probable > 0.5) | keep[label], bool)


def blocked(rgb: Pixels) -> Mask:
    """Mask (H, W) of the specular highlights and instruments found in `rgb` (H, W, 3) uint8."""
    return np.asarray(glare(rgb) | tool(rgb), bool)


def cortex(rgb: Pixels, mm_per_px: float) -> Mask:
    """Mask (H, W) of the exposed cortex in a picture (H, W, 3) sRGB.

    Pixels that resemble the middle of the picture more than its edge (C. Rother et al., "GrabCut", 2004),
    without those that are black, blue, covered by blood or part of an instrument.
    """
    scale = min(1.0, _OUTLINE_PX / max(rgb.shape))
    small = cv2.medianBlur(cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), 5)
    red, green, blue = np.moveaxis(small.astype(np.float32), 2, 0)
    wide = (max(3, round(_VESSEL_MM / mm_per_px * scale)),) * 2
    bloody = cv2.blur((green < _BLOODY * red).astype(np.float32), wide) > 0.9
    steel = cv2.resize(tool(rgb).astype(np.uint8), small.shape[1::-1]) > 0
    y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in small.shape[:2]), indexing="ij")
    label = np.where(x**2 + y**2 < _MIDDLE, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    label[(small.max(axis=2) < _BLACK) | (blue > 1.1 * red) | bloody | steel] = cv2.GC_BGD
    if not (label == cv2.GC_PR_FGD).any():
        return np.zeros(rgb.shape[:2], bool)
    cv2.setRNGSeed(1)  # for the initial colour clusters
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(np.ascontiguousarray(small[..., ::-1]), label, None, *models, 6, cv2.GC_INIT_WITH_MASK)
    inside = (label == cv2.GC_PR_FGD).astype(np.uint8)
    found = cv2.erode(inside, np.ones((_INSET_PX, _INSET_PX)), borderValue=1)
    return np.asarray(cv2.resize(found, rgb.shape[1::-1]) > 0)


def hidden(video: Pixels, tools: Mask) -> Mask:
    """Masks (T, H, W) of a video (T, H, W, 3): given instrument masks joined with the detected glare."""
    return np.asarray(tools | np.stack([glare(picture) for picture in video]), bool)


def grey_bodies(rgb: Pixels) -> Mask:
    """Mask (H, W) of connected pixels of little colour that touch the border and cover 0.3% of it."""
    red, green, blue = cv2.split(rgb)
    top = np.maximum(np.maximum(red, green), blue)
    colour = top - np.minimum(np.minimum(red, green), blue)
    grey = (colour < (0.22 * np.arange(256) + 4).astype(np.float32)[top]).astype(np.uint8)
    grey = cv2.morphologyEx(grey, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, label, stats, _ = cv2.connectedComponentsWithStats(grey)
    height, width = grey.shape
    left, upper = stats[:, cv2.CC_STAT_LEFT], stats[:, cv2.CC_STAT_TOP]
    right, lower = left + stats[:, cv2.CC_STAT_WIDTH], upper + stats[:, cv2.CC_STAT_HEIGHT]
    keep = (left == 0) | (upper == 0) | (right == width) | (lower == height)
    keep &= stats[:, cv2.CC_STAT_AREA] > 0.003 * height * width
    keep[0] = False
    return np.asarray(keep[label], bool)


def _grow(found: Mask, by_px: int) -> Mask:
    wide = 2 * by_px + 1
    element = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (wide, wide))
    return np.asarray(cv2.dilate(found.astype(np.uint8), element), bool)
