"""The index of a dataset: one row a sequence, in `index.parquet`, made from what is on disk."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

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


class IndexColumn(NamedTuple):
    """One column of the index."""

    name: str
    type: pa.DataType
    meaning: str
    unit: str = "-"


_INT, _REAL, _TEXT = pa.int64(), pa.float64(), pa.string()

COLUMNS = (
    IndexColumn("index", _INT, "position in the dataset"),
    IndexColumn("status", _TEXT, "done or failed"),
    IndexColumn("reason", _TEXT, "why it failed"),
    IndexColumn("path", _TEXT, "the store, relative to this file"),
    IndexColumn("content_hash", _TEXT, "hash of fields and attributes"),
    IndexColumn(
        "anatomy",
        _TEXT,
        "the geometry: a user's brain or a procedural one's seed, the same in every dataset; sequences that "
        "share it belong on one side of a split",
    ),
    IndexColumn("opening", _TEXT, "where a user's brain is opened: the same place, the same name everywhere"),
    IndexColumn("family", _TEXT, "appearance family"),
    IndexColumn("gesture", _TEXT, "kind of gesture, of every instrument"),
    IndexColumn("young_kpa", _REAL, "Young's modulus", "kPa"),
    IndexColumn("poisson", _REAL, "Poisson's ratio"),
    IndexColumn("load", _REAL, "peak load F/(E a^2)"),
    IndexColumn("peak_force_mn", _REAL, "largest force", "mN"),
    IndexColumn("peak_flow_px", _REAL, "largest true motion", "px"),
    IndexColumn("peak_motion_mm", _REAL, "the same at the craniotomy", "mm"),
    IndexColumn("frames", _INT, "frames"),
    IndexColumn("fps", _REAL, "frames a second"),
    IndexColumn("width", _INT, "width of the picture", "px"),
    IndexColumn("height", _INT, "height of the picture", "px"),
    IndexColumn("scale_mm_per_px", _REAL, "scale at the craniotomy", "mm/px"),
    IndexColumn("flow_backend", _TEXT, "estimator of the recovered flow"),
    IndexColumn("split", _TEXT, "train, validation or test; by the rule in split.json"),
    IndexColumn("cpu_s", _REAL, "processor time it took", "s"),
)

SCHEMA = pa.schema(
    [
        pa.field(
            one.name,
            one.type,
            metadata={"meaning": one.meaning} | ({} if one.unit == "-" else {"unit": one.unit}),
        )
        for one in COLUMNS
    ]
)

_LARGEST_BYTES = 1 << 28
_MOST_ROWS = 2_000_000
_REMEDY = "; `synth report` writes it anew"


def read_index(root: Path) -> pa.Table:
    """The index as it was last written.

    Raises:
        UserError: missing, damaged, of another program or version, or with rows that no dataset has.
    """
    path = root / NAME
    try:
        checked_file.check_file(path, _LARGEST_BYTES)
        about = pq.read_metadata(path)
        if about.num_rows > _MOST_ROWS or about.schema.names != SCHEMA.names:
            raise UserError(f"{path}: is the index of another program or version{_REMEDY}")
        file = pq.ParquetFile(path, memory_map=False, page_checksum_verification=True)
        table = file.read(use_threads=False).cast(SCHEMA)
        table.validate(full=True)
    except (OSError, pa.ArrowException, ValueError, LookupError, MemoryError) as error:
        why = (str(error).splitlines() or ["it takes too much memory"])[0]
        raise UserError(f"{path}: is damaged ({why[:200]}){_REMEDY}") from error
    _check_rows(table, path)
    return table


def _check_rows(table: pa.Table, path: Path) -> None:
    """UserError if rows say what no writer of ours does: readers take them at their word."""
    number, done = table["index"], table.filter(pc.equal(table["status"], "done"))
    hashed = pc.match_substring_regex(done["content_hash"], "^[0-9a-f]{32}$")
    right = {
        "index": number.null_count == 0 and (pc.min(number).as_py() or 0) >= 0,
        "index, twice": pc.count_distinct(number).as_py() == len(table),
        "status": set(table["status"].unique().to_pylist()) <= {"done", "failed"},
        "path": done["path"].to_pylist() == [f"{key or 0:06d}.zarr" for key in done["index"].to_pylist()],
        "content_hash": done["content_hash"].null_count == 0 and pc.all(hashed).as_py() is not False,
        "split": set(table["split"].unique().to_pylist()) <= {*split.SIDES, None},
    }
    wrong = [name for name, good in right.items() if not good]
    if wrong:
        raise UserError(f"{path}: rows can't be right ({wrong[0]}){_REMEDY}")


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
    sides = split.assign_if_possible(ordered, split.read_rule(folder.root))
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
