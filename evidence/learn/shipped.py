"""What the networks that come along err by in every world, and whether their intervals hold.

Run: python -m evidence.learn.shipped mission --model mono=MODEL --model stereo=MODEL --unseen mission-ood
With `--pack` they are written where the package looks for them, each with a card of these figures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from evidence import report, status
from evidence.curves.estimators import figures, map_figures
from evidence.curves.experiment import percent
from evidence.end_to_end import models
from learn.data.clips import load_clips, scored_source
from learn.evaluation.coverage import cover
from learn.inference import shipped
from learn.inference.predict import Predictor, load_model
from learn.split import unseen as never_met
from learn.training.threads import set_threads
from synth.errors import UserError

_LEVEL = 0.9
_LIMITS = (
    "Trained on rendered pictures alone; no recording of real tissue has been seen.",
    "Force is per Young's modulus: an error in that is the same error in the force.",
    "A membrane (pia) carries load that the surface doesn't show: sequences with one err most.",
)
_ONE_EYE = (
    "Along the line of sight one eye sees next to nothing; the interval there is wide.",
    "On recordings made with another finite-element code and another renderer it errs by more than the best "
    "physics beside it in `bench score` (docs/results/learn/foreign/monocular).",
)


def main(
    data: Path,
    model: Annotated[list[str], typer.Option(help="NAME=FOLDER; may be given again.")],
    unseen: Annotated[list[Path], typer.Option(help="Datasets of other worlds.")] = [],  # noqa: B006
    cache: Annotated[Path | None, typer.Option(help="Folder for packed arrays.")] = None,
    pack: Annotated[bool, typer.Option("--pack", help="Write mono and stereo into the package.")] = False,
    out: Path = report.RESULTS / "learn/shipped",
) -> None:
    """Errors and coverage of networks in the dataset `data`, that they were fitted on, and in others."""
    set_threads(1)
    rows = []
    for name, folder in (word.split("=", 1) for word in model):
        predictor = load_model(Path(folder))
        own = [_row(predictor, root, cache) for root in (data, *unseen)]
        rows += [{"model": name} | row for row in own]
        if pack and name in shipped.NAMES:
            limits = _LIMITS if predictor.card.settings.arch.depth else (*_LIMITS, *_ONE_EYE)
            shipped.pack_model(Path(folder), shipped.MODELS / name, report.commit(), _told(own), limits)
    found = {"data": status.data(data, *unseen), "rows": rows}
    report.save(out, "shipped.json", found, page(found))
    report.show(found)


def _row(predictor: Predictor, root: Path, cache: Path | None) -> dict[str, Any]:
    """What a model errs by on the sequences of a dataset that it has not met, and what its intervals hold."""
    source = scored_source(predictor.card.settings.input)
    every = load_clips(root, predictor.grid, (source,), cache=cache)
    clips = never_met(every, predictor.card)
    if not clips:
        raise UserError(f"{root}: the model has met every sequence")
    bare = [clip.membrane != "intact" for clip in clips]
    row: dict[str, Any] = {"asked": root.name, "sequences": len(clips)}
    answers = [partial(models.read_force, predictor, source=source, told=told) for told in (False, True)]
    row |= figures(answers[0], clips, bare)
    told = predictor.card.settings.arch.membrane
    row["told"] = figures(answers[1], clips, bare)["whole"] if told else None
    row |= map_figures(predictor, clips, source)
    held = next(one for one in cover(predictor, clips, source) if one.level == _LEVEL).as_dict()
    for part in ("size", "x", "y", "z"):
        row[f"held_{part}"] = [held[part][end] for end in ("mean", "low", "high")]
    return row | {key: held[key] for key in (*_WIDTHS, *_DISTANCES)}


def _told(own: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Figures for a card."""
    told = {}
    for row in own:
        where = f"{row['asked']}, {row['sequences']} sequences it never met"
        parts = {"error of the force": "whole", "told of the membrane": "told", "of its size": "force_size"}
        said = [f"{words} {percent(row[key])}" for words, key in parts.items() if row[key]]
        told[where] = "; ".join([*said, f"90% intervals hold for {percent(row['held_size'])} of frames"])
    return told


def page(found: Mapping[str, Any]) -> report.Page:
    """Errors, and what intervals hold, in every world."""
    errors = [
        {"model": row["model"], "asked": row["asked"], "sequences": row["sequences"]}
        | {name: percent(row.get(key)) for name, key in _ERRORS.items()}
        | {"map R²": row["map_r2"], "ghosts": row["ghosts"], "gain": row["gain"], "slope": row["slope"]}
        for row in found["rows"]
    ]
    held = [
        {"model": row["model"], "asked": row["asked"]}
        | {part: percent(row[f"held_{part}"]) for part in ("size", "x", "y", "z")}
        | {"width, of the peak": f"{row['width_of_peak']:.0%}"}
        | {"widths of x, y, z [mN]": ", ".join(f"{row[f'width_{axis}_mn']:.1f}" for axis in "xyz")}
        | {"frames of an unseen world": f"{row['out_of_distribution']:.0%}"}
        for row in found["rows"]
    ]
    sections = [
        report.Section("Errors", errors, (_ERRORS_ARE,)),
        report.Section("What 90% intervals hold", held, (_HELD_IS,)),
    ]
    words = ("Each is asked about sequences that it was never fitted, chosen or given intervals on.",)
    charts = [_chart(found["rows"], *which) for which in _CHARTS]
    return report.Page("The networks that come along", found, charts, sections, words)


def _chart(rows: Sequence[Mapping[str, Any]], title: str, key: str) -> report.Chart:
    known = {f"{row['model']}: {row['asked']}": row[key] for row in rows if row[key] is not None}
    lines = {name: [np.nan if v is None else v for v in values] for name, values in known.items()}
    ends = {name: (low, high) for name, (_, low, high) in lines.items()}
    return report.Chart(title, "share", report.bars({name: one[0] for name, one in lines.items()}, ends))


_CHARTS = (("Error of the force's size", "force_size"), ("Frames that a 90% interval holds", "held_size"))
_WIDTHS = ("width_mn", "width_of_peak", "width_x_mn", "width_y_mn", "width_z_mn")
_DISTANCES = ("out_of_distribution", "distance")
_PARTS = ("whole", "told", "across", "along", "force_size", "bare")
_ERRORS = {key.removeprefix("force_"): key for key in _PARTS}
_ERRORS_ARE = (
    "Root mean square error of the force as a part of the force's own, mean over sequences with its 95% "
    "interval; *told*: where the network is told whether there is a membrane; *bare*: sequences without one."
)
_HELD_IS = "Share of frames whose truth lies inside, mean over sequences; 90% was meant."


if __name__ == "__main__":
    typer.run(main)
