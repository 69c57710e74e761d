"""A photograph of cortex at the scale of a job's pictures, with what of it can be measured."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from synth.errors import UserError
from synth.fit.compression import Compression
from synth.fit.statistics import Mask, Picture
from synth.flow import mask_detection
from synth.job.schema import RenderSection
from synth.system import checked_file

_SMALLEST_PX = 160
_LEAST_MM2 = 60.0  # of cortex
_SIDE_PX = 240  # of the small picture that the outline is found in
_MIDDLE = 0.6  # squared radius of the ellipse that is taken for cortex at first, half sides are 1
_BLACK_L = 20.0
_BLOODY = 0.42  # green over red (sRGB)
_VESSEL_MM = 3.0  # no vessel is wider: what is bloody over more is something else
_INSET = 0.008  # widths by which the outline is drawn in


@dataclass(frozen=True)
class Photograph:
    """What a look is measured in."""

    rgb: Picture
    """(H, W, 3) sRGB."""
    usable: Mask
    """(H, W) cortex, without instruments."""
    mm_per_px: float
    compression: Compression

    @property
    def cortex_mm2(self) -> float:
        """Area that can be measured."""
        return float(self.usable.sum()) * self.mm_per_px**2


def read_photograph(path: Path, width_mm: float, mask: Path | None) -> Photograph:
    """The photograph at the scale of a default job's pictures, or at its own where that is coarser.

    Args:
        path: a picture file.
        width_mm: what its width spans at the cortex.
        mask: a picture of the same size, white where there is cortex to be measured; found if not given.

    Raises:
        UserError: it is no picture, too small, or shows too little cortex.
    """
    rgb = np.ascontiguousarray(np.asarray(checked_file.read_picture(path), np.uint8)[..., ::-1])
    if min(rgb.shape[:2]) < _SMALLEST_PX:
        raise UserError(f"{path}: smaller than {_SMALLEST_PX} pixels")
    own = width_mm / rgb.shape[1]
    if mask is None:
        usable = find_cortex(rgb, own)
    else:
        usable = np.asarray(checked_file.read_picture(mask, cv2.IMREAD_GRAYSCALE)) > 127
        if usable.shape != rgb.shape[:2]:
            raise UserError(f"{mask}: is of another size than the photograph")
    usual = RenderSection()
    finer = max(1.0, sum(usual.field_mm) / 2 / usual.size[0] / own)
    if finer > 1.02:
        small = {"dsize": None, "fx": 1 / finer, "fy": 1 / finer, "interpolation": cv2.INTER_AREA}
        rgb = np.asarray(cv2.resize(rgb, **small), np.uint8)
        usable = np.asarray(cv2.resize(usable.astype(np.float32), **small) > 0.99)
    else:
        finer = 1.0
    data = checked_file.read_bytes(path, checked_file.LARGEST_PICTURE)
    found = Photograph(rgb, usable, own * finer, Compression.of_file(data, finer))
    if found.cortex_mm2 < _LEAST_MM2:
        raise UserError(
            f"{path}: {found.cortex_mm2:.0f} mm2 of cortex in a width of {width_mm:g} mm, {_LEAST_MM2:g} are "
            "needed; mark it with --mask, or say with --width-mm what the picture spans"
        )
    return found


def find_cortex(rgb: Picture, mm_per_px: float) -> Mask:
    """(H, W): the exposed cortex, without instruments and dark border.

    What is like the middle of the picture and not like its edge (C. Rother et al., "GrabCut", 2004), less
    what is black, blue, soaked with blood or found to be an instrument.

    Args:
        rgb: (H, W, 3) sRGB.
        mm_per_px: its scale.
    """
    height, width = rgb.shape[:2]
    scale = min(1.0, _SIDE_PX / max(height, width))
    small = cv2.medianBlur(cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), 5)
    finer = min(1.0, 3 * scale)
    larger = cv2.resize(rgb, None, fx=finer, fy=finer, interpolation=cv2.INTER_AREA)
    tool = mask_detection.tool(larger).astype(np.uint8)
    side = 2 * max(1, round(_VESSEL_MM / mm_per_px * scale / 2)) + 1
    wide = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    lab = cv2.cvtColor(small.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    red, green, blue = (small[..., k].astype(np.float32) for k in range(3))
    bloody = cv2.morphologyEx((green < _BLOODY * red).astype(np.uint8), cv2.MORPH_OPEN, wide) > 0
    never = (lab[..., 0] < _BLACK_L) | (blue > 1.1 * red) | bloody
    never |= cv2.resize(tool, small.shape[1::-1]) > 0
    y, x = np.mgrid[: small.shape[0], : small.shape[1]] / np.array(small.shape[:2])[:, None, None] * 2 - 1
    middle = x**2 + y**2 < _MIDDLE
    if not (middle & ~never).any():
        return np.zeros((height, width), bool)
    label = np.where(middle, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    label[never] = cv2.GC_BGD
    cv2.setRNGSeed(1)  # of the colour clusters' first guess
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(np.ascontiguousarray(small[..., ::-1]), label, None, *models, 6, cv2.GC_INIT_WITH_MASK)
    found = ((label == cv2.GC_PR_FGD) & ~never).astype(np.uint8)
    inset = 2 * max(1, round(_INSET * small.shape[1])) + 1
    found = cv2.erode(found, np.ones((inset, inset), np.uint8), borderValue=1)
    whole, off = (cv2.resize(one, (width, height)) > 0 for one in (found, tool))
    return np.asarray(whole & ~off)
