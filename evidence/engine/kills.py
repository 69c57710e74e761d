"""Does a run survive SIGKILL? Workers, engines and both are killed; the dataset must not show it."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from evidence.engine import work as stand_in
from evidence.measuring import measuring
from synth.checks import verify
from synth.dataset import index
from synth.dataset.folder import Folder
from synth.engine import run
from synth.engine.progress import Bars
from synth.errors import UserError
from synth.job import reader
from synth.job.schema import Job

_PROGRAM = "import sys; from evidence.engine.kills import carry_out; carry_out(*sys.argv[1:])"
_RETRIES = 20


Start = Callable[[Path, float, bool], "subprocess.Popen[bytes]"]
"""Starts a run: its folder, the stand-in's sleep a frame [s], whether what failed is tried again."""


def carry_out(job: str, work: str, workers: str, root: str, again: str) -> None:
    """What the process of a run does."""
    if again == "again":
        Folder(Path(root)).forgive()
    with Bars() as bars:
        options = run.Options(workers=int(workers), work=work)
        run.run_job(Job.model_validate_json(job), Path(root), options, bars)


@measuring(
    "--count 20 --out runs/kills",
    out="docs/results/engine/kills",
    file="kills.json",
    passed=lambda found: found["equal"] and found["checksums_good"] and not found["leftovers"],
)
def kills(
    count: Annotated[int, typer.Option(help="Number of SIGKILLs.")] = 200,
    sequences: Annotated[int, typer.Option(help="Sequences of the job.")] = 50,
    workers: Annotated[int, typer.Option(help="Worker processes.")] = 2,
    job: Annotated[str, typer.Option(help="A job file or name, for all but its sequences.")] = "tiny",
    work: Annotated[str, typer.Option(help="What computes a sequence.")] = "evidence.engine.work:sequence",
    frame_s: Annotated[float, typer.Option(help="Sleep a frame of the stand-in [s].")] = 0.25,
    pause_s: Annotated[float, typer.Option(help="Longest wait between two kills [s].")] = 2.0,
    seed: Annotated[int, typer.Option(help="Of the kills.")] = 0,
) -> dict[str, Any]:
    """Kills runs at random moments, lets them resume, and compares with a run left in peace."""
    # The stand-in recovers no flow.
    ideal = ["flow.backend=ideal"] if work.startswith(stand_in.__name__) else []
    described = reader.load_job(job, [f"sequences={sequences}", *ideal])
    words = (described.model_dump_json(), work, str(workers))

    def start(root: Path, frame_s: float, again: bool) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-c", _PROGRAM, *words, str(root), "again" if again else "on"],
            env={**os.environ, **stand_in.environment(STAND_IN_FRAME_S=frame_s)},
            stderr=subprocess.DEVNULL,
        )

    with tempfile.TemporaryDirectory() as scratch:
        root, calm = Path(scratch) / "killed", Path(scratch) / "calm"
        history = _disturb(start, root, count, sequences, frame_s, pause_s, np.random.default_rng(seed))
        start(calm, 0.0, False).wait()
        found = {"job": job, "work": work, "sequences": sequences, **history, **_compare(root, calm)}
    return found | {"seed": seed}


def _disturb(
    start: Start,
    root: Path,
    count: int,
    sequences: int,
    frame_s: float,
    pause_s: float,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """Starts and kills until `count` processes died, then lets the dataset be finished; what was done."""
    victims = {"worker": 0, "engine": 0, "both": 0}
    run: subprocess.Popen[bytes] | None = None
    starts = retries = 0
    while sum(victims.values()) < count:
        if run is None or run.poll() is not None:
            again = root.exists() and bool(Folder(root).failures())
            retries += again
            if len(list(root.glob("*.zarr"))) == sequences:
                # All done before all kills: a few sequences are taken away, to be made again.
                for path in sorted(root.glob("*.zarr"))[:: max(sequences // 10, 1)]:
                    shutil.rmtree(path)
            if starts > 10 * count:
                raise UserError(f"{root}: runs end before anything can be killed")
            run = start(root, frame_s, again)
            starts += 1
        time.sleep(float(rng.uniform(0.05, pause_s)))
        kind = list(victims)[int(rng.integers(3))]
        victims[kind] += _kill(run, kind, rng)
    if run is not None:
        run.wait()
    for _ in range(_RETRIES):
        if len(list(root.glob("*.zarr"))) == sequences:
            break
        start(root, frame_s, True).wait()
    else:
        raise UserError(f"{root}: not complete after {_RETRIES} runs that nothing disturbed")
    return {"sigkills": victims, "starts": starts, "starts_that_retried_failed": retries}


def _compare(root: Path, calm: Path) -> dict[str, Any]:
    """The dataset that was disturbed, beside the other."""
    checks = {check.name: check.good for check in verify.verify_dataset(root).checks}
    ours, theirs = (index.dataset_hash(index.read_index(folder).to_pylist()) for folder in (root, calm))
    return {
        "hash_after_kills": ours,
        "hash_undisturbed": theirs,
        "leftovers": [path.name for path in root.glob("*.part")],
        "checksums_good": checks["checksum"] and checks["readable"] and checks["seal"],
        "equal": ours == theirs,
    }


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
