"""Scores against numbers computed by hand; coverage of bootstrap intervals on known dependence."""

import numpy as np
import pytest
from scipy.signal import lfilter
from sklearn.metrics import f1_score

from bench import bootstrap
from bench.scoring import force_metrics


def test_agreement_over_samples_where_both_are_finite() -> None:
    scores = force_metrics.agreement(np.array([0.0, 10, 20, np.nan]), np.array([2.0, 10, 24, 5]))
    expected = {"n": 3, "mae_mn": 2, "bias_mn": 2, "rmse_mn": np.sqrt(20 / 3), "r2": 0.9, "gain": 1.1}
    assert {key: scores[key] for key in expected} == pytest.approx(expected)
    flat = force_metrics.agreement(np.full(5, 3.0), np.arange(5.0))
    assert np.isnan([flat[key] for key in ("r", "r2", "ccc", "gain")]).all()
    assert np.isnan(force_metrics.agreement(np.array([]), np.array([]))["mae_mn"])


@pytest.mark.parametrize("late_s", [-0.2, 0.0, 0.13])
def test_lag_is_found_on_uneven_times(late_s: float) -> None:
    rng = np.random.default_rng(1)
    t = np.sort(rng.uniform(0, 10, 300))

    def signal(time_s: np.ndarray) -> np.ndarray:
        return np.sin(1.7 * time_s) + 0.5 * np.sin(4.1 * time_s + 1)

    assert force_metrics.lag(t, signal(t), signal(t - late_s)) == pytest.approx(late_s, abs=0.02)


def test_contact_has_hysteresis_and_events_close_short_gaps_and_drop_short_contacts() -> None:
    curve = np.array([0, 9, 11, 6, 4, 6, 11, 0.0])
    assert force_metrics.in_contact(curve, 10).tolist() == [
        False,
        False,
        True,
        True,
        False,
        False,
        True,
        False,
    ]
    t = np.arange(100) / 10
    contact = np.zeros(100, bool)
    contact[10:20] = contact[21:30] = True  # one contact with a gap of one sample
    contact[50] = True  # too short
    assert force_metrics.events(t, contact, 0.25) == [slice(10, 30)]


def test_the_sensors_contacts_do_not_depend_on_the_prediction() -> None:
    """Half of one contact with its peak and all of another are lost in the prediction."""
    t = np.arange(0, 8, 0.01)
    parts = [100 * np.exp(-((t - centre_s) ** 2) / 0.1) for centre_s in (2, 4, 6)]
    x = np.sum(parts, axis=0)
    y = 1.2 * x
    y[(t > 1.9) & (t < 2.5) | (t > 3) & (t < 5)] = np.nan
    complete_scores, complete_rows = force_metrics.compute_all(t, x, 1.2 * x)
    scores, rows = force_metrics.compute_all(t, x, y)
    assert scores["events"] == 3
    for key in ("from_s", "to_s", "peak_mn", "impulse_mns"):
        assert [row[key] for row in rows] == pytest.approx([row[key] for row in complete_rows])
    assert scores["event_peak_mn"] == pytest.approx(complete_scores["event_peak_mn"])
    for key in ("predicted_peak_mn", "peak_error", "impulse_error", "mae_mn"):
        assert np.isnan(rows[1][key])
    assert [rows[k]["peak_error"] for k in (0, 2)] == pytest.approx([0.2, 0.2]), "over predicted samples"
    assert [scores[key] for key in ("peak_mae", "impulse_mae")] == pytest.approx([0.2, 0.2])


def test_false_positives_are_counted_only_without_contact() -> None:
    t = np.arange(200) / 20
    x = np.where((t > 4) & (t < 6), 100.0, 0.0)
    predicted = x + np.where(t < 2, 30.0, 0.0)
    scores, _ = force_metrics.compute_all(t, x, predicted)
    assert scores["false_positive_rate"] == pytest.approx(np.mean(t[x == 0] < 2))
    assert force_metrics.compute_all(t, x, x)[0]["contact_f1"] == 1
    assert scores["contact_f1"] == pytest.approx(f1_score(x > 50, predicted > 20))


def autoregressive(n: int, phi: float, rng: np.random.Generator) -> np.ndarray:
    first = rng.normal() / np.sqrt(1 - phi**2)
    return np.asarray(lfilter([1], [1, -phi], [first, *rng.normal(size=n)[1:]]))


def test_block_length_grows_with_dependence_and_counts_are_whole_resamples_in_blocks() -> None:
    rng = np.random.default_rng(0)
    groups = [[autoregressive(500, phi, rng) for _ in range(20)] for phi in (0, 0.5, 0.9)]
    low, middle, high = (np.median([bootstrap.block_length(series) for series in group]) for group in groups)
    assert low < 4 < 12 < high
    assert low < middle < high
    counts = bootstrap.counts(200, 20, 50, np.random.default_rng(0))
    assert (counts.sum(axis=1) == 200).all()
    # In blocks of 20 a drawn sample's neighbour is nearly always drawn as often.
    assert np.corrcoef(counts[:, :-1].ravel(), counts[:, 1:].ravel())[0, 1] > 0.8


def test_coverage_of_the_bias_of_dependent_errors() -> None:
    rng = np.random.default_rng(3)
    hits, trials = 0, 60
    for _ in range(trials):
        truth = 50 + 30 * np.sin(np.arange(400) / 15)
        predicted = truth + 2 + autoregressive(400, 0.8, rng)
        low, high = force_metrics.agreement_intervals(truth, predicted, rng)["bias_mn"]
        hits += low <= 2 <= high
    assert hits / trials > 0.85


def test_paired_difference_removes_a_common_error() -> None:
    rng = np.random.default_rng(1)
    truth = np.zeros(300)
    common = 20 * np.abs(autoregressive(300, 0.5, rng))
    assert force_metrics.difference_interval(truth, common + 1, common, rng) == pytest.approx(
        (1, 1), abs=1e-9
    )
