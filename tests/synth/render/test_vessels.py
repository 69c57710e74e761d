"""Trees of vessels: Murray's law, their drawing, and that every anatomy grows."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from synth.job.schema import Anatomy
from synth.render.anatomy import noise, surface, trunk, tube, vessels
from synth.render.anatomy.surface import Relief
from synth.render.anatomy.tree import Tree, grow, murray


def test_cubes_of_radii_add_up() -> None:
    parent = np.array([-1, 0, 1, 1, 3, 3])
    radius = murray(parent, leaf=0.1)
    assert radius[0] == pytest.approx((3 * 0.1**3) ** (1 / 3))
    assert radius[3] == pytest.approx((2 * 0.1**3) ** (1 / 3))


def test_growth_reaches_what_is_in_reach() -> None:
    nodes, parent = np.array([[0.0, 0.0]]), np.array([-1])
    goals = np.random.default_rng(0).uniform(-4, 4, (60, 2))
    rng = np.random.default_rng(1)
    grown, up = grow(
        nodes, parent, goals, buds=np.array([True]), step=0.2, reach=9.0, kill=0.5, wander=0.3, rng=rng
    )
    left = np.linalg.norm(grown[None] - goals[:, None], axis=2).min(axis=1)
    assert (left < 0.5).mean() > 0.9
    assert (up[1:] < np.arange(1, len(up))).all()


def test_a_straight_vessel_is_drawn_as_wide_as_it_is() -> None:
    line = Tree(np.array([[-8.0, 0.0], [8.0, 0.0]]), np.array([-1, 0]), np.array([0.5, 0.5]))
    distance, radius = tube.raster(line, 400, 20.0)
    inside = distance < radius
    assert inside[:, 200].sum() * 20.0 / 400 == pytest.approx(1.0, abs=0.11)
    np.testing.assert_allclose(radius[inside], 0.5)


@pytest.mark.slow
@pytest.mark.parametrize("radius_mm", [4.0, 12.0, 30.0])
def test_every_anatomy_grows(radius_mm: float) -> None:
    """Small openings have trunks so short that none of their nodes may be drawn to sprout."""
    section = Anatomy.model_validate({"craniotomy": {"radius_mm": radius_mm}, "vertices": 900})
    for seed in range(3 if radius_mm > 5 else 12):
        made = surface.procedural(Relief.draw(section, np.random.default_rng(seed)), section)
        assert np.isfinite(made.vertices).all()


def test_trunks_join_and_do_not_cross() -> None:
    rng = np.random.default_rng(4)
    for seed in range(6):
        sulci = noise.band(np.random.default_rng(seed), 128, 34.0, 20.0, 0.3)
        (nodes, parent), radius = trunk.trunks(sulci, 34.0, rng, 5, (0.5, 1.0), smooth=40, wiggle=0.0)
        begins = np.append(0, np.flatnonzero(parent != np.arange(len(parent)) - 1))
        assert parent[0] == -1
        lines = np.split(nodes, begins[1:])
        for number, (begin, line) in enumerate(zip(begins, lines, strict=True)):
            if parent[begin] >= 0:
                np.testing.assert_allclose(line[0], nodes[parent[begin]], atol=1e-9)
                assert radius[begin] < 1.3 * radius[parent[begin]]
            for other in lines[:number]:
                met = cKDTree(other).query(line)[0] < 0.15
                # Only where it springs from: past that no part of it runs over an earlier one.
                assert not met[len(line) // 2 :].all()


def test_every_twig_has_a_parent() -> None:
    section = Anatomy()
    made = surface.procedural(Relief.draw(section, np.random.default_rng(3)), section)
    for tree in (made.vessels.arteries, made.vessels.veins, made.vessels.deep):
        child = np.flatnonzero(tree.parent >= 0)
        assert (tree.parent[child] < child).all()
        assert (tree.parent < 0).sum() <= 7, "roots are the trunks' alone"
        longest = np.linalg.norm(tree.nodes[child] - tree.nodes[tree.parent[child]], axis=1).max()
        assert longest < 0.8, "a twig that starts away from what it springs from"
    arteries = made.vessels.arteries
    assert 0.02 < np.quantile(arteries.radius, 0.3) < 0.05  # arterioles of 60-100 um


def test_a_twig_is_not_as_wide_as_its_trunk_where_it_leaves_it() -> None:
    nodes = np.array([[-8.0, 0.0], [0.0, 0.0], [8.0, 0.0], [0.0, 3.0]])
    tree = Tree(nodes, np.array([-1, 0, 1, 1]), np.array([1.0, 1.0, 1.0, 0.1]))
    distance, radius = tube.raster(tree, 400, 20.0)
    inside = (distance < radius).sum(axis=0) * 20.0 / 400
    np.testing.assert_allclose(inside[60:190], 2.0, atol=0.11)  # was notched beside the twig
    np.testing.assert_allclose(inside[210:340], 2.0, atol=0.11)


def test_no_bud_at_all_is_mended() -> None:
    assert vessels._sprouting(7, 0.0, np.random.default_rng(0)).sum() == 1
