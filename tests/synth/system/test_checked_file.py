"""Untrusted files are read within limits and run no code; files are written as a whole or not at all."""

import io
import os
import pickle
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from synth.errors import UserError
from synth.system import checked_file, resources

HOME = str(Path(checked_file.__file__).parents[2])


class Malicious:
    """Runs code when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (os.mkdir, ("ran",))


def encode_png(width: int, height: int) -> bytes:
    """A black picture; one of 32,000 x 32,000 pixels has a megabyte."""
    file = io.BytesIO()
    Image.new("1", (width, height)).save(file, "png")
    return file.getvalue()


@pytest.mark.parametrize("name", ["pipe", "folder", "hole", "none"])
def test_only_regular_files_of_a_bounded_size_are_opened(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    with (tmp_path / "hole").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(UserError):
        checked_file.open_file(tmp_path / name, 1 << 20)


@pytest.mark.parametrize(
    ("read", "write"),
    [
        (checked_file.read_yaml, lambda path: path.write_text("d: !!python/object/apply:os.mkdir [ran]")),
        (checked_file.read_json, lambda path: path.write_text("{")),
        (checked_file.read_arrays, lambda path: np.array([Malicious()], object).dump(path)),
        (checked_file.read_arrays, lambda path: path.write_bytes(pickle.dumps(Malicious()))),
        (checked_file.read_arrays, lambda path: path.write_bytes(b"PK cut")),
        (checked_file.read_picture, lambda path: path.write_bytes(encode_png(32_000, 32_000))),
    ],
)
def test_a_corrupted_file_is_one_line_and_runs_no_code(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    read: Callable[[Path], object],
    write: Callable[[Path], object],
) -> None:
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "a")
    with pytest.raises(UserError) as error:
        read(tmp_path / "a")
    assert "\n" not in str(error.value)
    assert not (tmp_path / "ran").exists()


def write_npz(path: Path, shape: tuple[int, ...], size: int, method: int = zipfile.ZIP_DEFLATED) -> None:
    """An .npz of a small array `a` and of `b`, whose header states float64 of a shape for `size` bytes."""
    np.savez_compressed(path, a=np.arange(3))
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f8", "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(path, "a", method) as archive, archive.open("b.npy", "w") as entry:
        entry.write(head.getvalue())
        for start in range(0, size, 1 << 20):
            entry.write(bytes(min(1 << 20, size - start)))


@pytest.mark.slow
def test_an_array_is_expanded_when_it_is_needed_and_fits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """800 MB in a file of 0.8 MB, where 1 GB is free: its neighbour is read all the same."""
    write_npz(tmp_path / "a.npz", (10**8,), 8 * 10**8)
    assert (tmp_path / "a.npz").stat().st_size < 10**6
    monkeypatch.setattr(resources, "free_memory", lambda: 10**9)
    file = checked_file.ArrayFile(tmp_path / "a.npz")
    assert file.shapes["b"] == (10**8,)
    assert file["a"].tolist() == [0, 1, 2]
    with pytest.raises(UserError, match="GB of memory"):
        file["b"]


@pytest.mark.parametrize(
    ("shape", "size", "method"),
    [
        ((10**12,), 80, zipfile.ZIP_DEFLATED),
        ((10,), 80_000, zipfile.ZIP_DEFLATED),
        ((-10,), 80, zipfile.ZIP_DEFLATED),
        ((10,), 80, zipfile.ZIP_BZIP2),
        ((10,), 80, zipfile.ZIP_LZMA),
    ],
)
def test_an_array_has_the_size_that_its_header_states(
    tmp_path: Path, shape: tuple[int, ...], size: int, method: int
) -> None:
    write_npz(tmp_path / "a.npz", shape, size, method)
    with pytest.raises(UserError):
        checked_file.ArrayFile(tmp_path / "a.npz")


def test_free_memory_is_at_most_the_machines() -> None:
    meminfo = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
    free = resources.free_memory()
    assert free is not None
    assert 0 < free <= int(meminfo["MemTotal"].split()[0]) * 1024
    with pytest.raises(ValueError, match="GB"):
        resources.refuse_excess(free)
    resources.refuse_excess(free // 10)


def test_values_of_valid_files_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("a: 1\nb: [1.5, true, ~]\nc: 2001-01-01\nd: &d {e: 1}\nf: *d\n")
    expected = {"a": 1, "b": [1.5, True, None], "c": "2001-01-01", "d": {"e": 1}, "f": {"e": 1}}
    assert checked_file.read_yaml(tmp_path / "a.yaml") == expected
    np.savez(tmp_path / "a.npz", a=np.arange(3), b=np.ones((2, 2), bool))
    shapes = {name: array.shape for name, array in checked_file.read_arrays(tmp_path / "a.npz").items()}
    assert shapes == {"a": (3,), "b": (2, 2)}
    (tmp_path / "a.png").write_bytes(encode_png(5, 3))
    assert checked_file.read_picture(tmp_path / "a.png").shape == (3, 5, 3)


def test_a_failed_write_leaves_files_unchanged(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("before")
    for make, name in ((checked_file.part_of, "a"), (checked_file.folder_of, "b")):
        with pytest.raises(ZeroDivisionError), make(tmp_path / name) as part:  # noqa: PT012
            (part if part.is_file() else part / "c").write_text("half")
            raise ZeroDivisionError
    assert (tmp_path / "a").read_text() == "before"
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_what_a_killed_process_left_is_deleted_and_what_another_writes_is_not(tmp_path: Path) -> None:
    """A folder being written is locked by its process; the name of another target only begins alike."""
    victim = "import os; from pathlib import Path; from synth.system import checked_file\n"
    victim += "with checked_file.folder_of(Path('b')) as part: (part / 'c').mkdir(); os.kill(os.getpid(), 9)"
    process = subprocess.run(
        [sys.executable, "-c", victim], cwd=tmp_path, env={**os.environ, "PYTHONPATH": HOME}
    )
    assert process.returncode == -9
    (leftover,) = tmp_path.glob(".b.*.part")
    (tmp_path / ".b.c.01234567.part").mkdir()
    (tmp_path / "precious").mkdir()
    (tmp_path / ".b.01234567.part").symlink_to(tmp_path / "precious")
    with checked_file.folder_of(tmp_path / "b") as folder:
        assert not leftover.exists()
        (folder / "own").touch()
        with pytest.raises(ZeroDivisionError), checked_file.folder_of(tmp_path / "b"):
            raise ZeroDivisionError
        assert (folder / "own").exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        ".b.01234567.part", ".b.c.01234567.part", "b", "precious",
    ]  # fmt: skip


def test_a_folder_without_space_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError):
        checked_file.make_folder(tmp_path / "new/out", 1 << 60)
    checked_file.make_folder(tmp_path / "new/out", 1 << 20)
    (tmp_path / "wall").write_text("")
    with pytest.raises(UserError):
        checked_file.make_folder(tmp_path / "wall/out")
    with pytest.raises(ZeroDivisionError), checked_file.open_folder(tmp_path / "a/b"):
        raise ZeroDivisionError
    assert not (tmp_path / "a").exists()
