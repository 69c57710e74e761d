"""Objects around an opening: cotton patties over its edge, a retractor's blade, stitches, dural vessels.

None of it is tissue or an acting instrument: it hides what is below it, in pictures and truth alike.
Sizes (mm), albedos (linear RGB) and absorptions were chosen by eye on an intra-operative photograph.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter1d
from scipy.spatial import cKDTree

from synth.arrays import Array, Floats, Indices, Map
from synth.geometry.triangles import Shape, grid_faces
from synth.render.anatomy.layers import Rgb, over, speckled, step, through
from synth.render.anatomy.tree import Tree

PATTY_MM = (5.0, 2.3)
"""Half length and half width of the patties over the opening's edge."""
_PATTY_GRID = (34, 18)
_COTTON_MM = 0.45
_BLADE_RINGS, _BLADE_AROUND = 60, 24


class Cotton:
    """Albedo of white felt and its blue thread, absorption of the blood that soaks it."""

    felt: Rgb = (0.86, 0.82, 0.76)
    thread: Rgb = (0.05, 0.12, 0.30)
    blood: Rgb = (0.15, 1.3, 1.4)


class Suture:
    """A stitch's black thread."""

    albedo: Rgb = (0.025, 0.025, 0.035)
    half_mm: float = 0.075
    raised_mm: float = 0.08


def stitches(edge: Floats, rng: np.random.Generator) -> Floats:
    """Angles (n,) rad of the stitches: where the opening is widest in each of a few sectors."""
    sectors = int(rng.integers(4, 7))
    first = int(rng.integers(len(edge)))
    parts = np.array_split(np.roll(np.arange(len(edge)), -first), sectors)
    widest = np.array([part[np.argmax(edge[part])] for part in parts])
    return np.asarray(2 * np.pi * widest / len(edge))


def aside(angle: Array, stitch: float) -> Array:
    """Signed angle (...) from a stitch, the shorter way [rad]."""
    return np.mod(angle - stitch + np.pi, 2 * np.pi) - np.pi


def threaded(
    stitches: Floats, angle: Map, away: Map, radius: float, colour: Map, bumps: Map
) -> tuple[Map, Map]:
    """Colour (r, n, 3) and bumps mm with threads: two strands from each stitch, meeting far out.

    `angle` rad and `away` mm: points (r, n) around an opening of mean `radius` mm, and beyond its edge.
    """
    covered = np.zeros_like(away)
    for stitch in stitches:
        across = aside(angle, stitch) * (radius + away)
        # A loop, round where it pierces the dura, its strands together far out.
        apart = 0.42 * np.sqrt(np.clip((away - 0.9) / 0.7, 0, 1)) * np.clip(1 - (away - 1.0) / 12.0, 0, 1)
        line = np.where(away > 0.9, np.abs(np.abs(across) - apart), 9.0)
        covered = np.maximum(covered, step((Suture.half_mm - line) / 0.06 + 0.2))
    threads = np.asarray(covered, np.float32)
    colour = colour + threads[..., None] * (np.array(Suture.albedo, np.float32) - colour)
    return colour, bumps + np.float32(Suture.raised_mm) * threads


def dural_vessels(edge: Floats, rng: np.random.Generator) -> Tree:
    """Meningeal vessels (nodes in world x, y mm) over the dura around an opening with an edge (A,) mm."""
    nodes, parent, radius = list[Floats](), list[int](), list[float]()
    mean = float(edge.mean())
    # A stem: its start (angle, mm from the edge), lean, width (sign: its way around), steps, and parent node.
    stems: list[tuple[float, float, float, float, int, int]] = []
    count, way = int(rng.integers(6, 10)), rng.choice([-1, 1])
    for k in range(count):
        first = 2 * np.pi * (k + rng.uniform(0, 0.8)) / count, rng.uniform(1.5, 6.0), rng.normal(0, 0.3)
        stems.append((*first, way * rng.uniform(0.09, 0.2), 60, -1))
    while stems:
        angle, away, lean, width, steps, before = stems.pop()
        for k in range(steps):
            own = abs(width) * (1 - 0.75 * k / steps)
            r = mean + away
            nodes.append(np.array([r * np.cos(angle), r * np.sin(angle)]))
            parent.append(before)
            radius.append(own)
            before = len(nodes) - 1
            # Along the edge, with a random lean that is drawn back to the middle of the folded dura.
            lean = 0.94 * lean + rng.normal(0, 0.09) - 0.02 * (away - 3.8)
            angle, away = angle + 0.25 * np.sign(width) / r, float(np.clip(away + 0.25 * lean, 0.8, 8.0))
            if own > 0.06 and rng.random() < 0.045:
                fork = lean + rng.choice([-1, 1]) * rng.uniform(0.7, 1.3)
                stems.append((angle, away, fork, 0.65 * np.sign(width) * own, int(0.6 * (steps - k)), before))
    return Tree(np.stack(nodes), np.asarray(parent, np.int64), np.asarray(radius))


