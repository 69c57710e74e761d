"""Maps of vessels: distance to the nearest centre line, and that vessel's radius."""

from __future__ import annotations

import numpy as np

from synth.arrays import Floats, Ints, Map
from synth.render.anatomy.tree import Tree
from synth.system.jit import argument_types, vectorised


def raster(tree: Tree, pixels: int, extent_mm: float, margin_mm: float | Floats = 0.5) -> tuple[Map, Map]:
    """Distance to a centre line, and its radius, (pixels, pixels) float32 mm, of the vessel that a pixel lies
    deepest in; farther than `margin_mm`, of all nodes or of each, (N,), from every vessel the distance is
    `extent_mm`, the radius 0."""
    distance = np.full((pixels, pixels), np.float32(extent_mm))
    radius = np.zeros((pixels, pixels), np.float32)
    texels = (tree.nodes / extent_mm + 0.5) * pixels - 0.5
    margins = np.full(tree.radius.shape, margin_mm, np.float64)
    _draw(texels, tree.parent, tree.radius, pixels / extent_mm, margins, distance, radius)
    return distance, radius


@argument_types("f8[:,::1], i8[::1], f8[::1], f8, f8[::1], f4[:,::1], f4[:,::1]")
@vectorised
def _draw(
    at: Floats, parent: Ints, wide: Floats, scale: float, margins: Floats, distance: Map, radius: Map
) -> None:
    """Draws round segments into the two maps; `at` in texels, of which a mm has `scale`."""
    rows, columns = distance.shape
    for k in range(len(parent)):
        p = parent[k]
        if p < 0:
            continue
        # A twig is not as wide as its trunk where it branches off.
        first, last, margin = min(wide[p], 1.3 * wide[k]), wide[k], margins[k]
        reach = (max(first, last) + margin) * scale
        x0, y0, dx, dy = at[p, 0], at[p, 1], at[k, 0] - at[p, 0], at[k, 1] - at[p, 1]
        whole = max(dx * dx + dy * dy, 1e-12)
        top, bottom = max(0, int(min(y0, y0 + dy) - reach)), min(rows, int(max(y0, y0 + dy) + reach) + 2)
        left, right = max(0, int(min(x0, x0 + dx) - reach)), min(columns, int(max(x0, x0 + dx) + reach) + 2)
        for y in range(top, bottom):
            for x in range(left, right):
                part = min(1.0, max(0.0, ((x - x0) * dx + (y - y0) * dy) / whole))
                aside, along = x - x0 - part * dx, y - y0 - part * dy
                own = first + part * (last - first)
                # Nearer than its margin, and deeper than in the vessel before: most texels need no root.
                most = scale * (own + min(margin, distance[y, x] - radius[y, x]))
                square = aside * aside + along * along
                if most > 0 and square < most * most:
                    distance[y, x], radius[y, x] = np.sqrt(square) / scale, own
