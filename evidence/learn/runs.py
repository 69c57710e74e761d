"""Comparison of losses: networks trained on ideal flow, over seeds, paired by sequence."""

import time
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import typer

from evidence import report, result_status, training
from evidence import result_cache as stored
from evidence.paired_means import difference, mean_of
from evidence.study import Study
from learn.data.clips import Clip, load_clips
from learn.evaluation.evaluate import evaluate
from learn.evaluation.metrics import METRICS
from learn.settings import TrainingSettings, preset, replace
from synth.arrays import Floats

LOSSES = ("mse", "antighost", "off-target")
SCORES = (
    "map_r2",
    "map_rmse",
    "force_mae",
    "false_positive_relative",
    "off_target_mn",
    "low_over_mn",
    "localisation_mm",
)
"""Metrics of a tested sequence; see `learn.evaluation.metrics`."""


def base_settings() -> TrainingSettings:
    """Training settings common to all comparisons, about a core-minute."""
    base = preset("tiny", epochs=8, loss="mse")
    return replace(base, arch=replace(base.arch, output="magnitude"))


def measure(
    dataset: Path, cache: Path = Path("runs/losses"), seeds: int = 3, epochs: int = 8
) -> dict[str, Any]:
    """Trains with every loss; `cache` gets packed sequences and networks, and completed runs are reused."""
    clips = load_clips(dataset, base_settings().grid, ("ideal",), cache=cache)
    runs: dict[str, list[dict[str, Any]]] = {}
    for loss, seed in product(LOSSES, range(seeds)):
        settings = replace(base_settings(), loss=loss, seed=seed, epochs=epochs)
        runs.setdefault(loss, []).append(carry_out(f"{loss}-seed{seed}", settings, clips, cache))
    return {
        "data": result_status.data(dataset),
        "rows": [row(name, own, runs["mse"]) for name, own in runs.items()],
    }


def page(found: Mapping[str, Any]) -> report.Page:
    """Means over sequences, and differences from squared error."""
    table = [
        {"loss": one["loss"], "runs": one["runs"], "pooled map R²": one["map_r2_pooled"]}
        | {METRICS[key].column: report.mean_cell(one[key]) for key in SCORES}
        for one in found["rows"]
    ]
    less = [
        {"loss": one["loss"]}
        | {METRICS[key].column: report.mean_cell(one["against_mse"][key]) for key in SCORES}
        for one in found["rows"]
        if one["against_mse"]
    ]
    sections = [
        report.Section("Means over tested sequences, BCa intervals", table),
        report.Section("Difference from squared error, paired by sequences", less),
    ]
    words = ("Networks of width 16 on a 64² grid, ideal flow, in equal steps on the same batches.",)
    return report.Page("Losses", found, words, sections)


def row(name: str, runs: Sequence[Mapping[str, Any]], base: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means of a loss's runs over tested sequences, and their differences from those of another loss."""
    pooled = float(np.mean([run["map_r2_pooled"] for run in runs]))
    found: dict[str, Any] = {"loss": name, "runs": len(runs), "map_r2_pooled": pooled, "against_mse": {}}
    for key in SCORES:
        own, other = by_sequence(runs, key), by_sequence(base, key)
        found[key] = mean_of(own)
        if runs is not base:
            found["against_mse"][key] = difference(other, own)
    return found


def by_sequence(runs: Sequence[Mapping[str, Any]], key: str) -> Floats:
    """A score of every tested sequence, sorted by name; means over the runs that tested it."""
    values: dict[str, list[float]] = {}
    for run in runs:
        for one in run["sequences"]:
            values.setdefault(one["name"], []).append(one.get(key, np.nan))
    return np.array([np.mean(values[name]) for name in sorted(values)], np.float64)


def carry_out(name: str, settings: TrainingSettings, clips: Sequence[Clip], cache: Path) -> dict[str, Any]:
    """Scores of a training on the first of three folds: `sequences`, `map_r2_pooled`, `train_cpu_s`.

    From `cache` if it has those of the same settings and data; an interrupted training continues.
    """
    split = training.nested(clips, 3, 0, 0)

    def compute() -> dict[str, Any]:
        began = time.process_time()
        predictor = training.fit(name, clips, split, settings, cache / "models")
        spent = time.process_time() - began
        scores = evaluate(predictor, [clips[i] for i in split.test], "ideal")
        typer.echo(f"{name}: {spent:.0f} CPU-s", err=True)
        pooled = scores.summary()["map_r2_pooled"]
        rows = [{"name": c.name} | one for c, one in zip(scores.clips, scores.per_clip(), strict=True)]
        return {"sequences": rows, "map_r2_pooled": pooled, "train_cpu_s": spent}

    key = stored.key(settings.model_dump(), [clip.content_hash for clip in clips])
    done: dict[str, Any] = stored.result(cache / "runs", name, key, compute)
    return done


STUDY = Study(
    measure,
    "learn/losses/losses.json",
    page,
    ("{mission} --cache {work}/losses",),
    needs=("mesh", "mechanics", "truth", "network"),
)
