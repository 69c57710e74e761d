"""Results and packed clips, cached in a folder by a key of all inputs: an interrupted run continues."""

import hashlib
import json
from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from learn.data.clips import Clip, pack, unpack
from synth.dataset import provenance
from synth.dataset.folder import write_whole
from synth.job import identity


@cache
def code() -> str:
    """Hash of this project's source files and of the packages' versions, PyTorch's included."""
    return f"{provenance.source('synth', 'learn', 'bench', 'evidence')} {version('torch')}"


def key(*parts: Any) -> str:
    """Key of the code and of settings and content hashes that JSON can hold."""
    return hashlib.blake2b(identity.canonical([code(), *parts]), digest_size=8).hexdigest()


def result(folder: Path, name: str, key: str, compute: Callable[[], Any]) -> Any:
    """Value of `compute`, as JSON holds it; computed only if the folder has no result of this key."""
    file = folder / f"{name}-{key}.json"
    if not file.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(file, json.dumps(compute()), durable=False)
    return json.loads(file.read_text("utf-8"))


def clip(file: Path, make: Callable[[], Clip]) -> Clip:
    """Clip packed in a file whose name contains its key; made and packed if there is none."""
    if not file.is_file():
        pack(make(), file)
    return unpack(file)
