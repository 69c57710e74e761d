"""Everything that a GPU changes, checked and timed in one call, each step a process of its own."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from bench.output import machine, write
from evidence.measuring import measuring
from synth.errors import UserError

Steps = Sequence[tuple[str, Sequence[str]]]
"""Name of each step and the arguments after `python`."""


@dataclass(frozen=True)
class Outcome:
    """One step."""

    name: str
    command: str
    exit_code: int
    """-1 where the step was stopped at its time limit."""
    wall_s: float


@measuring(
    "--out runs/gpu",
    out="docs/results/gpu",
    said="Folder for logs and gpu.json.",
    passed=lambda found: not any(one["exit_code"] for one in found),
)
def gpu(
    out: Path,
    limit: Annotated[float, typer.Option(help="Longest that one step may take [s].")] = 900.0,
) -> list[dict[str, Any]]:
    """Checks and times everything that an NVIDIA GPU changes. Exit code 1 if a step fails."""
    from synth.render.mitsuba.adapter import cuda

    if not cuda():
        raise UserError("no NVIDIA GPU and driver were found; `synth doctor` says what is missing")
    return [asdict(outcome) for outcome in run_steps(steps(out), out, limit)]


def steps(out: Path) -> Steps:
    """What is run, in order: first whether it is right, then how fast it is."""
    data, model = str(out / "data"), str(out / "model")
    full = ("--cache", str(out / "labels"), "-o", str(out / "full"), "--accelerator", "cuda")
    return (
        ("doctor", ("-m", "synth", "doctor")),
        ("variants agree", ("-m", "pytest", "-q", "tests/synth/render/test_scene.py")),
        ("rendering", ("-m", "bench", "experiment", "throughput", "-o", str(out / "render"))),
        ("flow", ("-m", "bench", "experiment", "flow", "--only", "time", "-o", str(out / "flow"))),
        ("networks", ("-m", "bench", "pareto", "learn", "--device", "cuda", "-o", str(out / "learn"))),
        ("dataset", ("-m", "synth", "render", "demo", "-o", data, "render.variant=cuda_ad_rgb")),
        ("verify", ("-m", "synth", "verify", data)),
        (
            "training",
            ("-m", "learn", "train", data, "-o", model, "--accelerator", "cuda", "--input", "mixed"),
        ),
        (
            "loading",
            ("-m", "bench", "experiment", "loading", "--device", "cuda", "-o", str(out / "loading")),
        ),
        ("full size", ("-m", "bench", "experiment", "full-size", *full)),
    )


def run_steps(steps: Steps, out: Path, limit_s: float) -> list[Outcome]:
    """Runs the steps one after another, each into `NAME.log`; one that fails does not stop the next.

    Returns:
        An outcome a step; `gpu.json` holds them with the machine, rewritten after every step.
    """
    out.mkdir(parents=True, exist_ok=True)
    found: list[Outcome] = []
    for name, arguments in steps:
        begin = time.perf_counter()
        with (out / f"{name.replace(' ', '-')}.log").open("wb") as log:
            try:
                done = subprocess.run(
                    [sys.executable, *arguments], stdout=log, stderr=log, timeout=limit_s, check=False
                )
                code = done.returncode
            except subprocess.TimeoutExpired:
                code = -1
        spent = round(time.perf_counter() - begin, 1)
        found.append(Outcome(name, "python " + " ".join(arguments), code, spent))
        print(f"{name}: {'good' if code == 0 else f'exit code {code}'}, {spent:.1f} s", file=sys.stderr)
        kept = {"machine": machine.describe(), "steps": [asdict(outcome) for outcome in found]}
        write.keep(out, "gpu.json", kept)
    return found
