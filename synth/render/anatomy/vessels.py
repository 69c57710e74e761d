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
    anastomose,
    gather,
    lattice,
    least_cost,
    relax,
    remaining_length,
    subdivide,
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
    Growth(spacing=6.0, reach=14.0, kill_distance=3.0, step=0.25, straight=1.5, end=(0.17, 0.32)),
    Growth(spacing=3.0, reach=8.0, kill_distance=1.4, step=0.2, straight=1.2, end=(0.045, 0.09)),
)
ARTERIOLES = (
    Growth(spacing=3.2, reach=12.0, kill_distance=0.9, step=0.22, straight=3.0, end=(0.045, 0.06)),
    Growth(spacing=1.5, reach=5.0, kill_distance=0.45, step=0.16, straight=2.4, end=(0.038, 0.048)),
    Growth(spacing=1.05, reach=2.5, kill_distance=0.24, step=0.12, straight=2.2, end=(0.028, 0.038)),
    Growth(spacing=0.75, reach=1.5, kill_distance=0.16, step=0.1, straight=1.8, end=(0.022, 0.032)),
)
_TRUNK_MM = 0.07  # least radius of the arteries that arterioles grow from
_SEEN_VEIN, _SEEN_TRUNK = 1.22, 1.42  # radius that is seen over that which shapes the mesh: a vessel's sunk
# part shines through the pia
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
_WIDEST_MM = 0.55  # radius that no artery of the pia reaches, whatever its branches sum up to
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
    uniform_density = np.ones((8, 8), np.float32)
    veins = _grow(VEINS, sulci, uniform_density, extent_mm, rng)
    # The density of arteries varies between gyri, and is 0 on a wide vein.
    artery_density = np.clip(0.8 + 0.35 * noise.band(rng, 128, extent_mm, 9.0, 0.5), 0.15, 1.0)
    distance, width = tube.raster(veins, 128, extent_mm)
    artery_density *= (distance > width + 0.3) | (width < 0.3)
    trunks = _grow(ARTERIES, sulci, artery_density.astype(np.float32), extent_mm, rng)
    deep = _grow(DEEP, sulci, uniform_density, extent_mm, rng)
    smooth_veins = _widen(_smooth(_prune(veins, 0.05), 1.6), _SEEN_VEIN)
    visible_veins = smooth_veins
    for growth in TRIBUTARIES:
        visible_veins = colonisation.fill(
            visible_veins, _place_targets(growth, uniform_density, extent_mm, rng), growth, rng
        )
    visible_veins = _finish(visible_veins, len(smooth_veins.nodes), 0.0, extent_mm, rng)
    distance, width = tube.raster(visible_veins, 512, extent_mm, _BESIDE_MM)
    vein_margin = (width > _WIDE_MM) & (distance < width + _BESIDE_MM)
    free_density = (
        ~vein_margin * np.clip(1 + 0.3 * noise.band(rng, 512, extent_mm, 8.0, 0.5), 0.6, 1)
    ).astype(np.float32)
    smooth_trunks = _smooth(_level_radii(_keep_entering(_prune(trunks, _TRUNK_MM), extent_mm)), 1.3)
    arteries = main_arteries = _thin_ends(_widen(smooth_trunks, _SEEN_TRUNK))
    for growth in ARTERIOLES:
        arteries = colonisation.fill(
            arteries, _place_targets(growth, free_density, extent_mm, rng), growth, rng
        )
    arteries = _finish(_narrow(_remove_thorns(arteries)), len(main_arteries.nodes), _BENT[0], extent_mm, rng)
    return Vessels(veins, trunks, visible_veins, arteries, deep)


def _place_targets(growth: Growth, density: Map, extent_mm: float, rng: np.random.Generator) -> Floats:
    """Points (N, 2) mm about a growth's spacing apart, of which a share `density` (m, m) stays."""
    points = _jitter_grid(growth.spacing, extent_mm, rng)
    return points[rng.random(len(points)) < noise.sample(density, points, extent_mm)]


def _prune(tree: Tree, least_mm: float) -> Tree:
    """The tree without twigs of a radius below `least_mm`."""
    return _select(tree, gather(tree.parent, (tree.radius >= least_mm).astype(np.float64)) > 0)


