"""Stores as strangers may hand them over: attributes edited, seals made good or not."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from synth.dataset import store


def edit_attributes(path: Path, *, reseal: bool = True, **changes: Any) -> None:
    """Attributes of a sealed store are others; with `reseal`, hashes made good as a stranger would."""
    metadata = json.loads((path / "zarr.json").read_text())
    metadata["attributes"].update(changes)
    write_attributes(path, metadata["attributes"], reseal)


def write_attributes(path: Path, attrs: dict[str, Any], reseal: bool) -> None:
    """Makes these the attributes of the store; what can't be hashed keeps its seals."""
    metadata = json.loads((path / "zarr.json").read_text())
    if reseal:
        try:
            attrs["content_hash"] = store.content_hash(attrs)
            attrs["seal_hash"] = store.seal_hash(attrs)
        except ValueError:
            pass
    metadata["attributes"] = attrs
    (path / "zarr.json").write_text(json.dumps(metadata))
