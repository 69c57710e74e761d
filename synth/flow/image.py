"""Image operations of the flow solver; masked pixels are excluded throughout.

Pictures and masks are (H, W), stacks of planes (C, H, W), all float32; `usable` is in 0..1.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from synth.arrays import Array, Map, Pixels
from synth.flow import kernels

# Luminance from red, green and blue: vessels have most contrast in green, averaging reduces noise.
GREY = np.array([0.2, 0.6, 0.2], np.float32)
GREY_PER_DEVIATION = 32.0  # normalised contrast of +-4 local deviations spans 8 bits
_WINDOW = 6.5  # px, standard deviation of the window of `normalise`
_FLOOR = 3.0  # grey levels added to the local deviation, so that noise is not amplified to full contrast


def local_contrast(grey: Map, window: tuple[int, int]) -> Pixels:
    """Local contrast (H, W), centred at 128, of a picture (H, W) in grey levels: no gain, no offset."""
    detail = grey - cv2.blur(grey, window)
    # Rounding in the running sums of a blur can make the variance of a blank picture negative.
    spread = np.sqrt(np.maximum(cv2.blur(detail * detail, window), 0)) + _FLOOR
    return np.asarray(np.clip(128 + GREY_PER_DEVIATION * detail / spread, 0, 255), np.uint8)


@dataclass(frozen=True, eq=False)
class Level:
    """One level of the pyramid: contrast-normalised pictures and their masks, each (H, W)."""

    rest: Map
    now: Map
    rest_usable: Map
    now_usable: Map


def end_points(flow: Map) -> tuple[Map, Map]:
    """Columns and rows, (H, W) px each, to which a flow (H, W, 2) px leads."""
    x, y = (np.arange(n, dtype=np.float32) for n in flow.shape[1::-1])
    return x + flow[..., 0], y[:, None] + flow[..., 1]


def luminance(picture: Pixels) -> Map:
    """Luminance (H, W) in grey levels of RGB (H, W, 3) uint8."""
    return np.asarray(picture @ GREY)


def flags(mask: Array) -> Map:
    """A mask (H, W) as float32."""
    return np.ascontiguousarray(mask, np.float32)


def box(planes: Map, radius: int) -> Map:
    """Mean of (C, H, W) over squares of 2 radius + 1 pixels; over fewer at the border."""
    out = np.empty(planes.shape, np.float32)
    kernels.box_into(planes, 2 * radius + 1, out)
    return out


def halve(planes: Map) -> Map:
    """Mean of (C, H, W) over 2 x 2 pixels: (C, ceil(H/2), ceil(W/2)); over fewer at an odd border."""
    count, height, width = planes.shape
    out = np.empty((count, (height + 1) // 2, (width + 1) // 2), np.float32)
    kernels.halve_into(planes, out)
    return out


def window(planes: Map, sigma: float) -> Map:
    """Approximate Gaussian blur at half the size, (C, H/2, W/2): two box filters."""
    radius = max(1, round(sigma / 2 * 1.5**0.5 - 0.5))  # each box has the variance ((2r+1)^2 - 1)/12
    return box(box(halve(planes), radius), radius)


def double(planes: Map, shape: tuple[int, ...]) -> Map:
    """Planes (C, h, w) at twice their size (bilinear), cropped to a height and a width."""
    return np.stack([cv2.resize(plane, None, fx=2, fy=2)[: shape[0], : shape[1]] for plane in planes])


def resize(planes: Map, shape: tuple[int, ...]) -> Map:
    """Planes (C, h, w) at another height and width (bilinear)."""
    return np.stack([cv2.resize(plane, (shape[1], shape[0])) for plane in planes])


def normalise(grey: Map, usable: Map) -> Map:
    """Local contrast normalisation (I - mean) / (deviation + floor) of grey levels (H, W) over usable
    neighbours only: local standard deviations, 0 at masked pixels.

    It removes gains and offsets that vary more slowly than the window, such as drifting illumination.
    """
    # Centring at 128 avoids cancellation in the difference of squares.
    centred = (grey - np.float32(128)) * usable
    total, first, second = window(np.stack([usable, centred, (grey - np.float32(128)) * centred]), _WINDOW)
    mean, square = first / np.maximum(total, 1e-4), second / np.maximum(total, 1e-4)
    deviation = np.sqrt(np.maximum(square - mean**2, 0)) + np.float32(_FLOOR)
    offset, scale = double(np.stack([mean + 128, 1 / deviation]), grey.shape)
    return np.asarray((usable > 0) * (grey - offset) * scale)


def fill(field: Map, usable: Map) -> Map:
    """A field (H, W) whose masked pixels are filled from around; zeros if no pixel is usable.

    Push-pull (Gortler et al., The Lumigraph, 1996, sec. 3.5). Where `usable` is 1 the field stays as it is.
    """
    known = field * usable
    if min(field.shape) <= 2:
        return np.asarray(known + (1 - usable) * (known.mean() / max(usable.mean(), np.float32(1e-6))))
    total, weight = halve(np.stack([known, usable]))
    coarse = fill(total / np.maximum(weight, 1e-6), flags(weight > 0))
    return np.asarray(known + (1 - usable) * resize(coarse[None], field.shape)[0])


def warp(now: Map, usable: Map, flow: Map) -> tuple[Map, Map]:
    """Samples of `now` (H, W) at x + w (bicubic) for a flow w (2, H, W) px, and the largest weight of the
    four pixels around: 0 where the interpolated weight is at most 0.9 of it, as at a masked pixel or the
    border."""
    warped, visible = np.empty((2, *now.shape), np.float32)
    kernels.warp_into(now, usable, flow, warped, visible)
    return warped, visible
