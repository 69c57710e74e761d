"""Denoising of soft edges: defocused objects and shadows are averaged along their own edges.

A few paths per pixel locate a soft edge only roughly, but along it little changes. So the share of paths that
it covers is averaged along the edge, while the background behind it stays unfiltered. K. Vaidyanathan et al.,
"Layered light field reconstruction for defocus blur", 2015; E. Heitz et al., "Combining analytic direct
illumination and stochastic shadows", 2018.
"""

from __future__ import annotations

import cv2
import numpy as np

from synth.arrays import Map
from synth.render.mitsuba.direct_light import Light
from synth.system.jit import vectorised

_REACH = 4  # px along an edge
_ENOUGH = 16  # paths per pixel from which on nothing is filtered
_SIGMA_PX = 1.5  # of the smoothing before and after slopes are taken
_FLAT = np.float32(1e-4)  # squared slope per pixel below which there is no edge


def soften(light: Light, power: float, spp: int) -> Map:
    """Radiance (H, W, 3) of `direct_light.trace` with its soft edges denoised.

    `power`: irradiance of all lamps, in green; `spp`: paths per pixel.
    """
    if spp >= _ENOUGH:
        return np.ascontiguousarray(light.radiance.transpose(1, 2, 0))
    behind = light.radiance - light.near
    share = light.shade * np.float32(1 / power)
    if share.any():
        _shade(behind, behind + light.blocked, share, light.cover, _along(share))
    picture = np.ascontiguousarray((light.near + behind).transpose(1, 2, 0))
    if light.cover.any():
        # Highlights on an object run along its edge as well.
        _cover(picture, light.near, behind, light.cover, _along(light.cover + light.near[1]))
    return picture


def _along(share: Map) -> Map:
    """Vectors (2, H, W) px along the edges of a share (H, W), of the length to average over; 0 elsewhere.

    By the structure tensor, which is largest across an edge. They are short where edges meet.
    """
    smooth = cv2.GaussianBlur(share, (0, 0), _SIGMA_PX)
    x, y = cv2.Sobel(smooth, -1, 1, 0, scale=0.125), cv2.Sobel(smooth, -1, 0, 1, scale=0.125)
    xx, xy, yy = (cv2.GaussianBlur(product, (0, 0), _SIGMA_PX) for product in (x * x, x * y, y * y))
    along = np.zeros((2, *share.shape), np.float32)
    _point(xx, xy, yy, along)
    return along


@vectorised
def _point(xx: Map, xy: Map, yy: Map, along: Map) -> None:
    height, width = xx.shape
    for y in range(height):
        for x in range(width):
            whole = xx[y, x] + yy[y, x]
            if whole > _FLAT:
                apart = np.sqrt((xx[y, x] - yy[y, x]) ** 2 + 4 * xy[y, x] ** 2)
                turn = 0.5 * np.arctan2(2 * xy[y, x], xx[y, x] - yy[y, x])
                # The average ends at the picture's border.
                reach = min(_REACH, x, y, width - 1 - x, height - 1 - y) * apart / whole
                along[0, y, x], along[1, y, x] = -np.sin(turn) * reach, np.cos(turn) * reach


@vectorised
def _shade(behind: Map, clear: Map, share: Map, cover: Map, along: Map) -> None:
    """Shades the light `behind` (3, H, W) by shadows whose share (H, W) is averaged along their edges."""
    height, width = share.shape
    for y in range(height):
        for x in range(width):
            if (along[0, y, x] == 0 and along[1, y, x] == 0) or cover[y, x] == 1:
                continue
            total, blocked, dull = np.float32(1e-9), np.float32(0), np.float32(0)
            for step in range(-_REACH, _REACH + 1):
                u = min(max(x + along[0, y, x] * step / _REACH, 0), width - 1.001)
                v = min(max(y + along[1, y, x] * step / _REACH, 0), height - 1.001)
                left, top = int(u), int(v)
                for j in range(2):
                    for i in range(2):
                        weight = (1 - abs(u - left - i)) * (1 - abs(v - top - j)) * (_REACH + 1 - abs(step))
                        bare = weight * (1 - cover[top + j, left + i])
                        total += bare
                        blocked += weight * share[top + j, left + i]
                        dull += bare * bare / (weight * clear[1, top + j, left + i] + np.float32(1e-6))
            # A highlight is due to one lamp, and its noise differs: only the light around it is corrected.
            bare = max(1 - cover[y, x], np.float32(1e-6))
            most = 4 * total * bare / (dull * (clear[1, y, x] + np.float32(1e-6)))
            gain = (share[y, x] / bare - blocked / total) * min(most, 1)
            for k in range(3):
                behind[k, y, x] = max(behind[k, y, x] + gain * clear[k, y, x], 0)


@vectorised
def _cover(picture: Map, near: Map, behind: Map, cover: Map, along: Map) -> None:
    """Composes a picture of defocused objects, averaged along their edges, over the light behind."""
    height, width = cover.shape
    found = np.zeros(8, np.float32)
    for y in range(height):
        for x in range(width):
            if along[0, y, x] == 0 and along[1, y, x] == 0:
                continue
            found[:] = 0
            for step in range(-_REACH, _REACH + 1):
                u = min(max(x + along[0, y, x] * step / _REACH, 0), width - 1.001)
                v = min(max(y + along[1, y, x] * step / _REACH, 0), height - 1.001)
                left, top = int(u), int(v)
                for j in range(2):
                    for i in range(2):
                        weight = (1 - abs(u - left - i)) * (1 - abs(v - top - j)) * (_REACH + 1 - abs(step))
                        found[0] += weight
                        found[1] += weight * cover[top + j, left + i]
                        for k in range(3):
                            found[2 + k] += weight * near[k, top + j, left + i]
                            found[5 + k] += weight * behind[k, top + j, left + i]
            open_here = 1 - cover[y, x]
            open_around = 1 - found[1] / found[0]
            if open_around < np.float32(1e-3):  # no edge, but a highlight on an object that covers everything
                continue
            for k in range(3):
                back = behind[k, y, x] + np.float32(0.05) * found[5 + k] / found[0]
                back /= open_here + np.float32(0.05) * open_around + np.float32(1e-6)
                picture[y, x, k] = found[2 + k] / found[0] + open_around * back
