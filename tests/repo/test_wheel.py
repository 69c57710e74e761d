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

pytestmark = pytest.mark.trial

PRODUCT = ("synth", "learn", "bench")


def test_the_wheel_holds_the_product_and_its_commands_run(tmp_path: Path) -> None:
    source, made, content = (tmp_path / name for name in ("source", "made", "content"))
    for name in PRODUCT:  # a copy, as a build leaves folders behind
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    pip = [sys.executable, "-m", "pip", "wheel", "--disable-pip-version-check", "--no-deps"]
    build = [*pip, "--no-build-isolation", "-q", "-w", str(made), "."]
    subprocess.run(build, cwd=source, check=True)
    (wheel,) = made.glob("*.whl")
    with zipfile.ZipFile(wheel) as packed:
        packed.extractall(content)

    held = {path.relative_to(content).as_posix() for path in content.rglob("*") if path.is_file()}
    ours = {
        path.relative_to(ROOT).as_posix()
        for name in PRODUCT
        for path in (ROOT / name).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and path.suffix not in (".nbi", ".nbc")
    }
    assert {name for name in held if ".dist-info/" not in name} == ours

    environment = {**os.environ, "PYTHONPATH": str(content)}
    where = "import synth.job.reader as r; r.load_job('demo', []); print(r.__file__)"
    helps = (["-m", program, "--help"] for program in PRODUCT)
    for words in (*helps, ["-m", "synth", "new", "job.yaml"], ["-c", where]):
        done = subprocess.run(
            [sys.executable, *words], cwd=tmp_path, env=environment, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(str(content)), "outside the checkout, the wheel's own"
    assert (tmp_path / "job.yaml").is_file()
