"""The first screen of a report: how large the force is, how sure, what would make it surer, what is wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bench.methods.comparison import PHYSICS
from bench.methods.force_interval import LEVEL, NORMAL, read_table
from bench.scoring.result import Result

_MOST_FINDINGS = 2  # findings on the first screen
_MOST_WORDS = 14  # of each
_WORTH = 0.02  # least change of the interval that is said, as a share of its width


@dataclass(frozen=True)
class Answers:
    """Short texts, at most 100 words together."""

    force: str
    interval: str
    improvements: tuple[str, ...]
    faults: tuple[str, ...]


def answer(result: Result) -> Answers:
    """The four answers on a scored recording."""
    faults = tuple(
        _shorten(f"{finding.cause}: {finding.message}") for finding in result.findings[:_MOST_FINDINGS]
    )
    if (count := len(result.findings) - _MOST_FINDINGS) > 0:
        faults = (*faults, f"and {count} more, below")
    main, unit = result.methods[result.main], "mN" if result.absolute else "mN per kPa"
    if result.refused or not np.isfinite(main.size_mn).any():
        return Answers("not stated", "held back", (), faults or ("the recording can't be measured",))
    k = int(np.nanargmax(main.size_mn))
    force = f"{_number(main.size_mn[k])} {unit} at most, at {result.time_s[k]:.2f} s"
    if main.scores and math.isfinite(error := main.scores["mae_of_peak"]) and result.absolute:
        force += f"; mean error against the sensor {error:.0%} of the peak"
    low, high = main.low_mn, main.high_mn
    if low is None or high is None or not np.isfinite(high[k]):
        return Answers(force, "no interval for this recording", (), faults or ("nothing found",))
    level = f"{LEVEL:.0%} interval" if main.interval.get("level") else "interval, not calibrated"
    interval = f"{_number(low[k])} to {_number(high[k])} {unit} there ({level})"
    improvements = find_gains(result, float(main.size_mn[k]), float(low[k]), float(high[k]))
    return Answers(force, interval, improvements, faults or ("nothing found",))


def find_gains(result: Result, size: float, low: float, high: float) -> tuple[str, ...]:
    """What isn't stated or known, each with the width [mN] of this interval with it, the narrowest first."""
    video, width = result.tracked.evidence, high - low
    if video is None or result.main != PHYSICS:
        return ()
    stating, widths = read_table().stating, dict[str, float]()
    if video.cameras == 1:
        widths["a second camera"] = width * stating["second camera"]
    if video.stated < 1:
        lacking = [name for name, known in _list_statements(result).items() if not known]
        widths[f"stating {', '.join(lacking)}"] = width * stating["statements"] ** (1 - video.stated)
    if young := result.settings["meta"].get("young_uncertainty", 0.0):
        common = NORMAL * young * size
        ends = [math.sqrt(max((side - size) ** 2 - common**2, 0.0)) for side in (low, high)]
        widths["E without its uncertainty"] = sum(ends)
    narrower = sorted(
        (new_width, name) for name, new_width in widths.items() if new_width < (1 - _WORTH) * width
    )
    unit = "mN" if result.absolute else "mN per kPa"
    return tuple(
        f"{name}: {_number(width)} to {_number(new_width)} {unit} wide" for new_width, name in narrower
    )


def _list_statements(result: Result) -> dict[str, bool]:
    """What `VideoEstimates.stated` counts, and whether this recording states it."""
    return dict(zip(("tissue.png", "masks", "membrane", "free_s"), result.tracked.stated, strict=True))


def _number(value: float) -> str:
    return f"{value:.3g}"


def _shorten(text: str) -> str:
    words = text.split()
    return text if len(words) <= _MOST_WORDS else " ".join(words[:_MOST_WORDS]) + " …"
