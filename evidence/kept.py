"""Results and packed sequences kept by what made them: settings, data, code."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from bench.output import write
from learn.data.clips import Clip, pack, unpack
from synth.dataset import provenance
from synth.job import identity

OURS = ("synth", "learn", "bench", "evidence")


@cache
def code(module: str) -> str:
    """One word for the source of a module, of all that it imports of ours, and of the flow estimators."""
    return provenance.source([module, *provenance.estimators()], OURS)


def word(module: str, *parts: Any) -> str:
    """One word for what a result depends on: `parts`, as JSON, and the code of the module that computes it.

    Whatever of these changes makes another word, so what was kept before is not found.
    """
    return hashlib.blake2b(identity.canonical([code(module), *parts]), digest_size=8).hexdigest()


def result(folder: Path, name: str, key: str, compute: Callable[[], Any]) -> Any:
    """What `compute` gives, as JSON holds it; computed only if `folder` has none of this `word`."""
    file = folder / f"{name}-{key}.json"
    if not file.is_file():
        write.keep(folder, file.name, compute())
    return json.loads(file.read_text("utf-8"))


def clip(folder: Path, make: Callable[[], Clip]) -> Clip:
    """The clip packed in a folder whose name says what made it; made and packed if there is none."""
    if not folder.is_dir():
        pack(make(), folder)
    return unpack(folder)
