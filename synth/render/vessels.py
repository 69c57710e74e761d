"""Vessels of the pia: trunks along the sulci, trees by space colonisation, radii by Murray's law.

A. Runions, B. Lane, P. Prusinkiewicz, "Modeling trees with a space colonization algorithm", 2007.
C. D. Murray, "The physiological principle of minimum work", 1926: r^3 of a parent is its children's sum.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from synth.render import noise

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Map = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Tree:
    """One kind of vessel as segments: each node is joined to its parent, which comes before it."""

    nodes: Floats
    """(N, 2) mm."""
    parent: Ints
    """(N,) index of the parent; -1 at a root."""
    radius: Floats
    """(N,) mm."""


@dataclass(frozen=True)
class Vessels:
    """All vessels of one anatomy."""

    veins: Tree
    arteries: Tree
    capillaries: Tree


def grow_all(sulci: Map, extent_mm: float, rng: np.random.Generator) -> Vessels:
    """Vessels that follow the sulci.

    Args:
        sulci: (n, n) depth below the gyri, 0 on a crown to 1 in a sulcus.
        extent_mm: side of the square that the map covers.
        rng: where the anatomy comes from.
    """
    many = extent_mm / 34.0
    trunks, radius = _trunks(sulci, extent_mm, rng, round(many * rng.integers(1, 4)), (0.50, 0.95))
    veins = _tree(extent_mm, rng, trunks, spacings=(4.2,), leaf=0.13, wander=0.5)
    veins = _widen(veins, radius)
    trunks, radius = _trunks(sulci, extent_mm, rng, round(many * rng.integers(3, 6)), (0.20, 0.36))
    arteries = _tree(extent_mm, rng, trunks, spacings=(3.4, 1.4), leaf=0.058, wander=0.45)
    arteries = _widen(arteries, radius)
    return Vessels(veins, arteries, _web(arteries, extent_mm, rng))


def raster(tree: Tree, pixels: int, extent_mm: float) -> tuple[Map, Map]:
    """Distance to the nearest centre line and that line's radius, both (pixels, pixels) float32 mm.

    Centre lines are drawn to the nearest pixel; far from any vessel the distance is large and the radius
    that of the nearest one.
    """
    scale = pixels / extent_mm
    child = np.flatnonzero(tree.parent >= 0)
    start, end = tree.nodes[tree.parent[child]], tree.nodes[child]
    count = np.maximum(2, np.ceil(np.linalg.norm(end - start, axis=1) * scale * 1.6).astype(np.int64) + 1)
    which = np.repeat(np.arange(len(child)), count)
    step = (np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)) / (count[which] - 1)
    points = start[which] + step[:, None] * (end - start)[which]
    radii = tree.radius[tree.parent[child]][which] * (1 - step) + tree.radius[child][which] * step
    pixel = np.floor((points / extent_mm + 0.5) * pixels).astype(np.int64)
    inside = ((pixel >= 0) & (pixel < pixels)).all(axis=1)
    pixel, radii = pixel[inside], radii[inside].astype(np.float32)
    distance = np.full((pixels, pixels), np.float32(extent_mm))
    radius = np.zeros((pixels, pixels), np.float32)
    # Where a twig leaves a trunk the nearest line may be the twig's: one class of width at a time.
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
        away, width = away / np.float32(scale), table[label]
        deeper = width - away > radius - distance
        distance, radius = np.where(deeper, away, distance), np.where(deeper, width, radius)
    return distance, radius


def grow(
    nodes: Floats,
    parent: Ints,
    attractors: Floats,
    *,
    buds: npt.NDArray[np.bool_],
    step: float,
    reach: float,
    kill: float,
    wander: float,
    rng: np.random.Generator,
) -> tuple[Floats, Ints]:
    """Space colonisation: nodes step towards the attractors nearest to them until none is left in reach.

    Args:
        nodes: (N, 2) mm, where growth starts.
        parent: (N,).
        attractors: (A, 2) mm.
        buds: (N,) which of the given nodes may sprout; everything grown may.
        step: length of a segment [mm].
        reach: farthest attractor that pulls [mm].
        kill: an attractor this near is used up [mm].
        wander: random part of a step's direction, as a share.
        rng: where the wandering comes from.

    Returns:
        All nodes (M, 2) and parents (M,), the given ones first.
    """
    all_nodes, all_parent = [nodes], [parent]
    distance, nearest = cKDTree(nodes[buds]).query(attractors)
    nearest = np.flatnonzero(buds)[nearest]
    # What lies beside a trunk is already supplied, bud or no bud.
    distance = np.where(cKDTree(nodes).query(attractors)[0] < kill, 0.0, distance)
    total = len(nodes)
    children = np.bincount(parent[parent >= 0], minlength=total)
    for _ in range(int(4 * reach / step) + 400):
        keep = distance > kill
        attractors, distance, nearest = attractors[keep], distance[keep], nearest[keep]
        pulls = distance < reach
        if not pulls.any():
            break
        positions = np.concatenate(all_nodes)
        toward: Floats = attractors[pulls] - positions[nearest[pulls]]
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        pulled, index = np.unique(nearest[pulls], return_inverse=True)
        direction: Floats = np.stack(
            [np.bincount(index, toward[:, axis]).astype(np.float64) for axis in (0, 1)], axis=1
        )
        direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
        direction += wander * rng.standard_normal(direction.shape)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        # A node pulled evenly from two sides would sprout the same twig for ever.
        free = children[pulled] < 3
        stuck = np.isin(nearest, pulled[~free])
        if stuck.any():
            distance = np.where(stuck, 0.0, distance)
        if not free.any():
            continue
        sprouts = positions[pulled[free]] + step * direction[free]
        children[pulled[free]] += 1
        children = np.concatenate([children, np.zeros(len(sprouts), children.dtype)])
        all_nodes.append(sprouts)
        all_parent.append(pulled[free])
        near, which = cKDTree(sprouts).query(attractors)
        closer = (near < distance) & (distance > 0)
        distance = np.where(closer, near, distance)
        nearest = np.where(closer, which + total, nearest)
        total += len(sprouts)
    return np.concatenate(all_nodes), np.concatenate(all_parent)


def murray(parent: Ints, leaf: float) -> Floats:
    """Radii (N,) mm by Murray's law from leaves of radius `leaf`; parents come before children."""
    cubes = np.zeros(len(parent))
    order = parent.tolist()
    values = cubes.tolist()
    smallest = leaf**3
    for node in range(len(order) - 1, -1, -1):
        if values[node] == 0.0:
            values[node] = smallest
        if order[node] >= 0:
            values[order[node]] += values[node]
    return np.asarray(np.cbrt(np.asarray(values)), np.float64)


