"""The search: steps of weighted least squares by slopes known beforehand, frames rendered anew for each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import lsq_linear

from synth.fit import parameters
from synth.fit.candidate import Setting, measured, render
from synth.fit.parameters import PARAMETERS, SPREAD, Parameter
from synth.job.schema import Family
from synth.render.appearance.family import FAMILIES

_LARGEST = 0.8  # step of a parameter, against how far it may be from the family's
_SURER = 0.6  # several frames are, than one
DECIDED = 0.15
"""Standard deviation of a parameter, on its scale, up to which a picture is said to tell it."""
_OUTLIER = 4.0  # spreads off: beyond, a statistic counts less, for no job may reach it (P. J. Huber, 1964)
# Green and blue over red in frames, against those of the reflectances they were rendered with.
_SEEN_G, _SEEN_B = 0.825, 0.735


@dataclass(frozen=True)
class Fitted:
    """What was found."""

    family: Family
    values: dict[str, float]
    statistics: dict[str, float]
    """Of the frames with these values."""
    distance: float
    left: tuple[str, ...]
    """Parameters that the photograph says nothing of: as the family has them."""
    bounded: tuple[str, ...]
    """Parameters that ended at a limit."""
    unsure: dict[str, float] = field(default_factory=dict)
    """Standard deviation of each parameter that the photograph says something of, on its scale: what other
    anatomies of the same parameters differ by."""

    @property
    def undecided(self) -> tuple[str, ...]:
        """Parameters that one such picture doesn't tell within 15%."""
        return tuple(name for name, sd in self.unsure.items() if sd > DECIDED)


def search(
    theirs: dict[str, float], setting: Setting, rounds: int, said: Callable[[int, float], None]
) -> Fitted:
    """The parameters whose frames have a photograph's statistics.

    Every round all anatomies are rendered, and all parameters take the step that would, by their slopes,
    bring the statistics nearest to the photograph's, each counted in the spread that it has between frames.
    The slopes needn't be right for that: where the statistics agree, no step is left. A round that came out
    worse is gone back on, and the next step is half as long.

    Args:
        theirs: the photograph's statistics.
        setting: of the frames that are tried.
        rounds: of rendering each anatomy anew.
        said: is told the round (from 1) and the distance there.
    """
    family = nearest_family(theirs)
    first = parameters.start(family)
    told = [one for one in PARAMETERS if any(np.isfinite(theirs[name]) for name in _own(one))]
    values = first
    tried: list[tuple[float, dict[str, float], dict[str, float]]] = []
    reach = _LARGEST
    for turn in range(rounds):
        sections = parameters.as_job(values, family)
        found = measured([render(sections, setting, index) for index in setting.anatomies])
        tried.append((parameters.distance(found, theirs), values, found))
        said(turn + 1, tried[-1][0])
        best = min(tried, key=lambda one: one[0])
        if best is not tried[-1]:
            reach /= 2
        values = best[1] | _stepped(told, best, first, theirs, reach)
    left = tuple(one.name for one in PARAMETERS if one not in told)
    bounded = tuple(one.name for one in told if not one.low < best[1][one.name] < one.high)
    unsure = _unsure(told, theirs, len(setting.anatomies))
    return Fitted(family, best[1], best[2], best[0], left, bounded, unsure)


def nearest_family(theirs: dict[str, float]) -> Family:
    """The named family whose crown and flush have most nearly the photograph's ratios of colours."""

    def off(family: Family) -> float:
        ranges = FAMILIES[family]
        total = 0.0
        for name in ("crown", "flush"):
            r, g, b = getattr(ranges, name)
            for channel, value in (("g", _SEEN_G * g), ("b", _SEEN_B * b)):
                seen = theirs[f"{name} {channel}"] / max(theirs[f"{name} r"], 1e-3)
                total += float(np.log(max(seen, 1e-3) / (value / r)) ** 2)
        return total if np.isfinite(total) else 0.0

    return min(FAMILIES, key=off)


def _unsure(told: list[Parameter], theirs: dict[str, float], frames: int) -> dict[str, float]:
    """Standard deviation of each parameter, on its scale, from the slopes and what anatomies differ by.

    The photograph is one draw and the frames are a few; where both say nothing it is the family's own.
    """
    names = [name for name in SPREAD if np.isfinite(theirs[name])]
    spread = np.sqrt(1 + 1 / frames) * np.array([SPREAD[name] for name in names])
    slopes = np.array([[one.effects.get(name, 0.0) for one in told] for name in names]) / spread[:, None]
    known = slopes.T @ slopes + np.diag([1 / one.vague**2 for one in told])
    deviation = np.sqrt(np.diag(np.linalg.inv(known)))
    return {one.name: float(sd) for one, sd in zip(told, deviation, strict=True)}


def _own(one: Parameter) -> list[str]:
    """The statistics that a parameter moves most."""
    return [name for name, slope in one.effects.items() if abs(slope) == max(map(abs, one.effects.values()))]


def _stepped(
    told: list[Parameter],
    best: tuple[float, dict[str, float], dict[str, float]],
    first: dict[str, float],
    theirs: dict[str, float],
    reach: float,
) -> dict[str, float]:
    """The parameters after a step of least squares within limits, drawn weakly to where they started."""
    _, values, found = best
    names = [name for name in SPREAD if np.isfinite(theirs[name]) and np.isfinite(found[name])]
    slopes = np.array([[one.effects.get(name, 0.0) for one in told] for name in names])
    spread = _SURER * np.array([SPREAD[name] for name in names])
    lacks = np.array([parameters.scaled(n, theirs[n]) - parameters.scaled(n, found[n]) for n in names])
    here = np.array([one.onto(values[one.name]) for one in told])
    home = np.array([one.onto(first[one.name]) for one in told])
    vague = np.array([one.vague for one in told])
    weight = np.sqrt(_OUTLIER / np.maximum(np.abs(lacks / spread), _OUTLIER)) / spread
    matrix = np.concatenate([slopes * weight[:, None], np.diag(1 / vague)])
    wanted = np.concatenate([lacks * weight, (home - here) / vague])
    most = reach * vague
    low = np.array([one.onto(one.low) for one in told]) - here
    high = np.array([one.onto(one.high) for one in told]) - here
    room = 1e-9
    step = lsq_linear(matrix, wanted, (np.maximum(low, -most) - room, np.minimum(high, most) + room)).x
    return {
        one.name: float(np.clip(one.back(a + d), one.low, one.high))
        for one, a, d in zip(told, here, step, strict=True)
    }
