"""What else lies about an opening: cotton over its edge, a retractor's blade, stitches, dural vessels.

None of it is tissue or an instrument that acts: it hides what is below it, in pictures and truth alike.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter, maximum_filter1d
from scipy.spatial import cKDTree

from synth.geometry.triangles import Shape, grid_faces
from synth.render.anatomy.tree import Tree

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]

PATTY_MM = (5.0, 2.3)
"""Half length and width of the patties over the opening's edge."""
_PATTY_GRID = (34, 18)
_COTTON_MM = 0.45
_BLADE_RINGS, _BLADE_AROUND = 60, 24


def stitches(edge: Floats, rng: np.random.Generator) -> Floats:
    """Angles (n,) rad at which threads hold the dura: where the opening is widest, one a sector."""
    sectors = int(rng.integers(4, 7))
    first = int(rng.integers(len(edge)))
    parts = np.array_split(np.roll(np.arange(len(edge)), -first), sectors)
    widest = np.array([part[np.argmax(edge[part])] for part in parts])
    return np.asarray(2 * np.pi * widest / len(edge))


def dural_vessels(edge: Floats, rng: np.random.Generator) -> Tree:
    """Meningeal vessels (nodes in world x, y mm) that run over the dura round an opening and branch.

    `edge`: (A,) mm, radius of the opening at even angles; `rng`: where they run.
    """
    nodes: list[Floats] = []
    parent: list[int] = []
    radius: list[float] = []
    mean = float(edge.mean())
    # A stem: where it starts (angle, mm from the edge), how it leans, its width, steps, and what it leaves.
    stems: list[tuple[float, float, float, float, int, int]] = []
    count, way = int(rng.integers(6, 10)), rng.choice([-1, 1])
    for k in range(count):
        first = 2 * np.pi * (k + rng.uniform(0, 0.8)) / count, rng.uniform(1.5, 6.0), rng.normal(0, 0.3)
        stems.append((*first, way * rng.uniform(0.09, 0.2), 60, -1))
    while stems:
        angle, away, lean, width, steps, before = stems.pop()
        for step in range(steps):
            own = abs(width) * (1 - 0.75 * step / steps)
            r = mean + away
            nodes.append(np.array([r * np.cos(angle), r * np.sin(angle)]))
            parent.append(before)
            radius.append(own)
            before = len(nodes) - 1
            # On along the edge (a width's sign is its way round), swaying, and held to the dura.
            lean = 0.94 * lean + rng.normal(0, 0.09) - 0.02 * (away - 3.8)
            angle, away = angle + 0.25 * np.sign(width) / r, float(np.clip(away + 0.25 * lean, 0.8, 8.0))
            if own > 0.06 and rng.random() < 0.045:
                fork = lean + rng.choice([-1, 1]) * rng.uniform(0.7, 1.3)
                stems.append(
                    (angle, away, fork, 0.65 * np.sign(width) * own, int(0.6 * (steps - step)), before)
                )
    return Tree(np.stack(nodes), np.asarray(parent, np.int64), np.asarray(radius))


def patties(edge: Floats, points: Floats, rng: np.random.Generator) -> list[tuple[Floats, Ints, Floats]]:
    """One or two cotton patties that lie half in the opening.

    Args:
        edge: (A,) mm, radius of the opening at even angles.
        points: (N, 3) mm, of everything that they may lie on.
        rng: where they lie.

    Returns:
        Vertices (V, 3) mm, faces (F, 3), and where each vertex is on its patty (V, 2) mm, of each.
    """
    tree = cKDTree(points[:, :2])
    faces = grid_faces(*_PATTY_GRID)[::-1, :, [0, 2, 1]].reshape(-1, 3)
    laid = []
    for around in rng.uniform(0, 2 * np.pi) + np.pi * np.arange(int(rng.integers(1, 3))):
        at = edge_at(edge, around) + rng.uniform(-0.6, 1.2)
        turn = around + np.pi / 2 + rng.uniform(-0.6, 0.6)
        rows, columns = _PATTY_GRID
        u, v = np.meshgrid(
            np.linspace(-1.06, 1.06, rows) * PATTY_MM[0],
            np.linspace(-1.1, 1.1, columns) * PATTY_MM[1],
            indexing="ij",
        )
        c, s = np.cos(turn), np.sin(turn)
        x = at * np.cos(around) + c * u - s * v
        y = at * np.sin(around) + s * u + c * v
        _, near = tree.query(np.stack([x.ravel(), y.ravel()], 1), k=6)
        below = points[near, 2].max(axis=1).reshape(x.shape)
        # Soaked felt hangs over what it lies on, and its outermost ring is tucked under.
        z = np.maximum(gaussian_filter(below, 1.5, mode="nearest"), below) + _COTTON_MM
        z[[0, -1]] -= _COTTON_MM + 0.25
        z[:, [0, -1]] -= _COTTON_MM + 0.25
        vertices = np.stack([x, y, z], -1).reshape(-1, 3)
        laid.append((vertices, faces, np.stack([u.ravel(), v.ravel()], 1)))
    return laid


def retractor(edge: Floats, points: Floats, rng: np.random.Generator) -> Shape:
    """A blade of steel from outside over the rim, bent down into the opening.

    `edge`: (A,) mm, radius of the opening at even angles; `points`: (N, 3) mm, of what it may lie on; `rng`:
    from where it comes.
    """
    around, wide = float(rng.uniform(0, 2 * np.pi)), float(rng.uniform(2.8, 4.2))
    outwards = np.array([np.cos(around), np.sin(around)])
    across = np.array([-outwards[1], outwards[0]])
    along = points[:, :2] @ outwards
    beside = np.abs(points[:, :2] @ across) < wide
    start = edge_at(edge, around) - float(rng.uniform(0.8, 2.0))
    s = np.linspace(0, 1, _BLADE_RINGS) ** 1.3 * 34.0
    slot = np.floor((along[beside] - start) / 0.5).astype(int)
    highest = np.full(int(s[-1] / 0.5) + 2, -np.inf)
    inside = (slot >= 0) & (slot < len(highest))
    np.maximum.at(highest, slot[inside], points[beside, 2][inside])
    known = np.flatnonzero(np.isfinite(highest))
    highest = np.interp(np.arange(len(highest)), known, highest[known])
    smooth = gaussian_filter(maximum_filter1d(highest, 5), 2.5, mode="nearest")
    z = np.interp(s, 0.5 * np.arange(len(highest)), np.maximum(smooth, highest)) + 0.55
    z = z - 0.5 * np.exp(-s / 1.2)
    close = np.sqrt(np.clip(1 - (1 - np.minimum(s / 2.5 + 0.02, 1)) ** 2, 0, 1))
    turn = np.linspace(0, 2 * np.pi, _BLADE_AROUND, endpoint=False)
    flat = np.sign(np.cos(turn)) * np.abs(np.cos(turn)) ** 0.3 * wide
    tall = np.sign(np.sin(turn)) * np.abs(np.sin(turn)) ** 0.6 * 0.35
    middle = (start + s)[:, None, None] * outwards
    xy = middle + (close[:, None] * flat)[..., None] * across
    vertices = np.concatenate([xy, (z[:, None] + close[:, None] * tall)[..., None]], -1).reshape(-1, 3)
    return Shape(vertices, grid_faces(_BLADE_RINGS, _BLADE_AROUND, "columns")[::-1].reshape(-1, 3))


def edge_at(edge: Floats, angle: float) -> float:
    """Radius mm at an angle [rad] of an opening's edge (A,) mm, which is given at even angles."""
    return float(edge[int(angle / (2 * np.pi) * len(edge)) % len(edge)])
