"""Trainings of the gap experiment and what they are asked: clips in, errors by sequence out, kept as JSON."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from evidence.gap import gap
from evidence.gap.recompute_flow import refollow
from learn.data.clips import Clip, pack, unpack
from learn.data.grid import Grid
from learn.data.split import Split
from learn.evaluation.evaluate import evaluate
from learn.inference.predict import load_predictor
from learn.settings import Settings
from learn.settings import replace as changed
from learn.training.train import train
from synth.dataset.folder import write_whole
from synth.dataset.store import Sequence as Stored

KEYS = ("force_mae", "map_rmse")
"""Errors by sequence: total force [mN], density [mN/mm²]; the first decides."""
Tests = Mapping[str, tuple[Sequence[Clip], str]]
"""By name: the clips asked and the displacement they are asked with."""


@dataclass(frozen=True)
class Training:
    """One network of the experiment."""

    kind: str
    """I: ideal flow; R: recovered; N: ideal with fitted noise; mixed: both."""
    flow: str
    """Back end of the recovered flow it is trained or, for I, only tested on."""
    seed: int

    @property
    def name(self) -> str:
        return f"{self.kind}-{self.flow}-seed{self.seed}"

    @property
    def model(self) -> str:
        """Which network: training on ideal flow is the same whatever flow the test recovers."""
        return f"I-seed{self.seed}" if self.kind == "I" else self.name


def followed(sequence: Stored, clip: Clip, backend: str, grid: Grid, cache: Path) -> Clip:
    """The clip with the flow that another back end recovers, as the paper's pipeline would run it.

    Only the instrument is masked, not glare: whoever draws masks by hand draws the tool's.

    Args:
        sequence: rendered, with `rgb`, `tool` and `tissue`.
        clip: of the sequence on `grid`, with ideal and any recovered flow.
        cache: folder of packed clips; keyed by content hash, back end and grid.
    """
    folder = cache / f"{clip.content_hash}-{grid.size}-{grid.extent_mm:g}-{backend}"
    if folder.is_dir():
        return unpack(folder)
    out, _ = refollow(sequence, clip, backend, sequence["tool"][...].astype(bool), grid)
    pack(out, folder)
    return out


def noisy(clips: Sequence[Clip], fit: Sequence[int], seed: int) -> tuple[list[Clip], gap.Noise]:
    """The clips with recovered flow replaced by ideal flow plus noise fitted on the `fit` ones."""
    chosen = [clips[i] for i in fit]
    noise = gap.fit_noise(
        [np.asarray(c.displacement["ideal"]) for c in chosen],
        [np.asarray(c.displacement["recovered"]) for c in chosen],
        [c.mask for c in chosen],
    )
    made = []
    for k, clip in enumerate(clips):
        rng = np.random.default_rng([seed, k])
        spoilt = noise.add(np.asarray(clip.displacement["ideal"]), clip.mask, rng)
        made.append(replace(clip, displacement={**clip.displacement, "recovered": spoilt}))
    return made, noise


def carry_out(
    training: Training,
    clips: Sequence[Clip],
    split: Split,
    settings: Settings,
    tests: Tests,
    folder: Path,
    models: Path,
    say: Callable[[str], None],
) -> dict[str, Any]:
    """The training's errors in every test, from `folder` if it was done before with the same settings.

    Args:
        clips: with ideal and recovered displacement; only fit and select of `split` are looked at.
        settings: `input` and `seed` are set by the training.
        tests: what the network is asked.
        folder: gets NAME.json.
        models: gets the trained networks; an unfinished one is continued.
        say: told what is under way.
    """
    kind = {"I": "ideal", "R": "recovered", "N": "recovered", "mixed": "mixed"}[training.kind]
    chosen = changed(settings, input=kind, seed=training.seed)
    file = folder / f"{training.name}.json"
    asked = {name: [c.content_hash for c in part] for name, (part, _) in tests.items()}
    if file.is_file():
        done: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        if done["settings"] == json.loads(json.dumps(chosen.as_dict())) and done["asked"] == asked:
            return done
    say(f"training {training.name}")
    used, noise = list(clips), None
    if training.kind == "N":
        used, noise = noisy(used, split.fit, training.seed)
    began = time.process_time()
    model = models / f"{training.model}-{_digest(chosen, used, split)}"
    card = train(used, split, chosen, model)
    spent = time.process_time() - began
    predictor = load_predictor(model)
    errors = {}
    for name, (part, source) in tests.items():
        rows = evaluate(predictor, part, source).per_clip()
        errors[name] = {key: [row[key] for row in rows] for key in KEYS}
    result = {
        "name": training.name,
        "settings": chosen.as_dict(),
        "epoch": card.epoch,
        "select_r2": card.score,
        "train_cpu_s": round(spent, 1),
        "noise": None if noise is None else vars(noise),
        "asked": asked,
        "errors": errors,
    }
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(file, json.dumps(result, indent=1) + "\n", durable=False)
    return result


def _digest(settings: Settings, clips: Sequence[Clip], split: Split) -> str:
    """Eight letters that change when the settings or the sequences do."""
    seen = [clips[i].content_hash for i in (*split.fit, *split.select)]
    return hashlib.sha256(json.dumps([settings.as_dict(), seen]).encode()).hexdigest()[:8]
