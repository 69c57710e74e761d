"""Maps of vessels: distance to the nearest centre line, and that vessel's radius."""

from __future__ import annotations

import itertools

import cv2
import numpy as np

from synth.arrays import Indices, Map
from synth.render.anatomy.tree import Tree
from synth.system.jit import vectorised


def raster(tree: Tree, pixels: int, extent_mm: float) -> tuple[Map, Map]:
    """Distance to the nearest centre line, to a pixel, and its radius, (pixels, pixels) float32 mm."""
    scale = pixels / extent_mm
    child = np.flatnonzero(tree.parent >= 0)
    start, end = tree.nodes[tree.parent[child]], tree.nodes[child]
    count = np.maximum(2, np.ceil(np.linalg.norm(end - start, axis=1) * scale * 1.6).astype(np.int64) + 1)
    which = np.repeat(np.arange(len(child)), count)
    step = (np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)) / (count[which] - 1)
    points = start[which] + step[:, None] * (end - start)[which]
    # A twig is not as wide as its trunk where it branches off.
    first = np.minimum(tree.radius[tree.parent[child]], 1.3 * tree.radius[child])
    radii = first[which] * (1 - step) + tree.radius[child][which] * step
    pixel = np.floor((points / extent_mm + 0.5) * pixels).astype(np.int64)
    inside = ((pixel >= 0) & (pixel < pixels)).all(axis=1)
    pixel, radii = pixel[inside], radii[inside].astype(np.float32)
    distance = np.full((pixels, pixels), np.float32(extent_mm))
    radius = np.zeros((pixels, pixels), np.float32)
    # Where a twig branches off, the nearest line may be the twig's: one class of width at a time.
    edges = np.geomspace(radii.min() * 0.999, radii.max() * 1.001, 4) if len(radii) else np.zeros(1)
    for low, high in itertools.pairwise(edges):
        own = (radii >= low) & (radii < high)
        line = np.zeros((pixels, pixels), np.float32)
        np.maximum.at(line, (pixel[own, 1], pixel[own, 0]), radii[own])
        if not line.any():
            continue
        away, label = cv2.distanceTransformWithLabels(
            (line == 0).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
        )
        table = np.zeros(int(label.max()) + 1, np.float32)
        table[label[line > 0]] = line[line > 0]
        _deepen(away, label, table, np.float32(scale), distance, radius)
    return distance, radius


@vectorised
def _deepen(away: Map, label: Indices, table: Map, scale: np.float32, distance: Map, radius: Map) -> None:
    """Draws vessels of radius table[label] mm, `away` texels from their lines, over shallower ones."""
    for y in range(away.shape[0]):
        for x in range(away.shape[1]):
            there, width = away[y, x] / scale, table[label[y, x]]
            if width - there > radius[y, x] - distance[y, x]:
                distance[y, x], radius[y, x] = there, width
