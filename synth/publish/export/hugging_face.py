"""Parquet for the Hugging Face Hub: a row a frame with its pictures, and a row a sequence.

`datasets.load_dataset(FOLDER)` reads it with pictures as pictures and arrays as arrays, and the Hub's viewer
shows it. The features stand in the Parquet files' own metadata, as `datasets` writes them, so that writing
needs pyarrow only (huggingface.co/docs/datasets/about_dataset_features).
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from synth.dataset import index
from synth.dataset.folder import Folder
from synth.dataset.store import Dataset, Sequence
from synth.fields import FIELDS, TIME, Field
from synth.publish import card
from synth.publish.export.encoding import PICTURES, as_png

# The viewer reads a group of rows at once, and refuses ones of more than some hundred megabytes.
_GROUP_BYTES = 100 << 20
_FILE_BYTES = 500 << 20

_ROWS = {"sequence": ("int64", "index of the sequence"), "frame": ("int64", "number in the sequence")}
_LEFT_OUT = ("status", "reason", "path", "split")  # of the index: nothing to say here


@dataclass(frozen=True)
class _Column:
    """One column: its type in Parquet, and what `datasets` makes of it."""

    name: str
    type: pa.DataType
    feature: dict[str, Any]

    def describe(self) -> pa.Field:
        """As a field of a schema; one of an array names the type that `datasets` has for it."""
        kind = str(self.feature["_type"])
        if not kind.startswith("Array"):
            return pa.field(self.name, self.type)
        about = {
            "ARROW:extension:name": f"datasets.features.features.{kind}ExtensionType",
            "ARROW:extension:metadata": json.dumps([self.feature["shape"], self.feature["dtype"]]),
        }
        return pa.field(self.name, self.type, metadata=about)

    def pack(self, values: list[Any]) -> pa.Array:
        """Rows as that type; arrays of one shape are taken as they are."""
        if pa.types.is_fixed_size_list(self.type):
            flat = pa.array(np.concatenate(values), self.type.value_type)
            return pa.FixedSizeListArray.from_arrays(flat, self.type.list_size)
        if pa.types.is_list(self.type):
            return _nested(np.stack(values), self.type)
        return pa.array(values, self.type)


def write_parquet(dataset: Dataset, target: Path) -> None:
    """`frames/SIDE-NNNNN.parquet` (default), `sequences/SIDE-00000.parquet`, and the card README.md.

    A frame's row holds every field with a frame axis, masks and pictures as PNG, all without loss; a
    sequence's row the index's columns, the fields without a frame axis, and all attributes as JSON.
    """
    first, sides = dataset[0], index.group_by_side(dataset)
    framed = [name for name in first.fields if FIELDS[name].dims[0] == TIME]
    still = [name for name in first.fields if FIELDS[name].dims[0] != TIME]
    frames = [*(_plain(name, kind) for name, (kind, _) in _ROWS.items()), *(_field(first, n) for n in framed)]
    told = [field for field in index.SCHEMA if field.name not in _LEFT_OUT]
    each = [_plain(field.name, str(field.type).replace("double", "float64")) for field in told]
    each += [*(_field(first, name) for name in still), _plain("attributes", "string")]
    for side, positions in sides.items():
        rows = (row for k in positions for row in _frames(dataset[k], framed))
        _write(target / "frames", side, frames, rows)
        about = (_sequence(dataset[k], still, [field.name for field in told]) for k in positions)
        _write(target / "sequences", side, each, about)
    (target / "README.md").write_text(_card(dataset, list(sides), framed, still), "utf-8")


def _plain(name: str, kind: str) -> _Column:
    return _Column(name, pa.type_for_alias(kind), {"dtype": kind, "_type": "Value"})


def _field(sequence: Sequence, name: str) -> _Column:
    """A field's values in one row: a picture, a number, or an array of its shape."""
    field = FIELDS[name]
    shape = sequence[name].shape[field.dims[0] == TIME :]
    if name in PICTURES or _is_mask(field):
        kind = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
        return _Column(name, kind, {"_type": "Image"})
    value = pa.type_for_alias(field.dtype)
    if not shape:
        return _plain(name, field.dtype)
    if len(shape) == 1:
        told = {"feature": {"dtype": field.dtype, "_type": "Value"}, "length": shape[0], "_type": "Sequence"}
        return _Column(name, pa.list_(value, shape[0]), told)
    for _ in shape:
        value = pa.list_(value)
    told = {"shape": list(shape), "dtype": field.dtype, "_type": f"Array{len(shape)}D"}
    return _Column(name, value, told)


def _is_mask(field: Field) -> bool:
    return field.dtype == "bool"


