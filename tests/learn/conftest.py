from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))

import phantom

from learn.data import Clip, load
from learn.grid import Grid

torch.set_num_threads(1)


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight sequences of six anatomies: two pairs share one."""
    folder = tmp_path_factory.mktemp("dataset")
    for index, anatomy in enumerate((1, 1, 2, 3, 3, 4, 5, 6)):
        phantom.write(folder, index, anatomy_seed=anatomy, family="pale" if anatomy == 6 else "healthy")
    return folder


@pytest.fixture(scope="session")
def clips(dataset: Path) -> list[Clip]:
    return load(dataset, Grid(32), ("ideal", "recovered"))
