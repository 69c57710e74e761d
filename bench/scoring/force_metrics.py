"""Agreement of a predicted force curve with the sensor's. Undefined scores are NaN, never 0."""

from __future__ import annotations

import math

import numpy as np

from bench import bootstrap
from bench.bootstrap import Interval
from learn.evaluation import metrics
from learn.evaluation.metrics import Metric
from synth.arrays import Floats, Mask

_LARGEST_LAG_S = 0.5
_LEAST_CONTACT_MN = 1e-3
_SHAPE_ERROR = "MAE after the best-fitting gain, over the contacts' mean peak."

METRICS = {
    "n": Metric("samples", "", "Samples where both are finite.", relative=True),
    "mae_mn": Metric("mean absolute error", "mN", "Mean absolute error.", 2, column="MAE [mN]"),
    "mae_of_peak": Metric("MAE of event peak", "%", "Over the contacts' mean peak.", column="of peak"),
    "rmse_mn": Metric("RMSE", "mN", "Root mean square error.", 2, column="RMSE [mN]"),
    "bias_mn": Metric("bias", "mN", "Mean of predicted minus sensor.", 2, column="bias [mN]"),
    "r": Metric("r", "", "Pearson's correlation.", relative=True, column="r"),
    "ccc": Metric("CCC", "", "Lin's concordance correlation.", column="CCC"),
    "r2": Metric("R²", "", "1 − SSE/SST about the sensor's mean: bias and gain count.", column="R²"),
    "gain": Metric("gain", "", "Least-squares slope of predicted on sensor.", column="gain"),
    "shape_error": Metric("shape error", "%", _SHAPE_ERROR, 3, True, "shape err."),
    "lag_s": Metric("lag", "ms", "Delay of predicted, at the best correlation.", 3, True, "lag"),
    "contact_f1": Metric("contact F1", "", "F1 of contact, by sample.", column="contact F1"),
    "false_positive_rate": Metric("false positives", "%", "Free samples with contact.", column="FPR"),
    "threshold_mn": Metric("contact threshold", "mN", "Sensor's force at contact.", 2, True),
    "events": Metric("contacts", "", "Contacts in the sensor's curve.", relative=True),
    "event_peak_mn": Metric("event peak", "mN", "Mean peak of the contacts.", 2, True),
    "peak_mae": Metric("peak error", "%", "Mean relative error of peaks.", column="peak err."),
    "impulse_mae": Metric("impulse error", "%", "The same for impulses.", column="impulse err."),
    "dropout": Metric("dropout", "%", "Samples without a prediction.", 3, True, "dropout"),
}
"""Definitions of the scores by their key in `score.json`."""

# Scores that are defined without a known stiffness.
RELATIVE = tuple(key for key, metric in METRICS.items() if metric.relative)
# Names of `learn.evaluation.metrics.agreements` and their keys here.
_AGREEMENT = {"mae": "mae_mn", "rmse": "rmse_mn", "bias": "bias_mn", "r": "r", "ccc": "ccc", "r2": "r2"}


def agreement(sensor: Floats, predicted: Floats) -> dict[str, float]:
    """Scores n, mae_mn, rmse_mn, bias_mn, r, ccc, r2, gain over samples (T,) mN where both are finite."""
    both = np.isfinite(sensor) & np.isfinite(predicted)
    x, y = sensor[both], predicted[both]
    values = metrics.agreement(metrics.moments(x, y))
    scores = {key: values[name] for name, key in _AGREEMENT.items()}
    return {"n": float(len(x)), **scores, "gain": metrics.line(x, y)[0]}


def agreement_intervals(sensor: Floats, predicted: Floats, rng: np.random.Generator) -> dict[str, Interval]:
    """Intervals of mae_mn, rmse_mn, bias_mn, r, ccc and r2 by a block bootstrap of the samples, with the
    largest block length of sensor, prediction and difference; empty for fewer than eight samples."""
    good = np.isfinite(sensor) & np.isfinite(predicted)
    x, y = sensor[good], predicted[good]
    if len(x) < bootstrap.LEAST_SAMPLES:
        return {}
    block = max(bootstrap.block_length(series) for series in (x, y, y - x))
    pairs = np.column_stack([np.ones_like(x), x, y, x**2, y**2, x * y, np.abs(y - x)])
    resampled = metrics.agreements(bootstrap.counts(len(x), block, bootstrap.RESAMPLES, rng) @ pairs)
    return {key: bootstrap.interval(resampled[name]) for name, key in _AGREEMENT.items()}