def _trunks(
    sulci: Map, extent_mm: float, rng: np.random.Generator, count: int, radius: tuple[float, float]
) -> tuple[tuple[Floats, Ints], Floats]:
    """Paths across the square along the sulci, as nodes with parents, and the trunk radius of each node."""
    side = 72
    depth = cv2.resize(sulci, (side, side), interpolation=cv2.INTER_AREA)
    nodes, parents, radii = [], [], []
    total = 0
    taken = np.zeros((side, side), np.float32)
    for trunk in range(max(1, count)):
        cost = 0.12 + (1 - np.clip(depth, 0, 1)) ** 2 + 0.35 * rng.random((side, side)) + 2.5 * taken
        angle = rng.uniform(0, 2 * np.pi) + trunk * 2 * np.pi / count
        turn = rng.uniform(0.6, 1.0) * np.pi
        ends = [_border(angle, side), _border(angle + turn, side)]
        path = _cheapest(cost, ends[0], ends[1])
        taken[path[:, 1].astype(int), path[:, 0].astype(int)] = 1.0
        taken = np.maximum(taken, cv2.GaussianBlur(taken, (0, 0), 1.5))
        line = ((path + 0.5) / side - 0.5) * extent_mm
        line = _resampled(_smoothed(line, 14), 0.18)
        line = line + _meander(rng, line, extent_mm, 0.55)
        nodes.append(line)
        parents.append(np.concatenate([[-1], np.arange(len(line) - 1) + total]))
        taper = np.linspace(1.0, rng.uniform(0.55, 0.85), len(line))
        radii.append(rng.uniform(*radius) * taper)
        total += len(line)
    return (np.concatenate(nodes), np.concatenate(parents).astype(np.int64)), np.concatenate(radii)


