"""Datasets from strangers: attributes, index, split and links, each read or refused in one line."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import foreign
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fake_run import in_process
from hostile import Guard, assert_told, cases
from hypothesis import example
from hypothesis import strategies as st
from typer.testing import CliRunner

from evidence.engine import work
from synth.cli import app
from synth.dataset import index
from synth.dataset.folder import claim
from synth.dataset.store import Dataset, open_sequence
from synth.errors import UserError
from synth.job.schema import Job

JOB = Job(seed=1, sequences=3, frames=3, render={"size": (64, 48)}, flow={"backend": "ideal"})
run = CliRunner().invoke


@pytest.fixture(scope="module")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("pristine") / "out"
    in_process(JOB, root, work.sequence)
    return root


@pytest.fixture
def dataset(pristine: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(pristine, tmp_path / "out"))


@pytest.fixture(scope="module")
def guard() -> Iterator[Guard]:
    with Guard("synth.publish.report", "synth.publish.card", "synth.publish.export", "matplotlib") as started:
        yield started


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"young_kpa": 0.0}, "attribute young_kpa can't be right"),
        ({"young_kpa": float("nan")}, "attribute young_kpa can't be right"),
        ({"young_kpa": "soft"}, "attribute young_kpa can't be right"),
        ({"young_kpa": True}, "attribute young_kpa can't be right"),
        ({"scale_mm_per_px": -1000.0}, "attribute scale_mm_per_px can't be right"),
        ({"frames": 10**9}, "attribute frames can't be right"),
        ({"frames": 2.5}, "attribute frames can't be right"),
        ({"size": [64]}, "attribute size can't be right"),
        ({"size": [20_000, 20_000]}, "20000 x 20000 pixels a frame is too large"),
        ({"index": "0"}, "attribute index can't be right"),
        ({"field_hashes": []}, "attribute field_hashes can't be right"),
        ({"scenario": [1]}, "attribute scenario can't be right"),
        ({"scenario": {"gesture": "pull"}}, "attribute scenario.gesture can't be right"),
        ({"timings": {"render": None}}, "attribute timings.render"),
        ({"format_version": [1] * 999}, "has format version [1, 1"),
    ],
    ids=str,
)
def test_attributes_that_cant_be_right_are_refused_though_sealed(
    dataset: Path, changes: dict[str, Any], message: str
) -> None:
    foreign.edit_attributes(dataset / "000000.zarr", **changes)
    done = run(app, ["fields", str(dataset)])
    assert (done.exit_code, len(done.stderr.splitlines())) == (2, 1)
    assert f"000000.zarr: the {message}" in done.stderr or f"000000.zarr: {message}" in done.stderr
    verified = run(app, ["verify", str(dataset), "--json"])
    assert verified.exit_code == 1
    readable = next(check for check in json.loads(verified.stdout)["checks"] if check["name"] == "readable")
    assert readable["bad"] == 1


@pytest.mark.parametrize("hashed", ["../../../outside", "/tmp/outside", "0" * 31, 7])
def test_a_content_hash_is_a_hash(dataset: Path, hashed: object) -> None:
    foreign.edit_attributes(dataset / "000000.zarr", reseal=False, content_hash=hashed)
    with pytest.raises(UserError, match="the attribute content_hash can't be right"):
        open_sequence(dataset / "000000.zarr")


def test_an_edited_attribute_is_refused_by_all_but_verify(dataset: Path) -> None:
    foreign.edit_attributes(dataset / "000000.zarr", reseal=False, young_kpa=2.0)
    for words in (["fields", str(dataset)], ["export", str(dataset), str(dataset / "to")]):
        done = run(app, words)
        assert (done.exit_code, len(done.stderr.splitlines())) == (2, 1)
        assert "its attributes are not those that were sealed; see `synth verify`" in done.stderr
    done = run(app, ["verify", str(dataset)])
    assert done.exit_code == 1
    assert "seal: 000000.zarr: attributes were edited" in done.stdout


def test_metadata_without_end_is_not_read(dataset: Path) -> None:
    with (dataset / "000000.zarr/zarr.json").open("ab") as file:
        file.truncate(10**10)
    with pytest.raises(UserError, match="its metadata is larger than 32,000,000 bytes"):
        open_sequence(dataset / "000000.zarr")


def test_one_chunk_that_holds_all_frames_is_refused(dataset: Path) -> None:
    """It would be unpacked whole for every frame."""
    path = dataset / "000000.zarr/flow/zarr.json"
    array = json.loads(path.read_text())
    sharding = array["codecs"][0]["configuration"]
    sharding["chunk_shape"] = [3, 48, 64, 2]
    array["shape"] = sharding["chunk_shape"]
    path.write_text(json.dumps(array))
    sequence = open_sequence(dataset / "000000.zarr")
    assert sequence["flow"].shape == (3, 48, 64, 2)  # small: no harm
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("synth.dataset.store._CHUNK_VALUES", 1000)
        with pytest.raises(UserError, match="flow: is not packed frame by frame"):
            sequence["flow"]


def rows(dataset: Path) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = index.read_index(dataset).to_pylist()
    return found


@pytest.mark.parametrize(
    ("changes", "wrong"),
    [
        ({"index": None}, "index"),
        ({"index": -1}, "index"),
        ({"index": 2}, "index, twice"),
        ({"status": "perhaps"}, "status"),
        ({"status": None}, "status"),
        ({"path": "../../etc"}, "path"),
        ({"path": "000001.zarr"}, "path"),
        ({"content_hash": "../x"}, "content_hash"),
        ({"content_hash": None}, "content_hash"),
        ({"split": "everything"}, "split"),
    ],
    ids=str,
)
def test_rows_that_cant_be_right(dataset: Path, changes: dict[str, Any], wrong: str) -> None:
    found = rows(dataset)
    found[0].update(changes)
    index.save_rows(dataset, found)
    done = run(app, ["report", str(dataset)])
    assert (done.exit_code, len(done.stderr.splitlines())) == (2, 1)
    assert f"index.parquet: rows can't be right ({wrong}); `synth card` writes it anew" in done.stderr
    assert run(app, ["card", str(dataset)]).exit_code == 0
    assert rows(dataset)[0]["path"] == "000000.zarr"


def test_an_index_of_another_program(dataset: Path) -> None:
    pq.write_table(pa.table({"a": [1]}), dataset / "index.parquet")
    done = run(app, ["report", str(dataset)])
    assert (done.exit_code, len(done.stderr.splitlines())) == (2, 1)
    assert "is the index of another program or version; `synth card` writes it anew" in done.stderr
    assert run(app, ["verify", str(dataset)]).exit_code == 1


def test_a_small_index_that_stands_for_endless_text(dataset: Path) -> None:
    """Parquet keeps a repeated text once: here 5 kB of file are 2 MB of table."""
    found = rows(dataset)[0] | {"reason": "x" * 20_000}
    index.save_rows(dataset, [found | {"index": k, "path": f"{k:06d}.zarr"} for k in range(100)])
    assert (dataset / "index.parquet").stat().st_size < 20_000
    with pytest.raises(UserError, match="a text is too long"):
        index.read_index(dataset)


def test_a_side_edited_in_the_index_is_found(dataset: Path) -> None:
    assert run(app, ["split", str(dataset), "--by", "sequence"]).exit_code == 0
    assert run(app, ["verify", str(dataset)]).exit_code in (0, 1)  # stand-ins break laws of physics
    found = rows(dataset)
    moved = next(row for row in found if row["split"] == "test")
    moved["split"] = "train"
    index.save_rows(dataset, found)
    checks = json.loads(run(app, ["verify", str(dataset), "--json"]).stdout)["checks"]
    splits = next(check for check in checks if check["name"] == "splits")
    assert splits["offender"] == f"index.parquet: sequence {moved['index']} is in train, by the rule in test"


@pytest.mark.parametrize(
    "text", ["{}", "[]", '{"by": 7}', '{"shares": [1e999, 0, 0]}', "[" * 100_000, "\x00"]
)
def test_a_split_that_is_none(dataset: Path, text: str) -> None:
    (dataset / "split.json").write_text(text)
    done = run(app, ["card", str(dataset)])
    if text == "{}":  # all of it is the default
        assert done.exit_code == 0
        return
    assert (done.exit_code, len(done.stderr.splitlines())) == (2, 1)
    assert "split.json: is " in done.stderr


@pytest.mark.parametrize(
    "name",
    [".run", ".run/scratch", ".run/logs", ".run/failed", ".run/lock", ".run/scratch/x", "000009.zarr.part"],
)
def test_no_run_follows_a_link(dataset: Path, tmp_path: Path, name: str) -> None:
    elsewhere = tmp_path / "elsewhere"
    (elsewhere / "scratch").mkdir(parents=True)
    (elsewhere / "worker-1.log").write_text("mine")
    place = dataset / name
    if place.is_dir():
        shutil.rmtree(place)
    place.unlink(missing_ok=True)
    place.symlink_to(elsewhere)
    with pytest.raises(UserError, match="is a link, which is not followed; remove it"), claim(dataset, JOB):
        pass
    assert sorted(path.name for path in elsewhere.rglob("*")) == ["scratch", "worker-1.log"]


def test_a_failure_that_says_nothing_is_none(dataset: Path) -> None:
    (dataset / ".run/failed/000001.json").write_text("[1]")
    (dataset / ".run/failed/x.json").write_text("{}")
    done = run(app, ["status", str(dataset)])
    assert done.exit_code == 0, done.output


# ---- drawn cases


def _flip(data: bytes, at: int, bit: int) -> bytes:
    flipped = bytearray(data)
    flipped[at % len(data)] ^= 1 << bit
    return bytes(flipped)


BITS = st.tuples(st.integers(0, 10**9), st.integers(0, 7))


def check_flipped_bit(pristine: Path, scratch: Path, bit: tuple[int, int]) -> None:
    """An index with a bit flipped says what it said, or is refused: never anything else."""
    before = index.read_index(pristine)
    (scratch / index.NAME).write_bytes(_flip((pristine / index.NAME).read_bytes(), *bit))
    with suppress(UserError):
        assert index.read_index(scratch).equals(before)


@cases(bit=BITS)
def test_a_flipped_bit_never_changes_the_index_unseen(
    pristine: Path, tmp_path_factory: pytest.TempPathFactory, bit: tuple[int, int]
) -> None:
    check_flipped_bit(pristine, tmp_path_factory.getbasetemp(), bit)


@pytest.mark.slow
@cases(slow=True, bit=BITS)
def test_a_flipped_bit_never_changes_the_index_unseen_at_length(
    pristine: Path, tmp_path_factory: pytest.TempPathFactory, bit: tuple[int, int]
) -> None:
    check_flipped_bit(pristine, tmp_path_factory.getbasetemp(), bit)


TREE = json.loads(
    json.dumps(
        {
            **{
                name: None
                for name in ("seed", "flow_backend", "job", "format", "format_version", "K", "extra")
            },
            **{name: None for name in ("anatomy_id", "rotation", "mechanics", "versions", "fps", "poisson")},
            **{name: None for name in ("index", "frames", "content_hash", "seal_hash", "young_kpa")},
            "size": [0, 0],
            "scale_mm_per_px": 0,
            "field_hashes": {"flow": "", "force": "", "radiance": ""},
            "scenario": {"family": "", "gesture": {"kind": "", "load": 0}, "relief": {"seed": 0}},
            "summary": {"peak_flow_px": 0, "peak_force_mn": 0, "peak_traction_kpa": 0},
            "timings": {"render": {"cpu_s": 0}},
        }
    )
)
READERS = st.sampled_from(["fields", "status", "report", "card", "verify", "export", "picture", "view"])


def check_attributes(
    guard: Guard, pristine: Path, changes: list[tuple[foreign.Place, Any]], reseal: bool, reader: str
) -> None:
    out = pristine.parent / "edited"
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(pristine, out)
    path = out / "000000.zarr"
    foreign.write_attributes(path, foreign.edit(dict(Dataset(pristine)[0].attrs), changes), reseal)
    if reader == "card":  # which takes an index at its word
        (out / "index.parquet").unlink()
    more = {"export": [str(out / "to")], "picture": ["--to", "p.png"], "view": ["--save", "scene.rrd"]}
    answer = guard.answer("synth", reader, out, *more.get(reader, []), cwd=out)
    if reader == "verify" and answer.code == 1:  # what it finds it says on stdout
        assert "Traceback" not in answer.out + answer.error
        return
    assert_told(answer)


@cases(changes=foreign.edits(TREE), reseal=st.booleans(), reader=READERS)
def test_attributes_of_any_kind(
    guard: Guard, pristine: Path, changes: list[tuple[foreign.Place, Any]], reseal: bool, reader: str
) -> None:
    check_attributes(guard, pristine, changes, reseal, reader)


@pytest.mark.slow
@cases(slow=True, changes=foreign.edits(TREE), reseal=st.booleans(), reader=READERS)
def test_attributes_of_any_kind_at_length(
    guard: Guard, pristine: Path, changes: list[tuple[foreign.Place, Any]], reseal: bool, reader: str
) -> None:
    check_attributes(guard, pristine, changes, reseal, reader)


COLUMNS = st.sampled_from([field.name for field in index.SCHEMA])
CELLS = st.lists(st.tuples(st.integers(0, 2), COLUMNS, foreign.JSON), min_size=1, max_size=3)


def check_index(guard: Guard, pristine: Path, cells: list[tuple[int, str, Any]], reader: str) -> None:
    """Cells of any kind, in a table of the types that they give it."""
    out = pristine.parent / "indexed"
    if not out.exists():
        shutil.copytree(pristine, out)
    found = rows(pristine)
    for row, column, value in cells:
        found[row][column] = value
    try:
        table = pa.Table.from_pylist(found, schema=index.SCHEMA)
    except (pa.ArrowException, OverflowError, TypeError, ValueError):
        try:
            table = pa.Table.from_pylist(found)
        except (pa.ArrowException, OverflowError, TypeError, ValueError):
            table = pa.table({column: [str(value)] for _, column, value in cells})
    try:
        pq.write_table(table, out / "index.parquet")
    except pa.ArrowException:
        return
    answer = guard.answer("synth", reader, out, cwd=out)
    if reader == "verify" and answer.code == 1:
        assert "Traceback" not in answer.out + answer.error
        return
    assert_told(answer)


@cases(cells=CELLS, reader=st.sampled_from(["report", "verify"]))
@example(cells=[(0, "young_kpa", None)], reader="report")
def test_an_index_of_any_kind(
    guard: Guard, pristine: Path, cells: list[tuple[int, str, Any]], reader: str
) -> None:
    check_index(guard, pristine, cells, reader)


@pytest.mark.slow
@cases(slow=True, cells=CELLS, reader=st.sampled_from(["report", "verify"]))
def test_an_index_of_any_kind_at_length(
    guard: Guard, pristine: Path, cells: list[tuple[int, str, Any]], reader: str
) -> None:
    check_index(guard, pristine, cells, reader)
