"""Checks and timings of everything that a GPU changes, each step in a process of its own.

Run: python -m evidence.gpu, or one step: --only training. Steps that have passed are skipped. The last two
make labels and train the paper's network on them: 256², 20,000 frames, 50 epochs.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated

import torch
import typer

from evidence import report
from evidence.folds import nested
from evidence.learn.labels import whole
from evidence.learn.runs import JOB
from evidence.steps import Step, run_steps
from learn.data.grid import Grid
from learn.evaluation.evaluate import evaluate
from learn.inference.predict import load_model
from learn.settings import preset, replace
from learn.training.threads import make_fabric, set_threads
from learn.training.train import train
from synth.errors import UserError
from synth.job import reader
from synth.job.schema import Job
from synth.system import gpu

app = typer.Typer(add_completion=False)


@app.callback(invoke_without_command=True)
def main(
    context: typer.Context,
    out: Path = report.RESULTS / "gpu",
    only: Annotated[str | None, typer.Option(help="Name of the only step to run.")] = None,
    limit_s: Annotated[float, typer.Option(help="A step that takes longer is stopped.")] = 580.0,
) -> None:
    """Checks and times everything that an NVIDIA GPU changes. Exit code 1 if a step fails."""
    if context.invoked_subcommand:
        return
    if gpu.probe() is None:
        raise UserError("no NVIDIA GPU and driver were found; `synth doctor` lists what is missing")
    named = dict(steps(out))
    if only is not None and only not in named:
        raise UserError(f"--only {only}: the steps are {', '.join(named)}")
    chosen = [(only, named[only])] if only else list(named.items())
    rows = run_steps(chosen, out / "gpu.json", out, limit_s)
    report.show({"steps": rows})
    raise typer.Exit(int(any(row["exit_code"] for row in rows)))


def steps(out: Path) -> Sequence[Step]:
    """Steps in order: first correctness, then speed."""
    data, model = str(out / "data"), str(out / "model")
    cuda = ("--device", "cuda")
    return (
        ("doctor", ("-m", "synth", "doctor")),
        ("variants agree", ("-m", "pytest", "-q", "tests/synth/render/test_scene.py")),
        ("networks", ("-m", "evidence.learn.pareto", *cuda, "--out", str(out / "learn"))),
        ("dataset", ("-m", "synth", "render", "demo", "-o", data, "render.variant=cuda_ad_rgb")),
        ("verify", ("-m", "synth", "verify", data)),
        (
            "training",
            ("-m", "learn", "train", data, "-o", model, "--accelerator", "cuda", "--input", "mixed"),
        ),
        ("labels", ("-m", "evidence.gpu", "labels", str(out / "labels"))),
        ("full size", ("-m", "evidence.gpu", "full-size", str(out / "labels"), str(out / "full"))),
    )


@app.command()
def labels(cache: Path, sequences: int = 500, frames: int = 52, size: int = 256, workers: int = 8) -> None:
    """Makes the labels of the full size in parallel; existing ones are reused."""
    job, grid = _job(sequences, frames), preset("paper", size=size).grid
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        list(pool.map(_make, [(job, index, grid, cache) for index in range(sequences)]))


@app.command()
def full_size(
    cache: Path,
    out: Path,
    sequences: int = 500,
    frames: int = 52,
    size: int = 256,
    width: int = 32,
    epochs: int = 50,
    batch: int = 64,
    accelerator: str = "auto",
) -> None:
    """Trains on these labels as the paper does and scores the held-out fold. Continues if it was stopped."""
    set_threads(1)
    base, job = preset("paper", size=size, epochs=epochs, batch=batch), _job(sequences, frames)
    clips = [whole(job, index, base.grid, cache) for index in range(sequences)]
    on_gpu = accelerator != "cpu" and torch.cuda.is_available()
    settings = replace(
        base,
        arch=replace(base.arch, width=width, output="magnitude"),
        learning_rate=2e-3,
        schedule="cosine",
        precision="bf16-mixed" if on_gpu else "32-true",
    )
    split = nested(clips, 10, 0, settings.seed)
    fabric = make_fabric(accelerator=accelerator, devices=1, precision=settings.precision)
    whole_run = not (out / "model").exists()  # a continued training has no meaningful rate
    began = time.perf_counter()
    train(clips, split, settings, out / "model", fabric=fabric)
    trained = time.perf_counter() - began
    tested = [clips[i] for i in split.test]
    found: Mapping[str, float] = evaluate(load_model(out / "model", fabric.device), tested, "ideal").summary()
    count = sum(clips[i].frames for i in split.fit)
    result = {
        "device": torch.cuda.get_device_name() if on_gpu else "cpu",
        "frames_fit": count,
        "training_s": trained if whole_run else None,
        "frames_per_s": count * epochs / trained if whole_run else None,
        "map_r2_pooled": found["map_r2_pooled"],
        "force_r2_pooled": found["force_r2_pooled"],
    }
    report.save(out, "full.json", result)
    report.show(result)


def _job(sequences: int, frames: int) -> Job:
    return reader.load_job(str(JOB)).model_copy(update={"sequences": sequences, "frames": frames})


def _make(task: tuple[Job, int, Grid, Path]) -> None:
    torch.set_num_threads(1)
    whole(*task)


if __name__ == "__main__":
    app()
