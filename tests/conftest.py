"""For every test: one thread a process, and what lies in tests/slow is slow."""

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
