"""Coverage of bootstrap intervals on series of known dependence."""

from __future__ import annotations

import numpy as np
import pytest

from bench import bootstrap
from bench.scoring import metrics


def autoregressive(n: int, phi: float, rng: np.random.Generator) -> np.ndarray:
    out = np.empty(n)
    out[0] = rng.normal() / np.sqrt(1 - phi**2)
    noise = rng.normal(size=n)
    for k in range(1, n):
        out[k] = phi * out[k - 1] + noise[k]
    return out


def test_block_length_grows_with_dependence() -> None:
    rng = np.random.default_rng(0)
    lengths = [
        np.median([bootstrap.block_length(autoregressive(500, phi, rng)) for _ in range(20)])
        for phi in (0, 0.5, 0.9)
    ]
    assert lengths[0] < 4
    assert lengths[0] < lengths[1] < lengths[2]
    assert lengths[2] > 12


def test_counts_are_whole_resamples_in_blocks() -> None:
    rng = np.random.default_rng(0)
    got = bootstrap.counts(200, 20, 50, rng)
    assert (got.sum(axis=1) == 200).all()
    # In blocks of 20 a drawn sample's neighbour is nearly always drawn as often.
    assert np.corrcoef(got[:, :-1].ravel(), got[:, 1:].ravel())[0, 1] > 0.8


def test_coverage_of_the_bias_of_dependent_errors() -> None:
    rng = np.random.default_rng(3)
    hits = naive = 0
    trials = 60
    for _ in range(trials):
        truth = 50 + 30 * np.sin(np.arange(400) / 15)
        predicted = truth + 2 + autoregressive(400, 0.8, rng)
        low, high = metrics.agreement_intervals(truth, predicted, rng)["bias_mn"]
        hits += low <= 2 <= high
        error = predicted - truth
        half = 1.96 * error.std() / np.sqrt(len(error))
        naive += abs(error.mean() - 2) <= half
    assert hits / trials > 0.85
    assert naive / trials < 0.65  # the 95% interval that assumes independence


def test_paired_difference_removes_a_common_error() -> None:
    rng = np.random.default_rng(1)
    truth = np.zeros(300)
    common = 20 * np.abs(autoregressive(300, 0.5, rng))
    low, high = metrics.difference_interval(truth, common + 1, common, rng)
    assert low == pytest.approx(1, abs=1e-9)
    assert high == pytest.approx(1, abs=1e-9)
