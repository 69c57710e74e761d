"""Stored results: whether the files that made them have changed."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from evidence import status


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A checkout with a script, an imported module, another module, data, and the script's result."""
    files = {
        "evidence/flow/pareto.py": "from synth import flow",
        "synth/__init__.py": "",
        "synth/flow.py": "import synth.job",
        "synth/job.py": "SIZE = 1",
        "synth/other.py": "",
        "data/job.yaml": "frames: 3",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", "-A")
    git(tmp_path, "-c", "user.name=a", "-c", "user.email=a@b", "commit", "-qm", "first")
    found = {
        "command": "python -m evidence.flow.pareto --seeds 3",
        "commit": git(tmp_path, "rev-parse", "--short", "HEAD").strip(),
        "cpu_hours": 1.5,
        "data": status.data(tmp_path / "data/job.yaml", home=tmp_path),
    }
    (tmp_path / "results").mkdir()
    (tmp_path / "results/pareto.json").write_text(json.dumps(found))
    return tmp_path


def git(folder: Path, *words: str) -> str:
    return subprocess.run(["git", "-C", folder, *words], check=True, capture_output=True, text=True).stdout


@pytest.mark.parametrize(
    ("changed", "found"),
    [("synth/other.py", ()), *((name, (name,)) for name in ("synth/job.py", "data/job.yaml"))],
)
def test_stale_if_imports_or_data_changed(home: Path, changed: str, found: tuple[str, ...]) -> None:
    assert [one.changed for one in status.gather(home / "results", home)] == [()]
    (home / changed).write_text((home / changed).read_text() + "\n")
    (one,) = status.gather(home / "results", home)
    assert (one.changed, one.cpu_hours) == (found, 1.5)
