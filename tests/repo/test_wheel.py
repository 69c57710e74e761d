"""What is installed holds the product, all of it, and nothing else."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from sources import ROOT

from bench.cli import _MEASURING

pytestmark = pytest.mark.slow

PRODUCT = ("synth", "learn", "bench")


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel's content, unpacked; built from a copy, as a build leaves folders behind."""
    source, made, content = (tmp_path_factory.mktemp(name) for name in ("source", "wheel", "installed"))
    for name in (*PRODUCT, "evidence", "tests"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    pip = [sys.executable, "-m", "pip", "wheel", "--disable-pip-version-check", "--no-deps"]
    done = subprocess.run(
        [*pip, "--no-build-isolation", "-q", "-w", str(made), "."], cwd=source, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = made.glob("*.whl")
    with zipfile.ZipFile(wheel) as packed:
        packed.extractall(content)
    return content


def typed(installed: Path, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """A command of the wheel, typed in a folder outside the checkout."""
    environment = {**os.environ, "PYTHONPATH": str(installed), "COLUMNS": "200"}
    return subprocess.run(
        [sys.executable, "-m", *words], cwd=folder, capture_output=True, text=True, env=environment
    )


def test_it_holds_all_of_the_product_and_nothing_else(installed: Path) -> None:
    held = {path.relative_to(installed).as_posix() for path in installed.rglob("*") if path.is_file()}
    ours = {
        path.relative_to(ROOT).as_posix()
        for name in PRODUCT
        for path in (ROOT / name).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and path.suffix not in (".nbi", ".nbc")
    }
    assert {name for name in held if ".dist-info/" not in name} == ours
    assert {"synth/py.typed", "synth/job/named/demo.yaml", "synth/flow/toolnet.pt"} <= held
    assert [name for name in held if name.endswith("bench/scoring/report.html.jinja")]


def test_its_commands_work_without_the_evidence(installed: Path, tmp_path: Path) -> None:
    said = typed(installed, tmp_path, "bench", "--help")
    assert said.returncode == 0, said.stderr
    words = said.stdout.split()
    assert {"score", "check", "flow"} <= set(words)
    assert not {"pareto", "stability", "experiment"} & set(words)
    for name in _MEASURING:
        refused = typed(installed, tmp_path, "bench", name, "flow", "--out", "runs", "--help")
        assert refused.returncode == 2
        assert f"in a clone's folder it is python -m bench {name}" in refused.stderr
    from_checkout = typed(ROOT, tmp_path, "bench", "--help").stdout.split()
    assert set(_MEASURING) <= set(from_checkout), "the evidence would not be seen"


def test_its_jobs_and_templates_are_found(installed: Path, tmp_path: Path) -> None:
    for words in (("synth", "new", "job.yaml"), ("synth", "render", "--help"), ("learn", "--help")):
        done = typed(installed, tmp_path, *words)
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "job.yaml").is_file()
    where = "import synth.job.reader as r; r.load_job('demo', []); print(r.__file__)"
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    found = subprocess.run(
        [sys.executable, "-c", where], cwd=tmp_path, capture_output=True, text=True, env=environment
    )
    assert found.stdout.startswith(str(installed)), found.stdout + found.stderr
