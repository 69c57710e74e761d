"""Shapes: the chart of the surface, trees of vessels, instruments and their finishes."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from synth.arrays import Map
from synth.geometry.triangles import Shape
from synth.job.schema import AnatomySection
from synth.render import finish, idle, instrument, scenery
from synth.render.anatomy import noise, surface
from synth.render.anatomy.chart import Chart, places, unroll
from synth.render.anatomy.colonisation import Growth, fill
from synth.render.anatomy.tree import Tree, lattice, least_cost, relaxed, remaining
from synth.render.appearance.reflection import Theatre, glow
from synth.render.materials import FinishMaps, Metal, read_map, stack_maps
from synth.sequence import scenario

Floats = NDArray[np.float64]
PLAN, RADIUS = 34.0, 14.0


def folds(at: Floats) -> Floats:
    """Parallel folds of 12 mm at 30 degrees, as steep as 46 degrees: they unroll exactly."""
    across = at @ np.array([np.cos(np.pi / 6), np.sin(np.pi / 6)])
    return np.asarray(2 * np.cos(2 * np.pi / 12 * across))


def singular(chart: Chart) -> Floats:
    """(n, 2) singular values of the map from the chart to the surface, over the middle of the disc."""
    axis = np.linspace(-8, 8, 60)
    at, step = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2), 0.05
    sides = np.array([[step, 0], [0, step]])
    on = np.stack([chart.at(at + side) - chart.at(at - side) for side in sides], axis=-1)
    rise = np.stack([folds(at + side) - folds(at - side) for side in sides], axis=-1)
    up = np.concatenate([np.broadcast_to(2 * sides, (len(at), 2, 2)), rise[:, None]], axis=1)
    assert (np.linalg.det(on) > 0).all()
    return np.asarray(np.linalg.svd(up @ np.linalg.inv(on), compute_uv=False))


def test_what_can_be_unrolled_keeps_its_lengths() -> None:
    stretch = singular(unroll(folds, PLAN, RADIUS))
    assert np.quantile(stretch[:, 0], 0.95) < 1.05
    assert np.quantile(stretch[:, 1], 0.05) > 0.95
    plan = singular(Chart(np.zeros((4, 4, 2), np.float32), PLAN, PLAN))
    assert np.quantile(plan[:, 0], 0.95) > 1.3


def test_a_place_is_found_again() -> None:
    chart = unroll(folds, PLAN, RADIUS)
    there = chart.at(places(chart, 64)).reshape(64, 64, 2)
    middle = ((np.arange(64) + 0.5) / 64 - 0.5) * chart.extent_mm
    assert np.abs(there - np.stack(np.meshgrid(middle, middle), axis=-1)).max() < 0.05
    np.testing.assert_array_equal(chart.shift, unroll(folds, PLAN, RADIUS).shift)


def test_what_is_nearly_flat_stays_its_plan() -> None:
    chart = unroll(lambda at: 0.2 * folds(at), PLAN, RADIUS)
    assert chart.extent_mm == PLAN
    assert not chart.shift.any()


@pytest.mark.slow
@pytest.mark.parametrize("radius_mm", [4.0, 30.0])
def test_every_anatomy_grows(radius_mm: float) -> None:
    section = AnatomySection()
    for seed in range(1 if radius_mm > 5 else 4):
        made = surface.grow(
            scenario.draw_relief(section, np.random.default_rng(seed)), radius_mm, vertices=900
        )
        assert np.isfinite(made.vertices).all()


def test_vessels_are_joined_thin_out_and_follow_murray() -> None:
    section = AnatomySection()
    made = surface.grow(scenario.draw_relief(section, np.random.default_rng(3)))
    for tree in (made.vessels.arteries, made.vessels.veins, made.vessels.deep):
        child = np.flatnonzero(tree.parent >= 0)
        assert (tree.parent[child] < child).all()
        longest = np.linalg.norm(tree.nodes[child] - tree.nodes[tree.parent[child]], axis=1).max()
        assert longest < 1.2, "a twig that starts away from what it springs from"
        assert (tree.radius[tree.parent[child]] > 0.6 * tree.radius[child]).mean() > 0.99
    arteries = made.vessels.arteries
    tips = np.bincount(arteries.parent + 1, minlength=len(arteries.parent) + 1)[1:] == 0
    assert np.median(arteries.radius[tips]) < 0.02
    assert 0.01 < np.median(arteries.radius) < 0.04  # arterioles of 20-80 um


def test_arteries_thin_over_millimetres_to_where_they_end() -> None:
    """No blunt stumps: within a millimetre of a free end inside the patch all are fine, within three thin."""
    made = surface.grow(scenario.draw_relief(AnatomySection(), np.random.default_rng(3)))
    tree = made.vessels.arteries
    left = remaining(tree.nodes, tree.parent, np.zeros(len(tree.nodes)))
    inside = np.abs(tree.nodes).max(axis=1) < 0.3 * made.chart.extent_mm
    for within, most in ((0.5, 0.03), (1.0, 0.06), (3.0, 0.2)):
        assert tree.radius[inside & (left < within)].max() < most


def test_a_vessel_of_least_cost_shares_its_way() -> None:
    """Two ends next to each other have a common trunk, of their cubes' sum, if sharing is cheaper."""
    way = lattice(10.0, 0.5, np.random.default_rng(0))
    near = cKDTree(way.points).query([[-4.5, 0.0], [4.5, 0.5], [4.5, -0.5]])[1]
    for sharing, least, most in ((0.0, 0, 2), (1.0, 6, 9)):
        made = least_cost(way, np.ones(len(way.points)), near[:1], near[1:], np.array([0.1, 0.2]), sharing)
        assert made.radius.max() == pytest.approx((0.1**3 + 0.2**3) ** (1 / 3))
        assert least < np.ptp(made.nodes[made.radius > 0.201, 0]) < most


