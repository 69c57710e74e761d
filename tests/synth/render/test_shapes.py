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
from synth.render.anatomy.tree import Tree, lattice, least_cost, relax, remaining_length
from synth.render.appearance.reflection import Theatre, glow
from synth.render.materials import FinishMaps, Metal, read_map, stack_maps
from synth.sequence import scenario

Floats = NDArray[np.float64]
PLAN, RADIUS = 34.0, 14.0


def fold_height(points: Floats) -> Floats:
    """Parallel folds of 12 mm at 30 degrees, as steep as 46 degrees: they unroll exactly."""
    distance = points @ np.array([np.cos(np.pi / 6), np.sin(np.pi / 6)])
    return np.asarray(2 * np.cos(2 * np.pi / 12 * distance))


def find_singular_values(chart: Chart) -> Floats:
    """(n, 2) singular values of the map from the chart to the surface, over the middle of the disc."""
    axis = np.linspace(-8, 8, 60)
    points, step = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2), 0.05
    sides = np.array([[step, 0], [0, step]])
    chart_slope = np.stack([chart.at(points + side) - chart.at(points - side) for side in sides], axis=-1)
    rise = np.stack([fold_height(points + side) - fold_height(points - side) for side in sides], axis=-1)
    surface_slope = np.concatenate([np.broadcast_to(2 * sides, (len(points), 2, 2)), rise[:, None]], axis=1)
    assert (np.linalg.det(chart_slope) > 0).all()
    return np.asarray(np.linalg.svd(surface_slope @ np.linalg.inv(chart_slope), compute_uv=False))


def test_what_can_be_unrolled_keeps_its_lengths() -> None:
    stretch = find_singular_values(unroll(fold_height, PLAN, RADIUS))
    assert np.quantile(stretch[:, 0], 0.95) < 1.05
    assert np.quantile(stretch[:, 1], 0.05) > 0.95
    plan = find_singular_values(Chart(np.zeros((4, 4, 2), np.float32), PLAN, PLAN))
    assert np.quantile(plan[:, 0], 0.95) > 1.3


def test_a_place_is_found_again() -> None:
    chart = unroll(fold_height, PLAN, RADIUS)
    positions = chart.at(places(chart, 64)).reshape(64, 64, 2)
    centres = ((np.arange(64) + 0.5) / 64 - 0.5) * chart.extent_mm
    assert np.abs(positions - np.stack(np.meshgrid(centres, centres), axis=-1)).max() < 0.05
    np.testing.assert_array_equal(chart.shift, unroll(fold_height, PLAN, RADIUS).shift)


def test_what_is_nearly_flat_stays_its_plan() -> None:
    chart = unroll(lambda points: 0.2 * fold_height(points), PLAN, RADIUS)
    assert chart.extent_mm == PLAN
    assert not chart.shift.any()


@pytest.mark.slow
@pytest.mark.parametrize("radius_mm", [4.0, 30.0])
def test_every_anatomy_grows(radius_mm: float) -> None:
    section = AnatomySection()
    for seed in range(1 if radius_mm > 5 else 4):
        cortex = surface.grow(
            scenario.draw_relief(section, np.random.default_rng(seed)), radius_mm, vertices=900
        )
        assert np.isfinite(cortex.vertices).all()


def test_vessels_are_joined_thin_out_and_follow_murray() -> None:
    section = AnatomySection()
    cortex = surface.grow(scenario.draw_relief(section, np.random.default_rng(3)))
    for tree in (cortex.vessels.arteries, cortex.vessels.veins, cortex.vessels.deep):
        child = np.flatnonzero(tree.parent >= 0)
        assert (tree.parent[child] < child).all()
        longest = np.linalg.norm(tree.nodes[child] - tree.nodes[tree.parent[child]], axis=1).max()
        assert longest < 1.2, "a twig that starts away from what it springs from"
        assert (tree.radius[tree.parent[child]] > 0.6 * tree.radius[child]).mean() > 0.99
    arteries = cortex.vessels.arteries
    tips = np.bincount(arteries.parent + 1, minlength=len(arteries.parent) + 1)[1:] == 0
    assert np.median(arteries.radius[tips]) < 0.02
    assert 0.01 < np.median(arteries.radius) < 0.04  # arterioles of 20-80 um


def test_arteries_thin_over_millimetres_to_where_they_end() -> None:
    """No blunt stumps: within a millimetre of a free end inside the patch all are fine, within three thin."""
    cortex = surface.grow(scenario.draw_relief(AnatomySection(), np.random.default_rng(3)))
    tree = cortex.vessels.arteries
    remaining_mm = remaining_length(tree.nodes, tree.parent, np.zeros(len(tree.nodes)))
    inside = np.abs(tree.nodes).max(axis=1) < 0.3 * cortex.chart.extent_mm
    for distance_mm, largest_mm in ((0.5, 0.03), (1.0, 0.06), (3.0, 0.2)):
        assert tree.radius[inside & (remaining_mm < distance_mm)].max() < largest_mm


