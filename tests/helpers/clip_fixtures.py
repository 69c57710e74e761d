"""Fixtures: a dataset of phantoms, and its clips. Every test process loads this file, so it imports late."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from made_once import made_once

if TYPE_CHECKING:
    from learn.data.clips import Clip


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight sequences of six anatomies: two pairs share one; not to be modified."""
    return made_once(tmp_path_factory, "phantoms", write_phantoms)


def write_phantoms(folder: Path) -> None:
    import phantom

    for index, anatomy in enumerate((1, 1, 2, 3, 3, 4, 5, 6)):
        phantom.write(folder, index, anatomy_seed=anatomy, family="pale" if anatomy == 6 else "healthy")


@pytest.fixture(scope="session")
def clips(dataset: Path) -> list[Clip]:
    from learn.data.clips import load_clips
    from learn.data.grid import Grid

    return load_clips(dataset, Grid(32), ("ideal", "recovered"))