def difference_interval(sensor: Floats, first: Floats, second: Floats, rng: np.random.Generator) -> Interval:
    """Interval of MAE(first) − MAE(second), paired: the same samples are drawn for both."""
    gap = np.abs(first - sensor) - np.abs(second - sensor)
    gap = gap[np.isfinite(gap)]
    if len(gap) < bootstrap.LEAST_SAMPLES:
        return (math.nan, math.nan)
    weights = bootstrap.counts(len(gap), bootstrap.block_length(gap), bootstrap.RESAMPLES, rng)
    return bootstrap.interval(weights @ gap / len(gap))


def gain(sensor: Floats, predicted: Floats, where: Mask) -> float:
    """The least-squares factor from `predicted` to `sensor` over the samples `where`."""
    good = where & np.isfinite(sensor) & np.isfinite(predicted)
    return ratio(float(sensor[good] @ predicted[good]), float(predicted[good] @ predicted[good]))


def lag(time_s: Floats, sensor: Floats, predicted: Floats) -> float:
    """The lag of `predicted` behind `sensor` [s] at the best correlation; NaN: undefined.

    Scores are at lag 0. It is found in steps of a quarter of the median frame time, within half a second in
    both directions. `time_s`: (T,) rising [s]; others (T,) mN.
    """
    both = np.isfinite(sensor) & np.isfinite(predicted) & np.isfinite(time_s)
    t, x, y = time_s[both], sensor[both], predicted[both]
    if len(t) < 8 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return math.nan
    step = float(np.median(np.diff(t))) / 4
    search = min(_LARGEST_LAG_S, 0.25 * float(t[-1] - t[0]))
    lags = np.arange(-round(search / step), round(search / step) + 1) * step
    inner = (t >= t[0] + search) & (t <= t[-1] - search)
    if inner.sum() < 8:
        return math.nan
    shifted = [np.interp(t[inner] + shift, t, y) for shift in lags]
    with np.errstate(divide="ignore", invalid="ignore"):  # constant curves
        r = np.corrcoef([x[inner], *shifted])[0, 1:]
    return float(lags[np.nanargmax(r)]) if np.isfinite(r).any() else math.nan


def contact_threshold(sensor: Floats, noise_floor_mn: float) -> float:
    """The sensor's force at contact [mN]: 3 times its noise floor, at least 5% of its peak, never 0."""
    peak = float(np.nanmax(sensor, initial=0.0))
    return max(3 * noise_floor_mn, 0.05 * peak, _LEAST_CONTACT_MN)


def in_contact(curve: Floats, threshold_mn: float) -> Mask:
    """Contact (T,) with hysteresis: it starts at the threshold and ends at half of it."""
    state, out = False, np.zeros(len(curve), bool)
    for k, value in enumerate(curve):
        if np.isfinite(value):
            state = value >= (0.5 * threshold_mn if state else threshold_mn)
        out[k] = state
    return out


def events(time_s: Floats, contact: Mask, shortest_s: float = 0.15) -> list[slice]:
    """Contacts of at least `shortest_s`, after closing shorter gaps; a sample lasts a median step."""
    step = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    edges = np.flatnonzero(np.diff(contact, prepend=False, append=False))
    first, last = edges[::2], edges[1::2] - 1
    is_apart = time_s[first[1:]] - time_s[last[:-1]] - step >= shortest_s
    first, last = first[np.append(True, is_apart)[: len(first)]], last[np.append(is_apart, True)[: len(last)]]
    is_long = time_s[last] - time_s[first] + step >= shortest_s
    return [slice(int(a), int(b) + 1) for a, b in zip(first[is_long], last[is_long], strict=True)]


