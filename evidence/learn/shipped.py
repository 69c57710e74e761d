"""Errors of the pretrained networks in and out of distribution, and the coverage of their intervals.

With `--pack` they are written into the package, each with a card of these figures.
"""

import shutil
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from evidence import report, status
from evidence.curves.experiment import figures
from evidence.end_to_end import models
from evidence.study import Study
from learn import checkpoint
from learn.checkpoint import ModelCard
from learn.data.clips import load_clips, scored_source
from learn.evaluation.coverage import cover
from learn.evaluation.evaluate import evaluate
from learn.inference import shipped
from learn.inference.convert import add_onnx
from learn.inference.predict import Predictor, load_model
from learn.split import unseen as held_out
from synth.errors import UserError
from synth.system.checked_file import write_whole

_LEVEL = 0.9
LARGEST_BYTES = 4_000_000  # of a file of a pretrained network
_LIMITS = (
    "Trained on rendered images alone, without recordings of real tissue.",
    "Force is proportional to Young's modulus and has at least its relative error.",
    "A membrane (pia) carries load that is not visible at the surface: errors are largest with a membrane.",
)
_MONOCULAR = (
    "The force along the line of sight is hardly visible with one camera; its interval is wide.",
    "On recordings made with another finite-element code and another renderer its error is about that of "
    "physics in `bench score` (docs/results/learn/foreign/monocular).",
)


def measure(
    data: list[Path], models: Path = shipped.MODELS, cache: Path | None = None, pack: bool = False
) -> dict[str, Any]:
    """Errors and coverage of networks on the first dataset, which they were fitted on, and on others.

    `models`: folder of mono and stereo; `cache`: folder for packed arrays; `pack`: write the networks into
    the package.
    """
    rows = []
    for name in shipped.NAMES:
        folder = models / name
        predictor = load_model(folder)
        own = [_row(predictor, root, cache) for root in data]
        rows += [{"model": name} | row for row in own]
        if pack:
            limits = _LIMITS if predictor.card.settings.arch.depth else (*_LIMITS, *_MONOCULAR)
            pack_model(folder, shipped.MODELS / name, report.commit(), listed(own), limits)
    return {"data": status.data(*data), "rows": rows}


def pack_model(
    model: Path, folder: Path, commit: str, metrics: Mapping[str, str], limits: Sequence[str]
) -> ModelCard:
    """Writes a pretrained network: weights.safetensors, config.json and a card, README.md.

    Args:
        model: folder of `learn train`.
        folder: of the pretrained network, `MODELS` and its name; replaced if it exists.
        commit: of the code that trained it.
        metrics: name and value of each measurement, with its unit.
        limits: known limits, a sentence each.

    Raises:
        UserError: the model is damaged, or larger than `LARGEST_BYTES`; nothing is written then.
    """
    net, card = checkpoint.read_model(model)
    shutil.rmtree(folder, ignore_errors=True)
    checkpoint.write_model(folder, card, net.state_dict())
    card = add_onnx(folder)
    line = shipped.describe(card)
    rows = {"data (hash of its sequences)": shipped.hash_data(card), "commit": commit, **metrics}
    table = "\n".join(f"| {what} | {value} |" for what, value in rows.items())
    bullets = "\n".join(f"- {one}" for one in limits)
    head = f"# {folder.name}\n\n{line[:1].upper()}{line[1:]}.\n\n| what | |\n| --- | --- |\n"
    write_whole(folder / "README.md", f"{head}{table}\n\nLimits:\n\n{bullets}\n".encode())
    size = max(file.stat().st_size for file in folder.iterdir())
    if size > LARGEST_BYTES:
        shutil.rmtree(folder)
        raise UserError(
            f"{model}: has a file of {size / 1e6:.1f} MB, at most {LARGEST_BYTES / 1e6:g} may be shipped; "
            "train it with a smaller arch.width"
        )
    return card


