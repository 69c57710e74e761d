"""The provenance of a sequence: versions of what determines its values, and the source that ran.

Versions are compared, source is only recorded: a comment changes no value. That a change of values raises a
version is held by the guard (`make guard`).
"""

from __future__ import annotations

import hashlib
import json
from functools import cache
from pathlib import Path

from synth.formats import CONTENT, MESH, STORE, motion_version
from synth.system import packages

HOME = Path(__file__).parents[2]
_RECORDED = "source"  # key of what is not compared
_MAKING = tuple(f"synth/{name}" for name in ("job", "geometry", "fem", "render", "video", "flow", "sequence"))


@cache
def generator() -> dict[str, str]:
    """`{"format", "content", "motion", package: version, "source"}`, all that a sequence's values depend on.

    `content`: versions of meshes and of what a job renders; `source`: a hash of the code, for the record.
    """
    versions = {"format": str(STORE), "content": f"{MESH}.{CONTENT}", "motion": motion_version()}
    return {**versions, **_computing(), _RECORDED: code(*_MAKING)}


def fingerprint() -> str:
    """The hash of what is compared of `generator()`."""
    return word(generator())


def select_compared(made_by: dict[str, str]) -> dict[str, str]:
    """The part of a `generator()` that decides whether two versions give the same values."""
    return {name: value for name, value in made_by.items() if name != _RECORDED}


def word(made_by: dict[str, str]) -> str:
    """The hash of what is compared of a `generator()`, of this or another version."""
    text = json.dumps(select_compared(made_by), sort_keys=True).encode()
    return hashlib.blake2b(text, digest_size=8).hexdigest()


def code(*folders: str, home: Path = HOME) -> str:
    """A hash of the names and bytes of the code and networks in folders below `home`."""
    total = hashlib.blake2b(digest_size=8)
    for path in sorted(path for folder in folders for path in (home / folder).rglob("*")):
        if path.suffix in (".py", ".onnx", ".json"):
            total.update(f"{path.relative_to(home)}\n{path.stat().st_size}\n".encode() + path.read_bytes())
    return total.hexdigest()


def _computing() -> dict[str, str]:
    return {name: version for name, version in packages.versions().items() if name in packages.COMPUTING}