def per_event(
    time_s: Floats, sensor: Floats, predicted: Floats, spans: list[slice]
) -> list[dict[str, float]]:
    """A row per contact: times, peak [mN] and impulse [mN s] (trapezoidal) of the sensor, and the errors over
    the samples with a prediction, NaN for fewer than two."""
    rows = []
    for span in spans:
        known = np.isfinite(sensor[span])
        if known.sum() < 2:
            continue
        t, x, y = time_s[span][known], sensor[span][known], predicted[span][known]
        row = {"from_s": t[0], "to_s": t[-1], "peak_mn": x.max(), "impulse_mns": np.trapezoid(x, t)}
        both = np.isfinite(y)
        if both.sum() > 1:  # else the errors are NaN
            t, x, y = t[both], x[both], y[both]
        peak, impulse = float(x.max()), float(np.trapezoid(x, t))
        row["predicted_peak_mn"] = y.max()
        row["peak_error"] = ratio(y.max() - peak, peak)
        row["impulse_error"] = ratio(float(np.trapezoid(y, t)) - impulse, impulse)
        row["mae_mn"] = np.abs(y - x).mean()
        rows.append({key: float(value) for key, value in row.items()})
    return rows


def contact_scores(sensor: Floats, predicted: Floats, threshold_mn: float) -> dict[str, float]:
    """Scores of contact detection, as `METRICS` describes them."""
    both = np.isfinite(sensor) & np.isfinite(predicted)
    contact, detected = (in_contact(curve, threshold_mn)[both] for curve in (sensor, predicted))
    free, hits, total = (
        ~contact,
        int((contact & detected).sum()),
        int(contact.sum() + detected.sum()),
    )
    return {
        # By its definition: importing scikit-learn for it took a fifth of the start of every command.
        "contact_f1": 2 * hits / total if total else math.nan,
        "false_positive_rate": float(detected[free].mean()) if free.any() else math.nan,
    }


def compute_all(
    time_s: Floats, sensor: Floats, predicted: Floats, noise_floor_mn: float = 0.0, used: Mask | None = None
) -> tuple[dict[str, float], list[dict[str, float]]]:
    """All scores of a predicted curve against a sensor's, and the table of its contacts.

    `time_s`: (T,) rising [s]; `sensor`, `predicted`: (T,) mN, NaN where unknown; `noise_floor_mn`: of the
    sensor without contact; `used`: (T,) samples that are scored; None: all. A contact ends at others.
    """
    used = np.ones(len(time_s), bool) if used is None else used
    sensor, predicted = np.where(used, sensor, np.nan), np.where(used, predicted, np.nan)
    threshold = contact_threshold(sensor, noise_floor_mn)
    rows = per_event(time_s, sensor, predicted, events(time_s, in_contact(sensor, threshold) & used))
    scores = agreement(sensor, predicted)
    peak = _mean_size(rows, "peak_mn")
    # The error after the best gain, known only in hindsight, is that of the curve's shape.
    scaled = gain(sensor, predicted, np.isfinite(sensor)) * predicted
    scores["shape_error"] = ratio(agreement(sensor, scaled)["mae_mn"], peak)
    scores |= contact_scores(sensor, predicted, threshold)
    scores |= {
        "lag_s": lag(time_s, sensor, predicted),
        "threshold_mn": threshold,
        "events": float(len(rows)),
        "event_peak_mn": peak,
        "mae_of_peak": ratio(scores["mae_mn"], peak),
        "peak_mae": _mean_size(rows, "peak_error"),
        "impulse_mae": _mean_size(rows, "impulse_error"),
        "dropout": float(np.mean(~np.isfinite(predicted[used]))) if used.any() else math.nan,
    }
    return scores, rows


def without_newtons(scores: dict[str, float]) -> dict[str, float]:
    """The scores with those that require newtons set to NaN, for predictions of unknown stiffness."""
    return {key: value if key in RELATIVE else math.nan for key, value in scores.items()}


def without_prediction(rows: list[dict[str, float]]) -> list[dict[str, float]]:
    """The contacts with all values that require predicted newtons set to NaN."""
    sensor_keys = ("from_s", "to_s", "peak_mn", "impulse_mns")
    return [{key: value if key in sensor_keys else math.nan for key, value in row.items()} for row in rows]


def _mean_size(rows: list[dict[str, float]], key: str) -> float:
    sizes = [abs(row[key]) for row in rows if np.isfinite(row[key])]
    return float(np.mean(sizes)) if sizes else math.nan


def ratio(above: float, below: float) -> float:
    """above / below; NaN unless `below` is positive."""
    return above / below if below > 0 else math.nan
