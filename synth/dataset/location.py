"""The location of a store: a folder, or anything that fsspec can open (zip, S3, HTTP, ...)."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from synth.errors import UserError


@dataclass(frozen=True)
class StoreLocation:
    """The folder of one store, local or remote."""

    name: str  # its path or address, for messages
    store: Any  # to be opened by Zarr
    size: Callable[[str], int]  # bytes of a file by its path in the store; 0 if it is missing
    folder: Path | None = None  # None if it is not on this machine's file system


def store(root: Path, index: int) -> Path:
    """The path of the sealed sequence `index` of the dataset in `root`."""
    return root / f"{index:06d}.zarr"


def index_of(name: str) -> int | None:
    """The index in the name of a sealed store; None for other names."""
    found = re.fullmatch(r"([0-9]{6}|[1-9][0-9]{6,})\.zarr", name)
    return int(found[1]) if found else None


def find_location(where: Path | str) -> StoreLocation:
    """The location of a path or an address such as `zip://000000.zarr::out.zip`. May raise UserError."""
    where, remote = str(where), "://" in str(where)
    fs, base = _open(where)
    if not fs.isdir(base):
        raise UserError(f"{where}: no such sequence")

    def size(key: str) -> int:
        try:
            return int(fs.size(f"{base}/{key}" if base else key) or 0)
        except FileNotFoundError:
            return 0

    if not remote:
        return StoreLocation(where, where, size, Path(where))
    from zarr.storage import FsspecStore

    return StoreLocation(where, FsspecStore.from_url(_absolute(where), read_only=True), size)


def stores(where: str) -> list[str]:
    """Addresses of the sealed stores in the dataset at an address, in order of their names."""
    fs, base = _open(where)
    first, chained, rest = where.partition("::")
    slash = "" if first.endswith("/") else "/"
    names = (str(entry).rstrip("/").rsplit("/", 1)[-1] for entry in fs.ls(base, detail=False))
    return sorted(f"{first}{slash}{name}{chained}{rest}" for name in names if index_of(name) is not None)


def _open(where: str) -> tuple[Any, str]:
    import fsspec

    try:
        fs, base = fsspec.core.url_to_fs(_absolute(where))
    except (ImportError, ValueError, OSError) as error:
        raise UserError(f"{where}: cannot be opened ({error})") from error
    return fs, str(base).rstrip("/")


def _absolute(where: str) -> str:
    """The address with an absolute path at the end of a chain (`zip://x::out.zip`), as Zarr requires."""
    *chain, last = where.split("::")
    if chain and "://" not in last:
        last = f"file://{Path(last).resolve()}"
    return "::".join([*chain, last])
