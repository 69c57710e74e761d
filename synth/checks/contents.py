"""Every value of a sequence, read once: does it decode, is it what was written, a number, in its range?"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from synth.checks.measure import Measure, truth
from synth.dataset import store
from synth.dataset.store import Sequence
from synth.fields import FIELDS
from synth.system.stopwatch import Stopwatch

CHECKS = {
    "checksum": "Every value is the one that was written.",
    "finite": "No value is NaN or infinite.",
    "range": "Every value is in the range that the field table gives.",
}


def check_contents(
    sequence: Sequence, frames: list[int], fast: bool, watch: Stopwatch
) -> Iterator[tuple[str, Measure]]:
    """Measures by the name of their check.

    Args:
        sequence: an opened store.
        frames: where to look when `fast`.
        fast: no checksums, and of large fields only `frames`.
        watch: is told the time of each check, and of reading as `readable`.

    Raises:
        UserError: a chunk cannot be read.
    """
    for name in sequence.fields:
        field, column = FIELDS[name], sequence[name]
        hasher = None if fast else store.field_hasher(name, column.stored, column.shape)
        low, high, finite = np.inf, -np.inf, True
        every: Any = (frames if fast else range(column.shape[0])) if field.framed else [...]
        for part in every:
            with watch.stage("readable"):
                values = np.ascontiguousarray(column[part])
            if hasher is not None:
                with watch.stage("checksum"):
                    hasher.update(values.astype(column.stored, copy=False).data)
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