def test_branches_grow_to_all_that_need_supply() -> None:
    """All targets get a vessel within the growth's distance, in steps, and r^3 is conserved."""
    trunk = Tree(np.stack([np.linspace(-5, 5, 60), np.zeros(60)], 1), np.arange(-1, 59), np.full(60, 1e-3))
    growth = Growth(spacing=1.0, reach=8.0, near=0.4, step=0.1, straight=0.6, end=(0.02, 0.02))
    rng = np.random.default_rng(0)
    targets = rng.uniform(-5, 5, (80, 2))
    made = fill(trunk, targets, growth, rng)
    assert cKDTree(made.nodes).query(targets)[0].max() < growth.near
    assert (made.parent[1:] < np.arange(1, len(made.parent))).all()
    assert np.allclose(made.nodes[:60], trunk.nodes)
    grown = np.linalg.norm(made.nodes[60:] - made.nodes[made.parent[60:]], axis=1)
    assert grown == pytest.approx(growth.step)
    tips = np.bincount(made.parent + 1, minlength=len(made.parent) + 1)[1:] == 0
    ends = np.count_nonzero(tips[60:])
    assert made.radius[0] == pytest.approx(growth.end[0] * ends ** (1 / 3), rel=1e-3)


def test_a_thin_twig_leaves_its_trunk_straight() -> None:
    """Murray: of a fork the wider branch turns less, the thin one leaves at nearly a right angle."""
    trunk = np.stack([np.arange(9.0), np.zeros(9)], 1)
    nodes, parent = np.concatenate([trunk, [[4.0, 1], [4, 2]]]), np.array([-1, *range(8), 4, 9])
    bent = []
    for twig in (0.1, 1.0):
        radius = np.array([1.0] * 9 + [twig] * 2)
        bent.append(relaxed(nodes, parent, radius, 0.1, 2000)[4, 1])
    assert 0 < bent[0] < 0.05
    assert bent[1] > 0.5


TIPS = np.array([[-1.0, 0.5, 2.0], [1.0, 0.5, 2.0]])
SHAFTS = np.array([[0.3, 0.2, 0.9], [0.3, 0.2, 0.9]])
DARK = Theatre(np.zeros((2, 2, 3), np.float32), 30.0, np.zeros(3), np.array([0, 0, 300.0]))


