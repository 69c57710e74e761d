"""Vessels of the pia: veins along the sulci, arteries from trunks that cross the patch down to arterioles.

Veins and trunks of arteries follow the sulci (`tree`); finer vessels fill what these leave empty
(`colonisation`). Densities and calibres were compared with an intra-operative photograph; the other
numbers were chosen by eye on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from synth.arrays import Floats, Ints, Map, Mask
from synth.render.anatomy import colonisation, noise, tube
from synth.render.anatomy.colonisation import Growth
from synth.render.anatomy.layers import over
from synth.render.anatomy.tree import (
    Lattice,
    Tree,
    gather,
    halved,
    joined,
    lattice,
    least_cost,
    relaxed,
    remaining,
)

_PATCH_MM = 34.0  # side of the patch that numbers of trunks are counted on
_FINEST_MM = 0.2  # spacing of the points that vessels pass
_MOST = 160  # of them along a side


@dataclass(frozen=True)
class Kind:
    """One kind of vessel; lengths in mm, pairs are ranges."""

    roots: tuple[int, int]  # trunks that enter at the patch's border
    through: tuple[int, int]  # trunks that leave it on the other side
    inside: tuple[int, int]  # trunks that come up from a sulcus inside
    trunk: tuple[float, float]  # radius of those where they leave
    coarse: float  # spacing of points, as a multiple of the finest's
    spacing: float  # of ends
    end: tuple[float, float]  # radius of the finest
    crown: float  # cost of a way over a gyrus, as a multiple of one along a sulcus
    chance: float  # spread of the logarithm of ways' costs: more winds more
    sharing: float  # see `least_cost`
    stiff: float  # radius of vessels that are smoothed fully
    taper: float  # length over which ends thin to nothing
    bends: tuple[float, float]  # shift of a fine vessel over 2 mm, of every vessel over 9 mm
    loops: float = 0.0  # share of ends that join another vessel


VEINS = Kind(
    roots=(1, 3), through=(2, 4), inside=(0, 1), trunk=(0.45, 0.95), coarse=2.5, spacing=5.0,
    end=(0.06, 0.11), crown=3.0, chance=0.9, sharing=0.4, stiff=0.25, taper=3.0, bends=(0.25, 0.5),
)  # fmt: skip
ARTERIES = Kind(
    roots=(2, 5), through=(2, 4), inside=(2, 5), trunk=(0.2, 0.38), coarse=1.0, spacing=0.62,
    end=(0.024, 0.045), crown=0.7, chance=1.0, sharing=0.2, stiff=0.3, taper=2.4, bends=(0.14, 0.35),
    loops=0.05,
)  # fmt: skip
DEEP = Kind(
    roots=(2, 4), through=(2, 3), inside=(0, 1), trunk=(0.08, 0.15), coarse=2.0, spacing=2.4,
    end=(0.05, 0.08), crown=1.0, chance=0.8, sharing=0.3, stiff=0.3, taper=3.0, bends=(0.2, 0.5),
)  # fmt: skip


TRIBUTARIES = (
    Growth(spacing=6.0, reach=14.0, near=3.0, step=0.25, straight=1.5, end=(0.17, 0.32)),
    Growth(spacing=3.0, reach=8.0, near=1.4, step=0.2, straight=1.2, end=(0.045, 0.09)),
)
ARTERIOLES = (
    Growth(spacing=3.2, reach=12.0, near=0.9, step=0.22, straight=3.0, end=(0.03, 0.04)),
    Growth(spacing=1.5, reach=5.0, near=0.45, step=0.16, straight=2.4, end=(0.03, 0.036)),
    Growth(spacing=0.88, reach=2.5, near=0.24, step=0.12, straight=2.2, end=(0.022, 0.030)),
    Growth(spacing=0.5, reach=1.5, near=0.16, step=0.1, straight=1.8, end=(0.017, 0.027)),
)
_TRUNK_MM = 0.07  # least radius of the arteries that arterioles grow from
_BESIDE_MM = 0.35  # no artery ends nearer to a wide vein than this
_WIDE_MM = 0.22  # radius of such a vein
_TWIG_MM = 0.25  # shorter side branches are left out: they look like thorns,
_TWIG_RADII = 5.0  # the more so, the wider what they leave
_ROUNDED = 11  # rounds of smoothing of what has grown in, over some 0.2 mm: more straighten twigs
_THIN_MM = 3.0  # length over which trunks thin to where branches go on
_TAPER_MM = 0.5  # length over which arterioles and tributaries thin
_POINTED = 0.018, 0.04  # radius of a free end, and by how much it grows with each mm from there
_ENDS_MM, _ENDS = (0.0, 0.55, 1.1, 1.8), (0.013, 0.023, 0.046, 0.2)  # most radius before a free end
_WIDENS = 1.08  # times, at most and besides, from a node to the next one up
_WINDING = 0.12, 1.9  # shift of fine vessels, and over what distance
_BENT = 0.2, 4.5  # that of all arteries; wide veins lie where the mesh is raised
_WIDEST_MM = 0.5  # radius that no artery of the pia reaches, whatever its branches sum up to
_SUPPLE_MM = 0.12  # radius of a vessel that winds half as much


@dataclass(frozen=True)
class Vessels:
    """All vessels of one anatomy."""

    veins: Tree  # that stand out of the mesh
    trunks: Tree  # of arteries, that press into veins
    visible_veins: Tree  # with smooth centre lines, and with tributaries
    arteries: Tree
    deep: Tree  # below the pia, visible through the tissue


def grow_all(sulci: Map, extent_mm: float, rng: np.random.Generator) -> Vessels:
    """Vessels of a square patch, along its sulci (n, n): 0 on a crown to 1 in a sulcus."""
    everywhere = np.ones((8, 8), np.float32)
    veins = _grown(VEINS, sulci, everywhere, extent_mm, rng)
    # The density of arteries varies between gyri, and is 0 on a wide vein.
    rich = np.clip(0.8 + 0.35 * noise.band(rng, 128, extent_mm, 9.0, 0.5), 0.15, 1.0)
    distance, width = tube.raster(veins, 128, extent_mm)
    rich *= (distance > width + 0.3) | (width < 0.3)
    trunks = _grown(ARTERIES, sulci, rich.astype(np.float32), extent_mm, rng)
    deep = _grown(DEEP, sulci, everywhere, extent_mm, rng)
    smooth = _smooth(_pruned(veins, 0.05), 1.6)
    visible = smooth
    for growth in TRIBUTARIES:
        visible = colonisation.fill(visible, _targets(growth, everywhere, extent_mm, rng), growth, rng)
    visible = _finished(visible, len(smooth.nodes), 0.0, extent_mm, rng)
    distance, width = tube.raster(visible, 512, extent_mm, _BESIDE_MM)
    beside = (width > _WIDE_MM) & (distance < width + _BESIDE_MM)
    free = (~beside * np.clip(1 + 0.3 * noise.band(rng, 512, extent_mm, 8.0, 0.5), 0.6, 1)).astype(np.float32)
    arteries = main = _slender(_smooth(_even(_from_outside(_pruned(trunks, _TRUNK_MM), extent_mm)), 1.3))
    for growth in ARTERIOLES:
        arteries = colonisation.fill(arteries, _targets(growth, free, extent_mm, rng), growth, rng)
    arteries = _finished(_narrow(_without_thorns(arteries)), len(main.nodes), _BENT[0], extent_mm, rng)
    return Vessels(veins, trunks, visible, arteries, deep)


def _targets(growth: Growth, density: Map, extent_mm: float, rng: np.random.Generator) -> Floats:
    """Points (N, 2) mm about a growth's spacing apart, of which a share `density` (m, m) stays."""
    points = _jittered(growth.spacing, extent_mm, rng)
    return points[rng.random(len(points)) < noise.sample(density, points, extent_mm)]


