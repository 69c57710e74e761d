"""What is said first of a scored recording, wherever it is said: a few numbers, or why there are none."""

from __future__ import annotations

import math
from dataclasses import dataclass

from bench.bootstrap import Interval
from bench.scoring.metrics import METRICS
from bench.scoring.result import Result

_NEWTONS = ("mae_mn", "mae_of_peak", "r", "ccc", "r2", "ghost_rate")
_SHAPE = ("r", "shape_error", "lag_s")
_PRESSED = ("mae_mn", "mae_of_peak", "r2")


@dataclass(frozen=True)
class Tile:
    """One number."""

    name: str
    value: float
    unit: str
    """As `Metric.unit`."""
    interval: Interval | None = None


@dataclass(frozen=True)
class Headline:
    """What is said first."""

    refused: str
    """Why no number is said; empty where numbers are."""
    tiles: tuple[Tile, ...]
    warnings: tuple[str, ...] = ()
    """What the numbers must not be read without."""


def headline(result: Result) -> Headline:
    """The main method's scores in the order that this recording asks for.

    With a separate press those after its gain come first. Without a known E, or with the press alone, the
    curve's shape follows: what no gain changes. Nothing of it where too many frames were lost.
    """
    odd = tuple(one.said for one in result.findings if one.state == "odd")
    if result.refused:
        return Headline(result.refused, (), odd)
    main = result.methods[result.main]
    if not main.scores:
        return Headline("No usable force sensor: these are predictions only, nothing is scored", (), odd)
    warnings = list(odd)
    if result.left == 2:
        warnings.append("Only two frames are scored: every curve correlates with two (see the notes)")
    if result.sync is not None and not result.aligned:
        warnings.append(
            f"The clocks could not be aligned ({result.sync.refused}): scored at the offset stated, "
            f"{result.settings['meta']['sync']['offset_s']:g} s"
        )
    tiles: list[Tile] = []
    if math.isfinite(main.calibrated.get("mae_mn", math.nan)):
        tiles += [
            Tile(f"{METRICS[key].name}, gain of the press", main.calibrated[key], METRICS[key].unit)
            for key in _PRESSED
        ]
    keys = _NEWTONS if result.absolute else _SHAPE
    tiles += [
        Tile(METRICS[key].name, main.scores[key], METRICS[key].unit, main.intervals.get(key)) for key in keys
    ]
    return Headline("", tuple(tiles), tuple(warnings))
