"""What `bench experiment mechanics` shows: effect on the force read against cost, errors, verdicts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from bench.output import charts, result_page
from evidence.mechanics import costs
from evidence.mechanics.answers import (
    FLOWS,
    NETWORK,
    NOTHING,
    ON_MIXTURE,
    ON_PLAIN,
    PARTS,
    PHYSICS,
    RIDGE,
    SHUFFLED,
    UNFITTED,
    as_array,
)
from evidence.mechanics.costs import Ratio
from evidence.mechanics.worlds import PLAIN, STEEP, WORLDS
from learn.evaluation.statistics import Interval, interval, paired

_WORDS = (
    "A sequence of every world shows the same anatomy, contact, load and look as the plain one of its "
    "number, with other mechanics. *Error* is of the force, root mean square over frames as a part of the "
    "force's own, mean over sequences; *more* is by how much it is above that in the plain world on the "
    "same sequences, *mixture less plain* by how much fitting on the mixture errs more than on plain; "
    "intervals are BCa over sequences. No anatomy that is asked about was fitted. No force at all errs by "
    "100%.",
    f"A rigid tip can't push aside by more than friction holds, so it is compared with `{STEEP}`: tractions "
    "within the same cone. *Taken off*: the tissue's own motion is subtracted as it was, which no removal "
    "does better. Tikhonov is physics alone, that of the plain world.",
    "Costs are CPU time of the mechanics of a scene of the default job (mesh, equations, 24 frames), all "
    "worlds in turn in one process, as a ratio to the world compared with; a rigid tip's scenes are those "
    "that press.",
)


class Found:
    """The data, with means and differences by reader, flow, world and part."""

    def __init__(self, found: Mapping[str, Any]) -> None:
        self.seed = int(found["seed"])
        self._rows = {(r["model"], r["fit"], r["flow"], r["world"]): r for r in found["rows"]}
        self.ratios = costs.ratios(found["seconds"], self.seed)

    def error(self, model: str, fit: str, flow: str, world: str, part: str) -> Interval:
        """Mean over sequences."""
        values = as_array(self._rows[model, fit, flow, world][part])
        return interval(values, np.random.default_rng(self.seed))

    def more(self, model: str, fit: str, flow: str, world: str, part: str) -> Interval:
        """What it errs more than in the world that this one is compared with."""
        usual = self._rows[model, fit, flow, WORLDS[world].against][part]
        return self._paired(usual, self._rows[model, fit, flow, world][part])

    def gained(self, model: str, flow: str, world: str, part: str) -> Interval:
        """What one fitted on the mixture errs more than one fitted on plain tissue."""
        usual, other = (self._rows[model, fit, flow, world][part] for fit in (ON_PLAIN, ON_MIXTURE))
        return self._paired(usual, other)

    def cost(self, world: str) -> Ratio:
        """Of what a world is rendered in."""
        return self.ratios[world.removesuffix(", taken off")]

    def _paired(self, usual: list[float | None], other: list[float | None]) -> Interval:
        rng = np.random.default_rng(self.seed)
        return paired(as_array(usual), as_array(other), rng).difference


def drawn(found: Mapping[str, Any]) -> result_page.Page:
    """What `results.json` says."""
    data = Found(found)
    sections = [result_page.Section("", words=[f"- {line}" for line in verdicts(data)])]
    for part, what in PARTS.items():
        for flow in reversed(FLOWS):
            rows = [_line(data, flow, world, part) for world in WORLDS]
            sections.append(result_page.Section(f"Error of {what}, {flow} flow", rows))
    sections.append(result_page.Section("Cost of the mechanics", [*_cost_rows(data)]))
    refused = found["refused"]
    words = [f"Refused: {len(refused)} sequences.", *(f"- {line}" for line in refused)]
    sections.append(result_page.Section("Refused", words=words if refused else ["No sequence was refused."]))
    return result_page.Page(
        "Mechanics: which a force reader must have seen, and what they cost",
        found,
        panels(data),
        sections,
        _WORDS,
        name="README.md",
    )


def panels(data: Found) -> list[charts.Panel]:
    """Effect on the force read from recovered flow against cost: a model a panel, a world a colour.

    A dot is fitted on plain tissue, a ringed one on the mixture.
    """
    made = []
    for model in (RIDGE, NETWORK):
        curves = []
        for world in WORLDS:
            if world in (PLAIN, STEEP):
                continue
            more = [data.more(model, fit, "recovered", world, "across") for fit in (ON_PLAIN, ON_MIXTURE)]
            means = tuple(100 * one.mean for one in more)
            ends = tuple((100 * one.low, 100 * one.high) for one in more)
            cost = (data.cost(world).ratio,) * 2
            labels = (ON_PLAIN, ON_MIXTURE)
            curves.append(charts.Curve(world, cost, means, labels, (1,), ends, named=False))
        title = f"{model}, recovered flow (ringed: fitted on the mixture)"
        y = "more error across the line of sight [% of the force]"
        made.append(charts.Panel(title, "mechanics, CPU over plain", y, tuple(curves)))
    return made


def _line(data: Found, flow: str, world: str, part: str) -> dict[str, str]:
    """One world for a table."""
    cells = {"world": world}
    for model in (RIDGE, NETWORK):
        cells[f"{model}: fitted on plain"] = _said(data.error(model, ON_PLAIN, flow, world, part))
        cells[f"{model}: more"] = _more(data, model, ON_PLAIN, flow, world, part)
        cells[f"{model}: on the mixture"] = _said(data.error(model, ON_MIXTURE, flow, world, part))
        cells[f"{model}: mixture less plain"] = _points(data.gained(model, flow, world, part))
    if flow == "recovered":
        cells[PHYSICS] = _said(data.error(PHYSICS, UNFITTED, flow, world, part))
    return cells


def _more(data: Found, model: str, fit: str, flow: str, world: str, part: str) -> str:
    same = WORLDS[world].against == world
    return "" if same else _points(data.more(model, fit, flow, world, part))


def _cost_rows(data: Found) -> Iterator[dict[str, Any]]:
    for world, one in data.ratios.items():
        yield {
            "world": world,
            "compared with": one.against,
            "CPU, times": _ends(f"{one.ratio:.2f}", one.low, one.high, ".2f"),
            "worst scene": f"{one.worst:.2f}",
            "scenes": one.scenes,
        }


def verdicts(data: Found) -> list[str]:
    """Per model, of the force across the line of sight on recovered flow; and the controls."""
    lines = []
    for model in (RIDGE, NETWORK):
        level = data.error(model, ON_PLAIN, "recovered", PLAIN, "across").mean
        hurt: list[str] = []
        not_told: list[str] = []
        mended: list[str] = []
        for world in WORLDS:
            if world in (PLAIN, STEEP):
                continue
            more = data.more(model, ON_PLAIN, "recovered", world, "across")
            gained = data.gained(model, "recovered", world, "across")
            (hurt if more.low > 0 else not_told).append(f"{world} ({100 * more.mean:+.0f})")
            if gained.high < 0:
                mended.append(f"{world} ({100 * gained.mean:+.0f})")
        at_home = data.gained(model, "recovered", PLAIN, "across")
        lines.append(
            f"{model}, fitted on plain tissue, errs across the line of sight by {100 * level:.0f}% of the "
            f"force there; by more (points) with {', '.join(hurt) or 'none'}; not told apart or less with "
            f"{', '.join(not_told) or 'none'}. The mixture errs less with {', '.join(mended) or 'none'}, and "
            f"{_points(at_home)} points on plain tissue."
        )
    nothing = [data.error(NOTHING, UNFITTED, "recovered", world, "whole").mean for world in WORLDS]
    shuffled = data.error(RIDGE, SHUFFLED, "recovered", PLAIN, "whole")
    lines.append(
        f"Controls: no force at all errs by {100 * min(nothing):.0f} to {100 * max(nothing):.0f}% in every "
        f"world; a ridge fitted on labels dealt out anew by {_said(shuffled)}."
    )
    return lines


def _said(one: Interval) -> str:
    return _ends(f"{100 * one.mean:.0f}%", 100 * one.low, 100 * one.high, ".0f")


def _points(one: Interval) -> str:
    return _ends(f"{100 * one.mean:+.0f}", 100 * one.low, 100 * one.high, "+.0f")


def _ends(said: str, low: float, high: float, form: str) -> str:
    return said if np.isnan(low) else f"{said} [{low:{form}}, {high:{form}}]"
