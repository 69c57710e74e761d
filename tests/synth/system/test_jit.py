"""The cache folder: SULCUS_CACHE, the user's cache, or a private temporary folder."""

import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from synth.system import cache


def test_the_cache_is_in_a_private_writable_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    private_folder, set_folder = tmp_path / f"sulcus-{os.getuid()}", tmp_path / "set"
    names, values = (
        ("SULCUS_CACHE", "XDG_CACHE_HOME", "HOME"),
        (str(set_folder), str(set_folder), "/dev/null"),
    )
    for name, value, folder in zip(
        names, values, (set_folder, set_folder / "sulcus", private_folder), strict=True
    ):
        for variable in names:
            monkeypatch.delenv(variable, raising=False)
        monkeypatch.setenv(name, value)
        assert cache.folder.__wrapped__("loops") == folder / "loops"
        assert (folder / "loops").is_dir()
    assert private_folder.stat().st_mode & 0o777 == 0o700
    private_folder.chmod(0o777)  # writable by others
    with pytest.raises(OSError, match=private_folder.name):
        cache.folder.__wrapped__("loops")


def test_a_cache_that_others_may_write_to_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SULCUS_CACHE", str(tmp_path))
    user_folder = tmp_path / f"user-{os.getuid()}" / "loops"
    for mode in (0o770, 0o707):
        (tmp_path / "loops").mkdir(exist_ok=True)
        (tmp_path / "loops").chmod(mode)
        assert cache.folder.__wrapped__("loops") == user_folder
        (tmp_path / "loops").rmdir()
    (tmp_path / "loops").symlink_to(tmp_path)  # which another user can direct elsewhere
    assert cache.folder.__wrapped__("loops") == user_folder


def test_concurrent_calls_compute_a_result_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "folder", lambda name: tmp_path)
    computations = list[int]()

    def make() -> bytes:
        time.sleep(0.1)
        computations.append(1)
        return b"7"

    with ThreadPoolExecutor(4) as pool:
        futures = [
            pool.submit(cache.load_or_make, "made/bin", b"key", make, bytes, bytes, (), 2) for _ in range(4)
        ]
    assert [future.result() for future in futures] == [b"7"] * 4
    assert len(computations) == 1
