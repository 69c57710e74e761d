"""Does a run survive SIGKILL? Workers, engines and both are killed; the dataset must not show it."""

from __future__ import annotations

import json as json_
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from bench.output import machine, write
from synth.checks import verify
from synth.dataset import index
from synth.dataset.folder import Folder

_PROGRAM = """
import sys
from pathlib import Path
from synth.engine import run as engine
from synth.dataset.folder import Folder
from synth.job.schema import Job
from synth.engine.progress import Bars
root, work, workers, job, retry = sys.argv[1:]
if retry == "retry":
    Folder(Path(root)).forgive()
with Bars() as bars:
    options = engine.Options(workers=int(workers), work=work)
    engine.run_job(Job.model_validate_json(job), Path(root), options, bars)
"""


def kills(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the results.")] = Path(
        "docs/results/engine/kills"
    ),
    count: Annotated[int, typer.Option(help="Number of SIGKILLs.")] = 200,
    sequences: Annotated[int, typer.Option(help="Sequences of the job.")] = 50,
    workers: Annotated[int, typer.Option(help="Worker processes.")] = 2,
    job: Annotated[str, typer.Option(help="A job file or name, for all but its sequences.")] = "tiny",
    work: Annotated[str, typer.Option(help="What computes a sequence.")] = "evidence.engine.work:sequence",
    frame_s: Annotated[float, typer.Option(help="Sleep a frame of the stand-in [s].")] = 0.25,
    pause_s: Annotated[float, typer.Option(help="Longest wait between two kills [s].")] = 2.0,
    seed: Annotated[int, typer.Option(help="Of the kills.")] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print JSON to standard output.")] = False,
) -> None:
    """Kills runs at random moments, lets them resume, and compares with a run left in peace."""
    from synth.job import reader

    described = reader.load_job(job, [f"sequences={sequences}"]).model_dump_json()
    rng = np.random.default_rng(seed)
    victims = {"worker": 0, "engine": 0, "both": 0}
    with tempfile.TemporaryDirectory() as scratch:
        root = Path(scratch) / "killed"
        run: subprocess.Popen[bytes] | None = None
        starts = retries = 0
        while sum(victims.values()) < count:
            if run is None or run.poll() is not None:
                again = "retry" if root.exists() and Folder(root).failures() else "go on"
                retries += again == "retry"
                if len(list(root.glob("*.zarr"))) == sequences:
                    # All done before all kills: a few sequences are taken away, to be made again.
                    for path in sorted(root.glob("*.zarr"))[:: max(sequences // 10, 1)]:
                        shutil.rmtree(path)
                run = _start(root, work, workers, described, again, frame_s)
                starts += 1
            time.sleep(float(rng.uniform(0.05, pause_s)))
            kind = list(victims)[int(rng.integers(3))]
            victims[kind] += _kill(run, kind, rng)
        if run is not None:
            run.wait()
        while len(list(root.glob("*.zarr"))) < sequences:
            _start(root, work, workers, described, "retry", frame_s).wait()
        calm = Path(scratch) / "calm"
        _start(calm, work, workers, described, "go on", 0.0).wait()
        checks = {check.name: check.good for check in verify.verify_dataset(root).checks}
        result = {
            "job": job,
            "work": work,
            "sigkills": victims,
            "sequences": sequences,
            "starts": starts,
            "starts_that_retried_failed": retries,
            "hash_after_kills": index.dataset_hash(index.read_index(root).to_pylist()),
            "hash_undisturbed": index.dataset_hash(index.read_index(calm).to_pylist()),
            "leftovers": [path.name for path in root.glob("*.part")],
            "checksums_good": checks["checksum"] and checks["readable"] and checks["seal"],
            "seed": seed,
            "machine": machine.describe(),
        }
    result["equal"] = result["hash_after_kills"] == result["hash_undisturbed"]
    write.keep(out, "kills.json", result)
    print(json_.dumps(result) if json else f"{sum(victims.values())} SIGKILLs: equal = {result['equal']}")
    if not (result["equal"] and result["checksums_good"] and not result["leftovers"]):
        raise typer.Exit(1)


def _start(
    root: Path, work: str, workers: int, job: str, retry: str, frame_s: float
) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-c", _PROGRAM, str(root), work, str(workers), job, retry],
        env={**os.environ, "STAND_IN_FRAME_S": str(frame_s)},
        stderr=subprocess.DEVNULL,
    )


def _kill(run: subprocess.Popen[bytes], kind: str, rng: np.random.Generator) -> int:
    """Kills; returns 1 if there was something to kill."""
    workers = _children(run.pid)
    if kind in ("worker", "both"):
        if not workers:
            return 0
        _send(workers[int(rng.integers(len(workers)))])
    if kind in ("engine", "both"):
        if run.poll() is not None:
            return 0
        run.kill()
        run.wait()
    return 1


def _send(pid: int) -> None:
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return


def _children(pid: int) -> list[int]:
    """Processes that `pid` started; only ever of the run that this program started itself."""
    try:
        tasks = list(Path(f"/proc/{pid}/task").iterdir())
        return [int(child) for task in tasks for child in (task / "children").read_text().split()]
    except FileNotFoundError:
        return []
