"""Loops are compiled once, for the types that a dataset calls them with."""

import subprocess
import sys
from pathlib import Path

import pytest

from synth.engine import compilation
from synth.system import cache

_RENDER = """
import sys
from pathlib import Path
from numba.core.sigutils import normalize_signature
from synth.job.reader import load_job
from synth.sequence.pipeline import render_sequence
from synth.system import jit

job = load_job("tiny", ["frames=3", "store.extra=[flow_next]"])
render_sequence(job, 0, Path(sys.argv[1]), lambda *_: None)
for loop, types in jit.LOOPS:
    called = [signature.args for signature in loop.nopython_signatures]
    if called != [normalize_signature(f"({types})")[0]]:
        print(f"{loop.py_func.__qualname__}: declared for {types}, but called with {called}")
"""


def test_a_dataset_calls_loops_with_the_types_they_are_compiled_for(tmp_path: Path) -> None:
    call = [sys.executable, "-c", _RENDER, str(tmp_path)]
    mismatches = subprocess.run(call, capture_output=True, text=True, check=True).stdout
    assert not mismatches, mismatches


def test_processes_compile_once_for_a_version_and_a_target(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cache, "folder", lambda name: tmp_path)
    log, lines = tmp_path / "log", list[str]()
    script = tmp_path / "python"
    script.write_text(f'#!/bin/sh\necho "$SULCUS_THREADS $3 $4" >> {log}\n')
    script.chmod(0o700)
    monkeypatch.setattr(sys, "executable", str(script))
    for _ in range(2):
        compilation.compile_once({"SULCUS_THREADS": "7"}, 2, lines.append)
    assert sorted(log.read_text().splitlines()) == ["7 0 2", "7 1 2"]
    assert len(lines) == 1
    monkeypatch.setattr("synth.system.target_processor.target", lambda: "another processor")
    compilation.compile_once({}, 1, lines.append)
    assert len(lines) == 2
    script.write_text("#!/bin/sh\nexit 1\n")
    monkeypatch.setattr("synth.system.target_processor.target", lambda: "a third")
    for _ in range(2):  # a failure is not taken for done
        compilation.compile_once({}, 1, lines.append)
    assert len(lines) == 4
