"""The index of a dataset, `index.parquet`: one row per sequence, derived from the stores."""

from __future__ import annotations

import hashlib
import io
import math
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from synth.dataset import location, sequence_split
from synth.dataset.attributes import cautions_of, gestures_of, name_gestures
from synth.dataset.dataset_folder import Folder, write_whole
from synth.dataset.sequence_split import DatasetSplit, Side
from synth.dataset.store import Dataset, Sequence, open_sequence
from synth.errors import UserError, first_line
from synth.system import checked_file

NAME = "index.parquet"


class IndexColumn(NamedTuple):
    """One fact about a sequence and its column: index, card and exports follow from it."""

    name: str
    type: pa.DataType
    meaning: str
    unit: str = "-"
    source: str | Callable[[Sequence], Any] = ""  # path of the attribute (empty: `name`), or a function
    title: str = ""  # heading of its range in the card; empty: it has none

    def read(self, sequence: Sequence) -> Any:
        """The cell of a finished sequence; None if it has no such attribute."""
        if callable(self.source):
            return self.source(sequence)
        value: Any = sequence.attrs
        for step in (self.source or self.name).split("."):
            value = value.get(step) if value else None
        return value


def _peak_motion_mm(sequence: Sequence) -> float | None:
    scale, flow = sequence.attrs.get("scale_mm_per_px"), sequence.attrs.get("summary", {}).get("peak_flow_px")
    return None if scale is None or flow is None else scale * flow


_INT, _REAL, _TEXT = pa.int64(), pa.float64(), pa.string()

# fmt: off
COLUMNS = (
    IndexColumn("index", _INT, "position in the dataset"),
    IndexColumn("status", _TEXT, "done or failed", source=lambda sequence: "done"),
    IndexColumn("reason", _TEXT, "why it failed", source=lambda sequence: None),
    IndexColumn("path", _TEXT, "the store, relative to this file",
                source=lambda sequence: sequence.path.name),
    IndexColumn("content_hash", _TEXT, "hash of fields and attributes"),
    IndexColumn("anatomy", _TEXT,
                "the geometry: a user's brain or the seed of a procedural one, the same in every dataset; "
                "sequences that share it belong on one side of a split",
                source=lambda sequence: sequence_split.name_anatomy(sequence.attrs)),
    IndexColumn("opening", _TEXT, "place of the craniotomy on a user's brain, named alike in every dataset",
                source="opening_id"),
    IndexColumn("family", _TEXT, "appearance family", source="scenario.family"),
    IndexColumn("gesture", _TEXT, "kind of gesture of each instrument",
                source=lambda sequence: name_gestures(sequence.attrs) or None),
    IndexColumn("instrument", _TEXT, "instrument of each gesture; none: not drawn",
                source=lambda sequence: name_gestures(sequence.attrs, "instrument") or None),
    IndexColumn("young_kpa", _REAL, "Young's modulus", "kPa", title="Young's modulus"),
    IndexColumn("poisson", _REAL, "Poisson's ratio"),
    IndexColumn("load", _REAL, "peak load F/(E a^2) of the first instrument", title="Load F/(E a²)",
                source=lambda sequence: next(iter(gestures_of(sequence.attrs)), {}).get("load")),
    IndexColumn("attempt", _INT, "earlier draws of its gestures, whose loads the mesh did not bear",
                source="scenario.attempt"),
    IndexColumn("peak_force_mn", _REAL, "largest force", "mN", "summary.peak_force_mn", "Peak force"),
    IndexColumn("peak_flow_px", _REAL, "largest true motion", "px", "summary.peak_flow_px"),
    IndexColumn("peak_motion_mm", _REAL, "largest true motion, at the scale of the craniotomy", "mm",
                _peak_motion_mm, "Peak motion"),
    IndexColumn("frames", _INT, "number of frames"),
    IndexColumn("fps", _REAL, "frames per second"),
    IndexColumn("width", _INT, "width of the picture", "px", lambda sequence: sequence.size[1]),
    IndexColumn("height", _INT, "height of the picture", "px", lambda sequence: sequence.size[0]),
    IndexColumn("scale_mm_per_px", _REAL, "scale at the craniotomy", "mm/px"),
    IndexColumn("flow_backend", _TEXT, "estimator of the recovered flow"),
    IndexColumn("split", _TEXT, "train, validation or test; null if there are too few anatomies to split"),
    IndexColumn("cpu_s", _REAL, "processor time of its creation", "s",
                lambda sequence: math.fsum(sequence.stages_cpu_s.values())),
)
# fmt: on

SCHEMA = pa.schema(
    [
        pa.field(name, kind, metadata={"meaning": meaning} | ({} if unit == "-" else {"unit": unit}))
        for name, kind, meaning, unit, *_ in COLUMNS
    ]
)

_LARGEST_BYTES = 1 << 28
_MOST_ROWS = 2_000_000
_REMEDY = "; `synth report` writes it again"