def _keep_entering(tree: Tree, extent_mm: float) -> Tree:
    """The trunks that enter at the patch's border, or all: a start in mid-field looks like a spindle."""
    entering = ~_inside(tree, extent_mm)[_find_trunks(tree)]
    return _select(tree, entering) if entering.any() else tree


def _level_radii(tree: Tree) -> Tree:
    """The tree no vessel of which widens away from its root, as beside a start in mid-field."""
    radii = tree.radius.tolist()
    for k, parent in reversed(list(enumerate(tree.parent.tolist()))):  # children come after their parents
        if parent >= 0:
            radii[parent] = max(radii[parent], radii[k])
    return Tree(tree.nodes, tree.parent, np.array(radii))


def _select(tree: Tree, selection: Mask) -> Tree:
    """The tree of the nodes (N,) that are kept, which includes the parent of each."""
    number = np.append(np.where(selection, np.cumsum(selection) - 1, -1), -1)
    return Tree(tree.nodes[selection], number[tree.parent[selection]], tree.radius[selection])


def _smooth(tree: Tree, over_mm: float) -> Tree:
    """The tree with centre lines and radii smoothed over a length; its ends stay.

    Springs of r^4, stiffer than at growth: no side branch bends its trunk into an elbow.
    """
    length = np.hypot(*(tree.nodes - tree.nodes[tree.parent])[tree.parent >= 0].T)
    rounds = round(2 * (over_mm / max(float(np.mean(length)), 0.02)) ** 2)
    state = np.column_stack([tree.nodes, np.log(tree.radius)])
    state = relax(state, tree.parent, tree.radius**2, 1e-3, rounds)
    return Tree(state[:, :2], tree.parent, np.exp(state[:, 2]))


def _widen(tree: Tree, factor: float) -> Tree:
    """The tree with radii times a factor."""
    return Tree(tree.nodes, tree.parent, factor * tree.radius)


def _thin_ends(tree: Tree) -> Tree:
    """The tree thinned towards its ends, where finer branches go on."""
    remaining_mm = remaining_length(tree.nodes, tree.parent, np.zeros(len(tree.nodes)))
    return Tree(tree.nodes, tree.parent, tree.radius * np.clip(remaining_mm / _THIN_MM, 0.25, 1) ** 0.5)


def _narrow(tree: Tree) -> Tree:
    """The tree with the widest vessels of a radius near to `_WIDEST_MM`."""
    return Tree(tree.nodes, tree.parent, tree.radius / (1 + (tree.radius / _WIDEST_MM) ** 4) ** 0.25)


def _remove_thorns(tree: Tree) -> Tree:
    """The tree without side branches that are short, most of all beside the trunk that they leave."""
    remaining_mm = remaining_length(tree.nodes, tree.parent, np.zeros(len(tree.nodes)))
    remaining_mm = remaining_mm + np.hypot(*(tree.nodes - tree.nodes[tree.parent]).T)
    least = _TWIG_MM + _TWIG_RADII * tree.radius[tree.parent]
    longest = np.zeros(len(remaining_mm))
    child = np.flatnonzero(tree.parent >= 0)
    np.maximum.at(longest, tree.parent[child], remaining_mm[child])
    thorns = (tree.parent >= 0) & (remaining_mm < least) & (remaining_mm < longest[tree.parent])
    while (outer := thorns[tree.parent] & (tree.parent >= 0) & ~thorns).any():
        thorns |= outer
    return _select(tree, ~thorns)


def _inside(tree: Tree, extent_mm: float) -> Mask:
    """Nodes (N,) that are not at the patch's border."""
    return np.asarray(np.abs(tree.nodes).max(axis=1) < 0.42 * extent_mm)


