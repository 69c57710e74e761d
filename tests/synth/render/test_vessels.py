"""Trees of vessels: Murray's law, their drawing, and that every anatomy grows."""

import numpy as np
import pytest

from synth.job.schema import Anatomy
from synth.render.anatomy import surface, tube, vessels
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


def test_no_bud_at_all_is_mended() -> None:
    assert vessels._sprouting(7, 0.0, np.random.default_rng(0)).sum() == 1
