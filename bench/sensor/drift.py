"""Drift of the sensor's zero, from spans in which the video shows the tissue at rest.

Tissue that has come back to where it was in the rest frame carries no load, so what the sensor measures there
is its zero. It is compared between such spans, as the median of each; noise alone changes it by 1.25 times
its standard deviation over the square root of the number of independent samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from synth.arrays import Floats, Mask

# By hand, on the recordings of tests/helpers/clean_recordings.py and with drift of 1 to 5 mN in them.
_REST = 0.12  # largest motion at rest over the largest, beyond the motion that is usual at rest
_USUAL = 10.0  # percentile of the motion that is usual at rest
_MOVES = 4.0  # least ratio of the largest motion to that: else the video shows no load
_LEAST_FRAMES, _LEAST_S = 4, 0.3  # of a span at rest, without its ends
# The same of a short span, which has to be stiller; least number of the sensor's samples in it.
_SHORT_FRAMES, _SHORT_S, _SHORT_REST, _SAMPLES = 2, 0.1, 0.05, 8
_SIGMAS = 4.0  # of the noise of the difference
_SHARE, _SHORT_SHARE = 0.025, 0.06  # least drift over the largest force


@dataclass(frozen=True)
class Drift:
    """The sensor's zero in M spans at rest."""

    time_s: Floats  # (M,) their middles [s]
    zero_mn: Floats  # (M, 3) the sensor's median
    change_mn: float  # from the first to the last span
    noise_mn: float  # standard deviation of that change by noise
    is_clear: bool  # whether it exceeds noise, and counts beside the largest force


def find_drift(
    time_s: Floats, axes_mn: Floats, moved: Floats, samples: tuple[Floats, Floats] | None = None
) -> Drift | None:
    """The zeros of a sensor (T, 3) mN in the spans in which the tissue is at rest; None: fewer than two.

    `time_s`: (T,) rising [s]; `moved`: (T,) mean motion of the tissue since the rest frame, any unit; frames
    with NaN are left out. `samples`: the sensor's own times (N,) and forces (N, 3), which count where the
    video shows rest too shortly for its frames.
    """
    known = np.isfinite(axes_mn).all(axis=1) & np.isfinite(moved)
    t, axes, motion = time_s[known], axes_mn[known], moved[known]
    spans, share = find_rest_spans(t, motion), _SHARE
    values, middles = [axes[span] for span in spans], [float(t[span].mean()) for span in spans]
    if len(spans) < 2 and samples is not None:
        share, sample_s = _SHORT_SHARE, samples[0]
        ends_s = [t[span][[0, -1]] for span in find_rest_spans(t, motion, short=True)]
        masks = [(sample_s >= a) & (sample_s <= b) & np.isfinite(samples[1]).all(axis=1) for a, b in ends_s]
        largest_mn = float(np.linalg.norm(axes, axis=1).max(initial=0.0))
        # A force that changes there is a load: the clocks are apart, or the video misses it.
        masks = [
            part
            for part in masks
            if part.sum() >= _SAMPLES and _change(samples[1][part]) < 0.25 * _SHORT_SHARE * largest_mn
        ]
        values, middles = (
            [samples[1][part] for part in masks],
            [float(sample_s[part].mean()) for part in masks],
        )
    if len(values) < 2:
        return None
    zero = np.stack([np.median(part, axis=0) for part in values])
    variance = [1.57 * float(part.var(axis=0).sum()) / len(part) for part in (values[0], values[-1])]
    change, noise = float(np.linalg.norm(zero[-1] - zero[0])), float(np.sqrt(sum(variance)))
    largest_mn = float(np.linalg.norm(axes - zero[0], axis=1).max())
    is_clear = change > max(_SIGMAS * noise, share * largest_mn)
    return Drift(np.array(middles), zero, change, noise, is_clear)


def _change(values: Floats) -> float:
    """Change of the median of a force (N, 3) from one half to the other."""
    first, second = np.array_split(values, 2)
    return float(np.linalg.norm(np.median(second, axis=0) - np.median(first, axis=0)))


def find_rest_spans(time_s: Floats, moved: Floats, short: bool = False) -> list[Mask]:
    """Each span (T,) in which motion is at the level of rest, without its first and last frame; `short`: also
    spans of few frames."""
    level, frames, least_s = _REST, _LEAST_FRAMES, _LEAST_S
    if short:
        level, frames, least_s = _SHORT_REST, _SHORT_FRAMES, _SHORT_S
    if len(moved) < 2 * _LEAST_FRAMES:
        return []
    usual_motion, largest_motion = float(np.percentile(moved, _USUAL)), float(moved.max())
    if not largest_motion > _MOVES * usual_motion:
        return []
    is_rest = moved < usual_motion + level * (largest_motion - usual_motion)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_rest, [False]])))
    spans = list[Mask]()
    for first, stop in zip(edges[::2] + 1, edges[1::2] - 1, strict=True):
        if stop - first >= frames and time_s[stop - 1] - time_s[first] >= least_s:
            inside = np.zeros(len(moved), bool)
            inside[first:stop] = True
            spans.append(inside)
    return spans


def remove_drift(time_s: Floats, axes_mn: Floats, drift: Drift) -> Floats:
    """The sensor (T, 3) mN without the change of its zero since the first span: linear between the spans'
    middles, constant beyond them."""
    change = drift.zero_mn - drift.zero_mn[0]
    drift_mn = np.stack([np.interp(time_s, drift.time_s, column) for column in change.T], axis=1)
    return np.asarray(axes_mn - drift_mn, np.float64)
