"""Stores with random damage: `synth verify` finds all damage that changes a value."""

import json
import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fake_work
import numpy as np
import pytest
import zarr
from fake_run import in_process

from synth.checks import verify
from synth.checks.measurements import Measure
from synth.dataset.dataset_folder import Folder
from synth.dataset.store import Dataset
from synth.job.schema import Job
from synth.system.stopwatch import Stopwatch

JOB = Job(seed=1, sequences=2, frames=5, render={"size": (64, 48)}, flow={"backend": "ideal"})
KINDS = (
    "bit", "bytes", "truncated", "emptied", "removed", "zeroed", "swapped", "rewritten", "edited", "key gone"
)  # fmt: skip
EACH = 5


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("damage") / "out"
    in_process(JOB, folder, fake_work.sequence)
    return folder


def damage(store: Path, kind: str, rng: np.random.Generator) -> None:
    """Damages a store; some damage changes no value, e.g. an unused bit of the compressed data."""
    files = sorted(path for path in store.rglob("*") if path.is_file())
    chunks = [path for path in files if "c" in path.relative_to(store).parts]
    candidates = files if kind in ("bit", "emptied", "removed") else chunks
    path = candidates[int(rng.integers(len(candidates)))]
    data = bytearray(path.read_bytes())
    offset = int(rng.integers(len(data)))
    if kind in ("bit", "bytes"):
        for k in [offset] if kind == "bit" else rng.integers(len(data), size=16):
            data[k] ^= 1 << int(rng.integers(8))
        path.write_bytes(data)
    elif kind == "truncated":
        path.write_bytes(data[:offset])
    elif kind == "emptied":
        path.write_bytes(b"")
    elif kind == "removed":
        path.unlink()
    elif kind == "zeroed":
        path.write_bytes(data[:offset] + bytes(len(data[offset : offset + 512])) + data[offset + 512 :])
    elif kind == "swapped":  # both files are intact, but of other frames or another field
        other = chunks[int(rng.integers(len(chunks)))]
        path.write_bytes(other.read_bytes())
        other.write_bytes(data)
    elif kind == "rewritten":  # by Zarr, so that every chunk's checksum is right
        group = zarr.open_group(str(store), mode="r+")
        array: Any = group[str(rng.choice(sorted(group.attrs["field_hashes"])))]
        place = tuple(int(rng.integers(length)) for length in array.shape)
        value = array[place]
        array[place] = ~value if array.dtype.kind in "bu" else np.nextafter(value, np.inf, dtype=array.dtype)
    else:
        metadata = [file for file in files if file.name == "zarr.json"]
        path = metadata[int(rng.integers(len(metadata)))]
        document = json.loads(path.read_text())
        leaves = [leaf for leaf in _leaves(document) if kind == "edited" or isinstance(leaf[0], dict)]
        holder, key = leaves[int(rng.integers(len(leaves)))]
        old = holder.pop(key) if kind == "key gone" else holder[key]
        if kind == "edited":
            is_number = isinstance(old, (int, float)) and not isinstance(old, bool)
            holder[key] = old + 1 if is_number else f"{old}x" if isinstance(old, str) else not old
        path.write_text(json.dumps(document))


def _leaves(node: Any) -> Iterator[tuple[Any, Any]]:
    for key, value in node.items() if isinstance(node, dict) else enumerate(node):
        if isinstance(value, (dict, list)):
            yield from _leaves(value)
        else:
            yield node, key


def are_equal(original: Path, copy: Path) -> bool:
    """Whether plain Zarr reads the same values, attributes and axes from both."""
    first = zarr.open_group(str(original), mode="r")
    try:
        second = zarr.open_group(str(copy), mode="r")
        return dict(first.attrs) == dict(second.attrs) and all(
            dict(array.attrs) == dict(other.attrs)
            and array.dtype == other.dtype
            and array.metadata.dimension_names == other.metadata.dimension_names
            and np.array_equal(array[...], other[...])
            for array, other in ((first[name], second[name]) for name in first.attrs["field_hashes"])
        )
    except Exception:  # any error: it can't be read
        return False


def test_damage_that_changes_a_value_is_found(root: Path, tmp_path: Path) -> None:
    rng, changes = np.random.default_rng(0), Counter[str]()
    identity, paths = str(Folder(root).read_description()["identity"]), Dataset(root).paths
    for k, kind in enumerate(KINDS * EACH):
        copy = tmp_path / paths[k % 2].name
        shutil.copytree(paths[k % 2], copy)
        damage(copy, kind, rng)
        if not are_equal(paths[k % 2], copy):
            changes[kind] += 1
            checks = list(verify.check_sequence(copy, identity, Stopwatch()))
            outcomes = [check.good for _, check in checks if isinstance(check, Measure)]
            assert not all(outcomes), f"{k}: {kind}"
        shutil.rmtree(copy)
    assert set(changes) == set(KINDS), "a kind that never changes a value"
