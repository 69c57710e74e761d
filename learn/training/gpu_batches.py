"""All frames on the device at once, batches cut and turned there: nothing but indices crosses the bus."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from learn.data.clips import Clip, sources, target
from learn.settings import TrainingSettings
from learn.training.batches import Batch, FrameDataset, turned

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

    def batch(self, items: Sequence[tuple[int, int, str, int]]) -> Batch:
        """As `FrameDataset.batch`; within it frames of one turn stand together."""
        items = sorted(items, key=lambda item: item[3])
        parts: list[dict[str, Tensor]] = []
        for turn in sorted({item[3] for item in items}):
            for source in self.sources:
                some = [item for item in items if item[3] == turn and item[2] == source]
                if some:
                    parts.append(self._cut(some, source, turn))
        return Batch(**{k: torch.cat([p[k] for p in parts]) for k in parts[0]})

    def _cut(self, items: list[tuple[int, int, str, int]], source: str, turn: int) -> dict[str, Tensor]:
        at = torch.tensor([int(self._first[c]) + t for c, t, _, _ in items], device=self._device)
        clip = torch.tensor([c for c, *_ in items], device=self._device)
        mask = turned(self._mask[clip], turn)
        sure = torch.ones_like(mask)
        if self._sure is not None:
            planes = self._sure[source][at]
            sure = turned(planes.flatten(0, 1)[:, None], turn).reshape(planes.shape)
        return {
            "displacement": turned(self._moved[source][at], turn),
            "mask": mask,
            "confidence": sure,
            "target": turned(self._true[at], turn),
        }


def held(clips: Sequence[Clip], settings: TrainingSettings, device: torch.device) -> FrameDataset:
    """Frames on a GPU whose memory is enough, else read as they are asked for."""
    if device.type != "cuda":
        return FrameDataset(clips, settings)
    arch = settings.arch
    told = arch.displacements + arch.confidence * (1 + arch.depth)
    planes = told * len(sources(settings.input)) + arch.components
    needed = sum(c.frames for c in clips) * planes * 4 * settings.size**2
    if needed > SHARE * torch.cuda.mem_get_info(device)[0]:
        return FrameDataset(clips, settings)
    return DeviceDataset(clips, settings, device)