def test_a_vessel_of_least_cost_shares_its_way() -> None:
    """Two ends next to each other have a common trunk, of their cubes' sum, if sharing is cheaper."""
    grid = lattice(10.0, 0.5, np.random.default_rng(0))
    nodes = cKDTree(grid.points).query([[-4.5, 0.0], [4.5, 0.5], [4.5, -0.5]])[1]
    for sharing, least, most in ((0.0, 0, 2), (1.0, 6, 9)):
        tree = least_cost(
            grid, np.ones(len(grid.points)), nodes[:1], nodes[1:], np.array([0.1, 0.2]), sharing
        )
        assert tree.radius.max() == pytest.approx((0.1**3 + 0.2**3) ** (1 / 3))
        assert least < np.ptp(tree.nodes[tree.radius > 0.201, 0]) < most


def test_branches_grow_to_all_that_need_supply() -> None:
    """All targets get a vessel within the growth's distance, in steps, and r^3 is conserved."""
    trunk = Tree(np.stack([np.linspace(-5, 5, 60), np.zeros(60)], 1), np.arange(-1, 59), np.full(60, 1e-3))
    growth = Growth(spacing=1.0, reach=8.0, kill_distance=0.4, step=0.1, straight=0.6, end=(0.02, 0.02))
    rng = np.random.default_rng(0)
    targets = rng.uniform(-5, 5, (80, 2))
    tree = fill(trunk, targets, growth, rng)
    assert cKDTree(tree.nodes).query(targets)[0].max() < growth.kill_distance
    assert (tree.parent[1:] < np.arange(1, len(tree.parent))).all()
    assert np.allclose(tree.nodes[:60], trunk.nodes)
    lengths = np.linalg.norm(tree.nodes[60:] - tree.nodes[tree.parent[60:]], axis=1)
    assert lengths == pytest.approx(growth.step)
    tips = np.bincount(tree.parent + 1, minlength=len(tree.parent) + 1)[1:] == 0
    ends = np.count_nonzero(tips[60:])
    assert tree.radius[0] == pytest.approx(growth.end[0] * ends ** (1 / 3), rel=1e-3)


def test_a_thin_twig_leaves_its_trunk_straight() -> None:
    """Murray: of a fork the wider branch turns less, the thin one leaves at nearly a right angle."""
    trunk = np.stack([np.arange(9.0), np.zeros(9)], 1)
    nodes, parent = np.concatenate([trunk, [[4.0, 1], [4, 2]]]), np.array([-1, *range(8), 4, 9])
    offsets = []
    for twig in (0.1, 1.0):
        radius = np.array([1.0] * 9 + [twig] * 2)
        offsets.append(relax(nodes, parent, radius, 0.1, 2000)[4, 1])
    assert 0 < offsets[0] < 0.05
    assert offsets[1] > 0.5


TIPS = np.array([[-1.0, 0.5, 2.0], [1.0, 0.5, 2.0]])
SHAFTS = np.array([[0.3, 0.2, 0.9], [0.3, 0.2, 0.9]])
DARK = Theatre(np.zeros((2, 2, 3), np.float32), 30.0, np.zeros(3), np.array([0, 0, 300.0]))


@pytest.mark.parametrize("kind", instrument.SHAPES)
def test_an_instrument_ends_at_its_tips(kind: str) -> None:
    tools = instrument.build([(kind, 1.2)], DARK, np.random.default_rng(0))
    assert tools is not None
    points, _ = tools.pose(TIPS, SHAFTS)
    assert np.isfinite(points).all()
    assert tools.faces.max() == len(points) - 1
    goals = TIPS if kind in ("forceps", "bayonet") else TIPS.mean(axis=0, keepdims=True)
    for goal in goals:
        assert np.linalg.norm(points - goal, axis=1).min() < 1.3
    # Nothing reaches past the tips, and the rest is on the hand's side.
    shaft_mm = (points - TIPS.mean(axis=0)) @ (SHAFTS[0] / np.linalg.norm(SHAFTS[0]))
    assert shaft_mm.min() > -0.4  # the tips are apart, also along the shaft
    assert 100 < shaft_mm.max() < 120
    assert trimesh.Trimesh(points, tools.faces).volume > 50, "faces turn outwards"


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
    for direction in np.array([[0.3, 0.05, 0.95], [0.05, 0.3, 0.95], [0.2, 0.2, 0.9]]):
        outgoing = (direction / np.linalg.norm(direction)).tolist()
        ours, theirs = (bsdf.eval(mi.BSDFContext(), si, outgoing) for bsdf in (steel, conductor))
        # Schlick's rise from right angles to the half vector's is below a thousandth here.
        np.testing.assert_allclose(np.array(ours), np.array(theirs) * tint, rtol=5e-3)


