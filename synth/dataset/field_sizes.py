"""What a sequence holds and takes on disk, field by field: for planning and for the docs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from synth.dataset.size_forecast import amount
from synth.fields import FIELDS
from synth.system.text_lines import hang

_KEPT = {
    "always": "always",
    "usually": "unless in `store.without`",
    "recovered": "with an estimator of flow",
    "stereo": "with `render.stereo_mm`",
    "stereo recovered": "with both of these",
    "asked": "if in `store.extra`",
}


@dataclass(frozen=True)
class Row:
    """One field at one size of picture."""

    name: str
    axes: str
    dtype: str
    unit: str
    kept: str
    """When a sequence has it."""
    raw: float
    """Bytes a frame in memory; of a field without frames, bytes a sequence."""
    stored: float
    """The same on disk, by the ratio measured on rendered sequences."""
    meaning: str


def rows(size: tuple[int, int] = (480, 640)) -> Iterator[Row]:
    """Every field in the table's order; size: (height, width) [px]."""
    for field in FIELDS.values():
        raw = float(np.prod(field.shape(1, size))) * np.dtype(field.dtype).itemsize
        yield Row(
            name=field.name,
            axes=", ".join(field.dims),
            dtype=field.dtype,
            unit=field.unit,
            kept=_KEPT[field.kept],
            raw=raw,
            stored=raw * field.packed,
            meaning=field.meaning,
        )


def lines() -> Iterator[str]:
    """For a terminal: two lines a field or more."""
    for row in rows():
        yield f"{row.name}: {row.axes}, {row.dtype}, {row.unit}, {amount(row.stored)} on disk, {row.kept}"
        yield from hang("    ", row.meaning)