def _pruned(tree: Tree, least_mm: float) -> Tree:
    """The tree without twigs of a radius below `least_mm`."""
    return _parts(tree, gather(tree.parent, (tree.radius >= least_mm).astype(np.float64)) > 0)


def _from_outside(tree: Tree, extent_mm: float) -> Tree:
    """The trunks that enter at the patch's border, or all: a start in mid-field looks like a spindle."""
    kept = ~_inside(tree, extent_mm)[_trunk_of(tree)]
    return _parts(tree, kept) if kept.any() else tree


def _even(tree: Tree) -> Tree:
    """The tree no vessel of which widens away from its root, as beside a start in mid-field."""
    wide = tree.radius.tolist()
    for k, up in reversed(list(enumerate(tree.parent.tolist()))):  # children come after their parents
        if up >= 0:
            wide[up] = max(wide[up], wide[k])
    return Tree(tree.nodes, tree.parent, np.array(wide))


def _parts(tree: Tree, kept: Mask) -> Tree:
    """The tree of the nodes (N,) that are kept, which includes the parent of each."""
    number = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)
    return Tree(tree.nodes[kept], number[tree.parent[kept]], tree.radius[kept])


def _smooth(tree: Tree, over_mm: float) -> Tree:
    """The tree with centre lines and radii smoothed over a length; its ends stay.

    Springs of r^4, stiffer than at growth: no side branch bends its trunk into an elbow.
    """
    length = np.hypot(*(tree.nodes - tree.nodes[tree.parent])[tree.parent >= 0].T)
    rounds = round(2 * (over_mm / max(float(np.mean(length)), 0.02)) ** 2)
    spread = np.column_stack([tree.nodes, np.log(tree.radius)])
    spread = relaxed(spread, tree.parent, tree.radius**2, 1e-3, rounds)
    return Tree(spread[:, :2], tree.parent, np.exp(spread[:, 2]))


