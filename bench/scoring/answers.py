"""The first screen of a report: how large the force is, how sure, what would make it surer, what is wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bench.methods.comparison import PHYSICS
from bench.methods.force_interval import LEVEL, NORMAL, read_table
from bench.scoring.result import Result

_SHOWN = 2  # findings on the first screen
_WORDS = 14  # of each
_WORTH = 0.02  # least change of the interval that is said, as a share of its width


@dataclass(frozen=True)
class Answers:
    """Short texts, at most 100 words together."""

    force: str
    sure: str
    surer: tuple[str, ...]
    wrong: tuple[str, ...]


def answer(result: Result) -> Answers:
    """The four answers on a scored recording."""
    wrong = tuple(_shorten(f"{one.cause}: {one.message}") for one in result.findings[:_SHOWN])
    if (more := len(result.findings) - _SHOWN) > 0:
        wrong = (*wrong, f"and {more} more, below")
    main, unit = result.methods[result.main], "mN" if result.absolute else "mN per kPa"
    if result.refused or not np.isfinite(main.size_mn).any():
        return Answers("not stated", "held back", (), wrong or ("the recording can't be measured",))
    k = int(np.nanargmax(main.size_mn))
    force = f"{_number(main.size_mn[k])} {unit} at most, at {result.time_s[k]:.2f} s"
    if main.scores and math.isfinite(error := main.scores["mae_of_peak"]) and result.absolute:
        force += f"; mean error against the sensor {error:.0%} of the peak"
    low, high = main.low_mn, main.high_mn
    if low is None or high is None or not np.isfinite(high[k]):
        return Answers(force, "no interval for this recording", (), wrong or ("nothing found",))
    level = f"{LEVEL:.0%} interval" if main.interval.get("level") else "interval, not calibrated"
    sure = f"{_number(low[k])} to {_number(high[k])} {unit} there ({level})"
    surer = find_gains(result, float(main.size_mn[k]), float(low[k]), float(high[k]))
    return Answers(force, sure, surer, wrong or ("nothing found",))


def find_gains(result: Result, size: float, low: float, high: float) -> tuple[str, ...]:
    """What isn't stated or known, each with the width [mN] of this interval with it, the narrowest first."""
    video, width = result.tracked.evidence, high - low
    if video is None or result.main != PHYSICS:
        return ()
    stating, widths = read_table().stating, dict[str, float]()
    if video.cameras == 1:
        widths["a second camera"] = width * stating["second camera"]
    if video.stated < 1:
        missing = [name for name, known in _known(result).items() if not known]
        widths[f"stating {', '.join(missing)}"] = width * stating["statements"] ** (1 - video.stated)
    if young := result.settings["meta"].get("young_uncertainty", 0.0):
        common = NORMAL * young * size
        ends = [math.sqrt(max((side - size) ** 2 - common**2, 0.0)) for side in (low, high)]
        widths["E without its uncertainty"] = sum(ends)
    better = sorted((new, name) for name, new in widths.items() if new < (1 - _WORTH) * width)
    unit = "mN" if result.absolute else "mN per kPa"
    return tuple(f"{name}: {_number(width)} to {_number(new)} {unit} wide" for new, name in better)


def _known(result: Result) -> dict[str, bool]:
    """What `VideoEstimates.stated` counts, and whether this recording states it."""
    return dict(zip(("tissue.png", "masks", "membrane", "free_s"), result.tracked.stated, strict=True))


def _number(value: float) -> str:
    return f"{value:.3g}"


def _shorten(text: str) -> str:
    words = text.split()
    return text if len(words) <= _WORDS else " ".join(words[:_WORDS]) + " …"
