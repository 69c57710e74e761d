"""Comparison of losses: networks trained on ideal flow, over seeds, paired by sequence."""

import time
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import typer

from evidence import report, result_cache, result_status, training
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
        "rows": [row(name, loss_runs, runs["mse"]) for name, loss_runs in runs.items()],
    }


def page(data: Mapping[str, Any]) -> report.Page:
    """Means over sequences, and differences from squared error."""
    table = [
        {"loss": result["loss"], "runs": result["runs"], "pooled map R²": result["map_r2_pooled"]}
        | {METRICS[key].column: report.mean_cell(result[key]) for key in SCORES}
        for result in data["rows"]
    ]
    differences = [
        {"loss": result["loss"]}
        | {METRICS[key].column: report.mean_cell(result["against_mse"][key]) for key in SCORES}
        for result in data["rows"]
        if result["against_mse"]
    ]
    sections = [
        report.Section("Means over tested sequences, BCa intervals", table),
        report.Section("Difference from squared error, paired by sequences", differences),
    ]
    words = ("Networks of width 16 on a 64² grid, ideal flow, in equal steps on the same batches.",)
    return report.Page("Losses", data, words, sections)


def row(name: str, runs: Sequence[Mapping[str, Any]], base: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means of a loss's runs over tested sequences, and their differences from those of another loss."""
    pooled = float(np.mean([run["map_r2_pooled"] for run in runs]))
    cells: dict[str, Any] = {"loss": name, "runs": len(runs), "map_r2_pooled": pooled, "against_mse": {}}
    for key in SCORES:
        values, base_values = by_sequence(runs, key), by_sequence(base, key)
        cells[key] = mean_of(values)
        if runs is not base:
            cells["against_mse"][key] = difference(base_values, values)
    return cells


def by_sequence(runs: Sequence[Mapping[str, Any]], key: str) -> Floats:
    """A score of every tested sequence, sorted by name; means over the runs that tested it."""
    values: dict[str, list[float]] = {}
    for run in runs:
        for sequence in run["sequences"]:
            values.setdefault(sequence["name"], []).append(sequence.get(key, np.nan))
    return np.array([np.mean(values[name]) for name in sorted(values)], np.float64)


def carry_out(name: str, settings: TrainingSettings, clips: Sequence[Clip], cache: Path) -> dict[str, Any]:
    """Scores of a training on the first of three folds: `sequences`, `map_r2_pooled`, `train_cpu_s`.

    From `cache` if it has those of the same settings and data; an interrupted training continues.
    """
    split = training.split_nested(clips, 3, 0, 0)

    def compute() -> dict[str, Any]:
        start = time.process_time()
        predictor = training.fit(name, clips, split, settings, cache / "models")
        cpu_s = time.process_time() - start
        scores = evaluate(predictor, [clips[i] for i in split.test], "ideal")
        typer.echo(f"{name}: {cpu_s:.0f} CPU-s", err=True)
        pooled = scores.summary()["map_r2_pooled"]
        rows = [
            {"name": clip.name} | line for clip, line in zip(scores.clips, scores.per_clip(), strict=True)
        ]
        return {"sequences": rows, "map_r2_pooled": pooled, "train_cpu_s": cpu_s}

    key = result_cache.key(settings.model_dump(), [clip.content_hash for clip in clips])
    result: dict[str, Any] = result_cache.result(cache / "runs", name, key, compute)
    return result


STUDY = Study(
    measure,
    "learn/losses/losses.json",
    page,
    ("{mission} --cache {work}/losses",),
    needs=("mesh", "mechanics", "truth", "network"),
)
