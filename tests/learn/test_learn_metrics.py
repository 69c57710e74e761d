"""Metrics against torchmetrics, and controls that must score what they must."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import torchmetrics

from learn.batch import measure_scales
from learn.checkpoint import Card
from learn.data import Clip
from learn.evaluate import Report, score
from learn.metrics import Moments, agreement, contact_mm, ghost_share, line
from learn.model import Architecture
from learn.settings import Settings


@pytest.fixture
def pairs() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    true = rng.gamma(1.0, 4.0, 500)
    return true, 0.8 * true + rng.normal(0.5, 1.0, 500)


def test_against_torchmetrics(pairs: tuple[np.ndarray, np.ndarray]) -> None:
    true, said = pairs
    got = agreement(Moments.of(true[:200], said[:200]) + Moments.of(true[200:], said[200:]))
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


def test_a_constant_truth_has_no_r2() -> None:
    assert math.isnan(agreement(Moments.of(np.ones(5), np.arange(5.0))).r2)
    assert math.isnan(agreement(Moments()).mae)


def test_calibration_line(pairs: tuple[np.ndarray, np.ndarray]) -> None:
    true, _ = pairs
    assert line(2 * true + 1, true) == pytest.approx((0.5, -0.5))


def test_contact_centre() -> None:
    map_ = np.zeros((20, 20))
    map_[5:8, 10:13] = 1.0
    map_[0, 0] = 0.4  # under half the peak: a ghost doesn't drag the centre along
    assert contact_mm(map_, 0.5).tolist() == [5.5, 3.0]
    assert np.isnan(contact_mm(np.zeros((4, 4)), 1.0)).all()


def test_ghost_share() -> None:
    said = np.array([[[0.0, 6.0], [7.0, 4.0]]])
    free = np.array([[[True, True], [False, True]]])
    assert ghost_share(said, free, 5.0) == pytest.approx(1 / 3)


def card(clips: list[Clip], output: str) -> Card:
    settings = Settings(size=32, arch=Architecture(width=8, levels=2, output=output))  # type: ignore[arg-type]
    return Card(settings, measure_scales(clips, settings), 1.2, {}, {})


def truth(clip: Clip, output: str) -> np.ndarray:
    density = clip.density * np.float32(clip.young_kpa)
    return density if output == "vector" else np.linalg.norm(density, axis=1, keepdims=True)


@pytest.mark.parametrize("output", ["vector", "magnitude"])
def test_the_truth_scores_one_and_no_ghosts(clips: list[Clip], output: str) -> None:
    c = card(clips, output)
    got = Report([score(clip, truth(clip, output), c) for clip in clips], c).summary()
    assert got["map_r2"] == pytest.approx(1, abs=1e-6)
    assert got["force_r2_pooled"] == pytest.approx(1, abs=1e-4)
    for name in ("map_mae", "ghost", "ghost_relative", "localisation_mm", "force_bias"):
        assert got[name] == pytest.approx(0, abs=5e-3), name


@pytest.mark.parametrize("output", ["vector", "magnitude"])
def test_saying_nothing_scores_at_most_zero(clips: list[Clip], output: str) -> None:
    c = card(clips, output)
    got = Report([score(clip, 0 * truth(clip, output), c) for clip in clips], c).summary()
    assert got["map_r2"] <= 0
    assert got["force_r2_pooled"] <= 0
    assert got["ghost"] == 0


def test_a_mirrored_answer_is_not_forgiven(clips: list[Clip]) -> None:
    """An answer that is right up to direction: the length's R² can't see it, the components' does."""
    c = card(clips, "vector")
    said = [truth(clip, "vector") * np.array([-1, 1, 1], np.float32)[:, None, None] for clip in clips]
    got = Report([score(clip, s, c) for clip, s in zip(clips, said, strict=True)], c).summary()
    assert got["map_r2"] == pytest.approx(1, abs=1e-6)
    assert got["vector_r2"] < 0.7
    assert got["vector_error_mn"] > 0


def test_columns_of_stiffness(clips: list[Clip]) -> None:
    c = card(clips, "vector")
    report = Report([score(clip, truth(clip, "vector"), c) for clip in clips], c)
    assert report.summary("double")["force_bias"] > 0 > report.summary("half")["force_bias"]
    assert report.summary("half")["force_r2_pooled"] < 1
    for clip, row in zip(report.clips, clips, strict=True):
        assert report.factor(clip, "unknown") == pytest.approx(1.2 / row.young_kpa)


def test_ghosts_are_counted_in_mn_over_a_contact_sized_patch(clips: list[Clip]) -> None:
    c = card(clips, "magnitude")
    ghosts = truth(clips[0], "magnitude") + np.float32(5.1 / (np.pi * 16)) * (clips[0].mask > 0)
    faint = truth(clips[0], "magnitude") + np.float32(4.9 / (np.pi * 16)) * (clips[0].mask > 0)
    assert score(clips[0], ghosts, c).ghost == 1
    assert score(clips[0], faint, c).ghost < 0.05
    assert score(clips[0], ghosts, c).stray_mn > 1


def test_bands_hold_every_frame_once(clips: list[Clip]) -> None:
    c = card(clips, "vector")
    report = Report([score(clip, truth(clip, "vector"), c) for clip in clips], c)
    assert sum(b["frames"] for b in report.bands()) == sum(clip.frames for clip in clips)
