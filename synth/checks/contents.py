"""What a store holds is what was sealed: attributes, fields, and every value, which is read once."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from synth.checks.measure import Measure, truth
from synth.dataset import store
from synth.dataset.store import Sequence
from synth.fields import FIELDS
from synth.system.stopwatch import Stopwatch

VALUES = {
    "checksum": "Every value is the one that was written.",
    "finite": "No value is NaN or infinite.",
    "range": "Every value is in the range that the field table gives.",
}
"""What `check_values` checks, by name."""


def seal(sequence: Sequence, frames: list[int]) -> Iterator[Measure]:
    """The attributes are those that were sealed, under the name that was given."""
    yield truth(sequence.is_sealed(), "attributes were edited")
    yield truth(sequence.path.stem == f"{sequence.index:06d}", "is another sequence than its name says")


def schema(sequence: Sequence, frames: list[int]) -> Iterator[Measure]:
    """The fields are those that the table declares: shape, type, unit, meaning, axes."""
    for field in FIELDS.values():
        if field.name in sequence:
            found = sequence[field.name]
            known = {"unit": field.unit, "meaning": field.meaning}
            yield truth(found.attrs == known, f"{field.name}: unit or meaning was edited")
            yield truth(found.dims == field.dims, f"{field.name}: axes were edited")
        else:
            yield truth(field.stored != "always", f"{field.name} is missing")


def check_values(
    sequence: Sequence, frames: list[int], fast: bool, watch: Stopwatch
) -> Iterator[tuple[str, Measure]]:
    """Measures by the name of their check in `VALUES`.

    Args:
        sequence: an opened store.
        frames: where to look when `fast`.
        fast: no checksums, and of large fields only `frames`.
        watch: takes the time of each check, and of reading as `readable`.

    Raises:
        UserError: a chunk cannot be read.
    """
    for name in sequence.fields:
        field, found = FIELDS[name], sequence[name]
        hasher = None if fast else store.field_hasher(name, found.stored, found.shape)
        low, high, finite = np.inf, -np.inf, True
        every: Any = (frames if fast else range(len(found))) if field.framed else [...]
        for part in every:
            with watch.stage("readable"):
                values = np.ascontiguousarray(found[part])
            if hasher is not None:
                with watch.stage("checksum"):
                    hasher.update(values.astype(found.stored, copy=False).data)
            if values.dtype.kind == "f":
                with watch.stage("finite"):
                    finite = finite and bool(np.isfinite(values).all())
                with watch.stage("range"):
                    low, high = min(low, float(values.min())), max(high, float(values.max()))
        if hasher is not None:
            good = hasher.hexdigest() == sequence.attrs["field_hashes"][name]
            yield "checksum", truth(good, f"{name}: values are not those that were written")
        yield "finite", truth(finite, f"{name}: holds values that are no numbers")
        if finite and field.low is not None:
            yield "range", Measure(field.low - low, 0.0, f"{name}: smallest value {low:g}", field.unit)
        if finite and field.high is not None:
            yield "range", Measure(high - field.high, 0.0, f"{name}: largest value {high:g}", field.unit)
