"""Learning curves: estimators recover a known force and are tested on held-out sequences."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_clip import made_clip

from evidence.curves import experiment
from evidence.curves.experiment import GRID, SAME, Estimator
from learn.data.clips import Clip


@pytest.fixture(scope="module")
def clips() -> list[Clip]:
    """Clips whose displacement is the force, all over the grid."""
    rng, made = np.random.default_rng(1), []
    for k in range(12):
        force = rng.normal(size=(6, 3))
        moved = np.broadcast_to(force[:, :, None, None], (6, 3, GRID.size, GRID.size)).astype(np.float32)
        one = made_clip(k, moved[:, :2], 2.0 * force)
        fields = {"recovered": moved[:, :2], "motion": moved}
        sure = np.ones((6, 2, GRID.size, GRID.size), np.float32)
        density = moved / GRID.extent_mm**2
        made.append(replace(one, displacement=fields, motion_confidence=sure, density=density))
    return made


def row(one: Estimator, clips: list[Clip], work: Path) -> dict[str, Any]:
    """Errors on the first four clips after fitting on the last six."""
    tests = {SAME: (clips[:4], [k % 2 == 0 for k in range(4)])}
    (found,) = experiment.measure_estimator(one, clips[4:], 2, tests, 10, 3600.0, work)
    return found


def test_ridge_estimates_force_in_stereo_and_its_lateral_part_monocular(
    clips: list[Clip], tmp_path: Path
) -> None:
    two = row(Estimator("ridge", 2, 6), clips, tmp_path)
    one = row(Estimator("ridge", 1, 6), clips, tmp_path)
    assert two["whole"][0] < 0.02
    assert two["gain"] == pytest.approx(1, abs=0.02)
    assert one["across"][0] < 0.02
    assert one["along"][0] > 0.3
    assert two["cpu_h"] == pytest.approx(6, abs=0.1)


def test_tested_sequences_are_held_out(
    clips: list[Clip], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    used: dict[str, list[str]] = {}

    def fitted(one: Estimator, fit: list[Clip], select: list[Clip], steps: int, work: Path) -> object:
        used.update(fit=[c.content_hash for c in fit], select=[c.content_hash for c in select])
        return lambda clip: used.setdefault("test", []).append(clip.content_hash) or clip.force

    monkeypatch.setattr(experiment, "fitted", fitted)
    assert row(Estimator("ridge", 2, 6), clips, tmp_path)["whole"][0] == 0
    assert used == {"fit": [*map(str, range(6, 12))], "select": ["4", "5"], "test": ["0", "1", "2", "3"]}
