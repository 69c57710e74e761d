"""For every test: one thread a process; tests/slow is slow; modules with slow tests come first."""

import os
from pathlib import Path

import pytest

# Numerical libraries read it when they are loaded, and so do the processes that tests start.
os.environ["OMP_NUM_THREADS"] = "1"
pytest_plugins = ["clip_fixtures"]

SLOW = Path(__file__).parent / "slow"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if SLOW in item.path.parents:
            item.add_marker(pytest.mark.slow)
    # A module is one process's: if a long one were the last, the other process would wait for it.
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)
