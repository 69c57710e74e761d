"""For every test: one thread a process; what is named below is slow; modules with slow tests come first."""

import gc
import os
from pathlib import Path

import pytest

# Numerical libraries read it when they are loaded, and so do the processes that tests start.
os.environ["OMP_NUM_THREADS"] = "1"
pytest_plugins = ["clip_fixtures"]

# Modules stay: nothing is gained by searching them for garbage, while they are imported or later.
gc.disable()

HOME = Path(__file__).parent
SLOW = (
    "slow",
    "bench/methods/test_plugins.py",
    "bench/recording/test_videos_as_recorded.py",
    "bench/scoring",
    "bench/importers/test_files_as_they_come.py",
    "learn/data/test_one_split.py",
    "learn/inference",
    "learn/network/test_registry.py",
    "repo/test_scripting.py",
    "synth/checks/test_verify.py",
    "synth/engine",
    "synth/fem/external",
    "synth/fem/test_brain_mesh.py",
    "synth/fem/test_driven_contact.py",
    "synth/flow/recording",
    "synth/sequence/test_series_mechanics.py",
)
"""Folders and files below this one whose tests take five seconds or more together."""


def is_slow(path: Path) -> bool:
    """Whether a module is below one of `SLOW`."""
    return any((place := HOME / name) == path or place in path.parents for name in SLOW)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Modules that are left out need not be imported."""
    return True if "not slow" in config.option.markexpr and is_slow(collection_path) else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if is_slow(item.path):
            item.add_marker(pytest.mark.slow)
    # A module is one process's: if a long one were the last, the other process would wait for it.
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()
