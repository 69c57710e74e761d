"""All frames in a GPU's memory, where batches are selected and turned."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from learn.data.clips import Clip, sources, target
from learn.data.grid import membrane_code
from learn.settings import TrainingSettings
from learn.training.batches import Batch, FrameDataset, FrameItem

SHARE = 0.6  # of the device's free memory that frames may take; the rest is the network's


class DeviceDataset(FrameDataset):
    """The frames of `FrameDataset`, in its order, stored on a device."""

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
        self._confidence = None
        if settings.arch.confidence:
            self._confidence = {s: whole([c.confidence_of(s) for c in self.clips]) for s in self.sources}
        self._true = whole([np.stack([target(c, t, parts) for t in range(c.frames)]) for c in self.clips])
        self._device = device

    def batch(self, items: Sequence[FrameItem]) -> Batch:
        """As `FrameDataset.batch`, but ordered by turn."""
        alike = {(item.turn, self.sources.index(item.source)) for item in items}
        parts = []
        for turn, k in sorted(alike):
            some = [one for one in items if (one.turn, one.source) == (turn, self.sources[k])]
            at = torch.tensor([int(self._first[one.clip]) + one.frame for one in some], device=self._device)
            clip = torch.tensor([one.clip for one in some], device=self._device)
            mask = self._mask[clip]
            sure = self._confidence
            confidence = torch.ones_like(mask) if sure is None else sure[self.sources[k]][at]
            codes = [one.membrane_known * membrane_code(self.clips[one.clip].membrane) for one in some]
            membrane = torch.tensor(codes, device=self._device)
            moved = self._moved[self.sources[k]][at]
            parts.append(Batch(moved, mask, confidence, self._true[at], membrane).turned(turn))
        return Batch(*map(torch.cat, zip(*parts, strict=True)))


def place_frames(clips: Sequence[Clip], settings: TrainingSettings, device: torch.device) -> FrameDataset:
    """The clips' frames, on the device if it is a GPU with enough memory, else read batch by batch."""
    if device.type != "cuda":
        return FrameDataset(clips, settings)
    arch = settings.arch
    inputs = arch.displacements + arch.confidence * (1 + arch.depth)
    planes = inputs * len(sources(settings.input)) + arch.components
    needed = sum(c.frames for c in clips) * planes * 4 * settings.size**2
    if needed > SHARE * torch.cuda.mem_get_info(device)[0]:
        return FrameDataset(clips, settings)
    return DeviceDataset(clips, settings, device)
