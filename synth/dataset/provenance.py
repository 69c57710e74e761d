"""The provenance of a sequence: a hash of the code and the packages that determine its values."""

from __future__ import annotations

import hashlib
import json
from functools import cache
from pathlib import Path

from synth.formats import STORE
from synth.system import packages

HOME = Path(__file__).parents[2]
_MAKING = tuple(f"synth/{name}" for name in ("job", "geometry", "fem", "render", "video", "flow", "sequence"))


@cache
def generator() -> dict[str, str]:
    """`{"format", "code", package: version}`; `code` is a hash of the packages that create a sequence."""
    return {"format": str(STORE), "code": code(*_MAKING), **_computing()}


@cache
def source(*folders: str) -> str:
    """A hash of the code in folders such as `synth/fem`, and of the versions of numerical packages."""
    return word({"code": code(*folders), **_computing()})


def fingerprint() -> str:
    """The hash of `generator()`."""
    return word(generator())


def word(made_by: dict[str, str]) -> str:
    """The hash of a `generator()`, of this or another version."""
    described = json.dumps(made_by, sort_keys=True).encode()
    return hashlib.blake2b(described, digest_size=8).hexdigest()


def code(*folders: str, home: Path = HOME) -> str:
    """A hash of the names and bytes of the code and networks in folders below `home`."""
    total = hashlib.blake2b(digest_size=8)
    for path in sorted(path for folder in folders for path in (home / folder).rglob("*")):
        if path.suffix in (".py", ".onnx", ".json"):
            total.update(f"{path.relative_to(home)}\n{path.stat().st_size}\n".encode() + path.read_bytes())
    return total.hexdigest()


def _computing() -> dict[str, str]:
    return {name: found for name, found in packages.versions().items() if name in packages.COMPUTING}
