"""Trees of vessels: Murray's law, and that every anatomy grows."""

import numpy as np
import pytest

from synth.job.schema import AnatomySection
from synth.render.anatomy import surface
from synth.render.anatomy.tree import murray
from synth.sequence import scenario


def test_cubes_of_radii_add_up() -> None:
    parent = np.array([-1, 0, 1, 1, 3, 3])
    radius = murray(parent, leaf=0.1)
    assert radius[0] == pytest.approx((3 * 0.1**3) ** (1 / 3))
    assert radius[3] == pytest.approx((2 * 0.1**3) ** (1 / 3))


@pytest.mark.slow
@pytest.mark.parametrize("radius_mm", [4.0, 30.0])
def test_every_anatomy_grows(radius_mm: float) -> None:
    """Small openings have trunks so short that none of their nodes may be drawn to sprout."""
    section = AnatomySection.model_validate({"craniotomy": {"radius_mm": radius_mm}, "vertices": 900})
    for seed in range(1 if radius_mm > 5 else 4):
        made = surface.grow(scenario.draw_relief(section, np.random.default_rng(seed)), section)
        assert np.isfinite(made.vertices).all()


def test_every_twig_has_a_parent() -> None:
    section = AnatomySection()
    made = surface.grow(scenario.draw_relief(section, np.random.default_rng(3)), section)
    for tree in (made.vessels.arteries, made.vessels.veins, made.vessels.deep):
        child = np.flatnonzero(tree.parent >= 0)
        assert (tree.parent[child] < child).all()
        assert (tree.parent < 0).sum() <= 7, "roots are the trunks' alone"
        longest = np.linalg.norm(tree.nodes[child] - tree.nodes[tree.parent[child]], axis=1).max()
        assert longest < 0.8, "a twig that starts away from what it springs from"
    arteries = made.vessels.arteries
    assert 0.02 < np.quantile(arteries.radius, 0.3) < 0.05  # arterioles of 60-100 um