def _finish(tree: Tree, main: int, bend_mm: float, extent_mm: float, rng: np.random.Generator) -> Tree:
    """The tree whose nodes from number `main` on have grown in, made to wind and bend, and thinned."""
    nodes = relax(tree.nodes, tree.parent, tree.radius**2, 1e-3, _ROUNDED)
    shift, wave = _WINDING
    winding, bends = (
        np.stack([noise.sample(noise.band(rng, 256, extent_mm, w, 0.5), nodes, extent_mm) for _ in "xy"], 1)
        for w in (wave, _BENT[1])
    )
    suppleness = shift / (1 + (tree.radius / _SUPPLE_MM) ** 2)
    remaining_mm = remaining_length(nodes, tree.parent, np.zeros(len(nodes)))
    thinning = np.where(np.arange(len(nodes)) < main, 1, np.clip(remaining_mm / _TAPER_MM, 0.5, 1) ** 0.5)
    # Wide vessels vary over centimetres: shorter waves look like beads.
    short_waves, long_waves = (
        noise.sample(noise.band(rng, 256, extent_mm, w, 0.6), nodes, extent_mm) for w in (2.5, 9.0)
    )
    wide_share = np.clip(tree.radius / 0.3, 0, 1)
    radius = (
        tree.radius
        * thinning
        * np.clip(1 + over(0.12 * short_waves, 0.2 * long_waves, wide_share), 0.75, 1.3)
    )
    return _point_ends(
        Tree(nodes + suppleness[:, None] * winding + bend_mm * bends, tree.parent, radius), extent_mm
    )


def _point_ends(tree: Tree, extent_mm: float) -> Tree:
    """The tree whose ends and roots inside the patch are pointed, and that narrows nowhere at once."""
    inside = _inside(tree, extent_mm)
    end, slope = _POINTED
    length = np.hypot(*(tree.nodes - tree.nodes[tree.parent]).T)
    limits = np.where(inside, end, np.inf)
    childless = np.bincount(tree.parent + 1, minlength=len(limits) + 1)[1:] == 0
    radii, limit = tree.radius.tolist(), np.where(childless, limits, 0.0).tolist()
    for k, parent in reversed(list(enumerate(tree.parent.tolist()))):  # children come after their parents
        radii[k] = min(radii[k], limit[k])
        if parent >= 0:
            limit[parent] = max(limit[parent], _WIDENS * radii[k] + slope * float(length[k]))
    remaining_mm = remaining_length(tree.nodes, tree.parent, np.where(inside, 0.0, _ENDS_MM[-1]))
    radius, trunk = (
        np.minimum(radii, np.interp(remaining_mm, _ENDS_MM, _ENDS, right=np.inf)),
        _find_trunks(tree),
    )
    for root in np.flatnonzero((tree.parent < 0) & inside):
        distance = np.hypot(*(tree.nodes - tree.nodes[root]).T)
        radius = np.where(trunk == root, np.minimum(radius, end + slope * distance), radius)
    return Tree(tree.nodes, tree.parent, radius)


def _find_trunks(tree: Tree) -> Ints:
    """The root (N,) that each node goes back to."""
    trunk = np.where(tree.parent >= 0, tree.parent, np.arange(len(tree.nodes)))
    while (trunk[trunk] != trunk).any():
        trunk = trunk[trunk]
    return trunk


