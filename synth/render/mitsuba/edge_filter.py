"""Denoising of soft edges: defocused objects and shadows are averaged along their own edges; and the light
that tissue scatters across a shadow's edge.

A few paths per pixel locate a soft edge only roughly, but along it little changes, and nothing within a small
part of the circle of confusion. So what covers a pixel is averaged over these, while the background behind it
stays unfiltered. K. Vaidyanathan et al., "Layered light field reconstruction for defocus blur", 2015;
E. Heitz et al., "Combining analytic direct illumination and stochastic shadows", 2018.
"""

from __future__ import annotations

import cv2
import numpy as np

from synth.arrays import Map
from synth.render.mitsuba.direct_light import Light
from synth.system.jit import argument_types, vectorised

_REACH, _STEPS = 4, 4  # px along an edge at least, and steps to either side
_ALONG, _ACROSS = 0.5, 0.2  # added reach, and standard deviation of an average, in radii of confusion
_SOFT_PX = 4.0  # radius of confusion whose edges are averaged as far as a shadow's
_MOST = 4  # times that light is corrected by the lamps that were sampled
_ENOUGH = 16  # paths per pixel from which on nothing is filtered
_OUTLINE_PX = 1.0  # smoothing of a share of steel before its slopes are taken
_MARGIN = 24  # px around the outline
_SIGMA_PX = 1.5  # of the smoothing before and after slopes are taken
_FLAT = np.float32(1e-4)  # squared slope per pixel below which there is no edge
_LEAST = np.float32(1e-6)
_TRAVELLED_MM = 0.36, 0.19, 0.15  # by light in tissue, farthest in red: standard deviations, by eye


def soften(light: Light, spp: int, mm_per_px: float = np.inf) -> Map:
    """Radiance (H, W, 3) of `direct_light.trace` of `spp` paths per pixel with its soft edges denoised.

    `mm_per_px`: of tissue, which scatters light into shadows; none if infinite.
    """
    sigmas = tuple(mm / mm_per_px for mm in _TRAVELLED_MM)
    if spp >= _ENOUGH:
        picture = np.ascontiguousarray(light.radiance.transpose(1, 2, 0))
        unshadowed = cv2.merge([*(light.radiance - light.foreground + light.blocked)])
        return picture + _scatter(light, light.shade, light.irradiance, unshadowed, sigmas)
    layers = light.foreground, light.radiance - light.foreground, light.blocked
    foreground, background, blocked = (cv2.merge([*layer]) for layer in layers)
    cover, irradiance, bare = light.cover, light.irradiance, 1 - light.cover
    mean_irradiance = cv2.GaussianBlur(irradiance, (0, 0), _SIGMA_PX)
    if cover.any():
        # Paths that an object leaves of a pixel's need not sample all lamps equally.
        valid = (cover > 0) & (irradiance > 0)
        expected = mean_irradiance / np.maximum(cv2.GaussianBlur(bare, (0, 0), _SIGMA_PX), _LEAST)
        correction = np.minimum(expected * bare / np.where(valid, irradiance, 1), _MOST)
        correction = np.where(valid, correction, np.float32(1))[..., None]
        background, blocked = background * correction, blocked * correction
    if light.shade.any():
        # Of the light past defocused objects, whose edges are none of a shadow's.
        shaded_share = cv2.GaussianBlur(light.shade, (0, 0), _SIGMA_PX) / np.maximum(
            mean_irradiance, _LEAST * mean_irradiance.max()
        )
        unshadowed = background + blocked
        brightness = unshadowed[..., 1] + _LEAST
        planes = cv2.merge([irradiance, light.shade, irradiance**2 / brightness])
        total, shade, dull = cv2.split(
            _average_along(planes, _edge_vectors(shaded_share, np.full_like(shaded_share, _SOFT_PX)))
        )
        # A highlight is due to one lamp, and its noise differs: only the light around it is corrected.
        limit = np.minimum(4 * total * irradiance / np.maximum(dull * brightness, _LEAST), 1)
        gain = limit * (light.shade / np.maximum(irradiance, _LEAST) - shade / np.maximum(total, _LEAST))
        scattered = _scatter(light, shade, total, limit[..., None] * unshadowed, sigmas)
        background = np.maximum(background + gain[..., None] * unshadowed + scattered, 0)
    picture = np.ascontiguousarray(foreground + background)
    if cover.any():
        reach = int((light.radius / np.maximum(cover, _LEAST)).max()) + _REACH
        share = cv2.blur(cover, (2 * reach + 1,) * 2)
        radius = cv2.blur(light.radius, (2 * reach + 1,) * 2) / np.maximum(share, _LEAST)
        # Object by object: scenery at opposite borders would have a box as large as the picture.
        count, label, boxes, _ = cv2.connectedComponentsWithStats((share > _LEAST).astype(np.uint8))
        for k in range(1, count):
            x, y, width, height = boxes[k, :4].tolist()
            box = np.s_[y : y + height, x : x + width]
            composite = _composite(foreground[box], background[box], cover[box], radius[box])
            picture[box] = np.where((label[box] == k)[..., None], composite, picture[box])
    return _smooth_outline(picture, light.steel + light.cover)


