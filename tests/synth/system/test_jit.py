"""Compiled code runs whoever installed it: cached beside it, at home, in a temporary folder or not at all."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import synth

# A ray through each of two pixels; one meets the triangle.
_PROGRAM = """
import numpy as np
import synth
from synth.render import truth
assert synth.__file__.startswith({package!r}), synth.__file__
corners = np.array([[-1.0, -1.0, 5.0], [2.0, -1.0, 5.0], [-1.0, 2.0, 5.0]])
flat = np.array([[-1.0, -1.0], [2.0, -1.0], [-1.0, 2.0]])
directions = np.array([[0.0, 0.0, 1.0], [0.9, 0.9, 1.0]])
faces = np.array([[0, 1, 2]], np.int32)
found = truth._cast(corners, flat, faces, directions, np.array([0, 1]), np.array([0, 1, 2]), 2, 1)
print(found[0].tolist(), round(float(found[2][0]), 6))
"""


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the package into which no cache can be written, by root neither."""
    home = tmp_path_factory.mktemp("package")
    source = Path(synth.__file__).parent
    shutil.copytree(source, home / "synth", ignore=shutil.ignore_patterns("__pycache__", "*.pt"))
    for folder in [home / "synth", *(path for path in (home / "synth").rglob("*") if path.is_dir())]:
        (folder / "__pycache__").write_text("in the way of the folder of that name")
    return home


def run(package: Path, scratch: Path, **environment: str) -> list[Path]:
    """Casts rays in a process of its own; returns the index files that numba left in `scratch` or here."""
    kept = {key: value for key, value in os.environ.items() if key not in ("HOME", "NUMBA_CACHE_DIR")}
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM.format(package=str(package))],
        env={**kept, "TMPDIR": str(scratch), "PYTHONPATH": str(package), **environment},
        cwd=scratch,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == "[0, -1] 5.0\n"
    return list(scratch.rglob("*.nbi"))


def temporary(scratch: Path) -> Path:
    return scratch / f"sulcus-{os.getuid()}"


@pytest.mark.slow
@pytest.mark.parametrize("home", [{}, {"HOME": "/dev/null"}, {"HOME": ""}], ids=["unset", "file", "empty"])
def test_without_a_home_the_cache_is_temporary(package: Path, tmp_path: Path, home: dict[str, str]) -> None:
    # The home of the account, which is looked up where the variable is unset, is barred by this one.
    left = run(package, tmp_path, XDG_CACHE_HOME="/dev/null/cache", **home)
    assert left
    assert all(temporary(tmp_path) in path.parents for path in left)
    assert temporary(tmp_path).stat().st_mode & 0o777 == 0o700


@pytest.mark.slow
def test_a_home_comes_before_that(package: Path, tmp_path: Path) -> None:
    left = run(package, tmp_path, XDG_CACHE_HOME=str(tmp_path / "cache"))
    assert left
    assert all(tmp_path / "cache" in path.parents for path in left)


@pytest.mark.slow
@pytest.mark.parametrize("foreign", ["open", "link", "file"])
def test_a_folder_that_others_may_write_is_not_used(package: Path, tmp_path: Path, foreign: str) -> None:
    if foreign == "file":
        temporary(tmp_path).write_text("")
    elif foreign == "open":
        temporary(tmp_path).mkdir()
        temporary(tmp_path).chmod(0o777)
    else:
        (tmp_path / "elsewhere").mkdir(mode=0o700)
        temporary(tmp_path).symlink_to(tmp_path / "elsewhere")
    assert run(package, tmp_path, XDG_CACHE_HOME="/dev/null/cache") == []


@pytest.mark.slow
def test_the_cache_lies_beside_a_package_that_can_be_written(package: Path, tmp_path: Path) -> None:
    shutil.copytree(package, tmp_path / "own")
    for blocked in (tmp_path / "own").rglob("__pycache__"):
        blocked.unlink()
    left = run(tmp_path / "own", tmp_path, XDG_CACHE_HOME=str(tmp_path / "cache"))
    assert tmp_path / "own/synth/render/__pycache__" in {path.parent for path in left}
    assert not (tmp_path / "cache").exists()


@pytest.mark.slow
@pytest.mark.parametrize("home", ["unset", "read-only"])
def test_a_sequence_is_rendered_where_nothing_else_can_be_written(
    package: Path, tmp_path: Path, home: str
) -> None:
    """As an unprivileged user has it: the whole program from a package, and with a home, that are not theirs.

    A file stands where the home's folders would be made, which stops root too.
    """
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    (tmp_path / "home").write_text("")
    kept = {key: value for key, value in os.environ.items() if key in ("PATH", "LANG", "OMP_NUM_THREADS")}
    homes = {} if home == "unset" else {"HOME": str(tmp_path / "home")}
    changes = ["sequences=1", "frames=2", "render.size=[64,48]", "fem.tets=400", "anatomy.vertices=4000"]
    # Without HOME the account's own folder is looked up, which may well be writable: it is barred.
    where = {"TMPDIR": str(scratch), "PYTHONPATH": str(package), "XDG_CACHE_HOME": "/dev/null/cache"}
    done = subprocess.run(
        [sys.executable, "-m", "synth", "render", "tiny", "-o", str(tmp_path / "out"), *changes],
        env={**kept, **homes, **where},
        cwd=scratch,
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "out/000000.zarr").is_dir()
    loops = {path.name.split("-")[0] for path in scratch.rglob("*.nbi")}
    assert "truth._cast_loop" in loops, loops
    assert "fused.linearise" in loops, loops