@pytest.mark.parametrize("kind", instrument.SHAPES)
def test_an_instrument_ends_at_its_tips(kind: str) -> None:
    made = instrument.build([(kind, 1.2)], DARK, np.random.default_rng(0))
    assert made is not None
    points, _ = made.pose(TIPS, SHAFTS)
    assert np.isfinite(points).all()
    assert made.faces.max() == len(points) - 1
    goals = TIPS if kind in ("forceps", "bayonet") else TIPS.mean(axis=0, keepdims=True)
    for goal in goals:
        assert np.linalg.norm(points - goal, axis=1).min() < 1.3
    # Nothing reaches past the tips, and the rest is on the hand's side.
    along = (points - TIPS.mean(axis=0)) @ (SHAFTS[0] / np.linalg.norm(SHAFTS[0]))
    assert along.min() > -0.4  # the tips are apart, also along the shaft
    assert 100 < along.max() < 120
    assert trimesh.Trimesh(points, made.faces).volume > 50, "faces turn outwards"


@pytest.mark.parametrize(("along", "across"), [(0.1, 0.1), (0.5, 0.15), (0.8, 0.8)])
def test_bare_steel_scatters_as_mitsubas_rough_conductor(along: float, across: float) -> None:
    """The renderer's steel and its `roughconductor` of the same alphas, which has one tint."""
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    from synth.render.mitsuba.adapter import _material

    tint, size = (0.6, 0.55, 0.5), (2, 2)
    layers = [np.full((*size, 3), tint), np.ones(size), np.full((*size, 2), (along, across)), np.zeros(size)]
    layers += [np.full((*size, 3), tint), np.full((*size, 3), (0.0, 0.0, 1.0))]
    maps = FinishMaps(*(np.asarray(layer, np.float32) for layer in layers))
    steel = mi.load_dict(_material(mi, Metal(maps, np.zeros((1, 3)))))
    rough = {"type": "roughconductor", "material": "none", "distribution": "ggx"}
    conductor = mi.load_dict(rough | {"alpha_u": along, "alpha_v": across})
    si = mi.SurfaceInteraction3f()
    si.wi, si.uv, si.n = [0, 0, 1], [0.5, 0.5], [0, 0, 1]
    si.sh_frame, si.dp_du, si.dp_dv = mi.Frame3f([0, 0, 1]), [1, 0, 0], [0, 1, 0]
    for way in np.array([[0.3, 0.05, 0.95], [0.05, 0.3, 0.95], [0.2, 0.2, 0.9]]):
        to = (way / np.linalg.norm(way)).tolist()
        ours, theirs = (one.eval(mi.BSDFContext(), si, to) for one in (steel, conductor))
        # Schlick's rise from right angles to the half vector's is below a thousandth here.
        np.testing.assert_allclose(np.array(ours), np.array(theirs) * tint, rtol=5e-3)


def test_a_mirror_over_tissue_shows_its_colour_below_and_the_dark_theatre_above() -> None:
    red = replace(DARK, wound=np.full((8, 8, 3), (0.8, 0.3, 0.2), np.float32), light=np.ones(3))
    lens = red.lens / np.linalg.norm(red.lens)
    shown = []
    for lean in (0.0, 80.0):  # of the surface: a mirror that lies flat shows what is above it
        t = np.deg2rad(lean)
        x, y = np.array([np.cos(t), 0.0, -np.sin(t)]), np.array([0.0, 1.0, 0.0])
        assert np.cross(x, y) @ lens == pytest.approx(np.cos(t))
        level = Shape(np.stack([0 * x, x, y]) + np.array([0, 0, 3.0]), np.array([[0, 1, 2]], np.int32))
        shown.append(glow(level, np.full(3, 0.1), np.ones(3), red)[0])
    above, below = shown
    assert below[0] > 2 * below[1] > 0
    assert below[0] > above[0]
    assert np.ptp(above) < 0.2 * above.mean() + 0.02


