from __future__ import annotations

from pathlib import Path

import pytest
import torch
from fake_recording import Bump, Maker

torch.set_num_threads(1)


@pytest.fixture
def make(tmp_path: Path) -> Maker:
    return Maker(tmp_path)


@pytest.fixture
def bump() -> Bump:
    return Bump()
