"""What `synth doctor` says of a machine that lacks something."""

from __future__ import annotations

import ctypes
from pathlib import Path

import pytest
from typer.testing import CliRunner

from synth.cli import app
from synth.system import doctor


def test_a_missing_library_of_the_renderer_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = {finding.what for finding in doctor.findings(tmp_path)}
    assert "renderer's libraries" not in names

    def refuse(name: str) -> None:
        raise OSError("libatomic.so.1: cannot open shared object file: No such file or directory")

    monkeypatch.setattr(ctypes, "CDLL", refuse)
    told = " ".join(CliRunner().invoke(app, ["doctor", str(tmp_path)], env={"COLUMNS": "80"}).stdout.split())
    assert "LACK renderer's libraries libatomic.so.1: cannot open shared object file" in told
    assert "-> install it (Debian: apt-get install libatomic1)" in told
