"""Training runs as data: (clips, split, settings) → one JSON of per-sequence scores, kept and reused."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from evidence.learn.coarse_rmse import CELLS, wide_rmse
from evidence.learn.controls import beyond_mean_map, controls, mean_map
from learn.data.clips import Clip
from learn.data.split import nested
from learn.evaluation.evaluate import evaluate
from learn.inference.predict import Predictor, load_predictor
from learn.inference.stiffness import stiffness
from learn.settings import Settings
from learn.training.train import train

PRESSES = 30
"""Tested sequences that get a calibration press: each costs as much as a sequence."""


@dataclass(frozen=True)
class Run:
    """One training run and the question it is asked."""

    name: str
    settings: Settings
    source: str = "ideal"
    """Displacement it is tested on."""
    control: str = ""
    """`shuffled`: the fitted frames' targets are dealt out anew among them; empty: they are not."""
    controlled: bool = True
    """Whether controls are scored too: of a further network on the same sequences they say nothing new."""


def carry_out(
    run: Run,
    clips: Sequence[Clip],
    folder: Path,
    models: Path,
    say: Callable[[str], None],
    presses: Callable[[int], Clip] | None = None,
) -> dict[str, Any]:
    """The run's scores on its test fold, from `folder` if it was done before.

    `models`: where the trained model stays, for whoever asks it more; a run that was stopped goes on from
    there.
    `presses`: gives a calibration press on the tissue of a sequence, by its index.
    """
    file = folder / f"{run.name}.json"
    if file.is_file():
        done: dict[str, Any] = json.loads(file.read_text())
        return done
    split = nested(clips, run.settings.folds, run.settings.fold, 0, run.settings.held_out_family)
    used = list(clips)
    if run.control == "shuffled":
        used = _dealt_out(used, split.fit)
    began, clock = time.process_time(), models / run.name / "cpu_s"
    whole = not (models / run.name).exists()
    card = train(used, split, run.settings, models / run.name)
    if whole:
        clock.write_text(f"{time.process_time() - began:.1f}")
    # A run that was stopped and continued has no time to tell.
    spent = float(clock.read_text()) if clock.is_file() else None
    predictor = load_predictor(models / run.name)
    pressed = None
    if presses is not None:
        pressed = {clips[i].content_hash: _pressed(predictor, presses(i)) for i in split.test[:PRESSES]}
    fitted, tested = [clips[i] for i in split.fit], [clips[i] for i in split.test]
    report = evaluate(predictor, tested, run.source, pressed=pressed)
    history = [json.loads(s) for s in (models / run.name / "history.jsonl").read_text().splitlines()]
    result: dict[str, Any] = {
        "name": run.name,
        "source": run.source,
        "control": run.control,
        "settings": run.settings.as_dict(),
        "sequences_fit": len(split.fit),
        "sequences_select": len(split.select),
        "epoch": card.epoch,
        "select_r2": card.score,
        "train_cpu_s": spent,
        "history": history,
        "controls": controls(predictor, tested, run.source, fitted) if run.controlled else {},
        **report.as_dict(),
    }
    if run.settings.size > CELLS:
        wide = wide_rmse(predictor, tested, run.source)
        for row, value in zip(result["sequences"], wide, strict=True):
            row["map_rmse_wide"] = value
    if run.control:
        base = mean_map(tested, predictor.card, fitted)
        result["beyond_mean_map"] = beyond_mean_map(report, base)
    if pressed is not None:
        off = [abs(np.log(pressed[clips[i].content_hash] / clips[i].young_kpa)) for i in split.test[:PRESSES]]
        result["press_young_off"] = float(np.exp(np.median(off)) - 1)
    folder.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(result, indent=1) + "\n")
    known = report.summary()
    took = "continued" if spent is None else f"{spent:.0f} CPU-s"
    say(
        f"{run.name}: {took}, map R² {known['map_r2_pooled']:.3f}, "
        f"force R² {known['force_r2_pooled']:.3f}, ghosts {known['ghost_relative']:.4f}"
    )
    return result


def _pressed(predictor: Predictor, press: Clip) -> float:
    force = np.linalg.norm(press.force, axis=1)
    return stiffness(predictor, np.asarray(press.displacement["ideal"]), press.mask, force)


def _dealt_out(clips: list[Clip], fit: Sequence[int]) -> list[Clip]:
    """Each fitted frame gets the force of another, drawn from all of them: what is learnt then is nothing.

    Dealing whole sequences isn't enough: they all rise and fall alike, so that much motion still goes with
    much force (map R² 0.18, force R² 0.62 after four epochs).
    """
    frames = [(i, t) for i in fit for t in range(clips[i].frames)]
    dealt = iter(np.random.default_rng(0).permutation(len(frames)))
    out = list(clips)
    for i in fit:
        from_ = [frames[next(dealt)] for _ in range(clips[i].frames)]
        out[i] = replace(
            clips[i],
            density=np.stack([clips[j].density[t] for j, t in from_]),
            force=np.stack([clips[j].force[t] / clips[j].young_kpa for j, t in from_]) * clips[i].young_kpa,
        )
    return out


def column(results: Sequence[dict[str, Any]], key: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    """One metric of every tested sequence of some runs, in order; NaN where it has none."""
    return np.array(
        [np.nan if s.get(key) is None else s[key] for r in results for s in r["sequences"]], np.float64
    )
