"""The split of a model of before datasets had one."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from learn.checkpoint import read_card
from synth.dataset import split


def split_as(dataset: Path, model: Path, copy: Path) -> Path:
    """A copy of a dataset, split as a model says that it was trained: older versions drew their own."""
    parts, sides = read_card(model).split, {"fit": "train", "select": "validation", "test": "test"}
    chosen: dict[str, Any] = {name: sides[part] for part, names in parts.items() for name in names}
    shutil.copytree(dataset, copy)
    split.store(copy, split.DatasetSplit(sides=chosen))
    return copy