def _grow(kind: Kind, sulci: Map, density: Map, extent_mm: float, rng: np.random.Generator) -> Tree:
    """One kind of vessel; `density` (m, m): share of its ends that stay."""
    grid = lattice(extent_mm, kind.coarse * max(_FINEST_MM, extent_mm / _MOST), rng)
    depth = noise.sample(sulci, grid.points, extent_mm)
    clouds = noise.sample(noise.band(rng, 128, extent_mm, 2.0, 0.7), grid.points, extent_mm)
    chance = np.exp(0.7 * kind.chance * (clouds + rng.standard_normal(len(depth))))
    cost = np.asarray((1 + kind.crown * (1 - np.clip(depth, 0, 1)) ** 2) * chance, np.float64)
    patches = extent_mm / _PATCH_MM
    roots, deep_roots, outlets = _place_trunks(kind, cost, grid, patches, rng)
    ends = _place_ends(kind, grid, density, extent_mm, rng)
    ends = ends[~np.isin(ends, np.concatenate([roots, deep_roots, outlets]))]
    starts = np.concatenate([roots, deep_roots])
    radius = np.concatenate([rng.uniform(*kind.trunk, len(outlets)), rng.uniform(*kind.end, len(ends))])
    coarse_tree = least_cost(grid, cost, starts, np.concatenate([outlets, ends]), radius, kind.sharing)
    tree = subdivide(
        anastomose(coarse_tree, kind.loops, 3 * kind.spacing, float(np.median(grid.lengths)), rng)
    )
    nodes, parent, radii = tree.nodes, tree.parent, tree.radius
    extra_mm = np.where(np.arange(len(nodes)) < 2 * len(coarse_tree.nodes), 0.0, kind.taper)
    nodes = relax(nodes, parent, radii, kind.stiff, 100)
    remaining_mm = remaining_length(nodes, parent, extra_mm)
    short_waves, long_waves = (
        [noise.sample(noise.band(rng, 128, extent_mm, wave, 0.4), nodes, extent_mm) for _ in range(2)]
        for wave in (1.7, 9.0)
    )
    suppleness = kind.bends[0] / (1 + (radii / (0.4 * kind.stiff)) ** 2)
    nodes = nodes + np.stack(short_waves, 1) * suppleness[:, None] + kind.bends[1] * np.stack(long_waves, 1)
    radii = radii * np.where(radii > kind.end[1], 1, np.clip(remaining_mm / kind.taper, 0.05, 1) ** 0.5)
    if len(deep_roots):  # it comes into sight over a millimetre or two
        radii = radii * np.clip(0.2 + cKDTree(grid.points[deep_roots]).query(nodes)[0] / 1.5, 0, 1)
    swell = noise.sample(noise.band(rng, 128, extent_mm, 4.0, 0.5), nodes, extent_mm)
    return Tree(nodes, parent, radii * np.clip(1 + 0.1 * swell, 0.75, 1.3))


def _place_trunks(
    kind: Kind, cost: Floats, grid: Lattice, patches: float, rng: np.random.Generator
) -> tuple[Ints, Ints, Ints]:
    """Points where trunks enter at the patch's border, come up in it, and leave it: where ways are cheap."""
    half = np.abs(grid.points).max()
    radius = np.abs(grid.points).max(axis=1)
    angle = np.arctan2(grid.points[:, 1], grid.points[:, 0])
    border, inner = np.flatnonzero(radius > 0.93 * half), np.flatnonzero(radius < 0.7 * half)

    def find_cheapest(directions: Floats) -> Ints:
        separation = np.abs(np.angle(np.exp(1j * (angle[border] - directions[:, None]))))
        return np.asarray(border[np.argmin(np.log(cost[border]) + 6 * separation, axis=1)])

    count, outlet_count = (
        max(1, round(patches * rng.integers(*limits))) for limits in (kind.roots, kind.through)
    )
    inner_count = round(patches * rng.integers(*kind.inside))
    root_angles = (
        rng.uniform(0, 2 * np.pi) + (np.arange(count) + rng.uniform(-0.3, 0.3, count)) * 2 * np.pi / count
    )
    outlet_angles = root_angles[np.arange(outlet_count) % count] + rng.uniform(0.7, 1.3, outlet_count) * np.pi
    candidates = rng.choice(inner, (inner_count, 40))
    deep_roots = candidates[np.arange(inner_count), np.argmin(cost[candidates], axis=1)]
    roots, outlets = np.unique(find_cheapest(root_angles)), np.unique(find_cheapest(outlet_angles))
    return roots, np.unique(deep_roots), outlets[~np.isin(outlets, roots)]


def _place_ends(kind: Kind, grid: Lattice, density: Map, extent_mm: float, rng: np.random.Generator) -> Ints:
    """Points about `kind.spacing` apart: of a jittered grid, which neither clumps nor lines up, a share."""
    points = _jitter_grid(kind.spacing, extent_mm, rng)
    points = points[rng.random(len(points)) < noise.sample(density, points, extent_mm)]
    return np.unique(cKDTree(grid.points).query(points)[1])


def _jitter_grid(spacing: float, extent_mm: float, rng: np.random.Generator) -> Floats:
    """A point (N, 2) mm somewhere in each cell of a grid: they neither clump nor line up."""
    side = max(1, int(extent_mm / spacing))
    cell = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)
    return np.asarray(((cell + rng.random(cell.shape)) / side - 0.5) * extent_mm)
