"""Errors of the pretrained networks in and out of distribution, and the coverage of their intervals."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from evidence import report, result_status
from evidence.curves import models
from evidence.curves.experiment import figures
from evidence.study import STEREO_MOTION, Study
from learn.data.clips import load_clips, scored_source
from learn.evaluation.coverage import cover
from learn.evaluation.evaluate import evaluate
from learn.inference import shipped_networks
from learn.inference.predict import Predictor, load_model
from learn.split import keep_unseen
from synth.errors import UserError

_LEVEL = 0.9


def measure(
    data: list[Path], models: Path = shipped_networks.MODELS, cache: Path | None = None
) -> dict[str, Any]:
    """Errors and coverage of networks on the first dataset, which they were fitted on, and on others.

    `models`: folder of the networks by name; `cache`: folder for packed arrays.
    """
    rows = []
    for name in shipped_networks.NAMES:
        predictor = load_model(models / name)
        rows += [{"model": name} | _row(predictor, root, cache) for root in data]
    return {"data": result_status.data(*data), "rows": rows}


def _row(predictor: Predictor, root: Path, cache: Path | None) -> dict[str, Any]:
    """Errors and coverage of a model on the held-out sequences of a dataset."""
    source = scored_source(predictor.card.settings.input)
    candidates = load_clips(root, predictor.grid, (source,), cache=cache)
    clips = keep_unseen(candidates, predictor.card)
    if not clips:
        raise UserError(f"{root}: no sequence was held out from the model's training")
    bare = [clip.membrane != "intact" for clip in clips]
    row: dict[str, Any] = {"data": root.name, "sequences": len(clips)}
    estimate = partial(models.read_force, predictor, source=source)
    row |= figures(estimate, clips, bare)
    row["membrane_known"] = None
    if predictor.card.settings.arch.membrane:
        row["membrane_known"] = figures(partial(estimate, membrane_known=True), clips, bare)["whole"]
    summary = evaluate(predictor, clips, source).summary()
    row["map_r2"] = round(summary["map_r2_pooled"], 4)
    row["false_positives"] = round(summary["false_positive_relative"], 5)
    coverage = next(entry for entry in cover(predictor, clips, source) if entry.level == _LEVEL).as_dict()
    for part in ("size", "x", "y", "z"):
        row[f"covered_{part}"] = [coverage[part][end] for end in ("mean", "low", "high")]
    return row | {key: coverage[key] for key in _WIDTHS}


def list_figures(rows: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Figures for a model's card, by dataset."""
    lines = {}
    for row in rows:
        errors = [f"{words} {report.percent(row[key])}" for words, key in _LISTED.items() if row[key]]
        coverage = f"coverage of 90% intervals {report.percent(row['covered_size'])}"
        lines[f"{row['data']}, {row['sequences']} held-out sequences"] = "; ".join([*errors, coverage])
    return lines


def page(data: Mapping[str, Any]) -> report.Page:
    """Errors and coverage, for every model and dataset."""
    errors = [
        {"model": row["model"], "data": row["data"], "sequences": row["sequences"]}
        | {name: report.percent(row.get(key)) for name, key in _ERRORS.items()}
        | {"map R²": row["map_r2"], "false positives": row["false_positives"]}
        | {"gain": row["gain"], "slope": row["slope"]}
        for row in data["rows"]
    ]
    coverage = [
        {"model": row["model"], "data": row["data"]}
        | {part: report.percent(row[f"covered_{part}"]) for part in ("size", "x", "y", "z")}
        | {"width, of the peak": f"{row['width_of_peak']:.0%}"}
        | {"widths of x, y, z [mN]": ", ".join(f"{row[f'width_{axis}_mn']:.1f}" for axis in "xyz")}
        | {"frames out of distribution": f"{row['out_of_distribution']:.0%}"}
        for row in data["rows"]
    ]
    sections = [
        report.Section("Errors", errors, (_ERRORS_ARE,)),
        report.Section("Coverage of 90% intervals", coverage, (_COVERED_IS,)),
    ]
    worst = ", ".join(
        f"{report.percent(row['whole'])} with {row['model']} on {row['data']}" for row in data["rows"]
    )
    words = (f"**Error of the force: {worst}.** All sequences are held out from training and calibration.",)
    parts = [
        (title, "share", {f"{row['model']}: {row['data']}": row[key] for row in data["rows"]})
        for title, key in _CHARTS
    ]
    return report.Page("The pretrained networks", data, words, sections, report.interval_charts(*parts))


_CHARTS = (("Error of the force's size", "force_size"), ("Coverage of 90% intervals", "covered_size"))
_WIDTHS = (
    *(f"width_{suffix}" for suffix in ("mn", "of_peak", "x_mn", "y_mn", "z_mn")),
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


STUDY = Study(
    measure,
    "learn/shipped/shipped.json",
    page,
    ("{mission} {mission-ood} --cache {work}/clips",),
    needs=(*STEREO_MOTION, "network"),
)
