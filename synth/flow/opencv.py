"""OpenCV's flow estimators as `Estimator`s, on contrast-normalised pictures with masked pixels filled."""

from typing import Any

import cv2
import numpy as np

from synth.arrays import Map, Mask, Pixels
from synth.flow import image

_RESIDUAL = 0.6  # local deviations between aligned pictures at which the confidence is 1/e
_SMALLEST = 16  # px a side that the pyramids of OpenCV's estimators need
_cv2: Any = cv2  # the type stubs of OpenCV lack the contributed modules


class OpenCvTvl1:
    """TV-L1 of Zach, Pock and Bischof (2007) in OpenCV, with settings chosen for cortex.

    OpenCV's default pyramid (step 0.8, 5 levels) is too shallow for motion of 10 px.
    """

    def __init__(self, weight: float = 0.1, warps: int = 3) -> None:
        self.weight, self.warps = weight, warps

    def flow(
        self, rest: Pixels, now: Pixels, rest_usable: Mask, now_usable: Mask, initial: Map | None = None
    ) -> tuple[Map, Map]:
        """See `Estimator.flow`."""
        pyramid = {"nscales": 5, "scaleStep": 0.5, "warps": self.warps, "useInitialFlow": initial is not None}
        energy = {"tau": 0.25, "lambda_": self.weight, "theta": 0.3, "gamma": 0.0, "epsilon": 0.01}
        rounds = {"outerIterations": 1, "innnerIterations": 10, "medianFiltering": 5}
        solver = _cv2.optflow.DualTVL1OpticalFlow_create(**pyramid, **energy, **rounds)
        return _solve(solver, rest, now, rest_usable, now_usable, initial)


class Dis:
    """Dense inverse search, Kroeger et al. (2016), OpenCV's medium preset: fast, less sharp."""

    def flow(
        self, rest: Pixels, now: Pixels, rest_usable: Mask, now_usable: Mask, initial: Map | None = None
    ) -> tuple[Map, Map]:
        """See `Estimator.flow`."""
        solver = _cv2.DISOpticalFlow_create(_cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        return _solve(solver, rest, now, rest_usable, now_usable, initial)


def _solve(
    solver: Any, rest: Pixels, now: Pixels, rest_usable: Mask, now_usable: Mask, initial: Map | None
) -> tuple[Map, Map]:
    height, width = rest_usable.shape
    before, after = _prepare(rest, rest_usable), _prepare(now, now_usable)
    start = np.zeros((height, width, 2), np.float32) if initial is None else initial.astype(np.float32)
    if min(height, width) < _SMALLEST:
        # Mirrored to the smallest size that has a pyramid; the result is cropped.
        margins = ((0, max(0, _SMALLEST - height)), (0, max(0, _SMALLEST - width)))
        before, after = np.pad(before, margins, "symmetric"), np.pad(after, margins, "symmetric")
        start = np.pad(start, (*margins, (0, 0)), "edge")
    solution = solver.calc(before, after, start)[:height, :width]
    flow = np.where(np.isfinite(solution), solution, 0).astype(np.float32)
    return flow, _confidence(flow, before[:height, :width], after[:height, :width], rest_usable, now_usable)


def _prepare(picture: Pixels, usable: Mask) -> Pixels:
    """Contrast-normalised picture (H, W) uint8 centred at 128, with masked pixels filled."""
    known = image.flags(usable)
    filled = image.fill(image.normalise(image.luminance(picture), known), known)
    return np.clip(np.round(128 + image.GREY_PER_DEVIATION * filled), 0, 255).astype(np.uint8)


def _confidence(flow: Map, before: Pixels, after: Pixels, rest_usable: Mask, now_usable: Mask) -> Map:
    """(H, W) in 0..1: agreement of the aligned pictures; 0 where a point is masked in either."""
    sampling = *image.end_points(flow), cv2.INTER_LINEAR
    visible = cv2.remap(now_usable.astype(np.float32), *sampling, borderValue=0) * rest_usable
    aligned = cv2.remap(after.astype(np.float32), *sampling, borderMode=cv2.BORDER_REPLICATE)
    difference = cv2.GaussianBlur(((aligned - before) * visible / image.GREY_PER_DEVIATION) ** 2, (0, 0), 2.0)
    share = cv2.GaussianBlur(visible, (0, 0), 2.0)
    residual = difference / np.maximum(share, 1e-3)
    return np.asarray(visible * np.exp(-residual / _RESIDUAL**2), np.float32)
