"""The headline of a scored recording, in report and terminal: a few numbers, or why there are none."""

from __future__ import annotations

import math
from dataclasses import dataclass

from bench.bootstrap import Interval
from bench.scoring.force_metrics import METRICS
from bench.scoring.result import Result
from learn.uncertainty.out_of_distribution import OUT_OF_DISTRIBUTION

_NEWTONS = ("mae_mn", "mae_of_peak", "r", "ccc", "r2", "false_positive_rate")
_SHAPE = ("r", "shape_error", "lag_s")
_PRESSED = ("mae_mn", "mae_of_peak", "r2")


@dataclass(frozen=True)
class Tile:
    """One number."""

    name: str
    value: float
    unit: str  # as `Metric.unit`
    interval: Interval | None = None


@dataclass(frozen=True)
class Headline:
    """The most important numbers of a result."""

    refused: str  # why there are no numbers; empty if there are
    tiles: tuple[Tile, ...]
    warnings: tuple[str, ...] = ()  # caveats that must be shown with the numbers
    of_peak: float | None = None  # the first tile's error over the contacts' mean peak; None: no error
    trust: str = ""  # one sentence on assumptions and, without findings, on frames and motion


def headline(result: Result) -> Headline:
    """The main method's most important scores for this recording: first after the gain found on `press_s`,
    then those in newtons, or without E the scale-invariant ones. None if too many frames were lost."""
    doubts = tuple(finding.message for finding in result.findings if finding.severity == "warning")
    if result.refused:
        return Headline(result.refused, (), doubts)
    main = result.methods[result.main]
    if not main.scores:
        why = "No usable force sensor: predictions only, nothing is scored"
        return Headline(why, (), doubts, trust=_trust(result))
    warnings = list(doubts)
    if result.left == 2:
        warnings.append("Only two frames are scored: correlations are meaningless (see the notes)")
    tiles, of_peak = list[Tile](), main.scores["mae_of_peak"] if result.absolute else None
    if math.isfinite(main.calibrated.get("mae_mn", math.nan)):
        of_peak = main.calibrated["mae_of_peak"]
        tiles += [
            Tile(f"{METRICS[key].name}, gain of the press", main.calibrated[key], METRICS[key].unit)
            for key in _PRESSED
        ]
    keys = _NEWTONS if result.absolute else _SHAPE
    tiles += [
        Tile(METRICS[key].name, main.scores[key], METRICS[key].unit, main.intervals.get(key)) for key in keys
    ]
    return Headline("", tuple(tiles), tuple(warnings), of_peak, _trust(result))


def _trust(result: Result) -> str:
    """One sentence on the assumed tissue and scale and, without findings, on frames and motion."""
    meta, network = result.settings["meta"], result.main
    parts = [] if result.findings else [f"None of {len(result.lost)} frames was lost"]
    method = result.methods.get(network)
    # Networks without intervals have no check of their training distribution.
    if network in result.settings.get("networks", {}) and method and method.low_mn is not None:
        if any(note.startswith(f"{network}: {OUT_OF_DISTRIBUTION}") for note in result.notes):
            parts.append("the motion is unlike that of the network's training data")
        elif parts:
            parts.append("the motion is like that of the network's training data")
    young = f"E = {meta['young_kpa']:.3g} kPa" if result.absolute else "E = 1 kPa (unknown)"
    assumptions = [young + _describe_error(meta.get("young_uncertainty", 0.0))]
    is_guess = meta.get("scale_mm_per_px") == "unknown"
    scale = " (unknown)" if is_guess else _describe_error(result.scale.uncertainty)
    assumptions.append(f"{result.scale.mm_per_px:.3g} mm/px{scale}")
    assumptions.append(f"membrane {meta.get('membrane', 'unknown')}")
    parts.append(f"{'a' if parts else 'A'}ssumed: {', '.join(assumptions)}")
    return "; ".join(parts) + "."


def _describe_error(uncertainty: float) -> str:
    return f" ± {uncertainty:.0%}" if uncertainty else ""
