"""Metrics against torchmetrics, and controls that must score what they must."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
import torchmetrics

from learn.checkpoint import ModelCard
from learn.data.clips import Clip
from learn.evaluation.evaluate import EvaluationReport, score
from learn.evaluation.metrics import agreement, contact_mm, moments
from learn.network.d2fnet import Architecture
from learn.settings import TrainingSettings
from learn.training.batches import measure_scales


@pytest.fixture
def pairs() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    true = rng.gamma(1.0, 4.0, 500)
    return true, 0.8 * true + rng.normal(0.5, 1.0, 500)


def test_against_torchmetrics(pairs: tuple[np.ndarray, np.ndarray]) -> None:
    true, said = pairs
    got = agreement(moments(true[:200], said[:200]) + moments(true[200:], said[200:]))
    t, p = torch.tensor(true), torch.tensor(said)
    for name, metric in {
        "r2": torchmetrics.R2Score(),
        "mae": torchmetrics.MeanAbsoluteError(),
        "rmse": torchmetrics.MeanSquaredError(squared=False),
        "r": torchmetrics.PearsonCorrCoef(),
    }.items():
        metric.set_dtype(torch.float64)
        metric.update(p, t)
        assert getattr(got, name) == pytest.approx(float(metric.compute()), rel=1e-6), name
    expected = 2 * np.cov(true, said, bias=True)[0, 1]
    expected /= true.var() + said.var() + (true.mean() - said.mean()) ** 2
    assert got.ccc == pytest.approx(expected)
    assert got.bias == pytest.approx((said - true).mean())


def test_contact_centre() -> None:
    map_ = np.zeros((20, 20))
    map_[5:8, 10:13] = 1.0
    map_[0, 0] = 0.4  # under half the peak: a ghost doesn't drag the centre along
    assert contact_mm(map_, 0.5).tolist() == [5.5, 3.0]
    assert np.isnan(contact_mm(np.zeros((4, 4)), 1.0)).all()


def card(clips: list[Clip], output: str) -> ModelCard:
    settings = TrainingSettings(size=32, arch=Architecture(width=8, levels=2, output=output))  # type: ignore[arg-type]
    return ModelCard(settings, measure_scales(clips, settings), 1.2, {}, {})


def truth(clip: Clip, output: str) -> np.ndarray:
    density = clip.density * np.float32(clip.young_kpa)
    return density if output == "vector" else np.linalg.norm(density, axis=1, keepdims=True)


def report(clips: list[Clip], said: list[np.ndarray], c: ModelCard) -> EvaluationReport:
    return EvaluationReport({"known": [score(clip, s, c) for clip, s in zip(clips, said, strict=True)]}, c)


@pytest.mark.parametrize("output", ["vector", "magnitude"])
def test_the_truth_scores_one_and_no_ghosts(clips: list[Clip], output: str) -> None:
    c = card(clips, output)
    got = report(clips, [truth(clip, output) for clip in clips], c).summary()
    assert got["map_r2"] == pytest.approx(1, abs=1e-6)
    assert got["force_r2_pooled"] == pytest.approx(1, abs=1e-4)
    for name in ("map_mae", "ghost", "ghost_relative", "localisation_mm", "force_bias"):
        assert got[name] == pytest.approx(0, abs=5e-3), name


@pytest.mark.parametrize("output", ["vector", "magnitude"])
def test_saying_nothing_scores_at_most_zero(clips: list[Clip], output: str) -> None:
    c = card(clips, output)
    got = report(clips, [0 * truth(clip, output) for clip in clips], c).summary()
    assert got["map_r2"] <= 0
    assert got["force_r2_pooled"] <= 0
    assert got["ghost"] == 0


def test_a_mirrored_answer_is_not_forgiven(clips: list[Clip]) -> None:
    """An answer that is right up to direction: the length's R² can't see it, the components' does."""
    c = card(clips, "vector")
    said = [truth(clip, "vector") * np.array([-1, 1, 1], np.float32)[:, None, None] for clip in clips]
    got = report(clips, said, c).summary()
    assert got["map_r2"] == pytest.approx(1, abs=1e-6)
    assert got["vector_r2"] < 0.7
    assert got["vector_error_mn"] > 0


def test_two_jaws_that_cancel_are_held_to_what_each_output_can_say(clips: list[Clip]) -> None:
    """A grasp's jaws pull against each other: no net force, yet a map of lengths rightly adds them up."""
    density = np.zeros_like(clips[0].density)
    density[3, 0, 10:14, 8:12], density[3, 0, 10:14, 20:24] = 0.01, -0.01
    clip = dataclasses.replace(clips[0], density=density, force=np.zeros_like(clips[0].force))
    for output in ("magnitude", "vector"):
        c = card(clips, output)
        got = score(clip, truth(clip, output), c)
        np.testing.assert_allclose(got.predicted_mn, got.true_mn, atol=1e-6)
        assert (got.true_mn[3] > 0.1) == (output == "magnitude")


def test_ghosts_are_counted_in_mn_over_a_contact_sized_patch(clips: list[Clip]) -> None:
    c = card(clips, "magnitude")
    ghosts = truth(clips[0], "magnitude") + np.float32(5.1 / (np.pi * 16)) * (clips[0].mask > 0)
    faint = truth(clips[0], "magnitude") + np.float32(4.9 / (np.pi * 16)) * (clips[0].mask > 0)
    assert score(clips[0], ghosts, c).others["ghost"] == 1
    assert score(clips[0], faint, c).others["ghost"] < 0.05
    assert score(clips[0], ghosts, c).others["stray_mn"] > 1


def test_a_contact_found_a_cell_aside_is_no_ghost_far_away(clips: list[Clip]) -> None:
    c, clip = card(clips, "magnitude"), clips[2]
    aside = np.roll(truth(clip, "magnitude"), 1, axis=3)
    got = score(clip, aside, c)
    assert got.others["ghost_relative"] > 0
    assert got.others["ghost_far"] == 0
    everywhere = aside + np.float32(0.06 * c.scales.target * clip.young_kpa) * (clip.mask > 0)
    assert score(clip, everywhere, c).others["ghost_far"] == 1
