"""Measurements of the physics at small size: refinement of the mesh."""

import pytest

from evidence.fem import relief


@pytest.mark.slow
def test_a_scene_with_relief_converges() -> None:
    sizes = [400, 1600, 3500]
    coarse, fine = relief.summarise(relief.measure_scene(2, sizes), sizes)
    assert fine["mean_worst"] < min(0.03, coarse["mean_worst"])
