"""Stores, indices and cards as strangers may hand them over, and what can be drawn to be in them."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from synth.dataset import store

Place = tuple[str | int, ...]
"""Keys and positions from the top of a tree of JSON."""

LEAVES = (
    st.none()
    | st.booleans()
    | st.integers(-(10**40), 10**40)
    | st.floats()
    | st.text(max_size=12)
    | st.sampled_from([0, -1, 1e-300, 1e300, 2**63, "../../x", "/etc/passwd", "0" * 32, "\x00", "²", "NaN"])
)
JSON = st.recursive(
    LEAVES,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=6,
)
"""Any small value that a JSON file holds, NaN and infinity too."""

GONE = "gone: the key is taken away"


def edits(tree: dict[str, Any]) -> st.SearchStrategy[list[tuple[Place, Any]]]:
    """One to three edits of a tree: where, and what is there instead."""
    places = sorted(_places(tree), key=str)
    return st.lists(st.tuples(st.sampled_from(places), JSON | st.just(GONE)), min_size=1, max_size=3)


def edit(tree: dict[str, Any], changes: Sequence[tuple[Place, Any]]) -> dict[str, Any]:
    """A copy of the tree with the edits made; one whose place an earlier edit took away is passed over."""
    made = copy.deepcopy(tree)
    for (*path, last), value in changes:
        block: Any = made
        for key in path:
            there = isinstance(block, dict) and key in block
            there |= isinstance(block, list) and isinstance(key, int) and key < len(block)
            block = block[key] if there else None
        if isinstance(block, dict):
            block.pop(last, None)
            if value != GONE:
                block[last] = value
        elif isinstance(block, list) and isinstance(last, int) and last < len(block):
            block[last] = None if value == GONE else value
    return made


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


def _places(tree: Any, at: Place = ()) -> Iterator[Place]:
    items = tree.items() if isinstance(tree, dict) else enumerate(tree[:2]) if isinstance(tree, list) else ()
    for key, value in items:
        yield (*at, key)
        yield from _places(value, (*at, key))
