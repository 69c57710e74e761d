"""`bench experiment shipped`: what the networks that come along err by in every world; do they say so?

With `--pack` they are written where the package looks for them, each with a card of these figures.
"""

from __future__ import annotations

import subprocess
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from bench.output import charts, result_page
from evidence.curves.experiment import with_intervals
from evidence.curves.page import percent
from evidence.curves.readers import figures, map_figures
from evidence.end_to_end import models
from evidence.measuring import CHECKOUT, measuring
from learn.data.clips import load_clips, scored
from learn.evaluation.coverage import cover
from learn.evaluation.evaluate import unseen as never_met
from learn.inference import shipped
from learn.inference.predict import Predictor, load_predictor
from learn.training.threads import set_threads
from synth.dataset.store import Dataset
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
    "physics beside it in `bench score` (docs/results/learn/foreign/one-eye).",
)


@measuring(
    "mission --model mono=model --unseen mission-unseen",
    out="docs/results/learn/shipped",
    file="shipped.json",
    page=lambda found, folder: result_page.write(drawn(found), folder),
    text="README.md",
)
def experiment(
    data: Annotated[Path, typer.Argument(help="Dataset that the models were trained on.")],
    model: Annotated[list[str], typer.Option(help="NAME=FOLDER; may be given again.")],
    unseen: Annotated[
        list[Path] | None, typer.Option(help="Datasets of other worlds; may be given again.")
    ] = None,
    cache: Annotated[Path | None, typer.Option(help="Folder for packed arrays.")] = None,
    pack: Annotated[
        bool, typer.Option("--pack", help="Write mono and stereo where the package looks for them.")
    ] = False,
) -> dict[str, Any]:
    """Errors and coverage of trained networks in every world; optionally packs them to come along."""
    set_threads(1)
    rows = []
    for said in model:
        name, _, folder = said.partition("=")
        if not name or not folder:
            raise UserError(f"--model {said}: NAME=FOLDER")
        predictor = load_predictor(Path(folder))
        own = [_row(predictor, root, cache) for root in (data, *(unseen or ()))]
        rows += [{"model": name} | row for row in own]
        if pack and name in shipped.NAMES:
            two = predictor.card.settings.arch.depth
            limits = _LIMITS if two else (*_LIMITS, *_ONE_EYE)
            shipped.pack_model(Path(folder), shipped.MODELS / name, _commit(), _told(own), limits)
    return {"rows": rows}


def _commit() -> str:
    """Of the checkout; what isn't committed counts as its last one, with a sign."""
    done = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=CHECKOUT, capture_output=True, text=True, check=False
    )
    return done.stdout.strip() or "unknown"


def _row(predictor: Predictor, root: Path, cache: Path | None) -> dict[str, Any]:
    """What a model errs by on the sequences of a dataset that it has not met, and what its intervals hold."""
    source = scored(predictor.card.settings.input)
    every = load_clips(root, predictor.grid, (source,), cache=cache)
    clips = never_met(every, predictor.card)
    if not clips:
        raise UserError(f"{root}: the model has met every sequence")
    membrane = {
        one.attrs["content_hash"]: bool((one.attrs.get("scenario") or {}).get("tissue", {}).get("membrane"))
        for one in Dataset(root)
    }
    bare = [not membrane[clip.content_hash] for clip in clips]
    vector = predictor.card.settings.arch.output == "vector"
    row = {"asked": root.name, "sequences": len(clips)}
    row |= figures(partial(models.read_force, predictor, source=source), clips, bare, size_only=not vector)
    row |= map_figures(predictor, clips, source)
    held = next(one for one in cover(predictor, clips, source) if one.level == _LEVEL).as_dict()
    for part in ("size", "x", "y", "z", "contact"):
        row |= {f"held_{part}": held[part]["mean"]}
        row |= {f"held_{part}_{end}": held[part][end] for end in ("low", "high")}
    return with_intervals(row) | {key: held[key] for key in _WIDTHS}


def _told(own: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Figures for a card."""
    told = {}
    for row in own:
        where = f"{row['asked']}, {row['sequences']} sequences it never met"
        parts = {"error of the force": "whole", "of its size": "force_size"}
        said = [f"{words} {cell}" for words, key in parts.items() if (cell := percent(row, key))]
        told[where] = "; ".join([*said, f"90% intervals hold for {percent(row, 'held_size')} of frames"])
    return told


def drawn(found: Mapping[str, Any]) -> result_page.Page:
    """What `shipped.json` says."""
    tables = [
        {
            "model": row["model"],
            "asked": row["asked"],
            "sequences": row["sequences"],
            **{name: percent(row, key) for name, key in _ERRORS.items()},
            "map R²": row["map_r2"],
            "ghosts": row["ghosts"],
            "gain": row["gain"],
            "slope": row["slope"],
        }
        for row in found["rows"]
    ]
    held = [
        {
            "model": row["model"],
            "asked": row["asked"],
            **{part: percent(row, f"held_{part}") for part in ("size", "x", "y", "z", "contact")},
            "width, of the peak": f"{100 * row['width_of_peak']:.0f}%",
            "widths of x, y, z [mN]": ", ".join(f"{row[f'width_{axis}_mn']:.1f}" for axis in "xyz"),
            "frames of an unseen world": f"{100 * row['unseen']:.0f}%",
        }
        for row in found["rows"]
    ]
    return result_page.Page(
        "The networks that come along",
        found,
        [_chart(found["rows"], *which) for which in _CHARTS],
        [
            result_page.Section("Errors", tables, (_ERRORS_ARE,)),
            result_page.Section("What 90% intervals hold", held, (_HELD_IS,)),
        ],
        ("Each is asked about sequences that it was never fitted, chosen or given intervals on.",),
        name="README.md",
    )


def _chart(rows: Sequence[Mapping[str, Any]], title: str, key: str) -> charts.Chart:
    lines = []
    for row in rows:
        if row[key] is not None:
            mean, low, high = (np.nan if value is None else value for value in row[key])
            lines.append(charts.Row(f"{row['model']}: {row['asked']}", mean, (low, high)))
    return charts.Chart(title, "part of the force" if key == "force_size" else "share", tuple(lines))


_CHARTS = (("Error of the force's size", "force_size"), ("Frames that a 90% interval holds", "held_size"))
_WIDTHS = ("width_mn", "width_of_peak", "width_x_mn", "width_y_mn", "width_z_mn", "unseen", "distance")
_ERRORS = {"whole": "whole", "across": "across", "along": "along", "size": "force_size", "bare": "bare"}
_ERRORS_ARE = (
    "Root mean square error of the force as a part of the force's own, mean over sequences with its 95% "
    "interval; *bare*: the sequences without a membrane."
)
_HELD_IS = (
    "Share of frames (*contact*: of cells that carry force) whose truth lies inside, mean over sequences; "
    "90% was meant."
)
