"""What a sequence holds and takes on disk, field by field: for planning and for the docs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from synth.dataset import size_forecast
from synth.dataset.store import Sequence
from synth.fields import FIELDS, TIME, Field
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
    raw: float
    """Bytes a frame in memory; of a field without frames, bytes a sequence."""
    stored: float
    """The same on disk, by the ratio measured on rendered sequences."""
    measured: float | None
    """The same in a dataset at hand."""
    meaning: str

    @property
    def on_disk(self) -> float:
        """As measured, or else by the ratio."""
        return self.stored if self.measured is None else self.measured


def rows(size: tuple[int, int], sequence: Sequence | None = None) -> Iterator[Row]:
    """Every field in the table's order; size: (height, width) [px]; `sequence` gives what is measured."""
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
            measured=None if sequence is None else _measured(field, sequence),
            meaning=field.meaning,
        )


_HEADS = ("field", "axes", "type", "unit", "in memory", "on disk")


def lines(size: tuple[int, int], sequence: Sequence | None = None) -> Iterator[str]:
    """For a terminal: two lines a field or more, and the sum of what a default job keeps of a frame."""
    found = list(rows(size, sequence))
    told = [(row.name, row.axes, row.dtype, row.unit, *_amounts(row)) for row in found]
    widths = [max(map(len, column)) for column in zip(_HEADS, *told, strict=True)]

    def line(cells: tuple[str, ...]) -> str:
        left = [f"{cell:<{wide}}" for cell, wide in zip(cells[:4], widths[:4], strict=True)]
        right = [f"{cell:>{wide}}" for cell, wide in zip(cells[4:], widths[4:], strict=True)]
        return "  ".join(left + right)

    yield line(_HEADS)
    for row, cells in zip(found, told, strict=True):
        yield line(cells)
        kept = "" if row.kept == _KEPT["always"] else f" (kept {row.kept})"
        yield from hang("    ", row.meaning + kept)
    yield ""
    yield from hang(
        "", f"Sizes are of a frame; without frames among its axes, of a sequence. {_sum(size, found)}"
    )


def table(size: tuple[int, int]) -> Iterator[str]:
    """The same in Markdown, for a page."""
    found = list(rows(size))
    yield "| field | axes | type | unit | kept | in memory | on disk | meaning |"
    yield "| --- | --- | --- | --- | --- | ---: | ---: | --- |"
    for row in found:
        per = "" if TIME in row.axes else " a sequence"
        sizes = " | ".join(f"{amount}{per}" for amount in _amounts(row))
        words = (f"`{row.name}`", row.axes, row.dtype, row.unit, row.kept, sizes, row.meaning)
        yield f"| {' | '.join(words)} |"
    yield ""
    yield _sum(size, found)


def _amounts(row: Row) -> tuple[str, str]:
    """In memory and on disk, as measured where there is a dataset."""
    return size_forecast.amount(row.raw), size_forecast.amount(row.on_disk)


def _sum(size: tuple[int, int], found: list[Row]) -> str:
    height, width = size
    usual = [
        row
        for row in found
        if FIELDS[row.name].kept in ("always", "usually", "recovered") and TIME in row.axes
    ]
    raw, stored = (
        size_forecast.amount(sum(sizes)) for sizes in zip(*((r.raw, r.on_disk) for r in usual), strict=True)
    )
    return (
        f"A frame of {width} x {height} px, without a second lens and what is only kept if asked for: "
        f"{raw} in memory, {stored} on disk."
    )


def page() -> str:
    """docs/fields.md."""
    return _HEAD + "\n".join(table((480, 640))) + "\n"


_HEAD = """\
# What a sequence holds

Written by `synth fields --page > docs/fields.md`; do not edit. Sizes: a frame of 640 x 480 px; on disk by
the ratio measured on rendered sequences. `synth fields --size 1280x960` gives them for another picture,
`synth fields OUT` as they are in a dataset.

`store.flow: float16` halves the flows. A value is then rounded to 11 bits: by 0.004 px at most below 16 px of
motion, 0.008 px below 32. The largest error of a sequence is measured as it is written, in its attribute
`summary.rounding_px`. Readers give float32 either way.

Older stores call `flow_recovered` by its former name, `flow_tvl1`; both names are read.

`render.stereo_mm: B` adds a second lens B mm to the right of the first, axes parallel, with the same focal
length f = `K[0,0]` and distortion, and its principal point moved so that both pictures show the same field:

    K_right[0,2] = K[0,2] + f B / z,    translation_right = translation - (B, 0, 0),

z being the distance of the craniotomy's centre along the axis. The attribute `right` holds `K`, `distortion`,
`rotation`, `translation` and `baseline_mm`. Without distortion both eyes see a point on the same row, and its
depth is

    Z = f B / (disparity + K_right[0,2] - K[0,2]).

"""


def _measured(field: Field, sequence: Sequence) -> float:
    folder: Path = sequence.path / (sequence.stored_name(field.name) or field.name)
    if not folder.is_dir():
        return 0.0
    return size_forecast.size(folder) / (sequence.frames if TIME in field.dims else 1)
