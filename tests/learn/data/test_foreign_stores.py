"""Stores and caches from strangers: what is not as it was sealed is not trained on."""

from __future__ import annotations

import json
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import foreign
import numpy as np
import phantom
import pytest
import zarr
from safetensors.numpy import load_file, save_file
from typer.testing import CliRunner

from learn.cli import app
from learn.data.clips import Clip, load_clips
from learn.data.grid import Grid
from synth.dataset import index, split
from synth.dataset.folder import Folder
from synth.dataset.split import Rule
from synth.errors import UserError

GRID = Grid(32)
TINY = ["--preset", "tiny", "--size", "32", "--width", "8", "--epochs", "1", "--json"]
ARRAYS = "arrays.safetensors"
run = CliRunner().invoke


@pytest.fixture
def own(dataset: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(dataset, tmp_path / "own"))


def edited(**changes: Any) -> Callable[[Path], None]:
    return lambda path: foreign.edit_attributes(path, reseal=False, **changes)


def resealed(**changes: Any) -> Callable[[Path], None]:
    return lambda path: foreign.edit_attributes(path, **changes)


def another_force(path: Path) -> None:
    """Chunks of another sequence, whose own checksums are right."""
    for field in ("force", "traction"):
        shutil.rmtree(path / field / "c")
        shutil.copytree(path.with_name("000005.zarr") / field / "c", path / field / "c")


def another_flow(path: Path) -> None:
    shutil.rmtree(path / "flow" / "c")
    shutil.copytree(path.with_name("000005.zarr") / "flow" / "c", path / "flow" / "c")


def written(name: str, value: float) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        array: Any = zarr.open_group(str(path), mode="r+")[name]
        array[(0,) * array.ndim] = value

    return write


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (edited(young_kpa=99.0), "its attributes are not those that were sealed; see `synth verify`"),
        (edited(young_kpa=0.0), "the attribute young_kpa can't be right"),
        (edited(young_kpa=float("nan")), "the attribute young_kpa can't be right"),
        (resealed(young_kpa=0.0), "the attribute young_kpa can't be right"),
        (resealed(scale_mm_per_px=1e30), "the attribute scale_mm_per_px can't be right"),
        (edited(content_hash="../../../outside"), "the attribute content_hash can't be right"),
        (edited(scale_mm_per_px=None), "its attributes are not those that were sealed"),
        (resealed(scale_mm_per_px=None), "lacks the attribute young_kpa or scale_mm_per_px"),
        (another_force, "force: values are not those that were sealed; see `synth verify`"),
        (another_flow, "flow: values are not those that were sealed; see `synth verify`"),
        (written("force", 1.0), "force: values are not those that were sealed"),
        (written("traction", float("nan")), "traction: holds values that are no numbers"),
        (written("area", -1.0), "area: values from -1 to 0.25 mm^2 can't be right"),
        (written("flow", 1e6), "px can't be right"),
    ],
)
@pytest.mark.parametrize("cached", [False, True])
def test_what_is_not_as_sealed_is_not_trained_on(
    own: Path, tmp_path: Path, harm: Callable[[Path], None], said: str, cached: bool
) -> None:
    harm(own / "000002.zarr")
    cache = ["--cache", str(tmp_path / "cache")] if cached else []
    done = run(app, ["train", str(own), "-o", str(tmp_path / "m"), *TINY, *cache])
    assert (done.exit_code, len(done.stderr.splitlines())) == (2, 1), done.output
    assert "000002.zarr: " in done.stderr
    assert said in done.stderr
    assert not (tmp_path / "m").exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cache", "own"][1 - cached :]


def test_what_predicts_and_calibrates_looks_too(own: Path, tmp_path: Path) -> None:
    import fake_model

    model = fake_model.write_model(tmp_path / "model")
    another_flow(own / "000002.zarr")
    words = ["predict", str(model), str(own / "000002.zarr"), "--input", "ideal", "-o", str(tmp_path / "f")]
    done = run(app, words)
    assert (done.exit_code, len(done.stderr.splitlines())) == (2, 1), done.output
    assert "flow: values are not those that were sealed" in done.stderr
    assert not (tmp_path / "f").exists()


# ---- caches


def packed(cache: Path) -> list[Path]:
    return sorted(cache.iterdir())


def test_a_copied_hash_poisons_nothing(own: Path, tmp_path: Path) -> None:
    """A store that claims the hash of another is refused, before and after that one is in the cache."""
    cache = tmp_path / "cache"
    good = load_clips(own, GRID, ("ideal",), cache=cache)
    claimed = json.loads((own / "000000.zarr/zarr.json").read_text())["attributes"]["content_hash"]
    foreign.edit_attributes(own / "000005.zarr", reseal=False, content_hash=claimed)
    for place in (cache, tmp_path / "fresh"):
        with pytest.raises(UserError, match=r"000005\.zarr: its attributes are not those that were sealed"):
            load_clips(own, GRID, ("ideal",), cache=place)
    # All attributes of the other, seals too, over values of its own: the values tell.
    attrs = json.loads((own / "000000.zarr/zarr.json").read_text())["attributes"]
    foreign.write_attributes(own / "000005.zarr", attrs, reseal=False)
    for path in own.glob("00000[!5].zarr"):
        shutil.rmtree(path)
    with pytest.raises(UserError, match="values are not those that were sealed"):
        load_clips(own, GRID, ("ideal",), cache=tmp_path / "empty")
    assert not (tmp_path / "empty").exists()
    # Where the other is in the cache already, it is what the attributes speak of, and what is given.
    (found,) = load_clips(own, GRID, ("ideal",), cache=cache)
    np.testing.assert_array_equal(found.density, good[0].density)


