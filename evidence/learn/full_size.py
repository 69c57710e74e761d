"""`bench experiment full-size`: the whole training as the paper has it, timed: 256², 20,000 frames, 50
epochs.

Meant for a GPU; every part can be made small, so that a machine without one can check that it runs.
"""

from __future__ import annotations

import json as json_
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated

import torch
import typer
from lightning_fabric import Fabric
from rich.console import Console

from bench.output.machine import describe
from evidence.learn.experiment import LOSSES, RESULTS
from evidence.learn.labels import FINE, clip, key
from evidence.measuring import measuring
from learn.data.clips import pack, unpack
from learn.data.grid import Grid
from learn.data.split import nested
from learn.evaluation.evaluate import evaluate
from learn.inference.predict import load
from learn.settings import preset
from learn.training.threads import set_threads
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
    set_threads(1)
    say = Console(stderr=True).print
    job = reader.load(str(RESULTS / "data/labels.yaml"))
    job = job.model_copy(update={"sequences": sequences, "frames": frames})
    grid, began = Grid(size), time.perf_counter()
    if size < FINE:
        raise UserError(f"grid size {size}: labels are made on {FINE}² at least")
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        list(pool.map(_make, [(job, i, grid, cache) for i in range(sequences)]))
    clips = [unpack(cache / key(job, i, grid)) for i in range(sequences)]
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
    split = nested(clips, settings.folds, settings.fold, settings.seed)
    fabric = Fabric(accelerator=accelerator, devices=1, precision=settings.precision)
    began = time.perf_counter()
    card = train(clips, split, settings, out / "model", fabric=fabric, log=lambda numbers: say(str(numbers)))
    trained = time.perf_counter() - began
    predictor = load(out / "model", fabric.device)
    known = evaluate(predictor, [clips[i] for i in split.test], "ideal")
    seen = len(split.fit) * frames
    result = {
        "machine": describe() | {"device": str(fabric.device), "torch": torch.__version__},
        "settings": settings.as_dict(),
        "sequences": {"fit": len(split.fit), "select": len(split.select), "test": len(split.test)},
        "frames_fit": seen,
        "labels_s": round(made, 1),
        "training_s": round(trained, 1),
        "frames_per_s": round(seen * epochs / trained, 1),
        "epoch": card.epoch,
        "columns": known.as_dict()["columns"],
    }
    (out / "full.json").write_text(json_.dumps(result, indent=1) + "\n")
    summary = known.summary()
    if json:
        print(json_.dumps(result))
    else:
        print(
            f"{seen} frames, {epochs} epochs in {trained:.0f} s ({result['frames_per_s']} frames/s), "
            f"labels in {made:.0f} s; map R² {summary['map_r2_pooled']:.3f}, "
            f"force R² {summary['force_r2_pooled']:.3f}"
        )


def _make(task: tuple[Job, int, Grid, Path]) -> None:
    job, index, grid, cache = task
    torch.set_num_threads(1)
    folder = cache / key(job, index, grid)
    if not folder.is_dir():
        pack(clip(job, index, grid, folder.name), folder)
