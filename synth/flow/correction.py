"""Correction of a flow and its standard deviation by a small network trained on rendered scenes.

A flow has systematic errors where an instrument hides or shades tissue, and where a dimple turns away from
the lamps. The network works on cells of 4 x 4 px and does not see pictures. Its features are the masks, the
flow and its agreement, changes of light and colour, and the remaining steps of Lucas and Kanade's equations
(IJCAI 1981) over two windows, in brightness and in colour, each without the mean change of the window. All
are in pixels or ratios, so that little of the renderer's appearance can be learnt. The outputs are the
correction and the logarithm of its variance (Kendall and Gal, NeurIPS 2017, eq. 5, with Student's
distribution). `weights.correction_training` trains the weights, stored next to this file with a card.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from synth.arrays import Array, Map, Mask, Pixels
from synth.flow import image, kernels, onnx_network
from synth.flow.image import GREY
from synth.system.jit import argument_types, vectorised

WEIGHTS = Path(__file__).with_name("correction.onnx")
CELL = 4  # px, side of a cell
_WINDOWS = 3, 7  # cells, sides of the windows of Lucas and Kanade's steps
_STEPS = [
    f"{tone} {n} {part}" for tone in ("grey", "colour") for n in _WINDOWS for part in ("x", "y", "known")
]
FEATURES = (
    *("visible in both", "visible now", "usable at rest", "residual", *_STEPS, "red", "green", "blue"),
    *("light at rest", "light now", "agreement", "flow x", "flow y"),
)
"""Input channels of the network, in the order of its weights."""
CHANNELS = len(FEATURES)
VECTORS = tuple((k, k + 1) for k, name in enumerate(FEATURES) if name.endswith(" x"))
"""Pairs of channels that are x and y of a vector and change when a picture is mirrored or rotated."""
PRODUCTS = ("1", "gx", "gy", "r", "gx gx", "gx gy", "gx r", "gy gy", "gy r", "r r")
"""Planes of `sum_cells` for greys, then for colours: g is the mean gradient of both, r their change."""
LIGHTS = ("red", "green", "blue", "luminance")
"""Further planes of `sum_cells`, for the rest frame and then for the frame now."""
_PRODUCTS, _LIGHTS, _LUMINANCE = len(PRODUCTS), len(LIGHTS), LIGHTS.index("luminance")
_MULTIPLE = 8  # cells: the levels of the network need multiples of it on both sides
_RIDGE = 0.02  # added to squared gradients per pixel, so that steps of windows without contrast vanish
_MAX_STEP_PX = 2.0  # limit of a linearised step
# Limit of the flow that the network is given. It was trained on motions of a few px: given more, it doubts
# what is right (docs/results/flow/large_motion).
_MAX_FLOW_PX = np.float32(8)
_MIN_RESIDUAL = 1e-3  # mean square, in squared local deviations
_OFFSET = np.float32(8)  # grey levels added before ratios are taken: the black of a sensor is not zero
# What has appeared since the rest frame is what is masked now, but neither then nor beside it, and holds a
# circle of a radius; up to the next length from it the correction is whole, from the last on there is none.
# In shares of the picture's longer side.
_APPEARED, _NEAR, _FAR = 0.015, 0.25, 0.5
_TWELVE, _QUARTER = np.float32(12), np.float32(0.25)


def correct(features: Map, flow: Map, proximity: Map) -> tuple[Map, Map]:
    """The corrected flow (H, W, 2) px, and the standard deviation (H, W) px of a component.

    What the network adds is shrunk where it isn't sure (Wiener's share, squared: unsquared, bare wet cortex
    errs 5% more than without), where the pictures determine the flow better than the network does, where they
    ask for the opposite, and far from what has appeared. What is masked is filled from around: in highlights
    on tissue the network invents motion.

    `features`: (CHANNELS, h, w), see `describe`, of the given flow (H, W, 2) px; `proximity`: (h, w), see
    `nearness`.
    """
    height, width, _ = flow.shape
    output = predict(WEIGHTS, features)[:, : features.shape[1], : features.shape[2]]
    prediction, log_variance = output[:2], output[2:]
    # Log-variances are limited to the trained range; the deviation is the geometric mean of both components.
    variance = np.exp(0.5 * log_variance.clip(-8, 5).sum(axis=0))
    signal = (prediction * prediction).mean(axis=0)
    weight = (signal / (signal + variance)) ** 2 / (1 + variance * _compute_information(features))
    weight *= proximity * _weigh_consent(features, prediction)
    visible = np.ascontiguousarray(features[FEATURES.index("visible in both")])
    added_flow = np.stack([image.fill(plane, visible) for plane in weight * prediction])
    deviation = np.sqrt(variance + ((prediction - added_flow) ** 2).mean(axis=0))
    planes = np.dstack([*added_flow, deviation])
    upsampled = cv2.resize(planes, (CELL * planes.shape[1], CELL * planes.shape[0]))[:height, :width]
    return flow + upsampled[..., :2], upsampled[..., 2]


def nearness(rest_usable: Mask, now_usable: Mask) -> Map:
    """1 near what has appeared since the rest frame, 0 far from it, as (h, w) on cells; masks are (H, W).

    The errors that the network knows are due to an instrument: what it hides, its shadow, and the dimple
    under it. On wet tissue, on photographs and phantoms without one, all of the harm was done: highlights
    that move, and stars, were taken for it.
    """
    long_side = max(now_usable.shape)
    radius = round(_APPEARED * long_side)
    side = 2 * radius + 1
    rest_interior = cv2.erode(rest_usable.astype(np.uint8), np.ones((side, side), np.uint8))
    appeared = rest_interior & ~now_usable
    (core,) = means(cv2.distanceTransform(appeared, cv2.DIST_L2, 3) > radius)
    if not core.any():
        return np.zeros_like(core)
    distance = CELL * cv2.distanceTransform((core == 0).astype(np.uint8), cv2.DIST_L2, 3) - radius
    share = (_FAR - distance / np.float32(long_side)) / np.float32(_FAR - _NEAR)
    return np.asarray(np.clip(share, 0, 1), np.float32)


def _weigh_consent(features: Map, prediction: Map) -> Map:
    """Share (h, w) of what the network adds, by its angle to where the pictures point.

    1 + cosine, at most 1, of the mean of Lucas and Kanade's steps. Most of what the correction still spoiled
    on photographs, it had moved away from the pictures.
    """
    step = np.sum([features[x : x + 2] for x, _ in VECTORS[:-1]], axis=0)
    cosine = (step * prediction).sum(0) / np.maximum(np.hypot(*step) * np.hypot(*prediction), 1e-9)
    return np.asarray(np.minimum(1 + cosine, 1), np.float32)


def _compute_information(features: Map) -> Map:
    """Inverse of the Cramér-Rao bound [1/px^2] of a displacement over the larger window, (h, w).

    For the direction with the least contrast: the sum of squared gradients over the residual's mean square.
    Light and shading change whole cells, so that each cell counts as one observation. With half to three
    times as many the mean error rises on no set of pictures.
    """
    side = _WINDOWS[-1]
    certainty, cell_residual, visible = (
        features[FEATURES.index(name)] for name in (f"grey {side} known", "residual", "visible in both")
    )
    contrast = _RIDGE * np.expm1(2 * certainty)  # see `_solve_steps`
    area = np.maximum(cv2.blur(visible, (side, side)), 1e-6)
    residual = cv2.blur(visible * np.maximum(cell_residual, _MIN_RESIDUAL), (side, side)) / area
    return np.asarray(visible * contrast * side**2 * area / np.maximum(residual, _MIN_RESIDUAL))


def predict(weights: Path, features: Map) -> Map:
    """Output (2 parts, h', w') of a network for features (channels, h, w), with its padding."""
    return onnx_network.run(weights, pad_cells(features))


def pad_cells(cells: Map) -> Map:
    """Pads (..., h, w) with zeros to the right and below to multiples of 8 cells."""
    margins = [(0, 0)] * (cells.ndim - 2) + [(0, -n % _MULTIPLE) for n in cells.shape[-2:]]
    return np.pad(cells, margins)


def describe(
    rest: Pixels,
    now: Pixels,
    rest_usable: Mask,
    greys: tuple[Map, Map],
    visible: Map,
    flow: Map,
    agreement: Map,
) -> Map:
    """`FEATURES` (CHANNELS, h, w) float32 of a frame and its flow on cells of 4 x 4 px.

    `rest`, `now`: (H, W, 3) uint8; `rest_usable`: (H, W), unmasked tissue at rest; `greys`: (H, W) each, the
    contrast-normalised rest frame, and frame now warped by `flow` (H, W, 2) px; `visible`: (H, W) 1 where
    pixels sampled now are usable, else 0, see `image.warp`; `agreement`: (H, W) 0..1, agreement of the flow.
    """
    height, width = agreement.shape
    u, v = cv2.split(flow)
    x = u + np.arange(width, dtype=np.float32)
    y = v + np.arange(height, dtype=np.float32)[:, None]
    now_warped = cv2.remap(now, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    mask = visible * rest_usable
    sums = np.empty((2 * (_PRODUCTS + _LIGHTS), -(-height // CELL), -(-width // CELL)), np.float32)
    colours = np.stack([cv2.split(picture) for picture in (rest, now_warped)])
    sum_cells(colours, np.stack(greys), mask, sums)
    products, lights = np.split(sums, [2 * _PRODUCTS])
    lights = lights.reshape(2, _LIGHTS, *sums.shape[1:]) / (CELL * CELL)
    overlap, visible, usable, agreement, u, v = means(mask, visible, rest_usable, agreement, u, v)
    area = np.maximum(overlap, 0.05)
    before, after = lights[:, :_LUMINANCE] / area + _OFFSET
    change = (overlap > 0) * np.log(after / before)
    common = np.median(change[:, overlap > 0.5], axis=1) if (overlap > 0.5).any() else np.zeros(3)
    change = 3 * np.clip(change - common[:, None, None] * (overlap > 0), -1, 1)
    light = 0.5 * np.log1p(lights[:, _LUMINANCE]) - 2
    steps = np.stack([_solve_steps(products, side) for side in _WINDOWS], 1).reshape(-1, *overlap.shape)
    residual = np.minimum(products[PRODUCTS.index("r r")] / (CELL * CELL * area), 4)
    scale = _QUARTER * _MAX_FLOW_PX / np.maximum(np.hypot(u, v), _MAX_FLOW_PX)
    planes = [overlap, visible, usable, residual, *steps, *change, *light, agreement, scale * u, scale * v]
    return np.stack(planes).astype(np.float32)


def means(*planes: Array) -> Map:
    """Means (C, h, w) over cells of planes (H, W); at the border the last row or column is repeated."""
    height, width = planes[0].shape
    margins, size = (0, -height % CELL, 0, -width % CELL), (-(-width // CELL), -(-height // CELL))
    cells = []
    for plane in planes:
        extended = cv2.copyMakeBorder(np.asarray(plane, np.float32), *margins, cv2.BORDER_REPLICATE)
        cells.append(cv2.resize(extended, size, interpolation=cv2.INTER_AREA))
    return np.stack(cells)


def _solve_steps(products: Map, side: int) -> Map:
    """Lucas and Kanade's steps over windows of `side` cells, from `PRODUCTS` (20, h, w) of `sum_cells`.

    Returns (2, 3, h, w), from greys and from colours: x and y [px], and a measure of their certainty.
    """
    window_means = np.empty(products.shape, np.float32)
    kernels.box_into(products, side, window_means)
    window_means = window_means.reshape(2, _PRODUCTS, *products.shape[1:]).swapaxes(0, 1)
    coverage = cv2.boxFilter(np.ones_like(products[0]), -1, (side, side), borderType=cv2.BORDER_CONSTANT)
    # Windows with less than one usable pixel per cell have less weight.
    gx, gy, r, xx, xy, xr, yy, yr = window_means[1:9] * (coverage / np.maximum(window_means[0] * coverage, 1))
    xx, xy, yy = xx - gx * gx + _RIDGE, xy - gx * gy, yy - gy * gy + _RIDGE
    xr, yr = xr - gx * r, yr - gy * r
    scale = 1 / (xx * yy - xy * xy)
    step = np.stack([xy * yr - yy * xr, xy * xr - xx * yr], 1) * scale[:, None]
    min_eigenvalue = 0.5 * (xx + yy) - np.hypot(0.5 * (xx - yy), xy)
    certainty = 0.5 * np.clip(np.log(np.maximum(min_eigenvalue, _RIDGE) / _RIDGE), 0, 5)
    return np.concatenate([_MAX_STEP_PX * np.tanh(step / _MAX_STEP_PX), certainty[:, None]], 1)


@argument_types("u1[:,:,:,::1], f4[:,:,::1], f4[:,::1], f4[:,:,::1]")
@vectorised
def sum_cells(colours: Pixels, greys: Map, mask: Map, sums: Map) -> None:
    """Sums products of two aligned pictures (2, 3, H, W) and their greys (2, H, W) over cells.

    Writes to `sums` (28, h, w): `PRODUCTS` of the greys and of the ratio of green to red, which is free of
    shading, inside the mask (H, W); then `LIGHTS` of the rest frame and of the frame now, the colours inside
    the mask. Cells at the border repeat its pixels.
    """
    height, width = mask.shape
    total, difference = np.empty((2, height, width + 2), np.float32), np.empty((2, height, width), np.float32)
    line, lines = np.empty((2, width), np.float32), np.empty((len(sums), sums.shape[2] * CELL), np.float32)
    terms, weighted = np.ones((4, width), np.float32), np.empty(width, np.float32)
    for y in range(height):
        for tone in range(2):
            for k in range(2):
                for x in range(width):
                    red, green = np.float32(colours[k, 0, y, x]), np.float32(colours[k, 1, y, x])
                    # Scaled to the range of a contrast-normalised grey.
                    colour = _TWELVE * (green - red) / (green + red + _OFFSET + _OFFSET)
                    line[k, x] = colour if tone else greys[k, y, x]
            for x in range(width):
                total[tone, y, x + 1] = line[0, x] + line[1, x]
                difference[tone, y, x] = line[1, x] - line[0, x]
            total[tone, y, 0], total[tone, y, width + 1] = total[tone, y, 1], total[tone, y, width]
    for row in range(sums.shape[1]):
        lines[:] = 0
        for y in range(row * CELL, row * CELL + CELL):
            source_y = min(y, height - 1)
            above, below = max(source_y - 1, 0), min(source_y + 1, height - 1)
            for tone in range(2 if y < height else 0):
                for x in range(width):
                    terms[1, x] = _QUARTER * (total[tone, source_y, x + 2] - total[tone, source_y, x])
                    terms[2, x] = _QUARTER * (total[tone, below, x + 1] - total[tone, above, x + 1])
                    terms[3, x] = difference[tone, source_y, x]
                k = _PRODUCTS * tone
                for i in range(4):
                    for x in range(width):
                        weighted[x] = mask[source_y, x] * terms[i, x]
                    for j in range(i, 4):
                        for x in range(width):
                            lines[k, x] += weighted[x] * terms[j, x]
                        k += 1
            for k in range(2):
                first = 2 * _PRODUCTS + _LIGHTS * k
                for i in range(3):
                    for x in range(width):
                        lines[first + i, x] += mask[source_y, x] * colours[k, i, source_y, x]
                        lines[first + _LUMINANCE, x] += GREY[i] * colours[k, i, source_y, x]
        for k in range(len(sums)):
            if k >= 2 * _PRODUCTS:
                lines[k, width:] = lines[k, width - 1]
            for column in range(sums.shape[2]):
                sums[k, row, column] = lines[k, column * CELL]
                for x in range(column * CELL + 1, column * CELL + CELL):
                    sums[k, row, column] += lines[k, x]
