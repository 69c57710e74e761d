"""Confidence of a flow at each pixel: a function of the standard deviation of a flow component."""

from __future__ import annotations

import numpy as np

from synth.arrays import Map
from synth.flow import image

LOW_CONFIDENCE = 0.3  # a visible pixel below it counts as lost: its standard deviation is above 0.76 px
_WINDOW = 4.0  # px, standard deviation of the window over which pictures are correlated
_NOISE = 0.02  # squared local deviations: variance of the noise; it lowers the correlation of faint texture
_HALF_PX = 0.5  # standard deviation of a component at confidence 1/2


def of_deviation(deviation_px: Map) -> Map:
    """Confidence 1 / (1 + (s / 0.5 px)^2) in 0..1 for the standard deviation s of a component, both (H, W).

    `tvl1` lowers it further where the pictures agree poorly. That of other estimators is not calibrated.
    """
    return np.asarray(1 / (1 + (deviation_px / np.float32(_HALF_PX)) ** 2), np.float32)


def deviation(confidence: Map) -> Map:
    """Standard deviation [px] for a confidence, both (H, W), limited to 0.016..3.5 px."""
    clipped_confidence = np.clip(confidence, 0.02, 0.999)
    return np.asarray(_HALF_PX * np.sqrt(1 / clipped_confidence - 1), np.float32)


def add_deviation(confidence: Map, deviation_px: float) -> Map:
    """Confidence (H, W) after adding an independent error of the given standard deviation [px]."""
    return np.asarray(confidence / (1 + confidence * np.float32(deviation_px / _HALF_PX) ** 2), np.float32)


def agreement(pictures: image.Level, warped: Map, visible: Map) -> Map:
    """Local correlation (H, W) in 0..1 of the rest frame with the warped frame; 0 where either is masked or
    blank.

    `pictures`: a level; `warped`, `visible`: (H, W), see `image.warp`.
    """
    mask = pictures.rest_usable * visible
    first, second = mask * pictures.rest, mask * warped
    sums = np.stack([mask, first * warped, first * pictures.rest, second * warped])
    total, product, power, power_now = image.window(sums, _WINDOW)
    product, power, power_now = (part / np.maximum(total, 1e-4) for part in (product, power, power_now))
    correlation = product / np.sqrt((power + np.float32(_NOISE)) * (power_now + np.float32(_NOISE)))
    return np.asarray(mask * image.double(correlation.clip(0, 1)[None], mask.shape)[0])
