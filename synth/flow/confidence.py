"""How far a flow can be trusted, pixel by pixel."""

from __future__ import annotations

import torch
from torch import Tensor

from synth.flow import image

DOUBTFUL = 0.3
"""A visible pixel of less confidence counts as lost: the best F1 for errors over 1 px, on the tuning set."""

_WINDOW = 4.0  # px: the neighbours that vouch for a pixel
_NOISE = 0.02  # local deviations squared: agreement of less contrast than this says nothing
_LOOP = 1.0  # px: there and back again misses by this much in a doubtful flow ...
_LOOP_SHARE = 0.05  # ... and by this share of the way


def judge(pictures: image.Level, flow: Tensor, back: Tensor | None) -> Tensor:
    """Confidence: seen in both pictures, times agreement once aligned, times return of the way back.

    Agreement is the local correlation of the rest frame with the warped one (1 the same, 0 unrelated, so a
    blank picture gives 0); the way back is w(x) + b(x + w(x)) (Sundaram, Brox and Keutzer, ECCV 2010, eq. 5).

    Args:
        pictures: the finest level.
        flow: (B, 2, H, W) px.
        back: (B, 2, h, w) px of half the size, flow from now to rest; None: not checked.

    Returns:
        (B, 1, H, W) in 0..1.
    """
    warped, seen = image.warp(pictures.now, pictures.now_usable, flow)
    mask = pictures.rest_usable * seen
    first, second = pictures.rest * mask, warped * mask
    sums = torch.cat([mask, first * second, first * first, second * second], 1)
    around = image.window(sums, _WINDOW)
    product, power, power_now = (around[:, 1:] / around[:, :1].clamp_min(1e-4)).unbind(1)
    agreement = product / torch.sqrt((power + _NOISE) * (power_now + _NOISE))
    vouched = agreement[:, None].clamp(0, 1)
    if back is not None:
        small = 0.5 * image.halved(flow)
        there, _ = image.warp(back, back[:, :1], small)
        miss = 2 * _length(small + there)
        allowed = _LOOP + _LOOP_SHARE * 2 * _length(small)
        vouched = vouched * torch.exp(-((miss / allowed) ** 2))
    return mask * image.doubled(vouched, mask)


def _length(field: Tensor) -> Tensor:
    """(B, 2, H, W) to (B, 1, H, W); `norm` over so short an axis takes many times as long."""
    return torch.hypot(field[:, :1], field[:, 1:])
