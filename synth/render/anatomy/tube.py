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
    nodes: Floats, parent: Ints, radii: Floats, scale: float, margins: Floats, distance: Map, radius: Map
) -> None:
    """Draws round segments into the two maps; `nodes` in texels, of which a mm has `scale`."""
    rows, columns = distance.shape
    for k in range(len(parent)):
        p = parent[k]
        if p < 0:
            continue
        # A twig is not as wide as its trunk where it branches off.
        first, last, margin = min(radii[p], 1.3 * radii[k]), radii[k], margins[k]
        reach = (max(first, last) + margin) * scale
        x0, y0, dx, dy = nodes[p, 0], nodes[p, 1], nodes[k, 0] - nodes[p, 0], nodes[k, 1] - nodes[p, 1]
        length2 = max(dx * dx + dy * dy, 1e-12)
        top, bottom = max(0, int(min(y0, y0 + dy) - reach)), min(rows, int(max(y0, y0 + dy) + reach) + 2)
        left, right = max(0, int(min(x0, x0 + dx) - reach)), min(columns, int(max(x0, x0 + dx) + reach) + 2)
        for y in range(top, bottom):
            for x in range(left, right):
                fraction = min(1.0, max(0.0, ((x - x0) * dx + (y - y0) * dy) / length2))
                offset_x, offset_y = x - x0 - fraction * dx, y - y0 - fraction * dy
                local_radius = first + fraction * (last - first)
                # Nearer than its margin, and deeper than in the vessel before: most texels need no root.
                limit = scale * (local_radius + min(margin, distance[y, x] - radius[y, x]))
                square = offset_x * offset_x + offset_y * offset_y
                if limit > 0 and square < limit * limit:
                    distance[y, x], radius[y, x] = np.sqrt(square) / scale, local_radius