def _slender(tree: Tree) -> Tree:
    """The tree thinned towards its ends, where finer branches go on."""
    left = remaining(tree.nodes, tree.parent, np.zeros(len(tree.nodes)))
    return Tree(tree.nodes, tree.parent, tree.radius * np.clip(left / _THIN_MM, 0.25, 1) ** 0.5)


def _narrow(tree: Tree) -> Tree:
    """The tree with the widest vessels of a radius near to `_WIDEST_MM`."""
    return Tree(tree.nodes, tree.parent, tree.radius / (1 + (tree.radius / _WIDEST_MM) ** 4) ** 0.25)


def _without_thorns(tree: Tree) -> Tree:
    """The tree without side branches that are short, most of all beside the trunk that they leave."""
    left = remaining(tree.nodes, tree.parent, np.zeros(len(tree.nodes)))
    left = left + np.hypot(*(tree.nodes - tree.nodes[tree.parent]).T)
    least = _TWIG_MM + _TWIG_RADII * tree.radius[tree.parent]
    longest = np.zeros(len(left))
    child = np.flatnonzero(tree.parent >= 0)
    np.maximum.at(longest, tree.parent[child], left[child])
    gone = (tree.parent >= 0) & (left < least) & (left < longest[tree.parent])
    while (beyond := gone[tree.parent] & (tree.parent >= 0) & ~gone).any():
        gone |= beyond
    return _parts(tree, ~gone)


def _inside(tree: Tree, extent_mm: float) -> Mask:
    """Nodes (N,) that are not at the patch's border."""
    return np.asarray(np.abs(tree.nodes).max(axis=1) < 0.42 * extent_mm)