def test_keys_are_made_by_us(own: Path, tmp_path: Path) -> None:
    load_clips(own, GRID, ("ideal",), cache=tmp_path / "cache")
    names = [path.name for path in packed(tmp_path / "cache")]
    assert all(len(name) == 32 and set(name) <= set("0123456789abcdef") for name in names)
    assert len(set(names)) == 8


def flipped(at: int) -> Callable[[Path], None]:
    def flip(folder: Path) -> None:
        data = bytearray((folder / ARRAYS).read_bytes())
        data[at] ^= 4
        (folder / ARRAYS).write_bytes(data)

    return flip


def replaced(**values: np.ndarray | None) -> Callable[[Path], None]:
    def replace(folder: Path) -> None:
        arrays = load_file(folder / ARRAYS) | values
        save_file({name: array for name, array in arrays.items() if array is not None}, folder / ARRAYS)

    return replace


def said(**changes: Any) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        tree = json.loads((folder / "clip.json").read_text())
        (folder / "clip.json").write_text(json.dumps(tree | changes))

    return edit


def pickled(folder: Path) -> None:
    (folder / ARRAYS).write_bytes(pickle.dumps(print))


def cut(folder: Path) -> None:
    (folder / ARRAYS).write_bytes((folder / ARRAYS).read_bytes()[:-100])


@pytest.mark.parametrize(
    "harm",
    [
        flipped(-5),
        flipped(4000),
        flipped(3),
        flipped(20),
        pickled,
        cut,
        lambda folder: (folder / ARRAYS).unlink(),
        replaced(mask=None),
        replaced(mask=np.ones((16, 16), np.float32)),
        replaced(mask=np.ones((32, 32), np.float16)),
        replaced(another=np.ones(3, np.float32)),
        lambda folder: (folder / "clip.json").write_text("[" * 10_000),
        said(young_kpa=0),
        said(checksums={"../../../mask": 1}),
        said(checksums={}),
        said(checksums={"mask": "1"}),
        said(name=7),
    ],
)
def test_a_damaged_cache_is_said_so(own: Path, tmp_path: Path, harm: Callable[[Path], object]) -> None:
    cache = tmp_path / "cache"
    load_clips(own, GRID, ("ideal",), cache=cache)
    harm(packed(cache)[0])
    done = run(app, ["train", str(own), "-o", str(tmp_path / "m"), *TINY, "--cache", str(cache)])
    assert (done.exit_code, len(done.stderr.splitlines())) == (2, 1), done.output
    assert f"{packed(cache)[0]}: damaged packed sequence (" in done.stderr
    assert done.stderr.endswith("; remove it\n")


def test_what_the_cache_says_of_a_sequence_is_not_taken(own: Path, tmp_path: Path, clips: list[Clip]) -> None:
    cache = tmp_path / "cache"
    load_clips(own, GRID, ("ideal",), cache=cache)
    for folder in packed(cache):
        said(young_kpa=1000.0, group="one", content_hash="x", family="calf")(folder)
    for clip, true in zip(load_clips(own, GRID, ("ideal",), cache=cache), clips, strict=True):
        assert (clip.young_kpa, clip.group, clip.content_hash) == (
            true.young_kpa,
            true.group,
            true.content_hash,
        )
        assert clip.family == true.family


def test_a_cache_that_cant_be_written_is_one_line(own: Path, tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("mine")
    done = run(app, ["train", str(own), "-o", str(tmp_path / "m"), *TINY, "--cache", str(tmp_path / "cache")])
    assert (done.exit_code, len(done.stderr.splitlines())) == (2, 1), done.output
    assert "cannot be written (" in done.stderr
    assert (tmp_path / "cache").read_text() == "mine"


# ---- the split


def test_an_edited_index_moves_nobody_to_the_training_side(tmp_path: Path) -> None:
    for k in range(6):
        phantom.write(tmp_path / "own", k, anatomy_seed=k)
    rule = Rule(shares=(0.5, 0.25, 0.25))
    split.keep_rule(tmp_path / "own", rule)
    before = index.written_sides(tmp_path / "own")
    index.write_index(Folder(tmp_path / "own"))
    rows = index.read_index(tmp_path / "own").to_pylist()
    for row in rows:
        row.update(anatomy="one", split="train", content_hash="0" * 32, family="calf")
    index.save_rows(tmp_path / "own", rows)
    assert index.written_sides(tmp_path / "own") == before
