"""Trainings of the gap experiment and what they are asked: clips in, errors by sequence out."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from evidence import kept
from evidence.gap import gap
from evidence.gap.recompute_flow import recover_flow
from evidence.measuring import four_digits
from learn.data.clips import Clip
from learn.data.grid import Grid
from learn.data.split import Split
from learn.evaluation.evaluate import evaluate
from learn.inference.predict import load_predictor
from learn.settings import Settings
from learn.settings import replace as changed
from learn.training.train import train
from synth.dataset.store import Sequence as Stored

KEYS = ("force_mae", "map_rmse")
"""Errors by sequence: total force [mN], density [mN/mm²]; the first decides."""
Tests = Mapping[str, tuple[Sequence[Clip], str]]
"""By name: the clips asked and the displacement they are asked with."""
_NUMBERS = {"seed": pa.int32(), "epoch": pa.int32()} | dict.fromkeys(
    ("select_r2", "train_cpu_s", *KEYS), pa.float32()
)
"""Columns of the table that aren't text."""


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


def kept_flow(sequence: Stored, clip: Clip, backend: str, grid: Grid, cache: Path) -> Clip:
    """The clip with the flow that another back end recovers, as the paper's pipeline would run it; cached.

    Only the instrument is masked, not glare: whoever draws masks by hand draws the tool's.

    Args:
        sequence: rendered, with `rgb`, `tool` and `tissue`.
        clip: of the sequence on `grid`, with ideal and any recovered flow.
        cache: folder of packed clips.
    """
    key = kept.word(recover_flow.__module__, clip.content_hash, backend, grid.size, grid.extent_mm)

    def make() -> Clip:
        return recover_flow(sequence, clip, backend, sequence["tool"][...].astype(bool), grid)[0]

    return kept.clip(cache / key, make)


def with_fitted_noise(clips: Sequence[Clip], fit: Sequence[int], seed: int) -> tuple[list[Clip], gap.Noise]:
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
    cache: Path,
    say: Callable[[str], None],
) -> dict[str, Any]:
    """The training's errors in every test, from `cache` if the same was done before on the same data.

    Args:
        clips: with ideal and recovered displacement; only fit and select of `split` are looked at.
        settings: `input` and `seed` are set by the training.
        tests: what the network is asked.
        cache: gets results and trained networks; an unfinished one is continued.
        say: told what is under way.
    """
    kind = {"I": "ideal", "R": "recovered", "N": "recovered", "mixed": "mixed"}[training.kind]
    chosen = changed(settings, input=kind, seed=training.seed)
    # Training on ideal flow is the same whatever flow the test recovers.
    flow = "" if training.kind == "I" else f"-{training.flow}"
    seen = [clips[i].content_hash for i in (*split.fit, *split.select)]
    trained = [training.kind, flow, chosen.as_dict(), len(split.fit), seen]
    model = cache / "models" / f"{training.kind}{flow}-seed{training.seed}-{kept.word(__name__, *trained)}"

    def compute() -> dict[str, Any]:
        say(f"training {training.name}")
        used, noise = list(clips), None
        if training.kind == "N":
            used, noise = with_fitted_noise(used, split.fit, training.seed)
        began = time.process_time()
        card = train(used, split, chosen, model)
        spent = round(time.process_time() - began, 1)
        found = {"epoch": card.epoch, "select_r2": card.score, "train_cpu_s": spent}
        return found | {"noise": noise and vars(noise), "errors": _errors(model, tests)}

    asked = {name: [c.content_hash for c in part] for name, (part, _) in tests.items()}
    key = kept.word(__name__, *trained, training.flow, asked)
    done: dict[str, Any] = kept.result(cache / "runs", training.name, key, compute)
    return done | {"asked": asked}


def _errors(model: Path, tests: Tests) -> dict[str, dict[str, list[float]]]:
    predictor = load_predictor(model)
    found = {}
    for name, (part, source) in tests.items():
        rows = evaluate(predictor, part, source).per_clip()
        found[name] = {key: [row[key] for row in rows] for key in KEYS}
    return found


def write_table(runs: Mapping[Training, Mapping[str, Any]], file: Path) -> None:
    """Every sequence's errors in every test of every training, a row each; `sequence`: its content's hash."""
    rows = [
        vars(training)
        | {name: run[name] for name in ("epoch", "select_r2", "train_cpu_s")}
        | {"test": test, "sequence": sequence}
        | {key: run["errors"][test][key][k] for key in KEYS}
        for training, run in runs.items()
        for test, asked in run["asked"].items()
        for k, sequence in enumerate(asked)
    ]
    file.parent.mkdir(parents=True, exist_ok=True)
    schema = pa.schema([(name, _NUMBERS.get(name, pa.string())) for name in rows[0]])
    pq.write_table(
        pa.Table.from_pylist(rows, schema),
        file,
        compression="zstd",
        compression_level=19,
        use_dictionary=[name for name in schema.names if name not in KEYS],
        use_byte_stream_split=list(KEYS),
    )


def rounded(run: Mapping[str, Any]) -> dict[str, Any]:
    """A training's run with its errors to four digits, as the table holds them."""
    errors = {
        test: {key: [four_digits(value) for value in values] for key, values in found.items()}
        for test, found in run["errors"].items()
    }
    return {**run, "errors": errors}