def test_a_mirror_over_tissue_shows_its_colour_below_and_the_dark_theatre_above() -> None:
    theatre = replace(DARK, wound=np.full((8, 8, 3), (0.8, 0.3, 0.2), np.float32), light=np.ones(3))
    lens = theatre.lens / np.linalg.norm(theatre.lens)
    glows = []
    for lean in (0.0, 80.0):  # of the surface: a mirror that lies flat shows what is above it
        t = np.deg2rad(lean)
        x, y = np.array([np.cos(t), 0.0, -np.sin(t)]), np.array([0.0, 1.0, 0.0])
        assert np.cross(x, y) @ lens == pytest.approx(np.cos(t))
        level = Shape(np.stack([0 * x, x, y]) + np.array([0, 0, 3.0]), np.array([[0, 1, 2]], np.int32))
        glows.append(glow(level, np.full(3, 0.1), np.ones(3), theatre)[0])
    above, below = glows
    assert below[0] > 2 * below[1] > 0
    assert below[0] > above[0]
    assert np.ptp(above) < 0.2 * above.mean() + 0.02


def test_finishes_are_as_drawn() -> None:
    (bar,), rng = instrument.shape_of("spatula", 4.0)[0], np.random.default_rng(0)
    blue_finish = finish.Finish((0.6, 0.6, 0.6), 0.35, 2.0, coat=finish.SOLD[0], bare_mm=9.0, wear=0.0)
    shaft_mm = bar.profile[:, 2]

    def draw_maps(skin: finish.Finish) -> FinishMaps:
        maps = bar.maps(skin, "spatula", rng, 0.05)
        return FinishMaps(**{name: read_map(layer, bar.uv) for name, layer in vars(maps).items()})

    blue_maps = draw_maps(blue_finish)
    assert np.median(blue_maps.base[shaft_mm > 9.3], axis=0) == pytest.approx(finish.SOLD[0], rel=0.15)
    np.testing.assert_allclose(blue_maps.mirror[shaft_mm > 9.3], 0.04, atol=1e-6)
    # A blade mirrors the dark room in bands and the tissue near its tip: at most the metal's own reflectance.
    bright = [
        np.percentile(
            bar.maps(
                replace(blue_finish, mirror=(grey,) * 3), "spatula", np.random.default_rng(1), 0.05
            ).base[..., 0],
            99,
        )
        for grey in (0.6, 0.3)
    ]
    assert bright[0] == pytest.approx(2 * bright[1], rel=0.05)
    assert (blue_maps.base[shaft_mm < 8.5].max(axis=0) < 1.45 * 0.6).all()
    tip_colour, far_colour = (
        np.median(blue_maps.base[mask], axis=0) for mask in (shaft_mm < 2, (shaft_mm > 6) & (shaft_mm < 8.5))
    )
    assert tip_colour[0] / tip_colour[2] > far_colour[0] / far_colour[2] > 1
    np.testing.assert_allclose(np.median(blue_maps.rough[shaft_mm < 8.5], axis=0), (0.7, 0.35), rtol=0.05)
    assert (blue_maps.bare[shaft_mm < 8.5] > 0.35).all()
    assert np.median(blue_maps.bare[shaft_mm < 8.5]) > 0.99, "but for the band that shows the lamps"
    assert not blue_maps.bare[shaft_mm > 9.3].any()
    normal = bar.maps(blue_finish, "spatula", rng, 0.1).normal
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1, rtol=1e-5)
    worn = draw_maps(replace(blue_finish, wear=0.9)).bare > 0.5
    outer = np.abs(bar.profile[:, 1]) > 0.8 * np.abs(bar.profile[:, 1]).max()
    assert worn[outer & (shaft_mm > 10)].mean() > 2 * worn[~outer & (shaft_mm > 10)].mean()
    bloody_base = draw_maps(replace(blue_finish, blood=0.6, blood_mm=5.0)).base
    red = bloody_base[:, 0] > 3 * bloody_base[:, 1]
    assert 0.2 < red[shaft_mm < 5].mean() <= 1
    assert not red[shaft_mm > 8].any()


