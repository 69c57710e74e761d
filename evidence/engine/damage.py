"""Does `synth verify` find damage? Stores are damaged at random; an independent reading says what changed."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
import zarr

from evidence.measuring import measuring
from synth.checks import verify
from synth.dataset.folder import Folder
from synth.dataset.store import Dataset


@dataclass(frozen=True)
class Case:
    """One damaged store."""

    kind: str
    what: str
    changed: bool
    """Whether plain Zarr reads another value, attribute or axis, or cannot read at all."""
    found: tuple[str, ...]
    """Names of the checks that failed."""


@measuring(
    "out --count 50 --out runs/damage",
    out="docs/results/engine/damage",
    file="damage.json",
    passed=lambda found: not found["missed"],
)
def damage(
    dataset: Annotated[Path, typer.Argument(help="A small rendered dataset; it is copied, not touched.")],
    count: Annotated[int, typer.Option(help="Number of damaged stores.")] = 300,
    seed: Annotated[int, typer.Option(help="Of the damage.")] = 0,
) -> dict[str, Any]:
    """Damages stores in every way that disks, copies and people do, and counts what verify misses."""
    rng = np.random.default_rng(seed)
    identity = str(Folder(dataset).described()["identity"])
    paths = Dataset(dataset).paths
    cases = []
    with tempfile.TemporaryDirectory() as scratch:
        for k in range(count):
            original = paths[k % len(paths)]
            copy = Path(scratch) / original.name
            shutil.copytree(original, copy)
            kind = list(KINDS)[k % len(KINDS)]
            what = KINDS[kind](copy, rng)
            changed = not _same(original, copy)
            found = tuple(check.name for check in verify.verify_sequence(copy, identity) if not check.good)
            cases.append(Case(kind, what, changed, found))
            shutil.rmtree(copy)
    return summary(cases, seed)


def summary(cases: list[Case], seed: int) -> dict[str, Any]:
    """Counts by kind, and every case that was missed."""
    kinds = {
        kind: {
            "stores": sum(case.kind == kind for case in cases),
            "changed": sum(case.kind == kind and case.changed for case in cases),
            "found": sum(case.kind == kind and case.changed and bool(case.found) for case in cases),
            "found_though_unchanged": sum(
                case.kind == kind and not case.changed and bool(case.found) for case in cases
            ),
        }
        for kind in KINDS
    }
    return {
        "stores": len(cases),
        "changed": sum(case.changed for case in cases),
        "missed": [vars(case) for case in cases if case.changed and not case.found],
        "kinds": kinds,
        "found_by": dict(Counter(case.found[0] for case in cases if case.changed and case.found)),
        "seed": seed,
    }


def _same(original: Path, copy: Path) -> bool:
    """Whether plain Zarr reads the same values, attributes and axes from both."""
    first = zarr.open_group(str(original), mode="r")
    try:
        second = zarr.open_group(str(copy), mode="r")
        if dict(first.attrs) != dict(second.attrs):
            return False
        for name in first.attrs["field_hashes"]:
            one, two = first[name], second[name]
            if dict(one.attrs) != dict(two.attrs) or one.dtype != two.dtype:
                return False
            if one.metadata.dimension_names != two.metadata.dimension_names:
                return False
            if not np.array_equal(one[...], two[...]):
                return False
    except Exception:  # whatever it is, a reader cannot read
        return False
    return True


def _chunk(store: Path, rng: np.random.Generator) -> Path:
    files = sorted(path for path in store.rglob("c/**/*") if path.is_file())
    return files[int(rng.integers(len(files)))]


def _metadata(store: Path, rng: np.random.Generator) -> Path:
    files = sorted(store.rglob("zarr.json"))
    return files[int(rng.integers(len(files)))]


def _any(store: Path, rng: np.random.Generator) -> Path:
    files = sorted(path for path in store.rglob("*") if path.is_file())
    return files[int(rng.integers(len(files)))]


def flipped_bit(store: Path, rng: np.random.Generator) -> str:
    """One bit of any file."""
    return _flip(_any(store, rng), 1, rng)


def flipped_bytes(store: Path, rng: np.random.Generator) -> str:
    """A bit in each of sixteen bytes of a chunk."""
    return _flip(_chunk(store, rng), 16, rng)


def _flip(path: Path, count: int, rng: np.random.Generator) -> str:
    data = bytearray(path.read_bytes())
    at = sorted(int(k) for k in rng.integers(len(data), size=count))
    for k in at:
        data[k] ^= 1 << int(rng.integers(8))
    path.write_bytes(data)
    return f"{path.relative_to(path.parents[1])} at {at[0]}"


def truncated(store: Path, rng: np.random.Generator) -> str:
    """A chunk cut short."""
    path = _chunk(store, rng)
    data = path.read_bytes()
    left = int(rng.integers(len(data)))
    path.write_bytes(data[:left])
    return f"{path} cut to {left}"


def emptied(store: Path, rng: np.random.Generator) -> str:
    """Any file, empty."""
    path = _any(store, rng)
    path.write_bytes(b"")
    return str(path)


def removed(store: Path, rng: np.random.Generator) -> str:
    """Any file, gone."""
    path = _any(store, rng)
    path.unlink()
    return str(path)


def zeroed_block(store: Path, rng: np.random.Generator) -> str:
    """512 bytes of a chunk, zero."""
    path = _chunk(store, rng)
    data = bytearray(path.read_bytes())
    start = int(rng.integers(len(data)))
    data[start : start + 512] = bytes(len(data[start : start + 512]))
    path.write_bytes(data)
    return f"{path} from {start}"


def swapped_files(store: Path, rng: np.random.Generator) -> str:
    """Two files of one field change places: each is whole, and stands for other frames or another field."""
    first, second = _chunk(store, rng), _chunk(store, rng)
    one, two = first.read_bytes(), second.read_bytes()
    first.write_bytes(two)
    second.write_bytes(one)
    return f"{first} with {second}"


def rewritten_value(store: Path, rng: np.random.Generator) -> str:
    """A value is replaced through Zarr itself, so that every chunk's own checksum is right."""
    group = zarr.open_group(str(store), mode="r+")
    names = sorted(group.attrs["field_hashes"])
    name = names[int(rng.integers(len(names)))]
    array = group[name]
    at = tuple(int(rng.integers(length)) for length in array.shape)
    value = array[at]
    array[at] = ~value if array.dtype.kind in "bu" else np.nextafter(value, np.inf, dtype=array.dtype)
    return f"{name}{at}"


