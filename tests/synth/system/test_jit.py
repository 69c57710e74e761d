"""Compiled code is kept beside the package, at home or in a temporary folder of one's own, or not at all."""

from __future__ import annotations

import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from synth.system import cache


def test_the_cache_is_where_it_can_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    mine = tmp_path / f"sulcus-{os.getuid()}"
    for name, value, at in (
        ("SULCUS_CACHE", str(tmp_path / "told"), tmp_path / "told"),
        ("XDG_CACHE_HOME", str(tmp_path / "user"), tmp_path / "user/sulcus"),
        ("HOME", str(tmp_path / "home"), tmp_path / "home/.cache/sulcus"),
        ("HOME", "/dev/null", mine),
        ("HOME", "", mine),
    ):
        for one in ("SULCUS_CACHE", "XDG_CACHE_HOME", "HOME"):
            monkeypatch.delenv(one, raising=False)
        monkeypatch.setenv(name, value)
        found = cache.folder.__wrapped__("loops")
        assert found == at / "loops"
        assert found.is_dir()
    assert mine.stat().st_mode & 0o777 == 0o700


def test_what_several_want_at_once_is_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "folder", lambda name: tmp_path)
    made = list[int]()

    def make() -> bytes:
        time.sleep(0.1)
        made.append(1)
        return b"7"

    with ThreadPoolExecutor(4) as pool:
        asked = [pool.submit(cache.kept, "made/bin", b"key", make, bytes, bytes, (), 2) for _ in range(4)]
    assert [one.result() for one in asked] == [b"7"] * 4
    assert len(made) == 1


def test_a_folder_that_others_may_write_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    monkeypatch.delenv("SULCUS_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", "/dev/null/cache")
    mine = tmp_path / f"sulcus-{os.getuid()}"
    mine.mkdir()
    mine.chmod(0o777)
    with pytest.raises(OSError, match=mine.name):
        cache.folder.__wrapped__("loops")
