"""Results, cached in a folder by a key of all inputs: an interrupted run continues.

Code enters by the integers of `synth.formats`, which are raised when a probe of the guard moves: a comment or
a new name makes nothing stale.
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from evidence.guard import guard
from synth import formats
from synth.job import identity
from synth.system import packages
from synth.system.checked_file import write_whole


@cache
def libraries() -> dict[str, str]:
    """Versions of the packages that compute, PyTorch's included."""
    package_versions = packages.versions()
    return {name: package_versions[name] for name in packages.COMPUTING if name in package_versions} | {
        "torch": version("torch")
    }


def key(*parts: Any, versions: Sequence[str] = ()) -> str:
    """Key of settings and content hashes that JSON can hold, of the packages, and of versions of our code.

    `versions`: names of `synth.formats` that the value depends on; all of them if none is named.
    """
    code_versions = {name: getattr(formats, name) for name in versions or guard.versions()}
    inputs = [formats.motion_version(), libraries(), code_versions, *parts]
    return hashlib.blake2b(identity.canonical(inputs), digest_size=8).hexdigest()


def result(folder: Path, name: str, key: str, compute: Callable[[], Any]) -> Any:
    """Value of `compute`, as JSON holds it; computed only if the folder has no result of this key."""
    file = folder / f"{name}-{key}.json"
    if not file.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(file, json.dumps(compute()), durable=False)
    return json.loads(file.read_text("utf-8"))
