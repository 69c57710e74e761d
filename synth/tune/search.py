"""Goal-oriented fidelity: the cheapest job whose error of the force is within a budget of full fidelity's.

A few probe sequences are computed at full fidelity and with one parameter changed at a time. What each does
to the force adds up to first order, with its sign, frame by frame; costs multiply stage by stage. That only
orders the candidates: the cheapest that is predicted to keep the budget is measured as a whole, on further
sequences too, and given up for the next if it does not keep it.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from synth.errors import UserError
from synth.tune.measurements import Measurements
from synth.tune.parameters import Settings, show

Floats = NDArray[np.float64]

_TRIES = 6
_STRICTER = (0.6, 0.95)  # after a broken prediction, the next may be between these parts of it
_EQUAL = 0.02  # costs that differ by less than this part, to which they are known, count as equal


@dataclass(frozen=True)
class Evaluation:
    """Settings of all parameters on some sequences, against full fidelity; infinite where they don't work."""

    name: str
    settings: Settings
    errors: tuple[float, ...]
    """By sequence, what they take of the budget (`excess`)."""
    totals: tuple[float, ...]
    """By sequence, by how much the force read from recovered displacement is off, as a part of the force."""
    cost: float
    """CPU-s a frame: physics, scene, rendering, flow; not the writing of the store."""

    @property
    def error(self) -> float:
        """Mean over sequences."""
        return float(np.mean(self.errors))


@dataclass(frozen=True)
class Tuned:
    """The answer."""

    budget: float
    alone: tuple[Evaluation, ...]
    """Every setting of every parameter by itself."""
    full: Evaluation
    own: Evaluation
    """The job as it was."""
    tried: tuple[Evaluation, ...]
    best: Evaluation
    """The cheapest that keeps the budget."""

    @property
    def changes(self) -> Settings:
        """Keys of the job that change, and their values."""
        return {key: value for key, value in self.best.settings.items() if value != self.own.settings[key]}


def parse_budget(text: str) -> float:
    """0.03 of `force 3%`: by how much the error of the force may grow. UserError for anything else."""
    found = re.fullmatch(r"\s*force\s+(\d+(?:\.\d+)?)\s*%\s*", text)
    if not found or not 0 < float(found[1]) < 100:
        raise UserError(f"--budget {text!r}: is written as 'force 3%', more than 0 and less than 100")
    return float(found[1]) / 100


def tune(measurements: Measurements, budget: float, probes: int, checks: int) -> Tuned:
    """Finds the cheapest settings within the budget.

    Args:
        measurements: of the job.
        budget: by how much the error of the force may grow over full fidelity's, as a part of the force.
        probes: sequences that every setting is measured on.
        checks: further ones that whole jobs are measured on.

    Raises:
        UserError: a probe sequence cannot be carried out at full fidelity.
    """
    parameters, every, some = measurements.parameters, range(probes + checks), range(probes)
    measurements.expected = probes * sum(len(one.settings) for one in parameters) + 3 * len(every)
    alone = []
    for one in parameters:
        for setting in one.settings[1:]:
            name, changed = f"{one.key} {show(setting)}", {**measurements.full_fidelity, one.key: setting}
            alone.append(evaluate(measurements, name, changed, some, predicted=True))
    full = evaluate(measurements, "full fidelity", measurements.full_fidelity, every)
    own = evaluate(measurements, "the job as it was", {one.key: one.own for one in parameters}, every)
    # Full fidelity keeps the budget, which is counted from it.
    best = own if own.error <= budget else full
    least = evaluate(measurements, "", best.settings, some, predicted=True).cost
    tried: list[Evaluation] = []
    allowed = budget
    for number in range(_TRIES):
        picked = _pick(measurements, some, allowed, [one.settings for one in tried])
        if picked is None or picked.cost > (1 - _EQUAL) * least:
            break
        found = evaluate(measurements, f"try {number + 1}", picked.settings, every)
        tried.append(found)
        if found.error <= budget:
            best = min(best, found, key=lambda one: one.cost)
            break
        allowed *= float(np.clip(budget / found.error, *_STRICTER))
    return Tuned(budget, tuple(alone), full, own, tuple(tried), best)


def _pick(
    measurements: Measurements, sequences: range, budget: float, excluded: Sequence[Settings]
) -> Evaluation | None:
    """The cheapest settings predicted to keep a budget; of some about as cheap, those that change least."""
    own = {one.key: one.own for one in measurements.parameters}
    combinations = itertools.product(*(one.settings for one in measurements.parameters))
    every = [dict(zip(own, values, strict=True)) for values in combinations]
    predicted = [evaluate(measurements, "", one, sequences, True) for one in every if one not in excluded]
    kept = [one for one in predicted if one.error <= budget]
    limit = (1 + _EQUAL) * min((one.cost for one in kept), default=0.0)
    near = [one for one in kept if one.cost <= limit]
    return min(near, key=lambda one: len(one.settings.items() - own.items()), default=None)


def evaluate(
    measurements: Measurements, name: str, settings: Settings, sequences: range, predicted: bool = False
) -> Evaluation:
    """Settings of all parameters, measured as a whole, or predicted from the parameters by themselves."""
    per_frame = 1 / np.array([measurements.job.frames, measurements.job.frames, 1, 1])
    errors, totals, costs = [], [], []
    for sequence in sequences:
        full = measurements.measure(sequence, {})
        measure = measurements.predict if predicted else measurements.measure
        found = measure(sequence, settings)
        errors.append(excess(found.label, found.read, full.read))
        totals.append(size(found.read))
        costs.append(found.cost @ per_frame)
    return Evaluation(name, settings, tuple(errors), tuple(totals), float(np.mean(costs)))


def excess(label: Floats, read: Floats, full: Floats) -> float:
    """What a sequence takes of the budget: never below 0, so that none pays for another.

    Args:
        label: (K, I) by how much the true displacement changes the force, as a part of the force.
        read: (K, I) error of the force read from the recovered displacement.
        full: (K, I) the same at full fidelity.
    """
    return max(size(label), size(read) - size(full), 0.0)


def size(errors: Floats) -> float:
    """Root mean square over frames of (K, I) errors, instruments together."""
    return float(np.sqrt(np.square(errors).sum(axis=1).mean()))
