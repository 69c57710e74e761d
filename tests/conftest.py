"""For every test: one thread a process, and what lies in tests/slow is slow."""

from pathlib import Path

import pytest
import torch

torch.set_num_threads(1)
pytest_plugins = ["clip_fixtures"]

SLOW = Path(__file__).parent / "slow"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if SLOW in item.path.parents:
            item.add_marker(pytest.mark.slow)
