"""Export as Parquet for the Hugging Face Hub: a row per frame with its pictures, and a row per sequence.

`datasets.load_dataset(FOLDER)` reads pictures as pictures and arrays as arrays, and the Hub's viewer shows
them. The features are written to the metadata of the Parquet files, as `datasets` does, so that only pyarrow
is needed (huggingface.co/docs/datasets/about_dataset_features).
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from synth.arrays import Array
from synth.dataset import index
from synth.dataset.dataset_folder import Folder
from synth.dataset.store import Dataset, Sequence
from synth.fields import FIELDS, TIME
from synth.publish import card
from synth.publish.export.encoding import PICTURES, as_png

# The viewer reads a row group at once, and refuses those of more than a few hundred megabytes.
_GROUP_BYTES, _GROUPS = 100 << 20, 5  # size of a row group; row groups per file

_ROWS = {"sequence": ("int64", "index of the sequence"), "frame": ("int64", "number in the sequence")}
_LEFT_OUT = ("status", "reason", "path", "split")  # columns of the index without meaning here


@dataclass(frozen=True)
class ParquetColumn:
    """One column: its type in Parquet, and its feature in `datasets`."""

    name: str
    type: pa.DataType
    feature: dict[str, Any]

    def describe(self) -> pa.Field:
        """The field of a schema; with the extension type of `datasets` for an array."""
        kind = str(self.feature["_type"])
        if not kind.startswith("Array"):
            return pa.field(self.name, self.type)
        metadata = {
            "ARROW:extension:name": f"datasets.features.features.{kind}ExtensionType",
            "ARROW:extension:metadata": json.dumps([self.feature["shape"], self.feature["dtype"]]),
        }
        return pa.field(self.name, self.type, metadata=metadata)

    def pack(self, values: list[Any]) -> pa.Array:
        """Rows as that type, without a Python object for each number of an array."""
        if not isinstance(values[0], np.ndarray):
            return pa.array(values, self.type)
        packed = pa.array(np.stack(values).astype(FIELDS[self.name].dtype, copy=False).reshape(-1))
        for size in reversed(values[0].shape):
            packed = pa.FixedSizeListArray.from_arrays(packed, size)
        return packed.cast(self.type)


def write_parquet(dataset: Dataset, target: Path) -> None:
    """Writes `frames/SIDE-NNNNN.parquet` (default), `sequences/SIDE-00000.parquet`, and the card README.md.

    A frame's row has all fields with a frame axis, masks and pictures as PNG, all lossless; a sequence's row
    the columns of the index, the fields without a frame axis, and all attributes as JSON.
    """
    first, sides = dataset[0], index.group_by_side(dataset)
    framed = [name for name in first.fields if FIELDS[name].dims[0] == TIME]
    frameless = [name for name in first.fields if name not in framed]
    index_columns = [column for column in index.COLUMNS if column.name not in _LEFT_OUT]
    frame_columns = [
        *(_plain(name, kind) for name, (kind, _) in _ROWS.items()),
        *(_field(first, n) for n in framed),
    ]
    sequence_columns = [
        _plain(column.name, str(column.type).replace("double", "float64")) for column in index_columns
    ]
    sequence_columns += [*(_field(first, name) for name in frameless), _plain("attributes", "string")]
    # Of the sequences that are written: the stored index may be missing, or older.
    rows = [index.row_of(sequence) for sequence in dataset]
    for side, positions in sides.items():
        frame_rows = (row for k in positions for row in _frames(dataset[k], framed))
        _write(target / "frames", side, frame_columns, frame_rows)
        sequence_rows = (rows[k] | _frameless(dataset[k], frameless) for k in positions)
        _write(target / "sequences", side, sequence_columns, sequence_rows)
        for k in positions:
            rows[k]["split"] = side
    text = card.template("export/hugging_face.md.jinja").render(
        **card.facts(Folder(dataset.root), rows),
        sides=list(sides),
        row_columns=_ROWS,
        framed=[FIELDS[name] for name in framed],
        still=[FIELDS[name] for name in frameless],
        index=index_columns,
    )
    (target / "README.md").write_text(text, "utf-8")


def _plain(name: str, kind: str) -> ParquetColumn:
    return ParquetColumn(name, pa.type_for_alias(kind), {"dtype": kind, "_type": "Value"})


def _field(sequence: Sequence, name: str) -> ParquetColumn:
    """The column of a field: pictures, numbers, or arrays."""
    dtype, shape = FIELDS[name].dtype, sequence[name].shape[FIELDS[name].dims[0] == TIME :]
    if name in PICTURES or dtype == "bool":
        kind = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
        return ParquetColumn(name, kind, {"_type": "Image"})
    if not shape:
        return _plain(name, dtype)
    value = pa.type_for_alias(dtype)
    if len(shape) == 1:
        feature = {"feature": _plain(name, dtype).feature, "length": shape[0], "_type": "Sequence"}
        return ParquetColumn(name, pa.list_(value, shape[0]), feature)
    for _ in shape:
        value = pa.list_(value)
    feature = {"shape": list(shape), "dtype": dtype, "_type": f"Array{len(shape)}D"}
    return ParquetColumn(name, value, feature)


def _frames(sequence: Sequence, names: list[str]) -> Iterator[dict[str, Any]]:
    for t in range(sequence.frames):
        cells = {name: _cell(name, sequence[name][t]) for name in names}
        yield {"sequence": sequence.index, "frame": t, **cells}


def _frameless(sequence: Sequence, names: list[str]) -> dict[str, Any]:
    cells = {name: _cell(name, sequence[name][:]) for name in names}
    return cells | {"attributes": json.dumps(sequence.attrs)}


def _cell(name: str, values: Array) -> Any:
    if name in PICTURES or values.dtype == bool:
        return {"bytes": as_png(values), "path": None}
    return values if values.ndim else values.item()


def _write(folder: Path, side: str, columns: list[ParquetColumn], rows: Iterator[dict[str, Any]]) -> None:
    """Writes `SIDE-NNNNN.parquet` in `folder`, each of several row groups."""
    features = {column.name: column.feature for column in columns}
    metadata = {"huggingface": json.dumps({"info": {"features": features}})}
    schema = pa.schema([column.describe() for column in columns], metadata)
    folder.mkdir(exist_ok=True)
    first = next(rows)
    size = sum(_bytes(first[column.name]) for column in columns)
    rows, count = chain([first], rows), max(1, _GROUP_BYTES // size)
    groups = iter(lambda: list(islice(rows, count)), [])
    for part, group in enumerate(groups):
        path = folder / f"{side}-{part:05d}.parquet"
        packing = {"compression": "zstd", "use_dictionary": False, "write_page_checksum": True}
        with pq.ParquetWriter(path, schema, **packing) as writer:
            for batch in chain([group], islice(groups, _GROUPS - 1)):
                packed = [column.pack([row[column.name] for row in batch]) for column in columns]
                writer.write_table(pa.Table.from_arrays(packed, schema=schema))


def _bytes(value: Any) -> int:
    """Approximate uncompressed size of a cell."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    return len(value["bytes"]) if isinstance(value, dict) else 8
