"""What made a sequence: one name for the code and the packages that shape its values."""

from __future__ import annotations

import hashlib
import json
from functools import cache
from pathlib import Path

from synth.formats import STORE
from synth.system import packages

HOME = Path(__file__).parents[2]
_MAKING = tuple(f"synth/{room}" for room in ("job", "geometry", "fem", "render", "video", "flow", "sequence"))
_OPENCV = "opencv-contrib-python-headless"
_COMPUTING = ("mitsuba", "drjit", "numpy", "scipy", _OPENCV, "torch", "numba", "llvmlite", "xatlas")


@cache
def generator() -> dict[str, str]:
    """`{"format", "code", package: version}`: two sequences of a job are comparable when it is equal.

    `code` is a hash of the files of the rooms that make a sequence, comments included.
    """
    return {"format": str(STORE), "code": code(*_MAKING), **_computing()}


@cache
def source(*folders: str) -> str:
    """One word for the code in folders, `synth/fem`, and for the packages that compute."""
    return word({"code": code(*folders), **_computing()})


def fingerprint() -> str:
    """`generator()` in one word."""
    return word(generator())


def word(made_by: dict[str, str]) -> str:
    """What `generator()` gave, here or elsewhere, in one word."""
    described = json.dumps(made_by, sort_keys=True).encode()
    return hashlib.blake2b(described, digest_size=8).hexdigest()


def code(*folders: str, home: Path = HOME) -> str:
    """A hash of the names and bytes of the programs and networks in folders below `home`."""
    total = hashlib.blake2b(digest_size=8)
    for path in sorted(path for folder in folders for path in (home / folder).rglob("*")):
        if path.suffix in (".py", ".pt", ".json"):
            total.update(f"{path.relative_to(home)}\n{path.stat().st_size}\n".encode() + path.read_bytes())
    return total.hexdigest()


def _computing() -> dict[str, str]:
    """Versions of the packages that compute."""
    return {name: found for name, found in packages.versions().items() if name in _COMPUTING}
