"""A run whose cluster loses a worker gives the bytes of an undisturbed run."""

import threading
from pathlib import Path

import pytest
from fake_run import Silent, options, wait_for

from synth.engine import run as engine
from synth.job.schema import Job

pytestmark = pytest.mark.trial

JOB = Job(seed=1, sequences=6, frames=5, render={"size": (64, 48)}, flow={"backend": "ideal"})


def test_a_lost_dask_worker_changes_no_byte(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
    import psutil
    from distributed.deploy.subprocess import SubprocessCluster

    root, host = tmp_path / "cluster", "127.0.0.1"
    cluster_options = {"n_workers": 2, "threads_per_worker": 1, "worker_class": "distributed.Worker"}
    with SubprocessCluster(host=host, dashboard_address=f"{host}:0", **cluster_options) as cluster:
        victim = psutil.Process(cluster.workers[0].process.pid)

        def kill_half_way() -> None:
            wait_for(lambda: len(list(root.glob("[0-9]*.zarr"))) >= 2)
            for process in (*victim.children(recursive=True), victim):
                process.kill()

        killer = threading.Thread(target=kill_half_way, daemon=True)
        killer.start()
        address = cluster.scheduler_address.replace("tcp", "dask")
        summary = engine.run_job(JOB, root, options("slow", workers=None, engine=address), Silent())
        killer.join(timeout=10)
        assert not killer.is_alive(), "none was killed"
    calm = engine.run_job(JOB, tmp_path / "local", options("sequence"), Silent())
    assert (summary.done, summary.failed) == (6, {})
    assert summary.content_hash == calm.content_hash
    assert not list(root.glob("*.part"))
