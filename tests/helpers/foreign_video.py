"""Edits of stores as an untrusted dataset may hold them, with valid or outdated seals."""

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

from synth.dataset import store


def edit_attributes(path: Path, reseal: bool = True, **changes: Any) -> None:
    """Changes attributes of a sealed store; with `reseal` its hashes are valid if they can be computed."""
    metadata = json.loads((path / "zarr.json").read_text())
    attrs = metadata["attributes"]
    attrs.update(changes)
    if reseal:
        with suppress(ValueError):
            attrs["content_hash"] = store.content_hash(attrs)
            attrs["seal_hash"] = store.seal_hash(attrs)
    (path / "zarr.json").write_text(json.dumps(metadata))
