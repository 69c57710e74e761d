"""Single frames of a dataset for training: a map-style dataset for torch's DataLoader."""

from __future__ import annotations

import os
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Sequence as Several
from pathlib import Path
from typing import Any

from synth.arguments import checked
from synth.dataset.store import Dataset, FieldReader, Sequence
from synth.errors import UserError
from synth.fields import FIELDS, TIME

_OPEN = 64  # stores that one process keeps open; opening one takes some milliseconds


class TorchDataset:
    """Every frame of every sequence in `root`, as `{field: array}`.

    Fields without a frame axis are returned whole; `index` and `frame` identify the item. Safe in forked or
    spawned workers: each process opens its own stores.

        frames = TorchDataset("out", ["rgb", "flow", "traction"])
        loader = torch.utils.data.DataLoader(frames, batch_size=8, num_workers=2)
    """

    @checked
    def __init__(self, root: Path | str, fields: Several[str], sequences: Several[int] | None = None) -> None:
        """
        Args:
            root: the dataset.
            fields: names from the field table.
            sequences: positions in the dataset of those to use (one side of a split); default: all.

        Raises:
            UserError: not a dataset, or a sequence lacks a field.
        """
        if unknown := [name for name in fields if name not in FIELDS]:
            raise UserError(f"{', '.join(unknown)}: no such field; there are {', '.join(FIELDS)}")
        self._dataset, self._fields = Dataset(root), tuple(fields)
        self._chosen = tuple(range(len(self._dataset)) if sequences is None else sequences)
        if not all(0 <= position < len(self._dataset) for position in self._chosen):
            raise UserError(f"sequences: the dataset has positions 0 to {len(self._dataset) - 1}")
        self._ends: list[int] = []
        for sequence in map(self._dataset.__getitem__, self._chosen):
            missing = [name for name in fields if name not in sequence]
            if missing:
                raise UserError(f"{sequence.path}: has no {', '.join(missing)}")
            self._ends.append(len(self) + sequence.frames)
        self._owner = os.getpid()
        self._open: OrderedDict[int, tuple[Sequence, dict[str, FieldReader]]] = OrderedDict()

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def __getitem__(self, item: int) -> dict[str, Any]:
        if not 0 <= item < len(self):
            raise IndexError(item)
        which = bisect_right(self._ends, item)
        frame = item - (self._ends[which - 1] if which else 0)
        sequence, readers = self._readers(self._chosen[which])
        values = {name: one[frame] if one.dims[0] == TIME else one[:] for name, one in readers.items()}
        return {"index": sequence.index, "frame": frame, **values}

    def _readers(self, position: int) -> tuple[Sequence, dict[str, FieldReader]]:
        if self._owner != os.getpid():  # forked: the parent's handles must not be used
            self._owner, self._open = os.getpid(), OrderedDict()
        if position not in self._open:
            sequence = self._dataset[position]
            self._open[position] = (sequence, {name: sequence[name] for name in self._fields})
            if len(self._open) > _OPEN:
                self._open.popitem(last=False)
        self._open.move_to_end(position)
        return self._open[position]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": OrderedDict()}
