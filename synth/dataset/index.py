"""The index of a dataset: one row a sequence, in `index.parquet`, made from what is on disk."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from synth.dataset import location, split
from synth.dataset.folder import Folder, write_whole
from synth.dataset.store import Sequence, open_sequence
from synth.errors import UserError

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
        pa.field("family", pa.string(), metadata={"meaning": "appearance family"}),
        pa.field("gesture", pa.string(), metadata={"meaning": "kind of gesture"}),
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


def read_index(root: Path) -> pa.Table:
    """The index as it was last written. UserError when it is missing or damaged."""
    path = root / NAME
    try:
        return pq.read_table(path, memory_map=False)
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except (OSError, pa.ArrowInvalid) as error:
        raise UserError(f"{path}: is damaged ({str(error).splitlines()[0]})") from error


def collect(folder: Folder) -> list[dict[str, Any]]:
    """All rows but for their sides, as the folder is now; those that the index has already are kept."""
    known: dict[int, dict[str, Any]] = {}
    if (folder.root / NAME).exists():
        table = read_index(folder.root)
        rows_before = table.to_pylist() if table.schema.equals(SCHEMA) else []
        known = {row["index"]: row for row in rows_before if row["status"] == "done"}
    rows = {key: known.get(key) or row_of(_open(folder, key)) for key in folder.sealed()}
    for key, failure in folder.failures().items():
        if key not in rows:
            rows[key] = {"index": key, "status": "failed", "reason": failure["reason"]}
    return [rows[key] for key in sorted(rows)]


def written_sides(root: Path) -> dict[str, str] | None:
    """The side of every sequence by its content hash, as `synth split` decided; None where nobody did.

    UserError if the dataset has too few groups for its rule.
    """
    if not split.is_written(root):
        return None
    rows = collect(Folder(root))
    sides = split.assign_sides(rows, split.read_rule(root))
    return {row["content_hash"]: side for row, side in zip(rows, sides, strict=True) if side is not None}


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
    pq.write_table(table, buffer, compression="zstd")
    write_whole(root / NAME, buffer.getvalue())


def row_of(sequence: Sequence) -> dict[str, Any]:
    """The row of a finished sequence, from its attributes."""
    attrs = sequence.attrs
    scenario, summary = attrs.get("scenario", {}), attrs.get("summary", {})
    gesture = scenario.get("gesture", {})
    scale, flow = attrs.get("scale_mm_per_px"), summary.get("peak_flow_px")
    stages = [stage for stage in attrs.get("timings", {}).values() if isinstance(stage, dict)]
    return {
        "index": sequence.index,
        "status": "done",
        "path": sequence.path.name,
        "content_hash": attrs["content_hash"],
        "anatomy": split.name_anatomy(attrs),
        "family": scenario.get("family"),
        "gesture": gesture.get("kind"),
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
