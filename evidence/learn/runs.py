"""Training runs as data: (clips, split, settings) → scores a sequence, kept and reused."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from evidence import kept
from evidence.learn.coarse_rmse import CELLS, wide_rmse
from evidence.learn.controls import beyond_mean_map, controls, mean_map
from learn.data.clips import Clip
from learn.data.split import Split, nested
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
    cache: Path,
    say: Callable[[str], None],
    presses: Callable[[int], Clip] | None = None,
) -> dict[str, Any]:
    """The run's scores on its test fold, from `cache` if the same run was done before on the same data.

    `cache`: where scores and trained models stay; a training that was stopped goes on from there.
    `presses`: gives a calibration press on the tissue of a sequence, by its index.
    """
    split, key = _split(run, clips), _key(run, clips)

    def compute() -> dict[str, Any]:
        trained = _train(run, clips, split, model_folder(run, clips, cache))
        found = trained | _score(run, clips, split, model_folder(run, clips, cache), presses)
        known, spent = found["columns"]["known"], found["train_cpu_s"]
        took = "continued" if spent is None else f"{spent:.0f} CPU-s"
        say(
            f"{run.name}: {took}, map R² {known['map_r2_pooled']:.3f}, "
            f"force R² {known['force_r2_pooled']:.3f}, ghosts {known['ghost_relative']:.4f}"
        )
        return found

    folder, name = cache / "runs", run.name if presses is None else f"{run.name}-pressed"
    done: dict[str, Any] = kept.result(folder, name, key, compute)
    return done


def model_folder(run: Run, clips: Sequence[Clip], cache: Path) -> Path:
    """Where the trained model of a run is."""
    return cache / "models" / f"{run.name}-{_key(run, clips)}"


def _key(run: Run, clips: Sequence[Clip]) -> str:
    settings = run.settings.as_dict()
    asked = [run.source, run.control, run.controlled, [clip.content_hash for clip in clips]]
    return kept.word(__name__, settings, *asked)


def _split(run: Run, clips: Sequence[Clip]) -> Split:
    return nested(clips, run.settings.folds, run.settings.fold, 0, run.settings.held_out_family)


def _train(run: Run, clips: Sequence[Clip], split: Split, model: Path) -> dict[str, Any]:
    used = _dealt_out(list(clips), split.fit) if run.control == "shuffled" else clips
    began, clock, whole = time.process_time(), model / "cpu_s", not model.exists()
    card = train(used, split, run.settings, model)
    if whole:
        clock.write_text(f"{time.process_time() - began:.1f}")
    return {
        "name": run.name,
        "source": run.source,
        "control": run.control,
        "settings": run.settings.as_dict(),
        "sequences_fit": len(split.fit),
        "sequences_select": len(split.select),
        "epoch": card.epoch,
        "select_r2": card.score,
        # A run that was stopped and continued has no time to tell.
        "train_cpu_s": float(clock.read_text()) if clock.is_file() else None,
        "history": [json.loads(line) for line in (model / "history.jsonl").read_text().splitlines()],
    }


def _score(
    run: Run,
    clips: Sequence[Clip],
    split: Split,
    model: Path,
    presses: Callable[[int], Clip] | None,
) -> dict[str, Any]:
    predictor, pressed = load_predictor(model), None
    if presses is not None:
        pressed = {clips[i].content_hash: _pressed(predictor, presses(i)) for i in split.test[:PRESSES]}
    fitted, tested = [clips[i] for i in split.fit], [clips[i] for i in split.test]
    report = evaluate(predictor, tested, run.source, pressed=pressed)
    found: dict[str, Any] = report.as_dict()
    found["controls"] = controls(predictor, tested, run.source, fitted) if run.controlled else {}
    if run.settings.size > CELLS:
        wide = wide_rmse(predictor, tested, run.source)
        for row, value in zip(found["sequences"], wide, strict=True):
            row["map_rmse_wide"] = value
    if run.control:
        found["beyond_mean_map"] = beyond_mean_map(report, mean_map(tested, predictor.card, fitted))
    if pressed is not None:
        off = [abs(np.log(pressed[c.content_hash] / c.young_kpa)) for c in tested[:PRESSES]]
        found["press_young_off"] = float(np.exp(np.median(off)) - 1)
    return found


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
