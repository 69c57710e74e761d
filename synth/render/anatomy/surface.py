"""The exposed cortex: relief, vessels and the fine surface that is loaded, moved and rendered.

The surface is a height field over the opening and a margin under its rim: the arachnoid bridges the sulci and
hides what lies deeper. Shares and widths of the relief were chosen by eye on an intra-operative photograph.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from synth.arrays import Floats, Indices, Map
from synth.errors import UserError
from synth.geometry.triangles import Shape, grid_faces
from synth.render.anatomy import noise, tube, vessels
from synth.render.anatomy.chart import Chart, places, unroll
from synth.render.anatomy.tree import Tree
from synth.render.anatomy.vessels import Vessels

MARGIN_MM = 5.0
"""Extent under the rim, so that no drawn tilt or pull reveals the patch's edge."""
LEAST_FILLED = 0.65
"""Least share of the patch that a user's brain has to fill."""
_RELIEF_PX = 512
_BED = 0.5  # depth of the groove under a vein of 0.8 mm radius, as a share of a sulcus's
_DIP = 0.5  # share of a vein's height that an artery of 0.25 mm radius takes where it crosses
_ROUND = 1.2  # 1: gyri are half waves; more: narrower clefts between flatter crowns


@dataclass(frozen=True)
class Relief:
    """Relief of one anatomy, as drawn."""

    seed: int  # seed of the folds, vessels and stains
    gyrus_mm: float  # spacing of the gyri
    sulcus_mm: float  # visible depth of the sulci


@dataclass(frozen=True)
class CortexSurface:
    """The fine surface at rest, in world axes, with its chart, sulci and vessels."""

    vertices: Floats  # (V, 3) mm
    faces: Indices  # (F, 3), counter-clockwise from outside
    uv: Map  # (V, 2): place on the chart, from 0 to 1
    pia: Floats  # (n, n) mm, height at the vertices without vessels; rows go with y, columns with x
    extent_mm: float  # side of the square patch
    chart: Chart  # the square that sulci, vessels and every map lie on
    sulci: Map  # (n, n) 0 on the crown of a gyrus to 1 in a sulcus
    vessels: Vessels  # nodes in mm from the chart's middle
    seed: int  # seed of everything else that belongs to this anatomy


def grow(
    relief: Relief,
    opening_mm: float = 12.0,
    *,
    vertices: int = 40_000,
    dome_mm: float = 70.0,
    brain: Shape | None = None,
    veined: bool = True,
) -> CortexSurface:
    """A cortex of some `vertices` under an opening of a radius, with veins that stand out of it.

    `dome_mm`: radius of curvature without a brain; `brain`: a user's, with folds of its own, z outwards,
    origin at the craniotomy's centre; any winding, holes and duplicates allowed; None: random gyri on a
    dome. `veined`: whether veins stand out. UserError: no surface under the opening.
    """
    extent = 2 * (opening_mm + MARGIN_MM)
    side = max(20, round(vertices**0.5))
    axis = np.linspace(-extent / 2, extent / 2, side)
    x, y = np.meshgrid(axis, axis)
    xy = np.stack([x.ravel(), y.ravel()], axis=1)
    if brain is None:
        sulci = _folds(relief, extent)
    else:
        arachnoid, sulci = _cover_brain(brain, relief, extent)
    network = vessels.grow_all(sulci, extent, np.random.default_rng([relief.seed, 1]))
    if brain is None:
        sulci = np.maximum(sulci, _beds(network.veins, extent))

    def height(points: Floats) -> Floats:
        if brain is not None:
            return noise.sample(arachnoid, points, extent).astype(np.float64)
        dome = np.sqrt(np.maximum(dome_mm**2 - (points**2).sum(axis=1), 0)) - dome_mm
        return np.asarray(dome - relief.sulcus_mm * noise.sample(sulci, points, extent))

    pia = height(xy)
    chart = unroll(height, extent, opening_mm + MARGIN_MM / 2)
    network = vessels.Vessels(*(replace(tree, nodes=chart.at(tree.nodes)) for tree in vars(network).values()))
    chart_xy = chart.at(xy)
    z = pia + veined * noise.sample(bulge(network, chart.extent_mm), chart_xy, chart.extent_mm)
    return CortexSurface(
        vertices=np.concatenate([xy, z[:, None]], axis=1),
        faces=grid_faces(side, side).reshape(-1, 3),
        pia=pia.reshape(side, side),
        uv=(chart_xy / chart.extent_mm + 0.5).astype(np.float32),
        extent_mm=extent,
        chart=chart,
        sulci=noise.sample(sulci, places(chart, _RELIEF_PX), extent).reshape(_RELIEF_PX, _RELIEF_PX),
        vessels=network,
        seed=relief.seed,
    )


def bulge(network: Vessels, extent_mm: float) -> Map:
    """Height of veins above the pia, (n, n) mm: half sunk round tubes with soft shoulders, pressed in where
    arteries cross them."""
    distance, radius = tube.raster(network.veins, _RELIEF_PX, extent_mm, 0.1)
    height = np.sqrt(np.maximum(radius**2 - distance**2, 0)) * 0.75
    distance, radius = tube.raster(network.trunks, _RELIEF_PX, extent_mm, 0.1)
    dent = _DIP * np.clip(radius / 0.25, 0, 1) * (distance < radius + 0.1)
    return noise.blur((height * (1 - dent)).astype(np.float32), 0.2, extent_mm)