def _tree(
    extent_mm: float,
    rng: np.random.Generator,
    trunks: tuple[Floats, Ints],
    *,
    spacings: tuple[float, ...],
    leaf: float,
    wander: float,
) -> Tree:
    """Branches from the trunks, then finer ones from those, one round for each spacing [mm]."""
    nodes, parent = trunks
    fixed = len(nodes)
    for spacing in spacings:
        step = 0.15 * min(spacing, 1.6)
        between = np.linalg.norm(nodes[1] - nodes[0])
        grown = len(nodes)
        nodes, parent = grow(
            nodes,
            parent,
            _scattered(extent_mm, spacing, rng),
            buds=rng.random(grown) < between / (1.3 * spacing),
            step=step,
            reach=9.0,
            kill=0.5 * spacing,
            wander=wander,
            rng=rng,
        )
        nodes, parent = _pruned(nodes, parent, grown, shortest=int(0.7 * spacing / step))
    nodes = _relaxed(nodes, parent, fixed, rounds=4)
    nodes = nodes + _meander(rng, nodes, extent_mm, 0.3)
    return Tree(nodes, parent, murray(parent, leaf) * _taper(nodes, parent, 1.6))


def _web(arteries: Tree, extent_mm: float, rng: np.random.Generator) -> Tree:
    """Twigs finer than the arteries' own, grown from them into what they left empty."""
    fixed = len(arteries.nodes)
    nodes, parent = grow(
        arteries.nodes,
        arteries.parent,
        _scattered(extent_mm, 0.55, rng),
        buds=rng.random(fixed) < 0.25,
        step=0.13,
        reach=2.4,
        kill=0.27,
        wander=0.45,
        rng=rng,
    )
    nodes = _relaxed(nodes, parent, fixed, rounds=3)
    radius = np.minimum(murray(parent, 0.028), 0.06) * _taper(nodes, parent, 0.8)
    # Only the twigs and what they spring from: the arteries are drawn on their own.
    drawn = np.arange(len(nodes)) >= fixed
    drawn[parent[fixed:]] = True
    number = np.cumsum(drawn) - 1
    up = np.where(np.arange(len(nodes)) >= fixed, number[parent], -1)
    return Tree(nodes[drawn], up[drawn], radius[drawn])


def _taper(nodes: Floats, parent: Ints, length: float) -> Floats:
    """Factor (N,) by which vessels thin over the last `length` mm before their ends."""
    up = parent.tolist()
    segment = np.linalg.norm(nodes - nodes[np.maximum(parent, 0)], axis=1).tolist()
    left = [0.0] * len(up)
    for node in range(len(up) - 1, -1, -1):
        if up[node] >= 0:
            left[up[node]] = max(left[up[node]], left[node] + segment[node])
    return np.asarray(0.4 + 0.6 * np.clip(np.asarray(left) / length, 0, 1))


def _widen(tree: Tree, trunk: Floats) -> Tree:
    radius = tree.radius.copy()
    radius[: len(trunk)] = np.maximum(np.minimum(radius[: len(trunk)], 1.3 * trunk), trunk)
    widest = trunk.max()
    radius[len(trunk) :] = np.minimum(radius[len(trunk) :], 0.8 * widest)
    return Tree(tree.nodes, tree.parent, radius)


def _pruned(nodes: Floats, parent: Ints, fixed: int, shortest: int) -> tuple[Floats, Ints]:
    """Without side twigs of fewer than `shortest` nodes, which look cut off."""
    links = parent.tolist()
    reach = [1] * len(links)
    for node in range(len(links) - 1, -1, -1):
        if links[node] >= 0:
            reach[links[node]] = max(reach[links[node]], reach[node] + 1)
    keep = [True] * len(links)
    for node in range(fixed, len(links)):
        up = links[node]
        side_twig = up < fixed or reach[node] + 1 < reach[up]
        keep[node] = keep[up] and not (side_twig and reach[node] < shortest)
    kept = np.flatnonzero(keep)
    number = np.cumsum(keep) - 1
    return nodes[kept], np.where(parent[kept] >= 0, number[parent[kept]], -1)


