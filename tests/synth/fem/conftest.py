from __future__ import annotations

from pathlib import Path

import pytest
from egg_brain import soup, written


@pytest.fixture
def egg(tmp_path: Path) -> Path:
    return written(tmp_path / "egg.obj", soup())
