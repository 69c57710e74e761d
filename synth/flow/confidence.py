"""How far a flow can be trusted, pixel by pixel: confidence stands for a standard deviation."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from synth.flow import image
from synth.flow.estimator import Map

DOUBTFUL = 0.3
"""A visible pixel of less confidence counts as lost: its deviation is above 0.76 px."""

_WINDOW = 4.0  # px: the neighbours that vouch for a pixel
_NOISE = 0.02  # local deviations squared: agreement of less contrast than this says nothing
_HALF_PX = 0.5  # deviation of a component whose confidence is a half


def of_deviation(deviation_px: Map) -> Map:
    """Confidence 1 / (1 + (s / 0.5 px)^2) in 0..1 of a component's standard deviation s, both (H, W).

    `tvl1` lowers it further where pictures hardly agree; those of other estimators aren't calibrated.
    """
    return np.asarray(1 / (1 + (deviation_px / np.float32(_HALF_PX)) ** 2), np.float32)


def deviation(confidence: Map) -> Map:
    """The other way round, px; what is masked or lost counts as 3.5 px off, nothing as less than 0.016 px."""
    sure = np.clip(confidence, 0.02, 0.999)
    return np.asarray(_HALF_PX * np.sqrt(1 / sure - 1), np.float32)


def add_deviation(confidence: Map, deviation_px: float) -> Map:
    """(H, W) the confidence of what has a further, independent error of this standard deviation."""
    return np.asarray(confidence / (1 + confidence * np.float32(deviation_px / _HALF_PX) ** 2), np.float32)


def agreement(pictures: image.Level, warped: Tensor, seen: Tensor) -> Tensor:
    """Seen in both pictures, times the local correlation of the rest frame with the warped one.

    1 is the same, 0 unrelated; a blank picture gives 0.

    Args:
        pictures: the finest level.
        warped, seen: (B, 1, H, W), see `image.warp`.

    Returns:
        (B, 1, H, W) in 0..1.
    """
    mask = pictures.rest_usable * seen
    first, second = pictures.rest * mask, warped * mask
    sums = torch.cat([mask, first * second, first * first, second * second], 1)
    around = image.window(sums, _WINDOW)
    product, power, power_now = (around[:, 1:] / around[:, :1].clamp_min(1e-4)).unbind(1)
    agreement = product / torch.sqrt((power + _NOISE) * (power_now + _NOISE))
    vouched = agreement[:, None].clamp(0, 1)
    return mask * image.doubled(vouched, mask)
