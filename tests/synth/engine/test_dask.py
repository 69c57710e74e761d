"""The Dask engine: errors of its configuration, and warnings about open clusters."""

from pathlib import Path

import pytest
from fake_run import Silent, options

from synth.engine import run
from synth.engine.dask import open_to, read_slurm
from synth.errors import UserError
from synth.job.schema import Job

JOB = Job(seed=2, sequences=6, frames=3, render={"size": (32, 24)}, flow={"backend": "ideal"})


def test_a_missing_scheduler_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("synth.engine.dask._CONNECT", "1s")
    with pytest.raises(UserError, match="no Dask scheduler answers"):
        run.run_job(JOB, tmp_path / "out", options("sequence", engine="dask://127.0.0.1:9"), Silent())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "named"),
    [("", "jobs"), ("cores: 4\nmemory: 8GB\n", "jobs"), ("jobs: [", "YAML")],
)
def test_wrong_slurm_files_are_refused(tmp_path: Path, text: str, named: str) -> None:
    (tmp_path / "slurm.yaml").write_text(text)
    with pytest.raises(UserError, match=named):
        read_slurm(tmp_path / "slurm.yaml")


@pytest.mark.parametrize(
    ("cluster", "warning"),
    [
        ("dask://localhost:8786", False),
        ("dask://node7:8786", True),
        ("tls://node7:8786", False),
        ({"cores": 1, "security": True}, True),  # the scheduler listens on every interface
        ({"interface": "ib0"}, True),
        ({"scheduler_options": {"host": "10.0.0.1"}}, True),
        ({"interface": "ib0", "security": True}, False),
    ],
)
def test_an_open_cluster_causes_a_warning(cluster: str | dict[str, object], warning: bool) -> None:
    assert bool(open_to(cluster)) is warning
