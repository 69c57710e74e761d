"""The index of a dataset: one row a sequence, in `index.parquet`, made from what is on disk."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from synth.dataset import location, split
from synth.dataset.attributes import name_gestures
from synth.dataset.folder import Folder, write_whole
from synth.dataset.store import Dataset, Sequence, open_sequence
from synth.errors import UserError
from synth.system import checked_file

NAME = "index.parquet"

SCHEMA = pa.schema(
    [
        pa.field("index", pa.int64(), metadata={"meaning": "position in the dataset"}),
        pa.field("status", pa.string(), metadata={"meaning": "done or failed"}),
        pa.field("reason", pa.string(), metadata={"meaning": "why it failed"}),
        pa.field("path", pa.string(), metadata={"meaning": "the store, relative to this file"}),
        pa.field("content_hash", pa.string(), metadata={"meaning": "hash of fields and attributes"}),
        pa.field(
            "anatomy",
            pa.string(),
            metadata={
                "meaning": "the geometry: a user's brain or a procedural one's seed, the same in every "
                "dataset; sequences that share it belong on one side of a split"
            },
        ),
        pa.field(
            "opening",
            pa.string(),
            metadata={"meaning": "where a user's brain is opened: the same place, the same name everywhere"},
        ),
        pa.field("family", pa.string(), metadata={"meaning": "appearance family"}),
        pa.field("gesture", pa.string(), metadata={"meaning": "kind of gesture, of every instrument"}),
        pa.field("young_kpa", pa.float64(), metadata={"meaning": "Young's modulus", "unit": "kPa"}),
        pa.field("poisson", pa.float64(), metadata={"meaning": "Poisson's ratio"}),
        pa.field("load", pa.float64(), metadata={"meaning": "peak load F/(E a^2)"}),
        pa.field("peak_force_mn", pa.float64(), metadata={"meaning": "largest force", "unit": "mN"}),
        pa.field("peak_flow_px", pa.float64(), metadata={"meaning": "largest true motion", "unit": "px"}),
        pa.field(
            "peak_motion_mm", pa.float64(), metadata={"meaning": "the same at the craniotomy", "unit": "mm"}
        ),
        pa.field("frames", pa.int64(), metadata={"meaning": "frames"}),
        pa.field("fps", pa.float64(), metadata={"meaning": "frames a second"}),
        pa.field("width", pa.int64(), metadata={"meaning": "width of the picture", "unit": "px"}),
        pa.field("height", pa.int64(), metadata={"meaning": "height of the picture", "unit": "px"}),
        pa.field(
            "scale_mm_per_px", pa.float64(), metadata={"meaning": "scale at the craniotomy", "unit": "mm/px"}
        ),
        pa.field("flow_backend", pa.string(), metadata={"meaning": "estimator of the recovered flow"}),
        pa.field(
            "split", pa.string(), metadata={"meaning": "train, validation or test; by the rule in split.json"}
        ),
        pa.field("cpu_s", pa.float64(), metadata={"meaning": "processor time it took", "unit": "s"}),
    ]
)


_LARGEST_BYTES = 1 << 30
_MOST_ROWS = 2_000_000
_LONGEST_TEXT = 10_000
_SPOILT = "; `synth report` writes it anew"


def read_index(root: Path) -> pa.Table:
    """The index as it was last written.

    Raises:
        UserError: missing, damaged, of another program or version, or with rows that no dataset has.
    """
    path = root / NAME
    try:
        checked_file.check_file(path, _LARGEST_BYTES)
        about = pq.read_metadata(path)
        if about.num_rows > _MOST_ROWS:
            raise UserError(f"{path}: holds more than {_MOST_ROWS:,} rows")
        if about.schema.names != SCHEMA.names:
            raise UserError(f"{path}: is the index of another program or version{_SPOILT}")
        texts = [field.name for field in SCHEMA if field.type == pa.string()]
        # Texts stay dictionaries until their length is known: a small file can stand for endless ones.
        table = pq.ParquetFile(
            path, memory_map=False, read_dictionary=texts, page_checksum_verification=True
        ).read(use_threads=False)
        for name in texts:
            table = table.set_column(table.schema.names.index(name), name, _plain(table[name]))
        table = table.cast(SCHEMA)
        table.validate(full=True)
    except (OSError, pa.ArrowException, ValueError, LookupError, MemoryError) as error:
        why = (str(error).splitlines() or ["it takes too much memory"])[0]
        raise UserError(f"{path}: is damaged ({why[:200]}){_SPOILT}") from error
    _check_rows(table, path)
    return table


def _plain(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Texts as such. ValueError if they are none, or one is too long."""
    if not pa.types.is_dictionary(column.type) or column.type.value_type != pa.string():
        raise ValueError("a text is none")
    for chunk in column.chunks:
        if (pc.max(pc.binary_length(chunk.dictionary)).as_py() or 0) > _LONGEST_TEXT:
            raise ValueError("a text is too long")
    return column.cast(pa.string())


