from __future__ import annotations

from pathlib import Path

import pytest
from fake_recording import Bump, Maker


@pytest.fixture
def make(tmp_path: Path) -> Maker:
    return Maker(tmp_path)


@pytest.fixture
def bump() -> Bump:
    return Bump()
