"""Training of the paper's network at its size, 256², on 20,000 frames without images, for 50 epochs."""

import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import torch

from evidence import report
from evidence.learn import labels
from evidence.learn.runs import JOB
from evidence.study import Study
from evidence.training import nested
from learn.evaluation.evaluate import evaluate
from learn.inference.predict import load_model
from learn.settings import preset, replace
from learn.training.threads import choose_device, set_threads
from learn.training.train import train
from synth.fem.equilibrium import InvertedElement, NoEquilibrium
from synth.job import reader
from synth.job.schema import Job


def measure(
    cache: Path,
    out: Path,
    sequences: int = 500,
    frames: int = 52,
    size: int = 256,
    epochs: int = 50,
    workers: int = 8,
    accelerator: str = "auto",
) -> None:
    """Makes missing labels in parallel, trains as the paper does, and scores the held-out fold.

    Continues if it was stopped.
    """
    job = reader.load_job(str(JOB)).model_copy(update={"sequences": sequences, "frames": frames})
    base = preset("paper", size=size, epochs=epochs, batch=64)
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        made = [index for index in pool.map(partial(_make, job, size, cache), range(sequences)) if index >= 0]
    clips = [labels.whole(job, index, base.grid, cache) for index in made]
    device = choose_device(accelerator)
    on_gpu = device.type == "cuda"
    settings = replace(
        base,
        arch=replace(base.arch, output="magnitude"),
        learning_rate=2e-3,
        schedule="cosine",
        precision="bf16-mixed" if on_gpu else "32-true",
    )
    split = nested(clips, 10, 0, settings.seed)
    whole_run = not (out / "model").exists()  # a continued training has no meaningful rate
    began = time.perf_counter()
    train(clips, split, settings, out / "model", device=device)
    trained = time.perf_counter() - began
    tested = [clips[i] for i in split.test]
    scores = evaluate(load_model(out / "model", device), tested, "ideal").summary()
    count = sum(clips[i].frames for i in split.fit)
    result = {
        "device": torch.cuda.get_device_name() if on_gpu else "cpu",
        "sequences_made": len(made),
        "frames_fit": count,
        "training_s": trained if whole_run else None,
        "frames_per_s": count * epochs / trained if whole_run else None,
        **{name: scores[name] for name in ("map_r2_pooled", "force_r2_pooled")},
    }
    report.save(out, "full.json", result)
    print(result)


def _make(job: Job, size: int, cache: Path, index: int) -> int:
    """Makes the labels of a sequence; returns its index, or -1 if its load has no solution."""
    set_threads(1)
    with suppress(InvertedElement, NoEquilibrium):
        labels.whole(job, index, preset("paper", size=size).grid, cache)
        return index
    return -1


STUDY = Study(measure, steps=())