def test_finishes_are_as_drawn() -> None:
    (bar,), rng = instrument.shape_of("spatula", 4.0)[0], np.random.default_rng(0)
    blue = finish.Finish((0.6, 0.6, 0.6), 0.35, 2.0, coat=finish.SOLD[0], bare_mm=9.0, wear=0.0)
    along = bar.profile[:, 2]

    def drawn(skin: finish.Finish) -> FinishMaps:
        maps = bar.maps(skin, "spatula", rng, 0.05)
        return FinishMaps(**{name: read_map(layer, bar.uv) for name, layer in vars(maps).items()})

    cover = drawn(blue)
    assert np.median(cover.base[along > 9.3], axis=0) == pytest.approx(finish.SOLD[0], rel=0.15)
    np.testing.assert_allclose(cover.mirror[along > 9.3], 0.04, atol=1e-6)
    # A blade mirrors the dark room in bands and the tissue near its tip: at most the metal's own reflectance.
    bright = [
        np.percentile(
            bar.maps(replace(blue, mirror=(grey,) * 3), "spatula", np.random.default_rng(1), 0.05).base[
                ..., 0
            ],
            99,
        )
        for grey in (0.6, 0.3)
    ]
    assert bright[0] == pytest.approx(2 * bright[1], rel=0.05)
    assert (cover.base[along < 8.5].max(axis=0) < 1.45 * 0.6).all()
    near, far = (np.median(cover.base[part], axis=0) for part in (along < 2, (along > 6) & (along < 8.5)))
    assert near[0] / near[2] > far[0] / far[2] > 1
    np.testing.assert_allclose(np.median(cover.rough[along < 8.5], axis=0), (0.7, 0.35), rtol=0.05)
    assert (cover.bare[along < 8.5] > 0.35).all()
    assert np.median(cover.bare[along < 8.5]) > 0.99, "but for the band that shows the lamps"
    assert not cover.bare[along > 9.3].any()
    normal = bar.maps(blue, "spatula", rng, 0.1).normal
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1, rtol=1e-5)
    worn = drawn(replace(blue, wear=0.9)).bare > 0.5
    outer = np.abs(bar.profile[:, 1]) > 0.8 * np.abs(bar.profile[:, 1]).max()
    assert worn[outer & (along > 10)].mean() > 2 * worn[~outer & (along > 10)].mean()
    bloody = drawn(replace(blue, blood=0.6, blood_mm=5.0)).base
    red = bloody[:, 0] > 3 * bloody[:, 1]
    assert 0.2 < red[along < 5].mean() <= 1
    assert not red[along > 8].any()


