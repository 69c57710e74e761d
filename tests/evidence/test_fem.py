"""Measurements of the physics at small size: refinement of the mesh."""

import pytest

from evidence.fem import relief


@pytest.mark.slow
def test_a_scene_with_relief_converges(monkeypatch: pytest.MonkeyPatch) -> None:
    rest = relief.at_rest(relief._JOB, 2)
    monkeypatch.setattr(relief, "at_rest", lambda job, index: rest)
    coarse, fine = relief.summarise(
        [relief.measure_scene(2, count) for count in (400, 1600, 3500)], [400, 1600, 3500]
    )
    assert fine["mean_worst"] < min(0.03, coarse["mean_worst"])
