"""Names of the sealed stores in a dataset's folder."""

from __future__ import annotations

import re
from pathlib import Path


def store(root: Path, index: int) -> Path:
    """The path of the sealed sequence `index` of the dataset in `root`."""
    return root / f"{index:06d}.zarr"


def index_of(name: str) -> int | None:
    """The index in the name of a sealed store; None for other names."""
    match = re.fullmatch(r"([0-9]{6}|[1-9][0-9]{6,})\.zarr", name)
    return int(match[1]) if match else None


def list_unfinished(root: Path) -> list[int]:
    """Indices of the stores that are being written, or were left so."""
    indices = (index_of(path.name.removesuffix(".part")) for path in root.glob("*.zarr.part"))
    return [index for index in indices if index is not None]
