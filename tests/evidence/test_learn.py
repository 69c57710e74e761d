"""Measurements of learning: scores of controls, cached runs, coarser grids."""

from dataclasses import replace as replace_field
from pathlib import Path

import numpy as np
import pytest

from evidence.datasets import coarser
from evidence.learn import runs
from evidence.learn.runs import Run
from learn.data.clips import Clip, target
from learn.data.grid import Grid
from learn.evaluation.evaluate import EvaluationReport, evaluate, score
from learn.settings import replace
from learn.training.train import train

GRID = Grid(32)


@pytest.fixture(scope="module")
def run() -> Run:
    arch = replace(runs.base_settings().arch, levels=2, width=8)
    return Run("mse-fold0-seed0", replace(runs.base_settings(), size=32, epochs=1, arch=arch))


def test_a_run_is_cached_by_settings_and_data(
    run: Run, clips: list[Clip], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained: list[str] = []
    monkeypatch.setattr(
        "evidence.training.train", lambda *given: trained.append(str(given[3])) or train(*given)
    )
    first = runs.carry_out(run, clips, tmp_path)
    assert runs.carry_out(run, clips, tmp_path) == first
    assert len(trained) == 1
    runs.carry_out(Run(run.name, replace(run.settings, seed=1)), clips, tmp_path)
    assert len(set(trained)) == 2
    # Controls: R² is at most 0 without motion and 1 for the true force.
    predictor = runs.fit(run, clips, tmp_path)
    assert {row["name"] for row in first["sequences"]} <= {clip.name for clip in clips}
    nothing = [replace_field(c, displacement={"ideal": 0 * c.displacement["ideal"]}) for c in clips]
    assert evaluate(predictor, nothing, "ideal").summary()["map_r2_pooled"] <= 0
    card = predictor.card
    parts = card.settings.arch.components
    truth = [np.stack([target(c, t, parts) for t in range(c.frames)]) * c.young_kpa for c in clips]
    scores = [score(c, one.astype(np.float32), card) for c, one in zip(clips, truth, strict=True)]
    found = EvaluationReport(scores).summary()
    assert (found["map_rmse"], found["map_r2_pooled"]) == (0, 1)


def test_a_coarser_grid_preserves_force_and_motion(clips: list[Clip]) -> None:
    wide = coarser(clips[2], 2)
    fine = clips[2].density.sum((2, 3)) * GRID.pitch_mm**2
    np.testing.assert_allclose(wide.density.sum((2, 3)) * Grid(16).pitch_mm ** 2, fine, rtol=1e-4, atol=1e-6)
    largest = [np.abs(c.displacement["ideal"]).max() for c in (clips[2], wide)]
    assert largest[1] == pytest.approx(largest[0], rel=0.1)