def test_blood_runs_along_a_shaft() -> None:
    """A film's borders are several times as many across a thin tine as along it, in equal lengths."""
    rng, (bar, _) = np.random.default_rng(0), instrument.shape_of("forceps", 1.0)[0]
    bare = finish.Finish((0.6, 0.6, 0.6), 0.2)
    changes = np.zeros(2)
    for _ in range(12):
        maps = bar.maps(replace(bare, blood=0.45, blood_mm=5.0), "forceps", rng, 0.05)
        film = maps.wet > 0.5
        columns = np.linspace(0, len(bar.profile) // 32 - 1, film.shape[1])
        along = np.interp(columns, np.arange(len(bar.profile) // 32), bar.profile[::32, 2])
        shown = (along > 0.8) & (along < 4.0)
        shape = film[:, shown]
        wide = np.ptp(bar.profile[:, :2][(bar.profile[:, 2] > 0.8) & (bar.profile[:, 2] < 4.0)], axis=0).sum()
        length = np.ptp(along[shown])
        changes += [
            (shape[1:] != shape[:-1]).sum() / shape.shape[1] / wide,
            (shape[:, 1:] != shape[:, :-1]).sum() / shape.shape[0] / length,
        ]
    assert changes[0] > 2 * changes[1] > 0


def test_stacked_maps_keep_each_bodys_texels() -> None:
    rng = np.random.default_rng(1)
    parts = []
    for height, width in ((4, 8), (3, 8), (5, 6)):
        channels = [(3,), (), (2,), (), (3,), (3,)]
        maps = FinishMaps(*(rng.random((height, width, *n)).astype(np.float32) for n in channels))
        parts.append((np.array([[0, 0], [1, 1], [0.4, 0.6]], np.float32), maps))
    uv, stack = stack_maps(parts)
    for k, (start, height) in enumerate(((0, 4), (4, 3))):
        corners = read_map(stack.base, uv[3 * k : 3 * k + 2])
        np.testing.assert_allclose(corners, parts[k][1].base[[0, -1], [0, -1]], atol=1e-5)
        assert (uv[3 * k : 3 * k + 3, 1] * len(stack.bare) > start).all()
        assert (uv[3 * k : 3 * k + 3, 1] * len(stack.bare) < start + height).all()
    assert stack.rough.shape == (12, 8, 2)


def test_tissue_is_darker_where_an_instrument_touches_it() -> None:
    made = instrument.build([("dissector", 1.2)], DARK, np.random.default_rng(0))
    assert made is not None
    axis = np.linspace(-6, 6, 41)
    x, y = (plane.ravel() for plane in np.meshgrid(axis, axis))
    for high, least, most in ((0.0, 0.4, 0.7), (5.0, 0.999, 1.0)):
        posed = made.pose(TIPS * [1, 1, 0] + [0, 0, high], SHAFTS)
        _, share = made.touch(posed, np.column_stack([x, y, 0 * x]))
        assert least <= share.min() <= most
        assert share[np.hypot(x, y - 0.5) > 5].min() > 0.9


def test_usual_and_random_finishes_are_drawn() -> None:
    rng = np.random.default_rng(0)
    usual, any_of = ([finish.draw_finish(s, rng, "bayonet") for _ in range(200)] for s in (0.0, 1.0))
    assert {one.coat for one in usual} == set(finish.SOLD)
    assert all(0.1 <= one.alpha <= 0.22 and one.streak > 3 for one in usual)
    assert min(one.alpha for one in any_of) < 0.1 < 0.7 < max(one.alpha for one in any_of)
    assert len({one.coat for one in any_of}) > 100


@pytest.mark.parametrize("kind", idle.RADII_MM)
def test_an_idle_instrument_has_its_size(kind: str) -> None:
    for radius in idle.RADII_MM[kind]:
        one = idle.IdleInstrument(kind, radius, (0.0, 0.0, 9.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0), 1.0)
        made = instrument.build([], DARK, np.random.default_rng(0), 1.0, [one])
        assert made is not None
        points = made.pose(*one.at(0.0)).vertices
        wide = np.ptp(points[points[:, 2] < 40, :2], axis=0)
        assert (max if kind in idle.CLOTH else min)(wide) == pytest.approx(2 * radius, rel=0.06, abs=0.11)


def test_a_map_painted_in_part_is_that_painted_whole() -> None:
    rng = np.random.default_rng(0)
    maps = [rng.random((40, 40)).astype(np.float32) for _ in "ab"]
    where = rng.choice(1600, 300, replace=False).astype(np.int32)

    def paint(a: Map, b: Map) -> tuple[Map, Map]:
        return np.stack([a, b], axis=-1), a * b

    whole, part = noise.in_rows(paint, *maps), noise.in_part(paint, where, (0.5, -1.0), *maps)
    left = np.setdiff1d(np.arange(1600), where)
    for full, some, rest in zip(whole, part, (0.5, -1.0), strict=True):
        assert full.shape == some.shape
        flat = some.reshape(1600, -1)
        assert np.array_equal(flat[where], full.reshape(1600, -1)[where])
        assert (flat[left] == rest).all()


@pytest.mark.parametrize("sides", [4, 16])
def test_a_bent_bar_faces_outwards_along_its_path(sides: int) -> None:
    s = np.linspace(0, 1, 9)
    path = np.column_stack([6 * s, 3 * s**2, np.sin(3 * s)])
    wire = scenery.wire(path, 0.3)
    shape = scenery.Bar(wire, sides, path, finish.Finish((0.6, 0.6, 0.6), 0.2), "hook").shape
    made = trimesh.Trimesh(*shape, process=False)
    length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    section = 0.3**2 * sides / 2 * np.sin(2 * np.pi / sides)
    assert 0.75 * section * length < made.volume < 1.05 * section * length


@pytest.mark.parametrize("kind", [*instrument.SHAPES, "clip"])
def test_no_face_of_a_drawn_part_lacks_an_area(kind: str) -> None:
    if kind == "clip":  # its ends are closed by two rings in one place
        s, radius = np.array([0.0, 0.0, 0.3, 2.9, 3.2, 3.2]), np.array([0.02, 1.0, 1.0, 1.0, 1.0, 0.02])
        part = instrument.Part(instrument.sweep(s, radius, radius, 0 * s, 0.8), 0)
        path = np.column_stack([s, 0 * s, 0.1 * s])
        shapes = [scenery.Bar(part, 16, path, finish.Finish((0.6, 0.6, 0.6), 0.2), kind).shape]
    else:
        shapes = [part.shape for half in (0.3, 4.0) for part in instrument.shape_of(kind, half)[0]]
    for shape in shapes:
        assert trimesh.triangles.area(shape.vertices[shape.faces]).min() > 1e-5