def edited_metadata(store: Path, rng: np.random.Generator) -> str:
    """One number, text or flag anywhere in a zarr.json is another."""
    path = _metadata(store, rng)
    document = json.loads(path.read_text())
    leaves = list(_leaves(document))
    holder, key = leaves[int(rng.integers(len(leaves)))]
    old = holder[key]
    holder[key] = _another(old)
    path.write_text(json.dumps(document))
    return f"{path.relative_to(store)}: {key}: {old!r} to {holder[key]!r}"


def removed_key(store: Path, rng: np.random.Generator) -> str:
    """A key of the metadata, gone."""
    path = _metadata(store, rng)
    document = json.loads(path.read_text())
    leaves = [(holder, key) for holder, key in _leaves(document) if isinstance(holder, dict)]
    holder, key = leaves[int(rng.integers(len(leaves)))]
    del holder[key]
    path.write_text(json.dumps(document))
    return f"{path.relative_to(store)}: {key}"


def _leaves(node: Any) -> Any:
    items = node.items() if isinstance(node, dict) else enumerate(node)
    for key, value in items:
        if isinstance(value, (dict, list)):
            yield from _leaves(value)
        else:
            yield node, key


def _another(value: Any) -> Any:
    if isinstance(value, bool) or value is None:
        return not value
    if isinstance(value, (int, float)):
        return value + 1
    return f"{value}x"


KINDS: dict[str, Callable[[Path, np.random.Generator], str]] = {
    function.__name__.replace("_", " "): function
    for function in (
        flipped_bit,
        flipped_bytes,
        truncated,
        emptied,
        removed,
        zeroed_block,
        swapped_files,
        rewritten_value,
        edited_metadata,
        removed_key,
    )
}
"""Every way of damage: changes the store in place and says what it did."""
