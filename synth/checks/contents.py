"""Checks of a store's content against its seal: attributes, fields, and all values, each read once."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from synth.checks.measurements import Measure, truth
from synth.dataset import store
from synth.dataset.store import Sequence
from synth.fields import FIELDS
from synth.system.stopwatch import Stopwatch

VALUES = {  # the checks of `check_values`
    "checksum": "No value has changed since it was written.",
    "finite": "No value is NaN or infinite.",
    "range": "All values are within the range in the field table.",
}


def seal(sequence: Sequence, frames: list[int]) -> Iterator[Measure]:
    """The attributes are unchanged since the seal, and the store's name is the sequence's index."""
    yield truth(sequence.is_sealed(), "attributes were edited")
    yield truth(sequence.path.stem == f"{sequence.index:06d}", "its name is not its index")


def schema(sequence: Sequence, frames: list[int]) -> Iterator[Measure]:
    """The fields are as declared in the field table: shape, type, unit, meaning, axes."""
    for field in FIELDS.values():
        if field.name in sequence:
            reader = sequence[field.name]
            expected = {"unit": field.unit, "meaning": field.meaning}
            yield truth(reader.attrs == expected, f"{field.name}: unit or meaning was edited")
            yield truth(reader.dims == field.dims, f"{field.name}: axes were edited")
        else:
            yield truth(field.stored != "always", f"{field.name} is missing")


def check_values(
    sequence: Sequence, frames: list[int], fast: bool, watch: Stopwatch
) -> Iterator[tuple[str, Measure]]:
    """Measures by the name of their check in `VALUES`; `watch` times each, and reading as `readable`.

    `fast`: no checksums, and only `frames` of large fields. UserError if a chunk cannot be read.
    """
    for name in sequence.fields:
        field, reader = FIELDS[name], sequence[name]
        hasher = None if fast else store.field_hasher(name, reader.stored, reader.shape)
        low, high, finite = np.inf, -np.inf, True
        selections: Any = (frames if fast else range(len(reader))) if field.framed else [...]
        for selection in selections:
            with watch.stage("readable"):
                values = np.ascontiguousarray(reader[selection])
            if hasher is not None:
                with watch.stage("checksum"):
                    hasher.update(values.astype(reader.stored, copy=False).data)
            if values.dtype.kind == "f":
                with watch.stage("finite"):
                    finite = finite and bool(np.isfinite(values).all())
                with watch.stage("range"):
                    low, high = min(low, float(values.min())), max(high, float(values.max()))
        if hasher is not None:
            unchanged = hasher.hexdigest() == sequence.attrs["field_hashes"][name]
            yield "checksum", truth(unchanged, f"{name}: values were changed")
        yield "finite", truth(finite, f"{name}: contains values that are not finite")
        if finite and field.low is not None:
            yield "range", Measure(field.low - low, 0.0, f"{name}: smallest value {low:g}", field.unit)
        if finite and field.high is not None:
            yield "range", Measure(high - field.high, 0.0, f"{name}: largest value {high:g}", field.unit)
