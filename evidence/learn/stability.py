"""Divergence of trainings, and errors of a trained network with wrong motion and scale."""

from collections.abc import Mapping, Sequence
from dataclasses import replace as changed
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import typer
from scipy import ndimage

from evidence import report, status
from evidence.learn import labels
from evidence.learn.runs import JOB, Run, base_settings, carry_out, fit
from evidence.study import Study
from evidence.training import nested
from learn.data.clips import Clip
from learn.data.grid import Grid
from learn.evaluation.evaluate import EvaluationReport, evaluate
from learn.loss import Loss
from learn.settings import replace
from learn.split import Split
from synth.errors import UserError
from synth.job import reader

LOSSES: tuple[Loss, ...] = ("mse", "mse-frame", "off-target")
RATES = (5e-4, 2e-3, 1e-2, 5e-2)
NOISE = ((0.005, 0.0), (0.02, 0.0), (0.005, 1.0), (0.02, 1.0), (0.05, 1.0))
"""Size [mm] and blob scale [mm] of noise on the displacement."""


def measure(cache: Path, seeds: int = 5) -> dict[str, Any]:
    """Divergence by learning rate and loss, and errors with disturbed inputs."""
    clips = labels.clips(reader.load_job(str(JOB)), base_settings().grid, cache)
    split = nested(clips, 3, 0, 0)
    return {
        "data": status.data(JOB),
        "rates": rates(clips, cache, seeds),
        "disturbed": [row for name in LOSSES[::2] for row in disturbed(clips, split, name, cache)],
    }


def page(found: Mapping[str, Any]) -> report.Page:
    """Pooled R² of the map under each disturbance."""
    lines = {f"{row['trained with']}, {row['input']}": row["map R²"] for row in found["disturbed"]}
    known = {name: value for name, value in lines.items() if value is not None}
    chart = report.Chart("Disturbed input", "pooled R² of the map", report.bars(known))
    columns = ("trained with", "input", "map R²", "force R²", "off-target force [mN]")
    table = [{name: row[name] for name in columns} for row in found["disturbed"]]
    rates = found["rates"]
    words = (
        f"**{sum(row['diverged'] for row in rates)} of {sum(row['seeds'] for row in rates)} trainings "
        f"diverged** ({len(RATES)} learning rates, {len(LOSSES)} losses). Sequences of "
        "`../data/labels.yaml`, fold 0 of 3, 64² grid.",
    )
    return report.Page("Networks: limits", found, [chart], [report.Section("Disturbed input", table)], words)


def rates(clips: Sequence[Clip], cache: Path, seeds: int) -> list[dict[str, Any]]:
    """Rows by learning rate and loss; a run diverges if it stops with an error, or ends with R² below 0."""
    rows = []
    usual = base_settings()
    base = replace(usual, epochs=2, arch=replace(usual.arch, width=8, stem=4, levels=2))
    for rate, loss in product(RATES, LOSSES):
        scores = []
        for seed in range(seeds):
            settings = replace(base, learning_rate=rate, loss=loss, seed=seed)
            try:
                run = Run(f"rate{rate:g}-{loss}-seed{seed}", settings)
                scores.append(carry_out(run, clips, cache)["map_r2_pooled"])
            except UserError as stopped:
                typer.echo(str(stopped), err=True)
        diverged = seeds - sum(score > 0 for score in scores)
        row = {"learning rate": rate, "loss": loss, "seeds": seeds, "diverged": diverged}
        spread = float(np.std(scores, ddof=1)) if len(scores) > 1 else None
        rows.append(row | {"R², mean": float(np.mean(scores)) if scores else None, "spread (sd)": spread})
    return rows


def disturbed(clips: Sequence[Clip], split: Split, name: Loss, cache: Path) -> list[dict[str, Any]]:
    """Rows of the tested sequences with noise on the motion, a wrong scale, no motion."""
    predictor = fit(Run(f"{name}-fold0-seed0", replace(base_settings(), loss=name)), clips, cache)
    test, rng = [clips[i] for i in split.test], np.random.default_rng(3)
    rows = {"undisturbed": numbers(evaluate(predictor, test, "ideal"))}
    for sigma, patch in NOISE:
        changed_clips = [noisy(clip, sigma, patch, predictor.grid, rng) for clip in test]
        rows[f"noise {sigma:g} mm, blobs {patch:g} mm"] = numbers(evaluate(predictor, changed_clips, "ideal"))
    for factor in (0.8, 1.2):
        found = numbers(evaluate(predictor, [scaled(clip, factor) for clip in test], "ideal"))
        # The map is displaced against the true one: only the total force can be compared.
        rows[f"mm/px ×{factor:g}"] = found | {"map R²": None, "off-target force [mN]": None}
    # R² is undefined for a true force of zero.
    nothing = numbers(evaluate(predictor, [still(clip) for clip in test], "ideal"))
    rows["no motion"] = nothing | {"map R²": None, "force R²": None}
    return [{"trained with": name, "input": what} | row for what, row in rows.items()]


def numbers(found: EvaluationReport) -> dict[str, float | None]:
    """Metrics of a report for a row."""
    one = found.summary()
    return {
        "map R²": one["map_r2_pooled"],
        "force R²": one["force_r2_pooled"],
        "force MAE [mN]": one["force_mae"],
        "off-target force [mN]": one["off_target_mn"],
        "false positives": one["false_positive_relative"],
    }


def noisy(clip: Clip, sigma_mm: float, patch_mm: float, grid: Grid, rng: np.random.Generator) -> Clip:
    """The clip with Gaussian noise of `sigma_mm` a component on the displacement after the rest frame.

    `patch_mm` is the noise's spatial scale (standard deviation of its Gaussian filter); 0: independent cells.
    """
    noise = rng.normal(size=clip.displacement["ideal"].shape).astype(np.float32)
    if patch_mm > 0:
        blur = patch_mm / grid.pitch_mm
        noise = ndimage.gaussian_filter(noise, (0, 0, blur, blur)) * np.float32(2 * np.sqrt(np.pi) * blur)
    noise[0] = 0
    moved = clip.displacement["ideal"] + np.float32(sigma_mm) * noise * clip.mask
    return changed(clip, displacement={"ideal": moved})


def scaled(clip: Clip, factor: float) -> Clip:
    """The clip with a wrong scale: all lengths are multiplied by `factor`."""
    n = clip.mask.shape[0]
    node = (np.arange(n) - (n - 1) / 2) / factor + (n - 1) / 2
    at = np.meshgrid(node, node, indexing="ij")

    def zoomed(values: Any) -> Any:
        return ndimage.map_coordinates(values, at, order=1, mode="constant")

    mask = (zoomed(np.asarray(clip.mask)) > 0.5).astype(np.float32)
    moved = np.stack([[zoomed(part) for part in frame] for frame in clip.displacement["ideal"]])
    moved = (factor * moved * mask).astype(np.float32)
    return changed(clip, mask=mask, displacement={"ideal": moved})


def still(clip: Clip) -> Clip:
    """The clip without motion and load."""
    moved = {"ideal": 0 * np.asarray(clip.displacement["ideal"])}
    return changed(clip, density=0 * np.asarray(clip.density), force=0 * clip.force, displacement=moved)


STUDY = Study(measure, "learn/stability/stability.json", page, ("{work}/labels",))
