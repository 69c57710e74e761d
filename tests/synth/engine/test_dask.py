"""The Dask engine: same dataset as on one machine, and words for what is missing."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import pytest
from fake_run import Silent, options, run_here, wait_for

from evidence.engine.dask import local_cluster
from synth.dataset.folder import Folder
from synth.dataset.index import dataset_hash, read_index
from synth.engine import run
from synth.engine.dask import read_slurm, slurm
from synth.errors import UserError
from synth.job.schema import Job

JOB = Job(seed=2, sequences=6, frames=3, render={"size": (32, 24)}, flow={"backend": "ideal"})


class Killing(Silent):
    """Kills a worker of the cluster as soon as two sequences have ended."""

    def __init__(self, victim: int) -> None:
        super().__init__()
        self.victim = victim

    def end(self, attempt: object, again: bool) -> None:
        super().end(attempt, again)  # type: ignore[arg-type]
        if len(self.attempts) == 2:
            os.killpg(self.victim, signal.SIGKILL)


@pytest.mark.slow
def test_a_lost_worker_costs_nothing_but_time(tmp_path: Path) -> None:
    root = tmp_path / "cluster"
    with local_cluster(2) as (address, processes):
        made = run.run_job(JOB, root, options("slow", engine=f"dask://{address}"), Killing(processes[0].pid))
        wait_for(lambda: processes[0].poll() is not None)
    assert (made.done, made.failed) == (6, {})
    run_here(tmp_path / "local", JOB.model_dump_json(), "sequence")
    assert made.content_hash == dataset_hash(read_index(tmp_path / "local").to_pylist())
    assert not list(root.glob("*.part"))


def test_the_jobs_script_holds_what_was_asked(tmp_path: Path) -> None:
    pytest.importorskip("dask_jobqueue", reason="the extra `cluster` is not installed")
    lines = ["jobs: 8", "cores: 1", "processes: 1", "memory: 8 GB", 'walltime: "12:00:00"']
    (tmp_path / "slurm.yaml").write_text(
        "\n".join([*lines, 'job_extra_directives: ["--gres=gpu:1"]', "queue: long"])
    )
    described = read_slurm(tmp_path / "slurm.yaml")
    assert described.pop("jobs") == 8
    with slurm({**described, "interface": "lo"}) as cluster:
        script = cluster.job_script()
    for asked in ("-p long", "--cpus-per-task=1", "--mem=8G", "-t 12:00:00", "--gres=gpu:1"):
        assert f"#SBATCH {asked}\n" in script
    started = script.splitlines()[-1]
    assert started.startswith(sys.executable)
    assert "--nthreads 1 " in started


def test_an_earlier_runs_workers_see_that_its_turn_is_over(tmp_path: Path) -> None:
    folder = Folder(tmp_path)
    folder.state.mkdir()
    for turn in (1, 2, 3):
        folder.pass_turn()
        assert (folder.turn, int(folder.turn_file.read_text())) == (turn, turn)


def test_no_scheduler_is_one_line_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("synth.engine.dask._CONNECT", "1s")
    with pytest.raises(UserError, match="no Dask scheduler answers"):
        run.run_job(JOB, tmp_path / "out", options("sequence", engine="dask://127.0.0.1:9"), Silent())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "is neither local, dask://host:port nor a file"),
        ("cores: 4\nmemory: 8GB\n", "how many `jobs`"),
        ("jobs: 4\n", "cores and memory"),
        ("jobs: [", "cannot be read"),
    ],
)
def test_slurm_files_that_do_not_do(tmp_path: Path, text: str | None, message: str) -> None:
    if text is not None:
        (tmp_path / "slurm.yaml").write_text(text)
    with pytest.raises(UserError, match=message):
        read_slurm(tmp_path / "slurm.yaml")