def test_blood_runs_along_a_shaft() -> None:
    """A film's borders are several times as many across a thin tine as along it, in equal lengths."""
    rng, (bar, _) = np.random.default_rng(0), instrument.shape_of("forceps", 1.0)[0]
    bare_finish = finish.Finish((0.6, 0.6, 0.6), 0.2)
    changes = np.zeros(2)
    for _ in range(12):
        maps = bar.maps(replace(bare_finish, blood=0.45, blood_mm=5.0), "forceps", rng, 0.05)
        film = maps.wet > 0.5
        columns = np.linspace(0, len(bar.profile) // 32 - 1, film.shape[1])
        shaft_mm = np.interp(columns, np.arange(len(bar.profile) // 32), bar.profile[::32, 2])
        visible_columns = (shaft_mm > 0.8) & (shaft_mm < 4.0)
        shape = film[:, visible_columns]
        width_mm = np.ptp(
            bar.profile[:, :2][(bar.profile[:, 2] > 0.8) & (bar.profile[:, 2] < 4.0)], axis=0
        ).sum()
        length = np.ptp(shaft_mm[visible_columns])
        changes += [
            (shape[1:] != shape[:-1]).sum() / shape.shape[1] / width_mm,
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
    tools = instrument.build([("dissector", 1.2)], DARK, np.random.default_rng(0))
    assert tools is not None
    axis = np.linspace(-6, 6, 41)
    x, y = (plane.ravel() for plane in np.meshgrid(axis, axis))
    for height_mm, least, most in ((0.0, 0.4, 0.7), (5.0, 0.999, 1.0)):
        posed_tools = tools.pose(TIPS * [1, 1, 0] + [0, 0, height_mm], SHAFTS)
        _, share = tools.touch(posed_tools, np.column_stack([x, y, 0 * x]))
        assert least <= share.min() <= most
        assert share[np.hypot(x, y - 0.5) > 5].min() > 0.9


def test_usual_and_random_finishes_are_drawn() -> None:
    rng = np.random.default_rng(0)
    usual_finishes, random_finishes = (
        [finish.draw_finish(s, rng, "bayonet") for _ in range(200)] for s in (0.0, 1.0)
    )
    assert {sample.coat for sample in usual_finishes} == set(finish.SOLD)
    assert all(0.1 <= sample.alpha <= 0.22 and sample.streak > 3 for sample in usual_finishes)
    assert (
        min(sample.alpha for sample in random_finishes)
        < 0.1
        < 0.7
        < max(sample.alpha for sample in random_finishes)
    )
    assert len({sample.coat for sample in random_finishes}) > 100


@pytest.mark.parametrize("kind", idle.RADII_MM)
def test_an_idle_instrument_has_its_size(kind: str) -> None:
    for radius in idle.RADII_MM[kind]:
        idle_instrument = idle.IdleInstrument(
            kind, radius, (0.0, 0.0, 9.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0), 1.0
        )
        tools = instrument.build([], DARK, np.random.default_rng(0), 1.0, [idle_instrument])
        assert tools is not None
        points = tools.pose(*idle_instrument.at(0.0)).vertices
        widths = np.ptp(points[points[:, 2] < 40, :2], axis=0)
        assert (max if kind in idle.CLOTH else min)(widths) == pytest.approx(2 * radius, rel=0.06, abs=0.11)


def test_a_map_painted_in_part_is_that_painted_whole() -> None:
    rng = np.random.default_rng(0)
    maps = [rng.random((40, 40)).astype(np.float32) for _ in "ab"]
    indices = rng.choice(1600, 300, replace=False).astype(np.int32)

    def paint(a: Map, b: Map) -> tuple[Map, Map]:
        return np.stack([a, b], axis=-1), a * b

    whole, part = noise.map_rows(paint, *maps), noise.map_pixels(paint, indices, (0.5, -1.0), *maps)
    remainder = np.setdiff1d(np.arange(1600), indices)
    for whole_map, part_map, filler in zip(whole, part, (0.5, -1.0), strict=True):
        assert whole_map.shape == part_map.shape
        part_rows = part_map.reshape(1600, -1)
        assert np.array_equal(part_rows[indices], whole_map.reshape(1600, -1)[indices])
        assert (part_rows[remainder] == filler).all()


@pytest.mark.parametrize("sides", [4, 16])
def test_a_bent_bar_faces_outwards_along_its_path(sides: int) -> None:
    s = np.linspace(0, 1, 9)
    path = np.column_stack([6 * s, 3 * s**2, np.sin(3 * s)])
    wire = scenery.wire(path, 0.3)
    shape = scenery.Bar(wire, sides, path, finish.Finish((0.6, 0.6, 0.6), 0.2), "hook").shape
    mesh = trimesh.Trimesh(*shape, process=False)
    length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    section = 0.3**2 * sides / 2 * np.sin(2 * np.pi / sides)
    assert 0.75 * section * length < mesh.volume < 1.05 * section * length


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