def _check_rows(table: pa.Table, path: Path) -> None:
    """UserError if rows say what no writer of ours does: readers take them at their word."""
    number, done = table["index"], pc.equal(table["status"], "done")
    told = table.filter(done)
    named = [f"{key:06d}.zarr" for key in told["index"].to_pylist() if key is not None]
    hashed = pc.match_substring_regex(told["content_hash"], "^[0-9a-f]{32}$")
    right = {
        "index": number.null_count == 0 and (pc.min(number).as_py() or 0) >= 0,
        "index, twice": pc.count_distinct(number).as_py() == len(table),
        "status": not len(table) or pc.all(pc.is_in(table["status"], pa.array(["done", "failed"]))).as_py(),
        "path": told["path"].to_pylist() == named,
        "content_hash": told["content_hash"].null_count == 0 and pc.all(hashed).as_py() is not False,
        "split": pc.all(pc.is_in(table["split"], pa.array([*split.SIDES, None]))).as_py() is not False,
    }
    wrong = [name for name, good in right.items() if not good]
    if wrong:
        raise UserError(f"{path}: rows can't be right ({wrong[0]}){_SPOILT}")


def collect(folder: Folder) -> list[dict[str, Any]]:
    """All rows but for their sides, as the folder is now; those that the index has already are kept.

    An index that can't be read is made anew: all that it says is in the stores.
    """
    known: dict[int, dict[str, Any]] = {}
    with suppress(UserError):
        known = {row["index"]: row for row in read_index(folder.root).to_pylist() if row["status"] == "done"}
    rows = {key: known.get(key) or row_of(_open(folder, key)) for key in folder.sealed()}
    for key, failure in folder.failures().items():
        if key not in rows:
            rows[key] = {"index": key, "status": "failed", "reason": failure["reason"]}
    return [rows[key] for key in sorted(rows)]


def written_sides(root: Path) -> dict[str, str] | None:
    """The side of every sequence by its content hash, as `synth split` decided; None where nobody did.

    From what the sealed stores say, not the index: that may be edited. UserError if the dataset has too few
    groups for its rule.
    """
    if not split.is_written(root):
        return None
    folder = Folder(root)
    rows = [row_of(_open(folder, key)) for key in folder.sealed()]
    sides = split.assign_sides(rows, split.read_rule(root))
    return {row["content_hash"]: side for row, side in zip(rows, sides, strict=True) if side is not None}


def group_by_side(dataset: Dataset) -> dict[str, list[int]]:
    """Positions of a dataset's sequences by side, in the order train, validation, test; sides without any
    are left out. All are "train" where nobody decided. UserError as `written_sides`.
    """
    sides = written_sides(dataset.root)
    if sides is None:
        return {"train": list(range(len(dataset)))}
    told = [sides.get(sequence.attrs["content_hash"]) for sequence in dataset]
    groups = {side: [k for k, one in enumerate(told) if one == side] for side in split.SIDES}
    return {side: chosen for side, chosen in groups.items() if chosen}


def write_index(folder: Folder) -> list[dict[str, Any]]:
    """Brings the index up to date with the folder. Returns all rows."""
    ordered = collect(folder)
    try:
        sides = split.assign_sides(ordered, split.read_rule(folder.root))
    except UserError:  # too few groups to have some on every side
        sides = [None] * len(ordered)
    for row, side in zip(ordered, sides, strict=True):
        row["split"] = side
    save_rows(folder.root, ordered)
    return ordered


def save_rows(root: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Writes the rows; columns that a row lacks are null."""
    table = pa.Table.from_pylist([dict(row) for row in rows], schema=SCHEMA)
    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd", write_page_checksum=True)
    write_whole(root / NAME, buffer.getvalue())


def row_of(sequence: Sequence) -> dict[str, Any]:
    """The row of a finished sequence, from its attributes."""
    attrs = sequence.attrs
    scenario, summary = attrs.get("scenario", {}), attrs.get("summary", {})
    gesture = scenario.get("gesture") or {}
    scale, flow = attrs.get("scale_mm_per_px"), summary.get("peak_flow_px")
    stages = [stage for stage in attrs.get("timings", {}).values() if isinstance(stage, dict)]
    return {
        "index": sequence.index,
        "status": "done",
        "path": sequence.path.name,
        "content_hash": attrs["content_hash"],
        "anatomy": split.name_anatomy(attrs),
        "opening": attrs.get("opening_id"),
        "family": scenario.get("family"),
        "gesture": name_gestures(scenario) or None,
        "young_kpa": attrs.get("young_kpa"),
        "poisson": attrs.get("poisson"),
        "load": gesture.get("load"),
        "peak_force_mn": summary.get("peak_force_mn"),
        "peak_flow_px": flow,
        "peak_motion_mm": None if scale is None or flow is None else scale * flow,
        "frames": sequence.frames,
        "fps": attrs.get("fps"),
        "width": sequence.size[1],
        "height": sequence.size[0],
        "scale_mm_per_px": scale,
        "flow_backend": attrs.get("flow_backend"),
        "cpu_s": sum(stage.get("cpu_s", 0.0) for stage in stages),
    }


def dataset_hash(rows: Iterable[Mapping[str, Any]]) -> str:
    """Hash of the content hashes of the finished sequences, in order of their index."""
    total = hashlib.blake2b(digest_size=16)
    for row in rows:
        if row["status"] == "done":
            total.update(f"{row['index']}:{row['content_hash']}\n".encode())
    return total.hexdigest()


def _open(folder: Folder, key: int) -> Sequence:
    return open_sequence(location.store(folder.root, key))
