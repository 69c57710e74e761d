"""Does a run on a real Dask cluster survive the loss of a worker, and give the dataset of one machine?"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from evidence.engine import work
from evidence.measuring import measuring
from synth.engine import run
from synth.engine.progress import Bars
from synth.job.schema import Job


@measuring(
    "--workers 2 --out runs/dask",
    out="docs/results/engine/dask",
    file="dask.json",
    passed=lambda found: (
        found["hash_on_cluster"] == found["hash_on_one_machine"]
        and found["one_killed"]
        and not found["leftovers"]
    ),
)
def dask(
    sequences: Annotated[int, typer.Option(help="Sequences of the job.")] = 12,
    workers: Annotated[int, typer.Option(help="Dask worker processes.")] = 3,
    frame_s: Annotated[float, typer.Option(help="Sleep a frame of the stand-in [s].")] = 0.2,
) -> dict[str, Any]:
    """Runs on Dask workers on this machine, kills one half-way, compares with a local run."""
    picture = {"render": {"size": (64, 48)}, "flow": {"backend": "ideal"}}
    job = Job.model_validate({"seed": 1, "sequences": sequences, "frames": 5, **picture})
    options = run.Options(
        work="evidence.engine.work:sequence", environment=work.environment(STAND_IN_FRAME_S=frame_s)
    )
    swift = replace(options, environment=work.environment())
    with tempfile.TemporaryDirectory() as scratch:
        root = Path(scratch) / "cluster"
        with local_cluster(workers) as (address, processes), Bars() as bars:
            killer = threading.Thread(
                target=_kill_half_way, args=(root, sequences, processes[0]), daemon=True
            )
            killer.start()
            on_cluster = run.run_job(job, root, replace(options, engine=f"dask://{address}"), bars)
            killer.join(timeout=10)
            killed = processes[0].poll() is not None
        leftovers = [path.name for path in root.glob("*.part")]
        with Bars() as bars:
            here = run.run_job(job, Path(scratch) / "local", swift, bars)
    return {
        "sequences": sequences,
        "dask_workers": workers,
        "one_killed": killed,
        "done": on_cluster.done,
        "failed": on_cluster.failed,
        "hash_on_cluster": on_cluster.content_hash,
        "hash_on_one_machine": here.content_hash,
        "leftovers": leftovers,
    }


@contextmanager
def local_cluster(workers: int) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A scheduler and `workers` worker processes on this machine: `host:port`, and the workers' processes."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}
    program = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--no-dashboard"]
    words = ["--host", "127.0.0.1", "--port", address.split(":")[1]]
    scheduler = subprocess.Popen([*program, *words], **quiet)  # type: ignore[call-overload]
    program = [sys.executable, "-m", "distributed.cli.dask_worker", f"tcp://{address}", "--no-dashboard"]
    words = ["--nthreads", "1", "--no-nanny", "--host", "127.0.0.1"]
    processes = []
    try:
        for _ in range(workers):
            processes.append(subprocess.Popen([*program, *words], **quiet))  # type: ignore[call-overload]
        yield address, processes
    finally:
        for process in [*processes, scheduler]:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def _kill_half_way(root: Path, sequences: int, victim: subprocess.Popen[bytes]) -> None:
    for _ in range(3000):
        if len(list(root.glob("[0-9]*.zarr"))) >= sequences // 3:
            os.killpg(victim.pid, signal.SIGKILL)
            victim.wait()
            return
        time.sleep(0.1)
