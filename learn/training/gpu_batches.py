"""All frames on the device at once, batches cut and turned there: nothing but indices crosses the bus."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from learn.data.clips import Clip, sources, target
from learn.data.grid import membrane_code
from learn.settings import TrainingSettings
from learn.training.batches import Batch, FrameDataset, FrameItem

SHARE = 0.6
"""Part of the device's free memory that frames may take; the rest is the network's."""


class DeviceDataset(FrameDataset):
    """The same frames as `FrameDataset`, in the same order, held by the device."""

    def __init__(self, clips: Sequence[Clip], settings: TrainingSettings, device: torch.device) -> None:
        super().__init__(clips, settings)
        parts = settings.arch.components
        self._first = np.cumsum([0, *(c.frames for c in self.clips)])

        def whole(arrays: list[np.ndarray[tuple[int, ...], np.dtype[np.float32]]]) -> Tensor:
            shape = (sum(len(a) for a in arrays), *arrays[0].shape[1:])
            out = torch.empty(shape, dtype=torch.float32, device=device)
            at = 0
            for a in arrays:
                out[at : at + len(a)] = torch.from_numpy(np.array(a))
                at += len(a)
            return out

        self._moved = {s: whole([c.displacement[s] for c in self.clips]) for s in self.sources}
        self._mask = whole([np.asarray(c.mask)[None, None] for c in self.clips])
        self._sure = None
        if settings.arch.confidence:
            self._sure = {s: whole([c.sure(s) for c in self.clips]) for s in self.sources}
        self._true = whole(
            [np.stack([target(c, t, settings.target, parts) for t in range(c.frames)]) for c in self.clips]
        )
        self._device = device

    def batch(self, items: Sequence[FrameItem]) -> Batch:
        """As `FrameDataset.batch`; within it frames of one turn stand together."""
        alike = {(item.turn, self.sources.index(item.source)) for item in items}
        parts = []
        for turn, k in sorted(alike):
            some = [one for one in items if (one.turn, one.source) == (turn, self.sources[k])]
            at = torch.tensor([int(self._first[one.clip]) + one.frame for one in some], device=self._device)
            clip = torch.tensor([one.clip for one in some], device=self._device)
            mask = self._mask[clip]
            sure = torch.ones_like(mask) if self._sure is None else self._sure[self.sources[k]][at]
            told = torch.tensor(
                [one.told * membrane_code(self.clips[one.clip].membrane) for one in some], device=self._device
            )
            moved = self._moved[self.sources[k]][at]
            parts.append(Batch(moved, mask, sure, self._true[at], told).turned(turn))
        return Batch(*map(torch.cat, zip(*parts, strict=True)))


def place_frames(clips: Sequence[Clip], settings: TrainingSettings, device: torch.device) -> FrameDataset:
    """Frames on a GPU whose memory is enough, else read as they are asked for."""
    if device.type != "cuda":
        return FrameDataset(clips, settings)
    arch = settings.arch
    inputs = arch.displacements + arch.confidence * (1 + arch.depth)
    planes = inputs * len(sources(settings.input)) + arch.components
    needed = sum(c.frames for c in clips) * planes * 4 * settings.size**2
    if needed > SHARE * torch.cuda.mem_get_info(device)[0]:
        return FrameDataset(clips, settings)
    return DeviceDataset(clips, settings, device)
