"""Generalisation of a force estimator over the mechanics of living tissue: membrane, pulse, slip.

Ridge is fitted on plain tissue and tested in every other condition, on scenes with other anatomies; then the
same after fitting on the mixture of all. Each condition is compared with the plain one on the same scenes.

Run: python -m evidence.mechanics.experiment --fit 14 --test 4 --out runs/mechanics
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from joblib import Parallel, delayed

from evidence import report
from evidence.end_to_end import models
from evidence.end_to_end.models import RIDGE, Estimate
from evidence.mechanics.conditions import CONDITIONS, MIXTURE, PLAIN, Scenes, coarse, rendered
from learn.data.clips import Clip
from learn.evaluation.statistics import Interval, interval, paired

ON_PLAIN, ON_MIXTURE = "plain", "mixture"
PARTS = {"across": "the force across the line of sight", "whole": "the force"}
Errors = list[float | None]  # of every sequence [%]; None: refused


def main(
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = report.RESULTS / "mechanics",
    work: Annotated[Path, typer.Option(help="Folder of sequences; a later run continues.")] = Path(
        "runs/mechanics-work"
    ),
    fit: Annotated[int, typer.Option(min=14, help="Sequences to fit on, plain and mixture each.")] = 35,
    test: Annotated[int, typer.Option(min=3, help="Sequences to test on, in every condition.")] = 12,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")] = 41,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
) -> None:
    """Error of a force estimator fitted on plain tissue, with other mechanics."""
    fitted, tested = Scenes(seed, fit, work), Scenes(seed + 1, test, work)
    wanted = [(tested, one, k) for name in CONDITIONS for one in rendered(name) for k in range(test)]
    wanted += [(fitted, name, k) for k in range(fit) for name in (PLAIN, mixed(k))]
    wanted = list(dict.fromkeys(wanted))
    made = Parallel(workers, verbose=5)(delayed(scenes.make)(name, k) for scenes, name, k in wanted)
    found = {
        "seed": seed,
        "fitted": {"sequences": fit, "mixture": MIXTURE},
        "refused": sorted(
            f"{name}, seed {scenes.seed}, sequence {k}: {why}"
            for (scenes, name, k), why in zip(wanted, made, strict=True)
            if why
        ),
        "rows": measure(fitted, tested),
    }
    shown = {one.heading: one.rows for one in page(found).sections if one.rows}
    report.publish(out, "results.json", found, page, shown)


def mixed(index: int) -> str:
    """The condition of a sequence of the mixture: each in turn."""
    return MIXTURE[index % len(MIXTURE)]


def measure(fitted: Scenes, tested: Scenes) -> list[dict[str, Any]]:
    """A row for each fit and condition: errors by sequence, relative to the force [%]."""
    tests = {name: [tested.clip(name, k) for k in range(tested.count)] for name in CONDITIONS}
    rows = []
    for fit in (ON_PLAIN, ON_MIXTURE):
        clips = [fitted.clip(mixed(k) if fit == ON_MIXTURE else PLAIN, k) for k in range(fitted.count)]
        estimate = build([clip for clip in clips if clip is not None])
        rows += [
            {"model": RIDGE, "fit": fit, "condition": name} | _errors(estimate, some)
            for name, some in tests.items()
        ]
    return rows


def build(fit: Sequence[Clip]) -> Estimate:
    """Ridge on cells of twice the size, which suffice for a linear rule."""
    ridge = models.build(RIDGE, [coarse(clip) for clip in fit])
    return lambda clip: ridge(coarse(clip))


def _errors(estimate: Estimate, clips: Sequence[Clip | None]) -> dict[str, Errors]:
    found: dict[str, Errors] = {part: [] for part in PARTS}
    for clip in clips:
        off = None if clip is None else models.errors([estimate(clip)], [clip.force])
        for part, values in found.items():
            name = "errors" if part == "whole" else part
            values.append(None if off is None else round(100 * off[name][0], 1))
    return found


def page(found: Mapping[str, Any]) -> report.Page:
    """Errors of ridge fitted on plain tissue and fitted on the mixture, in each condition."""
    rows = {(row["model"], row["fit"], row["condition"]): row for row in found["rows"]}
    bars, sections, hurt = [], [], []
    for part, what in PARTS.items():
        plain, table = rows[RIDGE, ON_PLAIN, PLAIN][part], []
        for name in CONDITIONS:
            own, mixture = (rows[RIDGE, on, name][part] for on in (ON_PLAIN, ON_MIXTURE))
            table.append(
                {
                    "condition": name,
                    "fitted on plain [%]": _cell(interval(_array(own), np.random.default_rng(0))),
                    "difference from plain": None if name == PLAIN else _cell(_more(plain, own), "+"),
                    "fitted on mixture, difference": _cell(_more(own, mixture), "+"),
                }
            )
            for group, values in enumerate((own, mixture) if part == "across" else ()):
                more, on = _more(plain, values), ("plain", "the mixture")[group]
                bars.append(report.Row(f"{name}, fitted on {on}", more.mean, (more.low, more.high), group))
                if more.low > 0 and group == 0:
                    hurt.append(f"{name} ({more.mean:+.0f} points)")
        sections.append(report.Section(f"Error of {what}", table))
    refused = [f"- {line}" for line in found["refused"]]
    return report.Page(
        "Mechanics: generalisation of a force estimator",
        found,
        [
            report.Chart(
                "Error across the line of sight", "difference from plain [% of the force]", tuple(bars)
            )
        ],
        [*sections, *([report.Section("Refused", words=refused)] if refused else [])],
        (
            "**After fitting on plain tissue the error across the line of sight is larger with "
            f"{'; '.join(hurt) or 'none of the conditions'}.**",
            "Conditions differ in mechanics alone: anatomy, contact, load and appearance are the same. Error "
            "of ridge on recovered flow: root mean square relative to that of the force, mean over "
            "sequences; differences are paired, intervals BCa. *Removed*: the tissue's own motion is "
            "subtracted exactly. Default jobs are plain; `mission` mixes membrane, slip and ν.",
        ),
    )


def _array(values: Errors) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Errors as an array, NaN for a refused sequence."""
    return np.array([np.nan if value is None else value for value in values])


def _more(usual: Errors, other: Errors) -> Interval:
    return paired(_array(usual), _array(other), np.random.default_rng(0)).difference


def _cell(one: Interval, sign: str = "") -> str:
    return report.mean_cell([one.mean, one.low, one.high], f"{sign}.0f")


if __name__ == "__main__":
    typer.run(main)
