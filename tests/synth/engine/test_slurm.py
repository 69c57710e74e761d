"""A dataset rendered through a real SLURM on this machine: lost jobs and nodes change no byte."""

import threading
from pathlib import Path

import pytest
import slurm_cluster
from fake_run import Silent, wait_for

from synth.dataset.dataset_folder import Folder
from synth.engine import run
from synth.job.schema import Job

pytestmark = pytest.mark.trial

SMALL = {"render": {"size": [64, 48], "spp": 2}, "anatomy": {"vertices": 2500}, "fem": {"tets": 300}}
JOB = Job.model_validate({"seed": 7, "sequences": 5, "frames": 3, "flow": {"backend": "ideal"}, **SMALL})
CLUSTER_YAML = """
jobs: 2
cores: 1
processes: 1
memory: 2 GB
walltime: "00:20:00"
# Another scheduler on this machine may hold the port that a dashboard has by default.
scheduler_options: {host: 127.0.0.1, dashboard_address: "127.0.0.1:0"}
log_directory: LOGS
"""


class Disturber(Silent):
    """When the first sequence has ended, drains the node and kills one of the two jobs."""

    def __init__(self, node: str) -> None:
        super().__init__()
        self.node, self.killed, self._once = node, "", threading.Lock()

    def end(self, attempt: object, again: bool) -> None:
        super().end(attempt, again)  # type: ignore[arg-type]
        if self._once.acquire(blocking=False):
            slurm_cluster.call("scontrol", "update", f"nodename={self.node}", "state=drain", "reason=test")
            job_ids = slurm_cluster.call("squeue", "-h", "-t", "running", "-o", "%i").split()
            assert len(job_ids) == 2, "both slots should be busy"
            self.killed = job_ids[0]
            slurm_cluster.call("scancel", "--signal=KILL", "--full", self.killed)
            slurm_cluster.call("scancel", self.killed)


@pytest.mark.skipif(bool(slurm_cluster.missing()), reason=slurm_cluster.missing())
def test_a_killed_job_and_a_drained_node_change_no_byte(tmp_path: Path) -> None:
    pytest.importorskip("dask_jobqueue", reason="the extra `cluster` is not installed")
    cluster_file = tmp_path / "slurm.yaml"
    cluster_file.write_text(CLUSTER_YAML.replace("LOGS", str(tmp_path / "logs")))
    with slurm_cluster.slurm_cluster(tmp_path / "slurm") as node:
        watcher = Disturber(node)
        cluster_summary = run.run_job(
            JOB, tmp_path / "cluster", run.Options(engine=str(cluster_file)), watcher
        )
        assert watcher.killed
        wait_for(lambda: not slurm_cluster.call("squeue", "-h", "-t", "running", "-o", "%i"))
        assert "drain" in slurm_cluster.call("sinfo", "-h", "-o", "%T")
    assert (cluster_summary.done, cluster_summary.failed) == (JOB.sequences, {})
    local_summary = run.run_job(JOB, tmp_path / "local", run.Options(workers=1), Silent())
    assert cluster_summary.content_hash == local_summary.content_hash
    assert not list((tmp_path / "cluster").glob("*.part"))
    assert not list((Folder(tmp_path / "cluster").state / "failed").glob("*"))