def _smooth_outline(picture: Map, steel: Map) -> Map:
    """The picture (H, W, 3), changed in place: averaged along the outline of a share (H, W) of steel.

    A few paths sample the thin shadow beside an outline in some pixels and miss it in the next: it would be a
    row of beads.
    """
    border = ((steel > 0) & (steel < 1 - _LEAST)).astype(np.uint8)
    if not border.any():
        return picture
    x, y, width, height = cv2.boundingRect(border)
    # As far around as the smoothing and the averages reach.
    box = np.s_[max(y - _MARGIN, 0) : y + height + _MARGIN, max(x - _MARGIN, 0) : x + width + _MARGIN]
    share = np.ascontiguousarray(steel[box])
    vectors = _edge_vectors(cv2.GaussianBlur(share, (0, 0), _OUTLINE_PX), np.zeros_like(share))
    vectors *= cv2.dilate(border[box], np.ones((3, 3), np.uint8))
    picture[box] = _average_along(np.ascontiguousarray(picture[box]), vectors)
    return picture


def _scatter(light: Light, shade: Map, irradiance: Map, unshadowed: Map, sigmas: tuple[float, ...]) -> Map:
    """Radiance (H, W, 3) that shadows gain, or light beside them loses, by the blur of irradiance in tissue.

    `shade` of the `irradiance` (H, W) is blocked; without it the radiance is `unshadowed` (H, W, 3);
    `sigmas`: of the blur in each channel, px. Steel neither gains nor gives.
    """
    if not any(sigmas):
        return np.zeros_like(unshadowed)
    tissue = (light.steel == 0).astype(np.float32)
    planes = cv2.merge([shade * tissue, irradiance * tissue])
    half_planes = cv2.resize(planes, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    shaded_share = shade / np.maximum(irradiance, _LEAST)
    # Where steel covers a part of a pixel, what is blocked there is the tissue's.
    y, x = np.nonzero((light.steel > 0) & (light.steel < 1 - light.cover - _LEAST))
    gains = []
    for channel, sigma in enumerate(sigmas):
        blurred = cv2.GaussianBlur(half_planes, (0, 0), 0.5 * sigma)
        blurred_share = blurred[..., 0] / np.maximum(blurred[..., 1], _LEAST)
        blurred_share = cv2.resize(blurred_share, shaded_share.shape[::-1])
        plane = (shaded_share - blurred_share) * unshadowed[..., channel] * tissue
        plane[y, x] = (1 - blurred_share[y, x]) * light.blocked[channel, y, x]
        gains.append(plane)
    return np.asarray(cv2.merge(gains), np.float32)


def _composite(foreground: Map, background: Map, cover: Map, radius: Map) -> Map:
    """Picture (H, W, 3) of defocused objects' light and share over the light `background`."""
    planes = _smooth(np.dstack([foreground, background, cover]), radius)
    # Highlights on an object run along its edge as well.
    planes = _average_along(planes, _edge_vectors(planes[..., 6] + planes[..., 1], radius))
    gap = 1 - planes[..., 6:]
    visible_background = background + np.float32(0.05) * planes[..., 3:6]
    visible_background /= (1 - cover)[..., None] + np.float32(0.05) * gap + _LEAST
    return np.where(gap < 1, planes[..., :3] + gap * visible_background, background)


def _smooth(planes: Map, radius: Map) -> Map:
    """Planes (H, W, C) averaged over a part of a radius (H, W) px, mixed from a few double box filters."""
    sizes = [1, 3, 7, 15, 31, 63]
    variances = [(size**2 - 1) / 6 for size in sizes]
    level = np.interp((_ACROSS * radius) ** 2, variances, range(len(sizes))).astype(np.float32)
    smoothed = np.zeros_like(planes)
    for k in range(int(np.ceil(level.max())) + 1):
        size = sizes[k], sizes[k]
        mean = planes if k == 0 else cv2.blur(cv2.blur(planes, size), size)
        close_pixels = np.abs(level - k) < 1
        smoothed[close_pixels] += (1 - np.abs(level[close_pixels] - k))[:, None] * mean[close_pixels]
    return smoothed


def _edge_vectors(share: Map, radius: Map) -> Map:
    """Vectors (2, H, W) px along the edges of a smooth share (H, W), of the length to average over; 0
    elsewhere. `radius`: (H, W) px of the circle of confusion.

    By the structure tensor, which is largest across an edge. They are short where edges meet.
    """
    x, y = cv2.Sobel(share, -1, 1, 0, scale=0.125), cv2.Sobel(share, -1, 0, 1, scale=0.125)
    xx, xy, yy = (cv2.GaussianBlur(product, (0, 0), _SIGMA_PX) for product in (x * x, x * y, y * y))
    vectors = np.zeros((2, *share.shape), np.float32)
    trace = xx + yy
    y, x = np.nonzero(trace > _FLAT / (1 + radius) ** 2)
    radius, trace, xx, xy, yy = (plane[y, x] for plane in (radius, trace, xx, xy, yy))
    # The average ends at the picture's border.
    border = np.minimum(np.minimum(x, share.shape[1] - 1 - x), np.minimum(y, share.shape[0] - 1 - y))
    reach = np.minimum(_REACH + _ALONG * radius, border) * np.hypot(xx - yy, 2 * xy) / trace
    turn = 0.5 * np.arctan2(2 * xy, xx - yy)
    vectors[:, y, x] = -np.sin(turn) * reach, np.cos(turn) * reach
    return vectors


def _average_along(planes: Map, vectors: Map) -> Map:
    """Planes (H, W, C) averaged over vectors (2, H, W) px and their opposites."""
    out = planes.copy()
    _average_planes(planes, vectors, np.empty(planes.shape[2], np.float32), out)
    return out


@argument_types("f4[:,:,::1], f4[:,:,::1], f4[::1], f4[:,:,::1]")
@vectorised
def _average_planes(planes: Map, vectors: Map, total: Map, out: Map) -> None:
    height, width, count = planes.shape
    for y in range(height):
        for x in range(width):
            if vectors[0, y, x] == 0 and vectors[1, y, x] == 0:
                continue
            for k in range(count):
                total[k] = 0
            for step in range(-_STEPS, _STEPS + 1):
                u = min(max(x + vectors[0, y, x] * step / _STEPS, 0), width - 1.001)
                v = min(max(y + vectors[1, y, x] * step / _STEPS, 0), height - 1.001)
                left, top = int(u), int(v)
                for j in range(2):
                    for i in range(2):
                        weight = (1 - abs(u - left - i)) * (1 - abs(v - top - j)) * (_STEPS + 1 - abs(step))
                        for k in range(count):
                            total[k] += np.float32(weight) * planes[top + j, left + i, k]
            for k in range(count):
                out[y, x, k] = total[k] / np.float32((_STEPS + 1) ** 2)
