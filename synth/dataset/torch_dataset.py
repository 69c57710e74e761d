"""Single frames of a dataset for training: a map-style dataset for torch's DataLoader."""

from __future__ import annotations

import math
import os
from bisect import bisect_right
from collections.abc import Callable
from collections.abc import Sequence as Several
from functools import lru_cache
from operator import index as index_of
from pathlib import Path
from typing import Any, SupportsIndex

from synth.arguments import checked
from synth.dataset.index import group_by_side
from synth.dataset.store import Dataset, FieldReader, Sequence
from synth.errors import UserError, did_you_mean
from synth.fields import FIELDS, TIME


@lru_cache(maxsize=128)  # opening a store takes some milliseconds
def _open(
    process: int, dataset: Dataset, position: int, fields: tuple[str, ...]
) -> tuple[Sequence, dict[str, FieldReader]]:
    """A sequence and its fields in this process: one that was forked must not use its parent's handles."""
    sequence = dataset[position]
    return sequence, {name: sequence[name] for name in fields}


class TorchDataset:
    """Frames of the sequences in `root`, as `{field: array}` with what they need.

    Each item has its fields, those without a frame axis as a whole; `index`, the sequence's; `frame`, its
    number; and `scale_mm_per_px` and `young_kpa`, NaN where they are unknown. `split`: only this side of the
    dataset's split; `clip`: so many frames in an item, `stride` apart; `step`: frames from the first of an
    item to the first of the next; `transform`: applied to each item. Safe in forked or spawned workers.

        frames = TorchDataset("out", ["rgb", "flow", "traction"], split="train", clip=8, stride=2)
        loader = torch.utils.data.DataLoader(frames, batch_size=8, num_workers=2)
    """

    @checked
    def __init__(
        self,
        root: Path | str,
        fields: str | Several[str] | None = None,
        sequences: Several[int] | None = None,
        *,
        split: str | None = None,
        clip: int = 0,
        stride: int = 1,
        step: int = 1,
        transform: Callable[[dict[str, Any]], Any] | None = None,
    ) -> None:
        """
        Args:
            root: the dataset.
            fields: names from the field table; default: all that every sequence has.
            sequences: positions in the dataset of those to use; default: all.
            split, clip, stride, step, transform: see above; `frame` is a clip's first; clip 0: single frames,
                without axis.

        Raises:
            UserError: not a dataset, no such side, or a sequence lacks a field or is shorter than a clip.
        """
        names = (fields,) if isinstance(fields, str) else fields
        if unknown := [name for name in names or () if name not in FIELDS]:
            hint = did_you_mean(unknown[0], FIELDS)
            raise UserError(f"{', '.join(unknown)}: no such field; there are {', '.join(FIELDS)}{hint}")
        self._dataset = Dataset(root)
        if clip < 0:
            raise UserError(f"clip: {clip}: must be a number of frames, or 0 for single ones")
        for key, value in (("stride", stride), ("step", step)):
            if value < 1:
                raise UserError(f"{key}: {value}: must be a number of frames, 1 at least")
        if stride > 1 and clip < 2:
            raise UserError("stride: is between the frames of a clip: give clip, or step for fewer items")
        self._clip, self._stride, self._step, self._transform = clip, stride, step, transform
        if split is not None:
            sides = group_by_side(self._dataset)
            if sequences is not None:
                raise UserError("split: give split or sequences, not both")
            if split not in sides:
                raise UserError(f"split: {split!r}: {root} has {', '.join(sides)}")
            sequences = sides[split]
        self._positions = tuple(range(len(self._dataset)) if sequences is None else sequences)
        if not all(0 <= position < len(self._dataset) for position in self._positions):
            raise UserError(f"sequences: the dataset has positions 0 to {len(self._dataset) - 1}")
        stores = [self._dataset[position] for position in self._positions]
        common = (name for name in FIELDS if all(name in sequence for sequence in stores))
        self._fields, self._ends = tuple(common if names is None else names), list[int]()
        clip_frames = (max(clip, 1) - 1) * stride + 1
        for sequence in stores:
            if missing := [name for name in self._fields if name not in sequence]:
                raise UserError(f"{sequence.path}: has no {', '.join(missing)}")
            if sequence.frames < clip_frames:
                gap = f" with stride={stride}" if stride > 1 else ""
                raise UserError(
                    f"{sequence.path}: has {sequence.frames} frames, fewer than clip={clip}{gap} needs"
                )
            self._ends.append(len(self) + 1 + (sequence.frames - clip_frames) // step)

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def __getitem__(self, item: SupportsIndex) -> Any:
        """An item by its number, of any kind of integer; negative ones count from the end."""
        number = index_of(item)
        if not -len(self) <= number < len(self):
            raise IndexError(f"{number}: there are {len(self)} items")
        number %= len(self)
        slot = bisect_right(self._ends, number)
        frame = self._step * (number - (self._ends[slot - 1] if slot else 0))
        sequence, readers = _open(os.getpid(), self._dataset, self._positions[slot], self._fields)
        last = frame + self._stride * (self._clip - 1) + 1
        selection = slice(frame, last, self._stride) if self._clip else frame
        values = {
            name: reader[selection] if reader.dims[0] == TIME else reader[:]
            for name, reader in readers.items()
        }
        sample: dict[str, Any] = {"index": sequence.index, "frame": frame, **values}
        for name in ("scale_mm_per_px", "young_kpa"):
            value = sequence.attrs.get(name)
            sample[name] = math.nan if value is None else float(value)
        return sample if self._transform is None else self._transform(sample)