def _scattered(extent_mm: float, spacing: float, rng: np.random.Generator) -> Floats:
    """Points about `spacing` apart: a jittered grid, which neither clumps nor lines up."""
    side = int(extent_mm / spacing)
    cell = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)
    return ((cell + rng.random(cell.shape)) / side - 0.5) * extent_mm


def _relaxed(nodes: Floats, parent: Ints, fixed: int, rounds: int) -> Floats:
    """Nodes after the first `fixed`, drawn towards their neighbours, which rounds off the steps."""
    has = np.flatnonzero(parent >= 0)
    for _ in range(rounds):
        total, count = np.zeros_like(nodes), np.zeros(len(nodes))
        np.add.at(total, has, nodes[parent[has]])
        np.add.at(count, has, 1)
        np.add.at(total, parent[has], nodes[has])
        np.add.at(count, parent[has], 1)
        moved = 0.5 * nodes + 0.5 * total / np.maximum(count, 1)[:, None]
        inner = (np.arange(len(nodes)) >= fixed) & (count > 1)
        nodes = np.where(inner[:, None], moved, nodes)
    return nodes


def _meander(rng: np.random.Generator, points: Floats, extent_mm: float, amplitude: float) -> Floats:
    """A smooth random shift of points, so that no vessel runs straight."""
    shifts = []
    for _ in range(2):
        long = noise.band(rng, 128, extent_mm, 7.0, 0.3)
        short = noise.band(rng, 128, extent_mm, 3.0, 0.3)
        shifts.append(amplitude * (0.6 * noise.sample(long, points, extent_mm)))
        shifts[-1] = shifts[-1] + amplitude * 0.22 * noise.sample(short, points, extent_mm)
    return np.stack(shifts, axis=1).astype(np.float64)


def _border(angle: float, side: int) -> tuple[int, int]:
    """Pixel (x, y) on the square's border in a direction from its centre."""
    direction = np.array([np.cos(angle), np.sin(angle)])
    point = direction / np.abs(direction).max() * (side - 1) / 2 + (side - 1) / 2
    return round(float(point[0])), round(float(point[1]))


def _cheapest(cost: Floats, start: tuple[int, int], end: tuple[int, int]) -> Floats:
    """Cheapest path (L, 2) of pixels x, y over a square cost map, diagonals allowed."""
    side = len(cost)
    index = np.arange(side * side).reshape(side, side)
    rows, columns, weights = [], [], []
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = index[: side - dy, max(0, -dx) : side - max(0, dx)]
        b = index[dy:, max(0, dx) : side + min(0, dx)]
        rows.append(a.ravel())
        columns.append(b.ravel())
        weights.append((0.5 * (cost.ravel()[a] + cost.ravel()[b]) * np.hypot(dx, dy)).ravel())
    graph = coo_array(
        (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), shape=(side**2, side**2)
    ).tocsr()
    source, goal = start[1] * side + start[0], end[1] * side + end[0]
    before = dijkstra(graph, directed=False, indices=source, return_predecessors=True)[1]
    path = [goal]
    while path[-1] != source:
        path.append(int(before[path[-1]]))
    return np.array([(p % side, p // side) for p in reversed(path)], dtype=np.float64)


def _smoothed(line: Floats, rounds: int) -> Floats:
    for _ in range(rounds):
        line = np.concatenate([line[:1], 0.25 * line[:-2] + 0.5 * line[1:-1] + 0.25 * line[2:], line[-1:]])
    return line


def _resampled(line: Floats, spacing: float) -> Floats:
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    at = np.linspace(0, along[-1], max(2, int(along[-1] / spacing)))
    return np.stack([np.interp(at, along, line[:, axis]) for axis in (0, 1)], axis=1)
