"""Single frames of a dataset for training: a map-style dataset that torch's DataLoader takes as it is."""

from __future__ import annotations

import os
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Sequence as Several
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from synth.dataset.store import Dataset, Sequence
from synth.errors import UserError
from synth.fields import FIELDS, TIME

# Stores that one process holds open; opening one costs some milliseconds.
_OPEN = 64


class TorchDataset:
    """Every frame of every sequence in `root`, as `{field: array}`.

    Fields without a frame axis come whole; `index` and `frame` say where an item is from. Safe in workers
    that are forked or spawned: a process opens its own stores.

        frames = TorchDataset("out", ["rgb", "flow", "traction"])  # from synth.store import TorchDataset
        loader = torch.utils.data.DataLoader(frames, batch_size=8, num_workers=2)
    """

    def __init__(self, root: Path | str, fields: Several[str], sequences: Several[int] | None = None) -> None:
        """
        Args:
            root: the dataset.
            fields: names from the field table.
            sequences: positions in the dataset to take frames from (one side of a split); all if not given.

        Raises:
            UserError: no dataset there, or a sequence lacks a field.
        """
        unknown = [name for name in fields if name not in FIELDS]
        if unknown:
            raise UserError(f"{', '.join(unknown)}: no such field; there are {', '.join(FIELDS)}")
        self._dataset, self._fields = Dataset(root), tuple(fields)
        self._chosen = tuple(range(len(self._dataset)) if sequences is None else sequences)
        lengths = []
        for position in self._chosen:
            sequence = self._dataset[position]
            lacking = [name for name in fields if name not in sequence]
            if lacking:
                raise UserError(f"{sequence.path}: has no {', '.join(lacking)}")
            lengths.append(sequence.frames)
        self._ends = list(accumulate(lengths))
        self._owner = os.getpid()
        self._open: OrderedDict[int, tuple[Sequence, dict[str, Any]]] = OrderedDict()

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def __getitem__(self, item: int) -> dict[str, Any]:
        if not 0 <= item < len(self):
            raise IndexError(item)
        which = bisect_right(self._ends, item)
        frame = item - (self._ends[which - 1] if which else 0)
        sequence, columns = self._columns(self._chosen[which])
        found: dict[str, Any] = {"index": sequence.index, "frame": frame}
        for name, column in columns.items():
            found[name] = np.asarray(column[frame] if column.dims[0] == TIME else column[:])
        return found

    def _columns(self, position: int) -> tuple[Sequence, dict[str, Any]]:
        if self._owner != os.getpid():  # forked: the parent's handles are the parent's
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
