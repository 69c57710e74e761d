"""`bench experiment full-size`: the whole training as the paper has it, timed: 256², 20,000 frames, 50
epochs.

Meant for a GPU; every part can be made small, so that a machine without one can check that it runs.
"""

from __future__ import annotations

import json as json_
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any

import torch
import typer
from rich.console import Console

from bench.output.machine import describe
from bench.output.write import keep
from evidence.learn.experiment import LOSSES, RESULTS
from evidence.learn.labels import FINE, whole
from evidence.measuring import measuring
from learn.data.clips import Clip
from learn.data.grid import Grid
from learn.data.split import nested
from learn.evaluation.evaluate import evaluate
from learn.inference.predict import load_predictor
from learn.settings import Settings, preset, replace
from learn.training.threads import make_fabric, set_threads
from learn.training.train import train
from synth.errors import UserError
from synth.job import reader
from synth.job.schema import Job


@measuring("--cache cache --out full")
def full_size(
    cache: Annotated[Path, typer.Option(help="Folder for packed sequences, 1.6 MB a frame at 256².")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the model and full.json.")],
    sequences: Annotated[
        int, typer.Option(min=6, help="Sequences made, a test fold of a fifth included.")
    ] = 500,
    frames: Annotated[int, typer.Option(min=2, help="Frames a sequence.")] = 52,
    size: Annotated[int, typer.Option(help="Grid cells along an edge: 128 or more.")] = 256,
    width: Annotated[int, typer.Option(help="Channels of the first level.")] = 32,
    stem: Annotated[int, typer.Option(help="Stride of the first convolution: 1, 2 or 4.")] = 1,
    epochs: Annotated[int, typer.Option(min=1, help="Passes over the fitted frames.")] = 50,
    batch: Annotated[int, typer.Option(min=1, help="Frames a step.")] = 64,
    loss: Annotated[str, typer.Option(help=f"One of {', '.join(LOSSES)}.")] = "mse",
    accelerator: Annotated[str, typer.Option(help="cpu, cuda or auto.")] = "auto",
    compile: Annotated[bool, typer.Option(help="Whether torch.compile takes the network.")] = True,
    workers: Annotated[int, typer.Option(min=1, help="Processes that make sequences.")] = 8,
    json: Annotated[bool, typer.Option("--json", help="Print JSON on stdout.")] = False,
) -> None:
    """Make labels in parallel, train at full size, score the fold that was kept; all of it timed."""
    if loss not in LOSSES:
        raise UserError(f"unknown loss {loss!r}: one of {', '.join(LOSSES)}")
    if size < FINE:
        raise UserError(f"grid size {size}: labels are made on {FINE}² at least")
    set_threads(1)
    say = Console(stderr=True).print
    job = reader.load_job(str(RESULTS / "data/labels.yaml"))
    job = job.model_copy(update={"sequences": sequences, "frames": frames})
    began = time.perf_counter()
    clips = _labels(job, Grid(size), cache, workers)
    made = time.perf_counter() - began
    gpu = accelerator != "cpu" and torch.cuda.is_available()
    base = preset("paper", size=size, epochs=epochs, batch=batch, folds=10, objective=LOSSES[loss])
    settings = replace(
        base,
        arch=replace(base.arch, width=width, stem=stem, output="magnitude"),
        learning_rate=2e-3,
        schedule="cosine",
        precision="bf16-mixed" if gpu else "32-true",
        channels_last=True,
        compile=compile,
    )
    result = train_and_score(clips, settings, accelerator, out / "model", say)
    result["labels_s"] = round(made, 1)
    keep(out, "full.json", result)
    if json:
        print(json_.dumps(result))
        return
    known = result["columns"]["known"]
    print(
        f"{result['frames_fit']} frames, {epochs} epochs in {result['training_s']:.0f} s "
        f"({result['frames_per_s']} frames/s), labels in {made:.0f} s; map R² {known['map_r2_pooled']:.3f}, "
        f"force R² {known['force_r2_pooled']:.3f}"
    )


def train_and_score(
    clips: Sequence[Clip], settings: Settings, accelerator: str, model: Path, say: Callable[[str], None]
) -> dict[str, Any]:
    """What a training took and what the fold that was kept says of it."""
    split = nested(clips, settings.folds, settings.fold, settings.seed)
    fabric = make_fabric(accelerator=accelerator, devices=1, precision=settings.precision)
    began = time.perf_counter()
    card = train(clips, split, settings, model, fabric=fabric, log=lambda numbers: say(str(numbers)))
    trained = time.perf_counter() - began
    report = evaluate(load_predictor(model, fabric.device), [clips[i] for i in split.test], "ideal")
    seen = sum(clips[i].frames for i in split.fit)
    return {
        "machine": describe() | {"device": str(fabric.device), "torch": torch.__version__},
        "settings": settings.as_dict(),
        "sequences": {"fit": len(split.fit), "select": len(split.select), "test": len(split.test)},
        "frames_fit": seen,
        "training_s": round(trained, 1),
        "frames_per_s": round(seen * settings.epochs / trained, 1),
        "epoch": card.epoch,
        "columns": report.as_dict()["columns"],
    }


def _labels(job: Job, grid: Grid, cache: Path, workers: int) -> list[Clip]:
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        list(pool.map(_make, [(job, i, grid, cache) for i in range(job.sequences)]))
    return [whole(job, i, grid, cache) for i in range(job.sequences)]


def _make(task: tuple[Job, int, Grid, Path]) -> None:
    torch.set_num_threads(1)
    whole(*task)
