"""Killed and resumed runs, on this machine and on a cluster, give the bytes of an undisturbed run."""

import os
import shutil
import signal
import subprocess
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from fake_run import Silent, options, start, wait_for

from synth.checks import verify
from synth.dataset.folder import Folder
from synth.engine import run as engine
from synth.job.schema import Job

pytestmark = pytest.mark.trial

JOB = Job(seed=1, sequences=6, frames=5, render={"size": (64, 48)}, flow={"backend": "ideal"})
KILLS = 6


def children(pid: int) -> list[int]:
    """Processes started by `pid`, which is always a run started by this test."""
    with suppress(FileNotFoundError):
        tasks = list(Path(f"/proc/{pid}/task").iterdir())
        return [int(child) for task in tasks for child in (task / "children").read_text().split()]
    return []


def kill(run: subprocess.Popen[bytes], kind: str, rng: np.random.Generator) -> bool:
    """Kills a worker, the engine or both; returns whether there was one."""
    workers = children(run.pid)
    if kind != "engine":
        if not workers:
            return False
        with suppress(ProcessLookupError):
            os.kill(int(rng.choice(workers)), signal.SIGKILL)
    if kind != "worker":
        if run.poll() is not None:
            return False
        run.kill()
        run.wait()
    return True


def test_a_run_that_is_killed_again_and_again_makes_the_same_dataset(tmp_path: Path) -> None:
    rng, root = np.random.default_rng(1), tmp_path / "killed"
    killed, starts, run = 0, 0, None
    while killed < KILLS:
        if run is None or run.poll() is not None:
            if root.exists():
                Folder(root).clear_failures()
            if len(list(root.glob("*.zarr"))) == JOB.sequences:  # all are done before the last kill
                shutil.rmtree(root / "000002.zarr")
            run, starts = start(root, JOB, "slow"), starts + 1
            assert starts < 10 * KILLS, "runs end before anything can be killed"
        time.sleep(float(rng.uniform(0.05, 1.5)))
        killed += kill(run, str(rng.choice(["worker", "engine", "both"])), rng)
    assert run is not None
    run.wait()
    assert starts > 1, "no engine was killed"
    Folder(root).clear_failures()
    resumed = engine.run_job(JOB, root, options("sequence"), Silent())
    calm = engine.run_job(JOB, tmp_path / "calm", options("sequence"), Silent())
    assert resumed.content_hash == calm.content_hash
    assert not list(root.glob("*.part"))
    good = {check.name: not check.bad for check in verify.verify_dataset(root).checks}
    assert good["checksum"]
    assert good["readable"]
    assert good["seal"]


def test_a_lost_dask_worker_changes_no_byte(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
    import psutil
    from distributed.deploy.subprocess import SubprocessCluster

    root, here = tmp_path / "cluster", "127.0.0.1"
    alone = {"n_workers": 2, "threads_per_worker": 1, "worker_class": "distributed.Worker"}
    with SubprocessCluster(host=here, dashboard_address=f"{here}:0", **alone) as cluster:
        victim = psutil.Process(cluster.workers[0].process.pid)

        def kill_half_way() -> None:
            wait_for(lambda: len(list(root.glob("[0-9]*.zarr"))) >= 2)
            for process in (*victim.children(recursive=True), victim):
                process.kill()

        killer = threading.Thread(target=kill_half_way, daemon=True)
        killer.start()
        address = cluster.scheduler_address.replace("tcp", "dask")
        made = engine.run_job(JOB, root, options("slow", workers=None, engine=address), Silent())
        killer.join(timeout=10)
        assert not killer.is_alive(), "none was killed"
    calm = engine.run_job(JOB, tmp_path / "local", options("sequence"), Silent())
    assert (made.done, made.failed) == (6, {})
    assert made.content_hash == calm.content_hash
    assert not list(root.glob("*.part"))
