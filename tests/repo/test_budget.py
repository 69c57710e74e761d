"""Lines of Python that each package may have: one in, one out.

Who raises a number says why in the same commit.
"""

from __future__ import annotations

import pytest
from sources import ROOT, sources

LINES = {
    "synth": 24_751,
    "learn": 5_611,
    "bench": 7_744,
    "evidence": 9_316,
    "tests": 14_744,
}
COMMANDS = 28
JOB_KEYS, TRAINING_KEYS = 100, 26  # a matrix and curves for the one contrast that went


@pytest.mark.parametrize("package", LINES)
def test_a_package_keeps_to_its_budget(package: str) -> None:
    assert (ROOT / package).is_dir()
    lines = sum(len(path.read_text("utf-8").splitlines()) for path in sources(package))
    assert lines <= LINES[package]


def test_keys_keep_to_their_budget() -> None:
    from learn.settings import TrainingSettings
    from synth.job.schema import Job
    from synth.system.config_file import places

    assert len(places(Job)) <= JOB_KEYS
    assert len(places(TrainingSettings)) <= TRAINING_KEYS


def test_commands_keep_to_their_budget() -> None:
    from importlib import import_module

    apps = [import_module(f"{package}.cli").app for package in ("synth", "learn", "bench")]
    assert sum(len(app.registered_commands) for app in apps) <= COMMANDS
