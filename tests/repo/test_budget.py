"""Size of the project: one in, one out.

Each row states what there is now and what is aimed at for the end of the round. A commit may raise the first
up to the second, never above it; where it is above already, it only falls.
"""

import re
import subprocess
from importlib import import_module
from pathlib import Path

import pytest
from sources import ROOT, sources

from learn.settings import TrainingSettings
from synth.job.schema import Job
from synth.system.config_file import places

BUDGET = {
    "synth, learn and bench": (36_500, 36_500),
    "evidence": (8_500, 8_500),
    "tests": (14_500, 14_500),
    "job keys": (95, 96),
    "training keys": (23, 24),
    "commands": (26, 26),
}


def lines(*packages: str) -> int:
    return sum(len(path.read_text("utf-8").splitlines()) for path in sources(*packages))


def commands() -> int:
    apps = [import_module(f"{package}.cli").app for package in ("synth", "learn", "bench")]
    return sum(len(app.registered_commands) for app in apps)


AGREED = {"job keys": 96}
"""Aims of the end of the round that take the place of lower ones of its first half."""

MEASURES = {
    "synth, learn and bench": lambda: lines("synth", "learn", "bench"),
    "evidence": lambda: lines("evidence"),
    "tests": lambda: lines("tests"),
    "job keys": lambda: len(places(Job)),
    "training keys": lambda: len(places(TrainingSettings)),
    "commands": commands,
}


@pytest.mark.parametrize("what", BUDGET)
def test_there_is_no_more_than_stated(what: str) -> None:
    assert MEASURES[what]() <= BUDGET[what][0]


@pytest.mark.parametrize("commit", ["HEAD", "HEAD~1"])
def test_no_commit_raises_what_is_above_what_is_aimed_at(commit: str) -> None:
    """Compared with the tables of the last commits; where git has none there is nothing to compare with."""
    here = f"{commit}:{Path(__file__).relative_to(ROOT).as_posix()}"
    shown = subprocess.run(["git", "show", here], cwd=ROOT, capture_output=True, text=True)
    before = re.findall(r'"([a-z ,]+)": \(([\d_]+), ([\d_]+)\)', shown.stdout)
    for what, is_, aim in before:
        assert BUDGET[what][0] <= max(int(is_), BUDGET[what][1]), what
        assert BUDGET[what][1] <= max(int(aim), AGREED.get(what, 0)), f"{what}: the aim itself was raised"
