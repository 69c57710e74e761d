"""Files of others are read within limits and run nothing; files of ours are there whole or not at all."""

from __future__ import annotations

import os
import pickle
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from synth.errors import UserError
from synth.system import checked_file


class Villain:
    """Runs code when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (os.mkdir, ("ran",))


def png(width: int, height: int) -> bytes:
    """A picture of zeros: a square of 32,000 takes a megabyte."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    squeezed = zlib.compressobj(9)
    row = bytes(1 + (width + 7) // 8)
    data = b"".join(squeezed.compress(row) for _ in range(height)) + squeezed.flush()
    head = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


@pytest.mark.parametrize("name", ["pipe", "device", "folder", "hole", "none", "circle", "x" * 5000, "a\0b"])
def test_only_regular_files_of_a_bounded_size_are_opened(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "device").symlink_to("/dev/zero")
    (tmp_path / "folder").mkdir()
    (tmp_path / "circle").symlink_to(tmp_path / "circle")
    with (tmp_path / "hole").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(UserError):
        checked_file.open_file(tmp_path / name, 1 << 20)


@pytest.mark.parametrize(
    "text",
    [
        "a0: &a0 [x,x]\n" + "".join(f"a{k}: &a{k} [*a{k - 1},*a{k - 1}]\n" for k in range(1, 40)),
        "seed: &a [*a]",
        "seed: " + "[" * 50_000,
        "- " * 50_000,
        "seed: 0x" + "f" * 10_000,
        "seed: " + "9" * 10_000,
        "seed: 2001-99-99",
        "x" * 300_000,
        "a: !!binary aGk=",
        "seed: [",
    ],
    ids=range(10),
)
def test_yaml_is_bounded(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(UserError):
        checked_file.read_yaml(tmp_path / "a.yaml")


def test_yaml_gives_plain_values_and_runs_nothing(tmp_path: Path) -> None:
    text = "a: 1\nb: [1.5, true, ~]\n2: 2001-01-01\nd: !!python/object/apply:os.mkdir [ran]\n"
    (tmp_path / "a.yaml").write_text(text)
    held = checked_file.read_yaml(tmp_path / "a.yaml")
    assert held == {"a": 1, "b": [1.5, True, None], "2": "2001-01-01", "d": ["ran"]}
    assert all(type(value) in (int, str, list) for value in held.values())


def test_arrays_are_numbers_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    np.savez(tmp_path / "good.npz", a=np.arange(3), b=np.ones((2, 2), bool))
    assert {name: held.shape for name, held in checked_file.read_arrays(tmp_path / "good.npz").items()} == {
        "a": (3,),
        "b": (2, 2),
    }
    np.savez(tmp_path / "code.npz", a=np.array([Villain()], object), allow_pickle=True)
    np.savez(tmp_path / "text.npz", a=np.array(["x"]))
    np.save(tmp_path / "one.npz", np.arange(3))
    (tmp_path / "pickle.npz").write_bytes(pickle.dumps(Villain()))
    (tmp_path / "cut.npz").write_bytes((tmp_path / "good.npz").read_bytes()[:-30])
    for name in ("code", "text", "pickle", "cut", "none"):
        with pytest.raises(UserError):
            checked_file.read_arrays(tmp_path / f"{name}.npz")
    assert not (tmp_path / "ran").exists()


def test_pictures_are_bounded_before_they_are_decoded(tmp_path: Path) -> None:
    (tmp_path / "good.png").write_bytes(png(5, 3))
    assert checked_file.read_picture(tmp_path / "good.png").shape == (3, 5, 3)
    for name, data in (
        ("large", png(32_000, 32_000)),
        ("none", png(0, 0)),
        ("cut", b"GIF89a"),
        ("text", b"x"),
    ):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(UserError):
            checked_file.read_picture(tmp_path / name)


def test_a_storage_of_opencv_is_bounded(tmp_path: Path) -> None:
    path = tmp_path / "a"
    matrix = (
        "%YAML:1.0\n---\nK: !!opencv-matrix\n  rows: 1\n  cols: 2\n  dt: d\n  data: [ 1., 2. ]\nwidth: 5\n"
    )
    path.write_text(matrix)
    held = checked_file.read_storage(path)
    assert held["K"].tolist() == [[1, 2]]
    assert held["width"] == 5
    head, deep = "%YAML:1.0\n---\nK: ", 100_000
    for text in (
        head + "[" * deep,
        head + "- " * deep,
        head + "a: " * deep,
        '<?xml version="1.0"?><opencv_storage>' + "<a>" * deep,
        "[" * deep,
        matrix.replace("rows: 1", "rows: 99999"),
        "",
    ):
        path.write_text(text)
        with pytest.raises(UserError):
            checked_file.read_storage(path)


@pytest.mark.parametrize("data", [b"[" * 100_000, b"{", b"\xff\xfe", b"9" * 10_000], ids=range(4))
def test_json_is_bounded(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "a.json").write_bytes(data)
    with pytest.raises(UserError):
        checked_file.read_json(tmp_path / "a.json")


def test_links_that_lie_in_the_way_are_not_followed(tmp_path: Path) -> None:
    secret, folder = tmp_path / "secret", tmp_path / "foreign"
    secret.write_text("mine")
    folder.mkdir()
    (folder / "a").symlink_to(secret)
    checked_file.write_whole(folder / "a", "theirs")
    assert secret.read_text() == "mine"
    assert not (folder / "a").is_symlink()
    assert (folder / "a").stat().st_mode == secret.stat().st_mode
    (folder / "d").symlink_to(tmp_path / "nowhere")
    with pytest.raises(UserError), checked_file.folder_of(folder / "d"):
        pass


def fail(done: int) -> None:
    """After `done` characters."""
    raise ZeroDivisionError


def test_what_fails_leaves_what_was_there(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("before")
    for make in (checked_file.part_of, checked_file.folder_of):
        place = tmp_path / ("a" if make is checked_file.part_of else "b")
        with pytest.raises(ZeroDivisionError), make(place) as part:
            fail((part if part.is_file() else part / "c").write_text("half"))
    assert (tmp_path / "a").read_text() == "before"
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_a_folder_without_room_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError):
        checked_file.make_folder(tmp_path / "new/out", 1 << 60)
    checked_file.make_folder(tmp_path / "new/out", 1 << 20)
    (tmp_path / "wall").write_text("")
    with pytest.raises(UserError):
        checked_file.make_folder(tmp_path / "wall/out")
    with pytest.raises(ZeroDivisionError), checked_file.made_folder(tmp_path / "a/b"):
        raise ZeroDivisionError
    assert not (tmp_path / "a").exists()
