"""Everything that a GPU changes, checked and timed in one call, each step a process of its own.

Run: python -m evidence.gpu; the last step trains the paper's network: 256², 20,000 frames, 50 epochs.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
import typer

from evidence import report
from evidence.folds import nested
from evidence.learn.labels import whole
from evidence.learn.runs import JOB
from learn.data.grid import Grid
from learn.evaluation.evaluate import evaluate
from learn.inference.predict import load_model
from learn.settings import preset, replace
from learn.training.threads import make_fabric, set_threads
from learn.training.train import train
from synth.errors import UserError
from synth.job import reader
from synth.job.schema import Job

Steps = Sequence[tuple[str, Sequence[str]]]
"""Name of each step and the arguments after `python`."""
app = typer.Typer(add_completion=False)


@app.callback(invoke_without_command=True)
def main(context: typer.Context, out: Path = report.RESULTS / "gpu", limit_s: float = 900.0) -> None:
    """Checks and times everything that an NVIDIA GPU changes. Exit code 1 if a step fails."""
    from synth.render.mitsuba.adapter import cuda

    if context.invoked_subcommand:
        return
    if not cuda():
        raise UserError("no NVIDIA GPU and driver were found; `synth doctor` says what is missing")
    rows = run_steps(steps(out), out, limit_s)
    report.show({"steps": rows})
    raise typer.Exit(int(any(row["exit_code"] for row in rows)))


def steps(out: Path) -> Steps:
    """What is run, in order: first whether it is right, then how fast it is."""
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
        ("full size", ("-m", "evidence.gpu", "full-size", str(out / "labels"), str(out / "full"))),
    )


def run_steps(steps: Steps, out: Path, limit_s: float) -> list[dict[str, Any]]:
    """Runs the steps one after another, each into `NAME.log`; one that fails does not stop the next.

    Returns:
        `name`, `command`, `exit_code` (-1: stopped at its time limit) and `wall_s` a step; `gpu.json` holds
        them, rewritten after every step.
    """
    out.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    for name, arguments in steps:
        begin = time.perf_counter()
        with (out / f"{name.replace(' ', '-')}.log").open("wb") as log:
            try:
                words = [sys.executable, *arguments]
                code = subprocess.run(words, stdout=log, stderr=log, timeout=limit_s).returncode
            except subprocess.TimeoutExpired:
                code = -1
        spent = time.perf_counter() - begin
        line = "python " + " ".join(arguments)
        rows.append({"name": name, "command": line, "exit_code": code, "wall_s": round(spent, 1)})
        typer.echo(f"{name}: exit code {code}, {spent:.1f} s", err=True)
        report.save(out, "gpu.json", {"steps": rows})
    return rows


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
    workers: int = 8,
) -> None:
    """Makes labels in parallel, trains as the paper does, scores the fold that was kept; all of it timed."""
    set_threads(1)
    job = reader.load_job(str(JOB)).model_copy(update={"sequences": sequences, "frames": frames})
    base = preset("paper", size=size, epochs=epochs, batch=batch)
    began = time.perf_counter()
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        list(pool.map(_make, [(job, index, base.grid, cache) for index in range(sequences)]))
    clips = [whole(job, index, base.grid, cache) for index in range(sequences)]
    labelled = time.perf_counter() - began
    gpu = accelerator != "cpu" and torch.cuda.is_available()
    settings = replace(
        base,
        arch=replace(base.arch, width=width, output="magnitude"),
        learning_rate=2e-3,
        schedule="cosine",
        precision="bf16-mixed" if gpu else "32-true",
        channels_last=True,
        compile=gpu,
    )
    split = nested(clips, 10, 0, settings.seed)
    fabric = make_fabric(accelerator=accelerator, devices=1, precision=settings.precision)
    began = time.perf_counter()
    train(clips, split, settings, out / "model", fabric=fabric)
    trained = time.perf_counter() - began
    tested = [clips[i] for i in split.test]
    found: Mapping[str, float] = evaluate(load_model(out / "model", fabric.device), tested, "ideal").summary()
    count = sum(clips[i].frames for i in split.fit)
    result = {
        "device": torch.cuda.get_device_name() if gpu else "cpu",
        "frames_fit": count,
        "labels_s": labelled,
        "training_s": trained,
        "frames_per_s": count * epochs / trained,
        "map_r2_pooled": found["map_r2_pooled"],
        "force_r2_pooled": found["force_r2_pooled"],
    }
    report.save(out, "full.json", result)
    report.show(result)


def _make(task: tuple[Job, int, Grid, Path]) -> None:
    torch.set_num_threads(1)
    whole(*task)


if __name__ == "__main__":
    app()
