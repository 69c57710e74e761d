"""Which of a living brain's mechanics must a force estimator have been fitted on?

Ridge is fitted on the plain world and asked for the force in every other, of scenes with anatomies that were
never fitted; then fitted on the mixture of all and asked again. A world is compared with the plain one on the
same scenes, so that what differs is the world.

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
from evidence.end_to_end.models import RIDGE, Answer
from evidence.mechanics.conditions import MIXTURE, PLAIN, WORLDS, Scenes, coarse, rendered
from learn.data.clips import Clip
from learn.evaluation.statistics import Interval, interval, paired

ON_PLAIN, ON_MIXTURE = "plain", "mixture"
PARTS = {"across": "the force across the line of sight", "whole": "the force"}
Errors = list[float | None]
"""Of every sequence [%]; None: it was refused."""


def main(
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = report.RESULTS / "mechanics",
    work: Annotated[Path, typer.Option(help="Folder for sequences, to go on from.")] = Path(
        "runs/mechanics-work"
    ),
    fit: Annotated[int, typer.Option(min=14, help="Sequences to fit on, of each of the two.")] = 35,
    test: Annotated[int, typer.Option(min=3, help="Sequences that are asked in every world.")] = 12,
    seed: Annotated[int, typer.Option(min=0, help="Root of every draw.")] = 41,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
) -> None:
    """What a force estimator fitted on plain tissue errs in other mechanics."""
    fitted, asked = Scenes(seed, fit, work), Scenes(seed + 1, test, work)
    wanted = [(asked, one, k) for name in WORLDS for one in rendered(name) for k in range(test)]
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
        "rows": ask(fitted, asked),
    }
    report.save(out, "results.json", found, page(found))
    report.show({one.heading: one.rows for one in page(found).sections if one.rows})


def mixed(index: int) -> str:
    """The world of a sequence of the mixture: each in turn."""
    return MIXTURE[index % len(MIXTURE)]


def ask(fitted: Scenes, asked: Scenes) -> list[dict[str, Any]]:
    """A row a fit of ridge and world: errors by sequence, as a part of the force [%]."""
    tests = {name: [asked.clip(name, k) for k in range(asked.count)] for name in WORLDS}
    rows = []
    for fit in (ON_PLAIN, ON_MIXTURE):
        clips = [fitted.clip(mixed(k) if fit == ON_MIXTURE else PLAIN, k) for k in range(fitted.count)]
        answer = build([clip for clip in clips if clip is not None])
        rows += [
            {"model": RIDGE, "fit": fit, "world": name} | _errors(answer, some)
            for name, some in tests.items()
        ]
    return rows


def build(fit: Sequence[Clip]) -> Answer:
    """Ridge; it reads cells of twice the size, enough for a linear rule."""
    ridge = models.build(RIDGE, [coarse(clip) for clip in fit])
    return lambda clip: ridge(coarse(clip))


def _errors(answer: Answer, clips: Sequence[Clip | None]) -> dict[str, Errors]:
    found: dict[str, Errors] = {part: [] for part in PARTS}
    for clip in clips:
        off = None if clip is None else models.errors([answer(clip)], [clip.force])
        for part, values in found.items():
            name = "errors" if part == "whole" else part
            values.append(None if off is None else round(100 * off[name][0], 1))
    return found


def page(found: Mapping[str, Any]) -> report.Page:
    """What each world costs ridge that never met it, and ridge fitted on the mixture."""
    rows = {(row["model"], row["fit"], row["world"]): row for row in found["rows"]}
    bars, sections, hurt = [], [], []
    for part, what in PARTS.items():
        plain, table = rows[RIDGE, ON_PLAIN, PLAIN][part], []
        for world in WORLDS:
            own, mixture = (rows[RIDGE, on, world][part] for on in (ON_PLAIN, ON_MIXTURE))
            table.append(
                {
                    "world": world,
                    "fitted on plain [%]": _cell(_mean(own)),
                    "more than in plain": None if world == PLAIN else _cell(_more(plain, own), "+"),
                    "mixture less plain": _cell(_more(own, mixture), "+"),
                }
            )
            for group, values in enumerate((own, mixture) if part == "across" else ()):
                more, on = _more(plain, values), ("plain", "the mixture")[group]
                bars.append(report.Row(f"{world}, fitted on {on}", more.mean, (more.low, more.high), group))
                if more.low > 0 and group == 0:
                    hurt.append(f"{world} ({more.mean:+.0f} points)")
        sections.append(report.Section(f"Error of {what}", table))
    refused = [f"- {line}" for line in found["refused"]]
    return report.Page(
        "Which mechanics must a force estimator have seen?",
        found,
        [report.Chart("Error across the line of sight", "more than in plain [% of the force]", tuple(bars))],
        [*sections, *([report.Section("Refused", words=refused)] if refused else [])],
        (
            "**Fitted on plain tissue, a reader errs more across the line of sight with "
            f"{'; '.join(hurt) or 'none'}.**",
            "A sequence of every world shows the same anatomy, contact, load and look as the plain one of "
            "its number, with other mechanics. Error of ridge on recovered flow: root mean square over "
            "frames as a part of the force's own, mean over sequences; differences are paired, intervals "
            "BCa over sequences. *Taken off*: the tissue's own motion is subtracted as it was, which no "
            "removal does better. Default jobs are plain; `mission` mixes membrane, slip and ν.",
        ),
    )


def _array(values: Errors) -> np.ndarray[Any, np.dtype[np.float64]]:
    """NaN for a sequence that was refused."""
    return np.array([np.nan if value is None else value for value in values])


def _mean(values: Errors) -> Interval:
    return interval(_array(values), np.random.default_rng(0))


def _more(usual: Errors, other: Errors) -> Interval:
    return paired(_array(usual), _array(other), np.random.default_rng(0)).difference


def _cell(one: Interval, sign: str = "") -> str:
    mean, low, high = (f"{value:{sign}.0f}" for value in (one.mean, one.low, one.high))
    return mean if np.isnan(one.low) else f"{mean} [{low}, {high}]"


if __name__ == "__main__":
    typer.run(main)