def with_felt(x: Map, y: Map, drawn: Sequence[Map], blood: float, colour: Map, bumps: Map) -> tuple[Map, Map]:
    """Colour (r, n, 3) and bumps mm at x, y mm with the felt of the patties in the middle, by noise `drawn`
    (r, n), soaked at its edges."""
    ragged, weave, stains = drawn
    far = np.maximum(np.abs(x) - PATTY_MM[0], np.abs(y) - PATTY_MM[1]) + 0.12 * ragged
    cover = step(0.5 - far / 0.25)[..., None]
    soaked = blood * np.clip(1.2 + far / 1.2 + 0.5 * stains, 0, 1.5)
    felt = through(speckled(Cotton.felt, 0.06 * weave), soaked, Cotton.blood)
    thread = (np.exp(-((y / 0.25) ** 4)) * (x > -PATTY_MM[0] + 1))[..., None]
    felt = felt * (1 - 0.8 * thread) + np.array(Cotton.thread, np.float32) * 0.8 * thread
    near = np.exp(-np.maximum(far, 0) / 0.5)[..., None]
    shaded = colour * (1 - 0.4 * near * (1 - cover))
    rough = bumps * (1 - cover[..., 0]) + 0.03 * weave * cover[..., 0]
    return np.asarray(over(shaded, felt, cover), np.float32), np.asarray(rough, np.float32)


def patties(edge: Floats, points: Floats, rng: np.random.Generator) -> list[tuple[Floats, Indices, Floats]]:
    """One or two cotton patties that lie half in an opening with an edge (A,) mm, on points (N, 3) mm.

    Of each: vertices (V, 3) mm, faces (F, 3), and the vertices' places on the patty (V, 2) mm.
    """
    tree = cKDTree(points[:, :2])
    faces = grid_faces(*_PATTY_GRID)[::-1, :, [0, 2, 1]].reshape(-1, 3)
    laid = []
    for around in rng.uniform(0, 2 * np.pi) + np.pi * np.arange(int(rng.integers(1, 3))):
        at = edge_at(edge, around) + rng.uniform(-0.6, 1.2)
        turn = around + np.pi / 2 + rng.uniform(-0.6, 0.6)
        long, wide = (np.linspace(-1.06, 1.06, _PATTY_GRID[0]), np.linspace(-1.1, 1.1, _PATTY_GRID[1]))
        u, v = np.meshgrid(long * PATTY_MM[0], wide * PATTY_MM[1], indexing="ij")
        c, s = np.cos(turn), np.sin(turn)
        x = at * np.cos(around) + c * u - s * v
        y = at * np.sin(around) + s * u + c * v
        _, near = tree.query(np.stack([x.ravel(), y.ravel()], 1), k=6)
        below = points[near, 2].max(axis=1).reshape(x.shape)
        # Soaked felt follows the surface below; its outermost ring is tucked under.
        z = np.maximum(gaussian_filter(below, 1.5, mode="nearest"), below) + _COTTON_MM
        z[[0, -1]] -= _COTTON_MM + 0.25
        z[:, [0, -1]] -= _COTTON_MM + 0.25
        vertices = np.stack([x, y, z], -1).reshape(-1, 3)
        laid.append((vertices, faces, np.stack([u.ravel(), v.ravel()], 1)))
    return laid


def retractor(edge: Floats, points: Floats, rng: np.random.Generator) -> Shape:
    """A blade of steel from outside over the rim, on points (N, 3) mm, bent down into an opening with an edge
    (A,) mm."""
    around, wide = float(rng.uniform(0, 2 * np.pi)), float(rng.uniform(2.8, 4.2))
    outwards = np.array([np.cos(around), np.sin(around)])
    across = np.array([-outwards[1], outwards[0]])
    along = points[:, :2] @ outwards
    below = np.abs(points[:, :2] @ across) < wide
    start = edge_at(edge, around) - float(rng.uniform(0.8, 2.0))
    s = np.linspace(0, 1, _BLADE_RINGS) ** 1.3 * 34.0
    slot = np.floor((along[below] - start) / 0.5).astype(int)
    highest = np.full(int(s[-1] / 0.5) + 2, -np.inf)
    inside = (slot >= 0) & (slot < len(highest))
    np.maximum.at(highest, slot[inside], points[below, 2][inside])
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
    """Radius mm at an angle [rad] of an opening's edge (A,) mm at even angles."""
    return float(edge[int(angle / (2 * np.pi) * len(edge)) % len(edge)])