def _finished(tree: Tree, main: int, bent: float, extent_mm: float, rng: np.random.Generator) -> Tree:
    """The tree whose nodes from number `main` on have grown in, made to wind and bend, and thinned."""
    nodes = relaxed(tree.nodes, tree.parent, tree.radius**2, 1e-3, _ROUNDED)
    shift, wave = _WINDING
    winding, bends = (
        np.stack([noise.sample(noise.band(rng, 256, extent_mm, w, 0.5), nodes, extent_mm) for _ in "xy"], 1)
        for w in (wave, _BENT[1])
    )
    supple = shift / (1 + (tree.radius / _SUPPLE_MM) ** 2)
    left = remaining(nodes, tree.parent, np.zeros(len(nodes)))
    thinned = np.where(np.arange(len(nodes)) < main, 1, np.clip(left / _TAPER_MM, 0.5, 1) ** 0.5)
    # Wide vessels vary over centimetres: shorter waves look like beads.
    short, long = (
        noise.sample(noise.band(rng, 256, extent_mm, w, 0.6), nodes, extent_mm) for w in (2.5, 9.0)
    )
    wide = np.clip(tree.radius / 0.3, 0, 1)
    radius = tree.radius * thinned * np.clip(1 + over(0.12 * short, 0.2 * long, wide), 0.75, 1.3)
    return _pointed(Tree(nodes + supple[:, None] * winding + bent * bends, tree.parent, radius), extent_mm)


def _pointed(tree: Tree, extent_mm: float) -> Tree:
    """The tree whose ends and roots inside the patch are pointed, and that narrows nowhere at once."""
    inside = _inside(tree, extent_mm)
    end, slope = _POINTED
    length = np.hypot(*(tree.nodes - tree.nodes[tree.parent]).T)
    most = np.where(inside, end, np.inf)
    childless = np.bincount(tree.parent + 1, minlength=len(most) + 1)[1:] == 0
    wide, limit = tree.radius.tolist(), np.where(childless, most, 0.0).tolist()
    for k, up in reversed(list(enumerate(tree.parent.tolist()))):  # children come after their parents
        wide[k] = min(wide[k], limit[k])
        if up >= 0:
            limit[up] = max(limit[up], _WIDENS * wide[k] + slope * float(length[k]))
    left = remaining(tree.nodes, tree.parent, np.where(inside, 0.0, _ENDS_MM[-1]))
    radius, trunk = np.minimum(wide, np.interp(left, _ENDS_MM, _ENDS, right=np.inf)), _trunk_of(tree)
    for root in np.flatnonzero((tree.parent < 0) & inside):
        away = np.hypot(*(tree.nodes - tree.nodes[root]).T)
        radius = np.where(trunk == root, np.minimum(radius, end + slope * away), radius)
    return Tree(tree.nodes, tree.parent, radius)


def _trunk_of(tree: Tree) -> Ints:
    """The root (N,) that each node goes back to."""
    trunk = np.where(tree.parent >= 0, tree.parent, np.arange(len(tree.nodes)))
    while (trunk[trunk] != trunk).any():
        trunk = trunk[trunk]
    return trunk


