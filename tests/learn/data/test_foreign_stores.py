"""Untrusted stores and caches: data that doesn't match its seal is refused."""

import json
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fake_model
import foreign_video
import numpy as np
import pytest
import zarr
from command import run

from learn.cli import app
from learn.data.clips import load_clips
from learn.data.grid import Grid
from synth.errors import UserError

GRID = Grid(32)


@pytest.fixture
def dataset_copy(dataset: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(dataset, tmp_path / "own"))


def swap_flow(path: Path) -> None:
    """Replaces chunks by those of another sequence, with valid checksums."""
    shutil.rmtree(path / "flow" / "c")
    shutil.copytree(path.with_name("000005.zarr") / "flow" / "c", path / "flow" / "c")


def write_nan(path: Path) -> None:
    traction: Any = zarr.open_group(str(path), mode="r+")["traction"]
    traction[0, 0, 0, 0] = np.nan


@pytest.mark.parametrize(
    ("harm", "key"),
    [
        (lambda path: foreign_video.edit_attributes(path, reseal=False, young_kpa=99.0), "attributes"),
        (swap_flow, "flow"),
        (write_nan, "traction"),
    ],
)
def test_data_that_does_not_match_its_seal_is_neither_trained_nor_predicted_on(
    dataset_copy: Path, tmp_path: Path, harm: Callable[[Path], None], key: str
) -> None:
    harm(dataset_copy / "000002.zarr")
    with pytest.raises(UserError, match=rf"000002\.zarr: .*{key}"):
        load_clips(dataset_copy, GRID, ("ideal",), cache=tmp_path / "cache")
    if key == "flow":
        model = fake_model.write_model(tmp_path / "model")
        words = ["predict", model, dataset_copy / "000002.zarr", "--input", "ideal", "-o", tmp_path / "f"]
        assert run(app, *words, code=2).stderr.count("\n") == 1
        assert not (tmp_path / "f").exists()


def test_a_copied_hash_does_not_fill_the_cache(dataset_copy: Path, tmp_path: Path) -> None:
    """A store that claims the hash of another is refused, before and after that one is in the cache."""
    cache = tmp_path / "cache"
    load_clips(dataset_copy, GRID, ("ideal",), cache=cache)
    attrs = json.loads((dataset_copy / "000000.zarr/zarr.json").read_text())["attributes"]
    foreign_video.edit_attributes(
        dataset_copy / "000005.zarr", reseal=False, content_hash=attrs["content_hash"]
    )
    for place in (cache, tmp_path / "fresh"):
        with pytest.raises(UserError, match=r"000005\.zarr"):
            load_clips(dataset_copy, GRID, ("ideal",), cache=place)
    # All attributes of the other, with seals: only the values differ.
    foreign_video.edit_attributes(dataset_copy / "000005.zarr", reseal=False, **attrs)
    for path in dataset_copy.glob("00000[!5].zarr"):
        shutil.rmtree(path)
    with pytest.raises(UserError):
        load_clips(dataset_copy, GRID, ("ideal",), cache=tmp_path / "empty")
    assert not (tmp_path / "empty").exists()


@pytest.mark.parametrize("pickled", [False, True])
def test_a_corrupted_cache_is_refused(dataset_copy: Path, tmp_path: Path, pickled: bool) -> None:
    cache = tmp_path / "cache"
    load_clips(dataset_copy, GRID, ("ideal",), cache=cache)
    file = min(cache.iterdir())
    data = bytearray(file.read_bytes())
    data[-5] ^= 4
    file.write_bytes(pickle.dumps(print) if pickled else data)
    with pytest.raises(UserError):
        load_clips(dataset_copy, GRID, ("ideal",), cache=cache)