def read_index(root: Path) -> pa.Table:
    """The index as stored. UserError: it is missing, damaged, or of another program or version."""
    path = root / NAME
    try:
        # Arrow refuses a path that is not UTF-8.
        data = pa.BufferReader(checked_file.read_bytes(path, _LARGEST_BYTES))
        file = pq.ParquetFile(data, page_checksum_verification=True)
        # A dataset of format 2 has no instruments in its index.
        names = [name for name in SCHEMA.names if name != "instrument" or name in file.metadata.schema.names]
        if file.metadata.num_rows > _MOST_ROWS or file.metadata.schema.names != names:
            raise UserError(f"{path}: is the index of another program or version{_REMEDY}")
        table = file.read(use_threads=False)
        null_columns = {name: pa.nulls(table.num_rows) for name in SCHEMA.names if name not in names}
        columns = dict(zip(names, table.columns, strict=True)) | null_columns
        table = pa.table(columns).select(SCHEMA.names).cast(SCHEMA)
        table.validate(full=True)
    except (OSError, pa.ArrowException, ValueError, LookupError, MemoryError) as error:
        raise UserError(f"{path}: is damaged ({first_line(error)}){_REMEDY}") from error
    return table


def read_split(root: Path, *, required: bool = True) -> DatasetSplit:
    """The stored split, else as `write_index` would create it. UserError: `required` and too few groups."""
    stored = sequence_split.read_stored(root)
    if stored.sides:
        return stored
    rows = [row_of(open_sequence(location.store(root, key))) for key in Folder(root).list_sealed()]
    try:
        assign = sequence_split.assign_sides if required else sequence_split.assign_if_possible
        return _add_sides(rows, assign(rows, stored), stored)
    except UserError as error:
        raise UserError(f"{root}: {error}") from None


def group_by_side(dataset: Dataset) -> dict[str, list[int]]:
    """Positions of sequences by side, without empty sides; all are "train" if there are too few to split."""
    names = [sequence.attrs["content_hash"] for sequence in dataset]
    split = read_split(dataset.root, required=False)
    sides = split.find(names, dataset.root) if split.sides else ["train"] * len(names)
    groups = {side: [k for k, other in enumerate(sides) if other == side] for side in sequence_split.SIDES}
    return {side: positions for side, positions in groups.items() if positions}


def write_index(folder: Folder, rule: DatasetSplit | None = None) -> list[dict[str, Any]]:
    """Updates the index from the folder, and creates it again if it can't be read. Returns all rows.

    New sequences are assigned a side, which is stored. `rule`, a split without sides, replaces the stored
    one; then UserError as `assign_sides`.
    """
    known_rows: dict[int, dict[str, Any]] = {}
    with suppress(UserError):
        known_rows = {
            row["index"]: row for row in read_index(folder.root).to_pylist() if row["status"] == "done"
        }
    failures = folder.failures().items()
    rows_by_index = {
        k: {"index": k, "status": "failed", "reason": failure["reason"]} for k, failure in failures
    }
    stores = {key: location.store(folder.root, key) for key in folder.list_sealed()}
    rows_by_index |= {key: known_rows.get(key) or row_of(open_sequence(path)) for key, path in stores.items()}
    rows = [rows_by_index[key] for key in sorted(rows_by_index)]
    split = rule or sequence_split.read_stored(folder.root)
    sides = (
        sequence_split.assign_sides(rows, rule) if rule else sequence_split.assign_if_possible(rows, split)
    )
    for row, side in zip(rows, sides, strict=True):
        row["split"] = side
    if any(sides):
        sequence_split.store(folder.root, _add_sides(rows, sides, split))
    save_rows(folder.root, rows)
    return rows


def _add_sides(
    rows: Iterable[Mapping[str, Any]], sides: Iterable[Side | None], split: DatasetSplit
) -> DatasetSplit:
    """The split with the sides of the rows added."""
    added = {row["content_hash"]: side for row, side in zip(rows, sides, strict=True) if side}
    return replace(split, sides={**split.sides, **added})


def save_rows(root: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Writes the index; missing columns are null."""
    table = pa.Table.from_pylist([dict(row) for row in rows], schema=SCHEMA)
    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd", write_page_checksum=True)
    write_whole(root / NAME, buffer.getvalue())


def row_of(sequence: Sequence) -> dict[str, Any]:
    """The index row of a finished sequence, from its attributes; without its side, which is not its own."""
    return {column.name: column.read(sequence) for column in COLUMNS if column.name != "split"}


def list_cautions(root: Path, indices: Iterable[int]) -> dict[str, list[int]]:
    """What is doubtful about the mechanics of sequences, each with those of which it is."""
    cautions: dict[str, list[int]] = {}
    for key in indices:
        with suppress(UserError):  # damage is reported by `synth verify`
            for caution in cautions_of(open_sequence(location.store(root, key), sealed=False).attrs):
                cautions.setdefault(caution, []).append(key)
    return cautions


def dataset_hash(rows: Iterable[Mapping[str, Any]]) -> str:
    """Hash of the content hashes of the finished sequences, in order of their index."""
    total = hashlib.blake2b(digest_size=16)
    for row in rows:
        if row["status"] == "done":
            total.update(f"{row['index']}:{row['content_hash']}\n".encode())
    return total.hexdigest()