def _grown(kind: Kind, sulci: Map, density: Map, extent_mm: float, rng: np.random.Generator) -> Tree:
    """One kind of vessel; `density` (m, m): share of its ends that stay."""
    way = lattice(extent_mm, kind.coarse * max(_FINEST_MM, extent_mm / _MOST), rng)
    depth = noise.sample(sulci, way.points, extent_mm)
    clouds = noise.sample(noise.band(rng, 128, extent_mm, 2.0, 0.7), way.points, extent_mm)
    chance = np.exp(0.7 * kind.chance * (clouds + rng.standard_normal(len(depth))))
    cost = np.asarray((1 + kind.crown * (1 - np.clip(depth, 0, 1)) ** 2) * chance, np.float64)
    many = extent_mm / _PATCH_MM
    roots, deep, out = _trunks(kind, cost, way, many, rng)
    ends = _ends(kind, way, density, extent_mm, rng)
    ends = ends[~np.isin(ends, np.concatenate([roots, deep, out]))]
    starts = np.concatenate([roots, deep])
    radius = np.concatenate([rng.uniform(*kind.trunk, len(out)), rng.uniform(*kind.end, len(ends))])
    used = least_cost(way, cost, starts, np.concatenate([out, ends]), radius, kind.sharing)
    made = halved(joined(used, kind.loops, 3 * kind.spacing, float(np.median(way.lengths)), rng))
    nodes, parent, own = made.nodes, made.parent, made.radius
    beyond = np.where(np.arange(len(nodes)) < 2 * len(used.nodes), 0.0, kind.taper)
    nodes = relaxed(nodes, parent, own, kind.stiff, 100)
    left = remaining(nodes, parent, beyond)
    short, long = (
        [noise.sample(noise.band(rng, 128, extent_mm, wave, 0.4), nodes, extent_mm) for _ in range(2)]
        for wave in (1.7, 9.0)
    )
    supple = kind.bends[0] / (1 + (own / (0.4 * kind.stiff)) ** 2)
    nodes = nodes + np.stack(short, 1) * supple[:, None] + kind.bends[1] * np.stack(long, 1)
    own = own * np.where(own > kind.end[1], 1, np.clip(left / kind.taper, 0.05, 1) ** 0.5)
    if len(deep):  # it comes into sight over a millimetre or two
        own = own * np.clip(0.2 + cKDTree(way.points[deep]).query(nodes)[0] / 1.5, 0, 1)
    swell = noise.sample(noise.band(rng, 128, extent_mm, 4.0, 0.5), nodes, extent_mm)
    return Tree(nodes, parent, own * np.clip(1 + 0.1 * swell, 0.75, 1.3))


def _trunks(
    kind: Kind, cost: Floats, way: Lattice, many: float, rng: np.random.Generator
) -> tuple[Ints, Ints, Ints]:
    """Points where trunks enter at the patch's border, come up in it, and leave it: where ways are cheap."""
    half = np.abs(way.points).max()
    out = np.abs(way.points).max(axis=1)
    angle = np.arctan2(way.points[:, 1], way.points[:, 0])
    border, inner = np.flatnonzero(out > 0.93 * half), np.flatnonzero(out < 0.7 * half)

    def cheapest(towards: Floats) -> Ints:
        apart = np.abs(np.angle(np.exp(1j * (angle[border] - towards[:, None]))))
        return np.asarray(border[np.argmin(np.log(cost[border]) + 6 * apart, axis=1)])

    count, leaving = (max(1, round(many * rng.integers(*of))) for of in (kind.roots, kind.through))
    within = round(many * rng.integers(*kind.inside))
    first = rng.uniform(0, 2 * np.pi) + (np.arange(count) + rng.uniform(-0.3, 0.3, count)) * 2 * np.pi / count
    across = first[np.arange(leaving) % count] + rng.uniform(0.7, 1.3, leaving) * np.pi
    chosen = rng.choice(inner, (within, 40))
    deep = chosen[np.arange(within), np.argmin(cost[chosen], axis=1)]
    roots, out = np.unique(cheapest(first)), np.unique(cheapest(across))
    return roots, np.unique(deep), out[~np.isin(out, roots)]


def _ends(kind: Kind, way: Lattice, density: Map, extent_mm: float, rng: np.random.Generator) -> Ints:
    """Points about `kind.spacing` apart: of a jittered grid, which neither clumps nor lines up, a share."""
    points = _jittered(kind.spacing, extent_mm, rng)
    points = points[rng.random(len(points)) < noise.sample(density, points, extent_mm)]
    return np.unique(cKDTree(way.points).query(points)[1])


def _jittered(spacing: float, extent_mm: float, rng: np.random.Generator) -> Floats:
    """A point (N, 2) mm somewhere in each cell of a grid: they neither clump nor line up."""
    side = max(1, int(extent_mm / spacing))
    cell = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)
    return np.asarray(((cell + rng.random(cell.shape)) / side - 0.5) * extent_mm)
