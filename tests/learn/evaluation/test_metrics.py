"""Metrics against torchmetrics and on predictions of known score; their intervals against SciPy's."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
import torchmetrics
from scipy import stats

from learn.checkpoint import ModelCard
from learn.data.clips import Clip
from learn.evaluation.evaluate import EvaluationReport, score
from learn.evaluation.metrics import agreement, contact_mm, moments
from learn.evaluation.statistics import over_groups, pooled_r2
from learn.network.shape import Architecture
from learn.settings import TrainingSettings
from learn.training.batches import measure_scales


def test_against_torchmetrics() -> None:
    rng = np.random.default_rng(3)
    true = rng.gamma(1.0, 4.0, 500)
    predicted = 0.8 * true + rng.normal(0.5, 1.0, 500)
    scores = agreement(moments(true[:200], predicted[:200]) + moments(true[200:], predicted[200:]))
    t, p = torch.tensor(true), torch.tensor(predicted)
    for name, metric in {
        "r2": torchmetrics.R2Score(),
        "mae": torchmetrics.MeanAbsoluteError(),
        "rmse": torchmetrics.MeanSquaredError(squared=False),
        "r": torchmetrics.PearsonCorrCoef(),
    }.items():
        metric.set_dtype(torch.float64)
        metric.update(p, t)
        assert scores[name] == pytest.approx(float(metric.compute()), rel=1e-6), name
    expected = 2 * np.cov(true, predicted, bias=True)[0, 1]
    expected /= true.var() + predicted.var() + (true.mean() - predicted.mean()) ** 2
    assert scores["ccc"] == pytest.approx(expected)
    assert scores["bias"] == pytest.approx((predicted - true).mean())


def test_contact_centre() -> None:
    map_ = np.zeros((20, 20))
    map_[5:8, 10:13] = 1.0
    map_[0, 0] = 0.4  # under half the peak: a false positive doesn't move the centre
    assert contact_mm(map_, 0.5).tolist() == [5.5, 3.0]
    assert np.isnan(contact_mm(np.zeros((4, 4)), 1.0)).all()


def card(clips: list[Clip], output: str) -> ModelCard:
    settings = TrainingSettings(size=32, arch=Architecture(width=8, levels=2, output=output))  # type: ignore[arg-type]
    return ModelCard(settings, measure_scales(clips, settings), 1.2, {}, {})


def truth(clip: Clip, output: str) -> np.ndarray:
    density = clip.density * np.float32(clip.young_kpa)
    return density if output == "vector" else np.linalg.norm(density, axis=1, keepdims=True)


def summary(clips: list[Clip], output: str, factor: np.ndarray | float) -> dict[str, float]:
    """Scores of the truth times a factor."""
    c = card(clips, output)
    scores = [score(clip, truth(clip, output) * factor, c) for clip in clips]
    return EvaluationReport(scores).summary()


@pytest.mark.parametrize("output", ["vector", "magnitude"])
def test_scores_of_the_truth_and_of_no_force(clips: list[Clip], output: str) -> None:
    scores = summary(clips, output, 1)
    assert scores["map_r2"] == pytest.approx(1, abs=1e-6)
    assert scores["force_r2_pooled"] == pytest.approx(1, abs=1e-4)
    for name in ("map_mae", "false_positive_relative", "localisation_mm", "force_bias"):
        assert scores[name] == pytest.approx(0, abs=5e-3), name
    scores = summary(clips, output, 0)
    assert scores["map_r2"] <= 0
    assert scores["force_r2_pooled"] <= 0
    assert scores["false_positive_relative"] == 0


def test_mirrored_forces_score_badly_in_the_components_alone(clips: list[Clip]) -> None:
    scores = summary(clips, "vector", np.array([-1, 1, 1], np.float32)[:, None, None])
    assert scores["map_r2"] == pytest.approx(1, abs=1e-6)
    assert scores["vector_r2"] < 0.7
    assert scores["vector_error_mn"] > 0


def test_opposite_forces_cancel_in_vectors_and_add_up_in_lengths(clips: list[Clip]) -> None:
    density = np.zeros_like(clips[0].density)
    density[3, 0, 10:14, 8:12], density[3, 0, 10:14, 20:24] = 0.01, -0.01
    clip = dataclasses.replace(clips[0], density=density, force=np.zeros_like(clips[0].force))
    for output in ("magnitude", "vector"):
        c = card(clips, output)
        scores = score(clip, truth(clip, output), c)
        np.testing.assert_allclose(scores.predicted_mn, scores.true_mn, atol=1e-6)
        assert (scores.true_mn[3] > 0.1) == (output == "magnitude")


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_specimens_are_resampled_whole() -> None:
    values = [1.0] * 10 + [3.0] * 10
    i = over_groups(values, [*"abcde" * 4], rng())
    assert (i.low, i.high) == (2.0, 2.0)  # every specimen has both
    i = over_groups([1.0] * 16 + [6.0] * 4, [*"aaaabbbbccccddddeeee"], rng())
    assert (i.low, i.high) == (1.0, 4.0)  # in 19 of 20 draws at most three of five are the odd specimen
    few_specimens = over_groups(values, [*"abcd" * 5], rng())
    assert few_specimens.mean == 2
    assert np.isnan([few_specimens.low, few_specimens.high]).all()


def test_pooled_r2_is_of_all_values_and_its_interval_of_whole_sequences() -> None:
    draw = np.random.default_rng(5)
    true = [draw.normal(size=50) * scale for scale in draw.gamma(2, 1, 20)]
    predicted = [t + draw.normal(size=50) * 0.5 for t in true]
    sums = np.array([moments(t, p) for t, p in zip(true, predicted, strict=True)])
    estimate = pooled_r2(sums, rng(), draws=8000)
    t, p = np.concatenate(true), np.concatenate(predicted)
    assert estimate.mean == pytest.approx(1 - ((t - p) ** 2).sum() / ((t - t.mean()) ** 2).sum())

    def r2(i: np.ndarray) -> float:
        t, p = np.concatenate([true[k] for k in i]), np.concatenate([predicted[k] for k in i])
        return float(1 - ((t - p) ** 2).sum() / ((t - t.mean()) ** 2).sum())

    options: dict[str, Any] = {"n_resamples": 2000, "method": "BCa", "vectorized": False, "rng": rng()}
    theirs = stats.bootstrap((np.arange(20),), r2, **options).confidence_interval
    assert (estimate.low, estimate.high) == pytest.approx((theirs.low, theirs.high), abs=0.02)
    assert np.isnan(pooled_r2(sums[:2], rng()).low)
    rest_sums = np.array([moments(np.zeros(4), np.ones(4))] * 4)
    assert np.isnan(pooled_r2(rest_sums, rng()).mean), "R² needs force"
