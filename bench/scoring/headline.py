"""What is said first of a scored recording, wherever it is said: a few numbers, or why there are none."""

from __future__ import annotations

import math
from dataclasses import dataclass

from bench.bootstrap import Interval
from bench.methods.comparison import FUSION, MAIN
from bench.scoring.metrics import METRICS
from bench.scoring.result import Result
from learn.uncertainty.out_of_distribution import OUT_OF_DISTRIBUTION

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
    of_peak: float | None = None
    """The first tile's error over the contacts' mean peak; None where it is no error."""
    trust: str = ""
    """What was lost, what was unlike the training, what was assumed: one sentence."""


def headline(result: Result) -> Headline:
    """The main method's scores in the order that this recording asks for.

    With a separate press those after its gain come first. Without a known E, or with the press alone, the
    curve's shape follows: what no gain changes. Nothing of it where too many frames were lost.
    """
    odd = tuple(one.message for one in result.findings if one.state == "odd")
    if result.refused:
        return Headline(result.refused, (), odd)
    main = result.methods[result.main]
    if not main.scores:
        why = "No usable force sensor: these are predictions only, nothing is scored"
        return Headline(why, (), odd, trust=_trust(result))
    warnings = list(odd)
    if result.left == 2:
        warnings.append("Only two frames are scored: every curve correlates with two (see the notes)")
    if result.sync is not None and not result.aligned:
        warnings.append(
            f"The clocks could not be aligned ({result.sync.refused}): scored at the offset stated, "
            f"{result.settings['meta']['sync']['offset_s']:g} s"
        )
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
    """Lost frames, motion unlike the network's training, and what of tissue and scale was taken as given."""
    meta, frames, lost = result.settings["meta"], len(result.lost), int(result.lost.sum())
    parts = [f"{lost} of {frames} frames were lost" if lost else f"None of {frames} frames was lost"]
    network = MAIN if result.main == FUSION else result.main
    asked = result.methods.get(network)  # without intervals nothing is known of what it was trained on
    if network in result.settings.get("networks", {}) and asked is not None and asked.low_mn is not None:
        unlike = any(note.startswith(f"{network}: {OUT_OF_DISTRIBUTION}") for note in result.notes)
        parts.append(f"it moves {'unlike anything' if unlike else 'as what'} the network was trained on")
    young = f"E = {meta['young_kpa']:.3g} kPa" if result.absolute else "E of 1 kPa, for none is known"
    given = [young + _within(meta.get("young_uncertainty", 0.0))]
    guessed = meta.get("scale_mm_per_px") == "unknown"
    scale = " (a guess)" if guessed else _within(result.scale.uncertainty)
    given.append(f"{result.scale.mm_per_px:.3g} mm/px{scale}")
    given.append(f"membrane {meta.get('membrane', 'unknown')}")
    return "; ".join([*parts, f"taken as given: {', '.join(given)}"]) + "."


def _within(uncertainty: float) -> str:
    return f" ± {uncertainty:.0%}" if uncertainty else ""
