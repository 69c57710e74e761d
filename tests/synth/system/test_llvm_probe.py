"""An LLVM is tried in a process of its own, and only once if it works."""

import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest

from synth.system import cache, llvm


def test_a_library_that_works_is_tried_once_and_one_that_fails_each_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    attempts, codes = list[str](), [1, 1, 0]

    def run(words: list[str], env: dict[str, str], **_: object) -> SimpleNamespace:
        attempts.append(env["DRJIT_LIBLLVM_PATH"])
        return SimpleNamespace(returncode=codes[min(len(attempts), 3) - 1])

    monkeypatch.setattr(cache, "folder", lambda name: tmp_path)
    monkeypatch.setattr(subprocess, "run", run)
    library = tmp_path / "libLLVM.so.23"
    assert not llvm.probe(str(library))
    library.write_bytes(b"one")
    assert [llvm.probe(str(library)) for _ in range(4)] == [False, False, True, True]
    assert attempts == 3 * [str(library)]
    library.write_bytes(b"another")  # an update
    assert llvm.probe(str(library))
    assert len(attempts) == 4
