"""Files and folders written whole: nothing half, no link followed, and room found before the work."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from synth.errors import UserError
from synth.system import whole_file


def test_a_file_is_there_whole_and_with_the_usual_rights(tmp_path: Path) -> None:
    (tmp_path / "plain").write_text("")
    whole_file.write_whole(tmp_path / "a", "one")
    whole_file.write_whole(tmp_path / "a", b"two")
    assert (tmp_path / "a").read_text() == "two"
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "plain").stat().st_mode
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "plain"]


def test_links_that_lie_in_the_way_are_not_followed(tmp_path: Path) -> None:
    secret, folder = tmp_path / "secret", tmp_path / "foreign"
    secret.write_text("mine")
    folder.mkdir()
    for name in ("a", ".a.part", f".a.{os.getpid()}-0.part"):
        (folder / name).symlink_to(secret)
    whole_file.write_whole(folder / "a", "theirs")
    assert secret.read_text() == "mine"
    assert not (folder / "a").is_symlink()
    assert (folder / "a").read_text() == "theirs"
    with whole_file.folder_of(folder / "b") as part:
        (part / "c").write_text("x")
    (folder / "d").symlink_to(tmp_path / "nowhere")
    with pytest.raises(UserError, match="exists already"), whole_file.folder_of(folder / "d"):
        pass


def fail(done: int) -> None:
    """After `done` characters."""
    raise ZeroDivisionError


def test_what_fails_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("before")
    for make in (whole_file.part_of, whole_file.folder_of):
        place = tmp_path / ("a" if make is whole_file.part_of else "new/b")
        with pytest.raises(ZeroDivisionError), make(place) as part:
            fail((part if part.is_file() else part / "c").write_text("half"))
    assert (tmp_path / "a").read_text() == "before"
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_a_folder_without_room_is_refused_and_gone(tmp_path: Path) -> None:
    with (
        pytest.raises(UserError, match=r"cannot be written \((No space left|File too large)"),
        whole_file.made_folder(tmp_path / "new/out", 1 << 60),
    ):
        raise AssertionError("the work began")
    assert not list(tmp_path.iterdir())
    with whole_file.made_folder(tmp_path / "new/out", 1 << 20):
        pass
    assert not list((tmp_path / "new/out").iterdir())


def test_a_folder_that_was_there_stays(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with pytest.raises(ZeroDivisionError), whole_file.made_folder(tmp_path / "out/new"):
        raise ZeroDivisionError
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert not list((tmp_path / "out").iterdir())


def test_what_an_interrupted_writing_left_is_swept(tmp_path: Path) -> None:
    (tmp_path / "keep").write_text("")
    (tmp_path / ".a.1-0.part").write_text("")
    (tmp_path / ".b.1-0.part").symlink_to(tmp_path / "keep")
    (tmp_path / ".c.1-0.part").mkdir()
    whole_file.sweep(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["keep"]
    assert whole_file.is_part(".a.1-0.part", "a")
    assert not whole_file.is_part(".ab.1-0.part", "a")