def _frames(sequence: Sequence, names: list[str]) -> Iterator[dict[str, Any]]:
    for t in range(sequence.frames):
        row: dict[str, Any] = {"sequence": sequence.index, "frame": t}
        yield row | {name: _cell(name, sequence[name][t]) for name in names}


def _sequence(sequence: Sequence, still: list[str], told: list[str]) -> dict[str, Any]:
    about = index.row_of(sequence)
    row = {name: about[name] for name in told}
    row |= {name: _cell(name, sequence[name][:]) for name in still}
    return row | {"attributes": json.dumps(sequence.attrs)}


def _cell(name: str, values: NDArray[Any]) -> Any:
    if name in PICTURES or _is_mask(FIELDS[name]):
        return {"bytes": as_png(values), "path": None}
    return values if values.ndim else values.item()


def _write(folder: Path, side: str, columns: list[_Column], rows: Iterator[dict[str, Any]]) -> None:
    """`SIDE-NNNNN.parquet` in `folder`, each of several groups of rows."""
    features = {column.name: column.feature for column in columns}
    about = {"huggingface": json.dumps({"info": {"features": features}})}
    schema = pa.schema([column.describe() for column in columns], about)
    folder.mkdir(exist_ok=True)
    held: list[dict[str, Any]] = []
    part, used, size = 0, 0, 0
    writer: pq.ParquetWriter | None = None
    for row in rows:
        held.append(row)
        size += sum(_bytes(value) for value in row.values())
        if size < _GROUP_BYTES:
            continue
        writer = writer or _open(folder / f"{side}-{part:05d}.parquet", schema)
        writer.write_table(_table(held, columns, schema))
        used, size, held = used + size, 0, []
        if used >= _FILE_BYTES:
            writer.close()
            writer, used, part = None, 0, part + 1
    if held:
        writer = writer or _open(folder / f"{side}-{part:05d}.parquet", schema)
        writer.write_table(_table(held, columns, schema))
    if writer:
        writer.close()


def _open(path: Path, schema: pa.Schema) -> pq.ParquetWriter:
    return pq.ParquetWriter(path, schema, compression="zstd", use_dictionary=False, write_page_checksum=True)


def _table(rows: list[dict[str, Any]], columns: list[_Column], schema: pa.Schema) -> pa.Table:
    packed = [column.pack([row[column.name] for row in rows]) for column in columns]
    return pa.Table.from_arrays(packed, schema=schema)


def _bytes(value: Any) -> int:
    """About what a cell takes unpacked."""
    if isinstance(value, np.ndarray):
        # Each innermost list has an offset beside its numbers.
        return int(value.nbytes + 4 * value.size / max(value.shape[-1:] or (1,)))
    return len(value["bytes"]) if isinstance(value, dict) else 8


def _nested(values: NDArray[Any], kind: pa.DataType) -> pa.Array:
    """(N, ...) as N rows of lists of lists."""
    depth, kinds = values.ndim - 1, [kind]
    for _ in range(depth):
        kinds.append(kinds[-1].value_type)
    packed = pa.array(np.ascontiguousarray(values).reshape(-1), kinds[-1])
    for level in range(depth, 0, -1):
        count = int(np.prod(values.shape[:level]))
        offsets = np.arange(count + 1, dtype=np.int32) * np.int32(values.shape[level])
        packed = pa.ListArray.from_arrays(pa.array(offsets), packed)
    return packed.cast(kind)


def _card(dataset: Dataset, sides: list[str], framed: list[str], still: list[str]) -> str:
    """README.md: what the Hub and `datasets` read of it, and what a person does."""
    folder = Folder(dataset.root)
    about, rows = folder.job().card, [index.row_of(sequence) for sequence in dataset]
    frames = sum(row["frames"] for row in rows)
    configs = [
        {
            "config_name": name,
            "default": name == "frames",
            "data_files": [{"split": side, "path": f"{name}/{side}-*.parquet"} for side in sides],
        }
        for name in ("frames", "sequences")
    ]
    return str(
        card.template("export/hugging_face.md.jinja").render(
            card=about,
            configs=configs,
            side=sides[0],
            size_category=card.size_category(frames),
            sequences=len(rows),
            frames=frames,
            row_columns=_ROWS,
            framed=[FIELDS[name] for name in framed],
            still=[FIELDS[name] for name in still],
            index=[column for column in card.columns() if column["name"] not in _LEFT_OUT],
            families=card.share(rows, "family"),
            gestures=card.share(rows, "gesture"),
            limits=card.limits(folder),
            identity=folder.described()["identity"],
            width=rows[0]["width"],
            height=rows[0]["height"],
        )
    )