def _row(predictor: Predictor, root: Path, cache: Path | None) -> dict[str, Any]:
    """Errors and coverage of a model on the held-out sequences of a dataset."""
    source = scored_source(predictor.card.settings.input)
    every = load_clips(root, predictor.grid, (source,), cache=cache)
    clips = held_out(every, predictor.card)
    if not clips:
        raise UserError(f"{root}: no sequence was held out from the model's training")
    bare = [clip.membrane != "intact" for clip in clips]
    row: dict[str, Any] = {"data": root.name, "sequences": len(clips)}
    estimate = partial(models.read_force, predictor, source=source)
    row |= figures(estimate, clips, bare)
    row["membrane_known"] = None
    if predictor.card.settings.arch.membrane:
        row["membrane_known"] = figures(partial(estimate, membrane_known=True), clips, bare)["whole"]
    known = evaluate(predictor, clips, source).summary()
    row["map_r2"] = round(known["map_r2_pooled"], 4)
    row["false_positives"] = round(known["false_positive_relative"], 5)
    covered = next(one for one in cover(predictor, clips, source) if one.level == _LEVEL).as_dict()
    for part in ("size", "x", "y", "z"):
        row[f"covered_{part}"] = [covered[part][end] for end in ("mean", "low", "high")]
    return row | {key: covered[key] for key in _WIDTHS}


def listed(own: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Figures for a model's card, by dataset."""
    lines = {}
    for row in own:
        errors = [f"{words} {report.percent(row[key])}" for words, key in _LISTED.items() if row[key]]
        coverage = f"coverage of 90% intervals {report.percent(row['covered_size'])}"
        lines[f"{row['data']}, {row['sequences']} held-out sequences"] = "; ".join([*errors, coverage])
    return lines


def page(found: Mapping[str, Any]) -> report.Page:
    """Errors and coverage, for every model and dataset."""
    errors = [
        {"model": row["model"], "data": row["data"], "sequences": row["sequences"]}
        | {name: report.percent(row.get(key)) for name, key in _ERRORS.items()}
        | {"map R²": row["map_r2"], "false positives": row["false_positives"]}
        | {"gain": row["gain"], "slope": row["slope"]}
        for row in found["rows"]
    ]
    covered = [
        {"model": row["model"], "data": row["data"]}
        | {part: report.percent(row[f"covered_{part}"]) for part in ("size", "x", "y", "z")}
        | {"width, of the peak": f"{row['width_of_peak']:.0%}"}
        | {"widths of x, y, z [mN]": ", ".join(f"{row[f'width_{axis}_mn']:.1f}" for axis in "xyz")}
        | {"frames out of distribution": f"{row['out_of_distribution']:.0%}"}
        for row in found["rows"]
    ]
    sections = [
        report.Section("Errors", errors, (_ERRORS_ARE,)),
        report.Section("Coverage of 90% intervals", covered, (_COVERED_IS,)),
    ]
    worst = ", ".join(
        f"{report.percent(row['whole'])} with {row['model']} on {row['data']}" for row in found["rows"]
    )
    words = (f"**Error of the force: {worst}.** All sequences are held out from training and calibration.",)
    charts = []
    for title, key in _CHARTS:
        known = {f"{row['model']}: {row['data']}": np.array(row[key], float) for row in found["rows"]}
        bars = tuple(report.Row(name, mean, (low, high)) for name, (mean, low, high) in known.items())
        charts.append(report.Chart(title, "share", bars))
    return report.Page("The pretrained networks", found, charts, sections, words)


_CHARTS = (("Error of the force's size", "force_size"), ("Coverage of 90% intervals", "covered_size"))
_WIDTHS = (
    *(f"width_{one}" for one in ("mn", "of_peak", "x_mn", "y_mn", "z_mn")),
    "out_of_distribution",
    "distance",
)
_LISTED = {"error of the force": "whole", "membrane known": "membrane_known", "of its size": "force_size"}
_PARTS = ("whole", "membrane_known", "across", "along", "force_size", "bare")
_ERRORS = {key.removeprefix("force_").replace("_", " "): key for key in _PARTS}
_ERRORS_ARE = (
    "Root mean square error relative to that of the force, mean over sequences with its 95% interval; "
    "*membrane known*: with presence or absence of a membrane as input; *bare*: sequences without one; "
    "*false positives*: share of contact-free area with a force."
)
_COVERED_IS = "Share of frames whose true force lies inside, mean over sequences; nominal 90%."


STUDY = Study(measure, "learn/shipped/shipped.json", page, ("{mission} {mission-ood} --cache {work}/clips",))
