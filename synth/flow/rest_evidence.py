"""What the rest frame says of instruments in a later frame: where nothing has changed, none has appeared.

The segmentation judges by looks. The rest frame, aligned by a coarse flow, adds what has changed since. Where
the picture has, the odds of an instrument rise by a factor: shadows and highlights change it too, but the
segmentation tells them from steel. Where it hasn't, which the texture of the rest
frame has to tell, and there was no instrument at rest, they fall by the same factor. The odds are then
smoothed between the edges of the picture (D. Min et al., IEEE TIP 2014), so that the rims of a shaft go with
its middle, and specks with what is around them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from scipy.special import expit, logit

from synth.arrays import Array, Map, Mask, Pixels
from synth.flow import image
from synth.flow.segmentation import Segmentation

_cv2: Any = cv2  # the type stubs of OpenCV lack the contributed modules


class Limits:
    """Chosen by hand on 18 videos by Cycles, and on renders and photographs with instruments."""

    side: int = 160  # px, longest side of the pictures that are compared
    smallest: int = 64  # px a side: the coarse flow reads beyond pictures with less than 32
    factor: float = 5.0  # of odds; with 9 the motion at contacts that renders show is less by another 1%
    changed: float = 6.4  # grey levels over the picture's median change from which it has changed
    same: float = 4.0  # the same, below which it has not
    texture: float = 6.0  # standard deviation [grey levels] in a window of the rest frame that tells so
    min_instrument: float = 0.5  # probability of an instrument at rest from which it may lie still
    known: float = 0.004  # probability from 0 and from 1 within which odds tell nothing
    across_px: int = 5  # side of the window of the mean change, of the flow's median and mean
    around_px: int = 7  # side of the window of the texture
    smooth: float = 10.0  # weight of smoothness
    edge: float = 8.0  # grey levels of an edge over which odds are not smoothed


class RestEvidence:
    """Weighs the instruments in the frames of a video by its rest frame."""

    def __init__(self, rest: Pixels, at_rest: Segmentation) -> None:
        """Starts with the rest frame (H, W, 3) uint8 and its classes."""
        self._rest, self._instrument = _shrink(rest), _shrink(at_rest.instrument)

    def weigh(self, segmentation: Segmentation, frame: Pixels) -> Segmentation:
        """The classes of a later frame (H, W, 3) uint8, with other odds of instruments."""
        small = _shrink(frame)
        rest, before = align(small, self._rest, self._instrument)
        changed, unchanged = compare(small, rest)
        odds = logit(np.clip(_shrink(segmentation.instrument), Limits.known, 1 - Limits.known))
        evidence = np.where(changed, 1, 0) - np.where(unchanged & (before < Limits.min_instrument), 1, 0)
        odds = (odds + np.log(Limits.factor) * evidence).astype(np.float32)
        odds = _cv2.ximgproc.fastGlobalSmootherFilter(small, odds, Limits.smooth, Limits.edge)
        return replace(segmentation, instrument=expit(cv2.resize(odds, frame.shape[1::-1])))


def align(frame: Pixels, rest: Pixels, instrument: Map) -> tuple[Pixels, Map]:
    """The rest frame (h, w, 3) uint8 and the probability of instruments there (h, w) at the pixels of a frame
    of its size, by a coarse flow (T. Kroeger et al., ECCV 2016)."""
    solver = _cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    backward_flow = solver.calc(_contrast(frame), _contrast(rest), np.zeros((*rest.shape[:2], 2), np.float32))
    side = Limits.across_px
    smooth = cv2.blur(
        np.dstack([cv2.medianBlur(plane, side) for plane in cv2.split(backward_flow)]), (side, side)
    )
    columns, rows = image.end_points(smooth)
    mode = cv2.INTER_LINEAR
    return (
        np.asarray(cv2.remap(rest, columns, rows, mode, borderMode=cv2.BORDER_REPLICATE), np.uint8),
        np.asarray(cv2.remap(instrument, columns, rows, mode, borderMode=cv2.BORDER_REPLICATE), np.float32),
    )


def compare(frame: Pixels, rest: Pixels) -> tuple[Mask, Mask]:
    """Where (h, w) a frame differs from the aligned rest frame, and where it is known not to; (h, w, 3) uint8
    each."""
    after, before = (cv2.blur(picture, (3, 3)).astype(np.float32) for picture in (frame, rest))
    change = np.abs(after - before).mean(axis=-1)
    change = cv2.blur(change, (Limits.across_px,) * 2) - np.median(change)
    grey, window = image.luminance(rest) - 128, (Limits.around_px,) * 2
    variance = cv2.blur(grey * grey, window) - cv2.blur(grey, window) ** 2
    return change > Limits.changed, (change < Limits.same) & (variance > Limits.texture**2)


def _contrast(picture: Pixels) -> Pixels:
    """Contrast-normalised picture (h, w) uint8, centred at 128."""
    grey = image.normalise(image.luminance(picture), np.ones(picture.shape[:2], np.float32))
    return np.clip(np.round(128 + image.GREY_PER_DEVIATION * grey), 0, 255).astype(np.uint8)


def _shrink(planes: Array) -> Array:
    """A picture (H, W, 3) or map (H, W) at the size at which pictures are compared."""
    height, width = planes.shape[:2]
    share = Limits.side / max(height, width)
    mode = cv2.INTER_AREA if share < 1 else cv2.INTER_LINEAR
    size = max(Limits.smallest, round(width * share)), max(Limits.smallest, round(height * share))
    return np.asarray(cv2.resize(planes, size, interpolation=mode))
