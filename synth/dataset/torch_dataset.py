"""Single frames of a dataset for training: a map-style dataset for torch's DataLoader."""

from __future__ import annotations

import operator
import os
from bisect import bisect_right
from collections.abc import Callable
from collections.abc import Sequence as Several
from functools import lru_cache
from pathlib import Path
from typing import Any, SupportsIndex

from synth.arguments import checked
from synth.dataset.index import group_by_side
from synth.dataset.store import Dataset, FieldReader, Sequence
from synth.errors import UserError
from synth.fields import FIELDS, TIME


@lru_cache(maxsize=128)  # opening a store takes some milliseconds
def _open(
    process: int, dataset: Dataset, position: int, fields: tuple[str, ...]
) -> tuple[Sequence, dict[str, FieldReader]]:
    """A sequence and its fields in this process: one that was forked must not use its parent's handles."""
    sequence = dataset[position]
    return sequence, {name: sequence[name] for name in fields}


class TorchDataset:
    """Frames of the sequences in `root`, as `{field: array}`, with `index` of the sequence and `frame`.

    Fields without a frame axis are returned whole. `split`: only this side of the dataset's split; `clip`:
    so many consecutive frames in an item; `transform`: applied to each item. Safe in forked or spawned
    workers.

        frames = TorchDataset("out", ["rgb", "flow", "traction"], split="train")
        loader = torch.utils.data.DataLoader(frames, batch_size=8, num_workers=2)
    """

    @checked
    def __init__(
        self,
        root: Path | str,
        fields: Several[str],
        sequences: Several[int] | None = None,
        *,
        split: str | None = None,
        clip: int = 0,
        transform: Callable[[dict[str, Any]], Any] | None = None,
    ) -> None:
        """
        Args:
            root: the dataset.
            fields: names from the field table.
            sequences: positions in the dataset of those to use; default: all.
            split, clip, transform: see above; `frame` is a clip's first; clip 0: single frames, without axis.

        Raises:
            UserError: not a dataset, no such side, or a sequence lacks a field or is shorter than a clip.
        """
        if unknown := [name for name in fields if name not in FIELDS]:
            raise UserError(f"{', '.join(unknown)}: no such field; there are {', '.join(FIELDS)}")
        self._dataset, self._fields = Dataset(root), tuple(fields)
        if clip < 0:
            raise UserError(f"clip: {clip}: must be a number of frames, or 0 for single ones")
        self._clip, self._transform = clip, transform
        if split is not None:
            sides = group_by_side(self._dataset)
            if sequences is not None:
                raise UserError("split: give split or sequences, not both")
            if split not in sides:
                raise UserError(f"split: {split!r}: {root} has {', '.join(sides)}")
            sequences = sides[split]
        self._chosen = tuple(range(len(self._dataset)) if sequences is None else sequences)
        if not all(0 <= position < len(self._dataset) for position in self._chosen):
            raise UserError(f"sequences: the dataset has positions 0 to {len(self._dataset) - 1}")
        self._ends: list[int] = []
        for sequence in map(self._dataset.__getitem__, self._chosen):
            if missing := [name for name in fields if name not in sequence]:
                raise UserError(f"{sequence.path}: has no {', '.join(missing)}")
            if sequence.frames < clip:
                raise UserError(f"{sequence.path}: has {sequence.frames} frames, fewer than clip={clip}")
            self._ends.append(len(self) + sequence.frames - max(clip - 1, 0))

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def __getitem__(self, item: SupportsIndex) -> Any:
        """The item of a whole number, also NumPy's or a tensor's; negative ones count from the end."""
        given, count = operator.index(item), len(self)
        item = given + count if given < 0 else given
        if not 0 <= item < count:
            raise IndexError(f"{given}: there are {count} items")
        which = bisect_right(self._ends, item)
        frame = item - (self._ends[which - 1] if which else 0)
        sequence, readers = _open(os.getpid(), self._dataset, self._chosen[which], self._fields)
        at = slice(frame, frame + self._clip) if self._clip else frame
        values = {name: one[at] if one.dims[0] == TIME else one[:] for name, one in readers.items()}
        found = {"index": sequence.index, "frame": frame, **values}
        return found if self._transform is None else self._transform(found)