def _folds(relief: Relief, extent_mm: float) -> Map:
    """Sulci (n, n) from 0 to 1: zero lines of band-passed noise, about a gyrus apart."""
    rng = np.random.default_rng([relief.seed, 0])
    # Zero lines of noise lie half a wavelength apart.
    waves = noise.band(rng, _RELIEF_PX, extent_mm, 2 * relief.gyrus_mm, 0.22)
    waves = waves + 0.12 * noise.band(rng, _RELIEF_PX, extent_mm, 0.7 * relief.gyrus_mm, 0.3)
    # For a sine of that wavelength both have the same amplitude: |sin| is a row of cushions between clefts.
    amplitude = np.abs(waves)
    slope = np.hypot(*np.gradient(waves, extent_mm / _RELIEF_PX)) * relief.gyrus_mm / np.pi
    slope = noise.blur(slope.astype(np.float32), 0.5, extent_mm)
    valley = (1 - amplitude / np.maximum(np.hypot(amplitude, slope), 1e-3)) ** _ROUND
    fade = np.clip(0.85 + 0.2 * noise.band(rng, _RELIEF_PX, extent_mm, 1.6 * relief.gyrus_mm, 0.3), 0.5, 1.0)
    return noise.blur((valley * fade).astype(np.float32), 0.4, extent_mm)


def _beds(veins: Tree, extent_mm: float) -> Map:
    """Grooves of wide veins where they cross a gyrus, (n, n) from 0 to 1 as the sulci."""
    distance, radius = tube.raster(veins, _RELIEF_PX // 4, extent_mm, 3.6)
    groove = _BED * np.clip(radius / 0.8, 0, 1) * np.exp(-((distance / 1.8) ** 2))
    groove = noise.blur(groove.astype(np.float32), 0.3, extent_mm)
    return np.asarray(cv2.resize(groove, (_RELIEF_PX, _RELIEF_PX)), np.float32)


def _cover_brain(brain: Shape, relief: Relief, extent: float) -> tuple[Map, Map]:
    """Height (n, n) mm of the arachnoid over a brain, and its sulci (n, n) from 0 to 1."""
    height = _height_map(brain, extent, _RELIEF_PX // 2)
    gaps = np.isnan(height)
    if gaps.mean() > 1 - LEAST_FILLED:
        hint = "`synth preview` of the mesh finds suitable places"
        raise UserError(f"anatomy.craniotomy: the brain's surface does not fill the opening there; {hint}")
    if gaps.any():  # the height of the nearest pixel
        nearest = distance_transform_edt(gaps, return_distances=False, return_indices=True)
        height = height[tuple(nearest)]
    # The arachnoid bridges narrow clefts: a closing, then a smoothing.
    pixel = extent / len(height)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * int(2.0 / pixel) + 1,) * 2)
    closing = cv2.morphologyEx(height, cv2.MORPH_CLOSE, disc)
    arachnoid = noise.blur(np.maximum(height, closing - relief.sulcus_mm), 0.7, extent)
    depth = noise.blur(arachnoid, 4.0, extent) - arachnoid
    sulci = np.clip(depth / max(float(np.quantile(depth, 0.98)), 1e-6), 0, 1).astype(np.float32)
    return arachnoid, sulci


def _height_map(surface: Shape, extent: float, pixels: int) -> Map:
    """Highest point of the surface over each pixel, (n, n) mm; NaN where there is none."""
    vertices, faces = surface
    scale = pixels / extent
    flat = (vertices[:, :2] / extent + 0.5) * pixels - 0.5
    corners = flat[faces]
    low = np.ceil(corners.min(axis=1)).astype(np.int64)
    high = np.floor(corners.max(axis=1)).astype(np.int64)
    visible = ((high >= 0) & (low < pixels) & (high >= low)).all(axis=1)
    # Without the far side and the base of the brain, which lie deeper than any sulcus.
    visible &= vertices[faces][:, :, 2].max(axis=1) > -0.75 * extent
    height = np.full((pixels, pixels), np.nan, np.float32)
    for face in np.flatnonzero(visible):
        (x0, y0), (x1, y1) = np.clip(low[face], 0, None), np.clip(high[face], None, pixels - 1)
        a, b, c = corners[face]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if abs(area) < 1e-9 * scale:
            continue
        x, y = np.meshgrid(np.arange(x0, x1 + 1), np.arange(y0, y1 + 1))
        u = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area
        v = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area
        inside = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9)
        za, zb, zc = vertices[faces[face], 2]
        z = np.where(inside, za + u * (zb - za) + v * (zc - za), np.nan)
        window = height[y0 : y1 + 1, x0 : x1 + 1]
        height[y0 : y1 + 1, x0 : x1 + 1] = np.fmax(window, z)
    return height


def resize(surface: CortexSurface, factor: float) -> CortexSurface:
    """A surface of another size; chart and vessels, which it is painted by, stay as they were grown."""
    if factor == 1:
        return surface
    vertices, pia = factor * surface.vertices, factor * surface.pia
    return replace(surface, vertices=vertices, pia=pia, extent_mm=factor * surface.extent_mm)
