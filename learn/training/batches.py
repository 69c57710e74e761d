"""Batches of frames as tensors, with augmentation by turns, surface motion and errors of other frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from learn.data.clips import Clip, amount, sources, target
from learn.data.grid import Scales, membrane_code
from learn.network.channels import channels, divergence, rotate
from learn.settings import TrainingSettings
from learn.training import error_transfer
from learn.training.error_transfer import Transfer
from synth.errors import UserError

SHARE = 0.3  # of a GPU's free memory that frames of a part may take: those to fit, and those to select by
_CPU = torch.device("cpu")
MEMBRANE_HIDDEN = 1 / 3  # share of training frames with an unknown membrane: `arch.membrane` works without it


class Batch(NamedTuple):
    """Frames on one device, in physical units."""

    displacement: Tensor  # (B, 2, N, N) mm, with depth (B, 3, N, N)
    mask: Tensor  # (B, 1, N, N) 0/1
    confidence: Tensor  # (B, 1, N, N) 0..1, with depth (B, 2, N, N)
    target: Tensor  # (B, C, N, N) in the unit of `Scales.target`
    membrane: Tensor  # (B,) of `membrane_code`

    def rotate(self, turn: int) -> Batch:
        """All fields turned by `rotate`; each confidence is a scalar."""
        planes = rotate(self.confidence.flatten(0, 1)[:, None], turn).reshape(self.confidence.shape)
        displacement, mask, truth = (
            rotate(field, turn) for field in (self.displacement, self.mask, self.target)
        )
        return Batch(displacement, mask, planes, truth, self.membrane)


class FrameItem(NamedTuple):
    """One frame of a batch."""

    clip: int
    frame: int
    source: str  # displacement, as in `learn.data.clips.FIELDS`
    turn: int = 0  # 0-7, as of `rotate`
    membrane_known: bool = False
    errors: Transfer | None = None  # an error that is added to `source`, with its confidence
    deviation_factor: float = 1.0  # of the deviation that the confidence states


def add_surface_motion(batch: Batch, settings: TrainingSettings, generator: torch.Generator) -> Batch:
    """The batch with `surface_motion_mm` added to half of its frames; `generator`: always on the CPU."""
    displacement = batch.displacement
    count, planes, size = displacement.shape[0], displacement.shape[1], displacement.shape[-1]
    axis = torch.linspace(-1, 1, size)
    x, y = axis.expand(size, size), axis[:, None].expand(size, size)
    shapes = torch.stack([torch.ones_like(x), x, y, 1 - x**2 - y**2])
    amount = torch.randn(count, planes, len(shapes), generator=generator)
    is_depth = torch.arange(planes) == 2
    amount *= settings.surface_motion_mm * torch.where(is_depth, 1.0, 1 / 3)[:, None] / len(shapes) ** 0.5
    amount *= (torch.rand(count, generator=generator) < 0.5)[:, None, None]
    motion = torch.einsum("bps,syx->bpyx", amount, shapes).to(displacement)
    return batch._replace(displacement=displacement + motion * batch.mask)


def inputs(batch: Batch, settings: TrainingSettings, scales: Scales) -> Tensor:
    """The network's channels for a batch."""
    confidence = batch.confidence if settings.arch.confidence else None
    membrane = batch.membrane if settings.arch.membrane else None
    return channels(batch.displacement, batch.mask, settings.grid.pitch_mm, scales, confidence, membrane)


class FrameDataset:
    """All frames of some clips, in batches on a device; a GPU with enough memory stores what it has read."""

    def __init__(
        self, clips: Sequence[Clip], settings: TrainingSettings, device: torch.device = _CPU
    ) -> None:
        self.clips, self.settings, self.device = list(clips), settings, device
        self.sources = sources(settings.input)
        for clip in self.clips:
            if clip.mask.shape != (settings.size, settings.size):
                raise UserError(f"{clip.name}: its grid is {len(clip.mask)}², the model's {settings.size}²")
        self._recovered = [self.sources[-1] in clip.displacement for clip in self.clips]
        self._donors = [(c, clip.frames) for c, clip in enumerate(self.clips) if self._recovered[c]]
        self._masks = [torch.from_numpy(np.array(c.mask))[None, None].to(device) for c in self.clips]
        self._stored = dict[tuple[int, int, str], tuple[Tensor, ...]]()
        planes = 2 * settings.arch.displacements - 1 + settings.arch.components
        needed = sum(c.frames for c in self.clips) * len(self.sources) * planes * 4 * settings.size**2
        self._stores = device.type == "cuda" and needed < SHARE * torch.cuda.mem_get_info(device)[0]

    def order(self, rng: np.random.Generator) -> list[FrameItem]:
        """The frames of one epoch, turned at random, in random order."""
        items: list[tuple[int, int]] = []
        for c, clip in enumerate(self.clips):
            frames = np.arange(clip.frames)
            if 0 < self.settings.frames < clip.frames:
                frames = rng.choice(clip.frames, self.settings.frames, replace=False)
            items += [(c, int(t)) for t in frames]
        if 0 < self.settings.epoch_frames < len(items):
            items = [items[i] for i in rng.choice(len(items), self.settings.epoch_frames, replace=False)]
        turn = rng.integers(0, 8, len(items))
        order = rng.permutation(len(items))
        membrane_known = [False] * len(items)
        if self.settings.arch.membrane:
            membrane_known = [bool(is_known) for is_known in rng.random(len(items)) >= MEMBRANE_HIDDEN]
        frame_items = [
            FrameItem(items[i][0], items[i][1], self.sources[0], int(turn[i]), membrane_known[i])
            for i in order
        ]
        if len(self.sources) > 1:
            return [self._with_errors(item, rng) for item in frame_items]
        return frame_items

    def _with_errors(self, item: FrameItem, rng: np.random.Generator) -> FrameItem:
        """The frame with true or recovered motion, another's error, or its own with another confidence."""
        share, recovered = rng.random(), self._recovered[item.clip]
        if share < error_transfer.IDEAL:
            return item
        if recovered and share > 1 - error_transfer.RECOVERED:
            return item._replace(source=self.sources[-1])
        errors, factor = error_transfer.draw(rng, self._donors, self.settings.arch.displacements)
        if recovered and share > error_transfer.IDEAL + error_transfer.TRANSFERRED:
            return item._replace(source=self.sources[-1], deviation_factor=factor)
        return item._replace(errors=errors, deviation_factor=factor)

    def sequential(self, clip: int, source: str) -> Iterator[Batch]:
        """All frames of one clip, in order, not turned."""
        step = self.settings.batch
        for start in range(0, self.clips[clip].frames, step):
            stop = min(start + step, self.clips[clip].frames)
            yield self.batch([FrameItem(clip, t, source) for t in range(start, stop)])

    def batch(self, items: Sequence[FrameItem]) -> Batch:
        """The frames of `items` as tensors."""
        frames = []
        for c, t, source, turn, membrane_known, errors, factor in items:
            displacement, confidence, truth = self._read(c, t, source)
            if errors is not None:
                donor_recovered = self._read(errors.clip, errors.frame, self.sources[-1])
                donor = self._read(errors.clip, errors.frame, self.sources[0])[0]
                displacement, confidence = error_transfer.transfer(
                    displacement, donor, donor_recovered[0] - donor, donor_recovered[1], errors
                )
                displacement, confidence = displacement * self._masks[c], confidence * self._masks[c]
            if factor != 1:
                confidence = error_transfer.restate(confidence, factor)
            code = membrane_code(self.clips[c].membrane) if membrane_known else 0.0
            codes = torch.full((1,), code, device=self.device)
            frames.append(Batch(displacement, self._masks[c], confidence, truth, codes).rotate(turn))
        return Batch(*map(torch.cat, zip(*frames, strict=True)))

    def _read(self, c: int, t: int, source: str) -> tuple[Tensor, ...]:
        """Displacement, confidence and target of a frame of clip `c`."""
        if (frame := self._stored.get((c, t, source))) is None:
            clip = self.clips[c]
            truth = target(clip, t, self.settings.arch.components)
            arrays = clip.displacement[source][t], clip.confidence_of(source)[t], truth
            frame = tuple(torch.from_numpy(np.array(array))[None].to(self.device) for array in arrays)
            if self._stores:
                self._stored[c, t, source] = frame
        return frame


def measure_scales(clips: Sequence[Clip], settings: TrainingSettings, frames: int = 16) -> Scales:
    """Scales from up to `frames` evenly spaced frames of every clip. UserError: no motion or no force."""
    motion, strain, target_sizes, force = [], [], [], []
    squares, cells = 0.0, 0.0
    for clip in clips:
        mask = torch.from_numpy(np.array(clip.mask))[None, None]
        inside = clip.mask > 0
        for t in np.unique(np.linspace(0, clip.frames - 1, frames).astype(int)):
            for source in (name for name in sources(settings.input) if name in clip.displacement):
                u = torch.from_numpy(np.array(clip.displacement[source][t]))[None]
                motion.append(np.linalg.norm(clip.displacement[source][t], axis=0)[inside])
                strain.append(np.abs(divergence(u, mask, settings.grid.pitch_mm)[0, 0].numpy()[inside]))
            truth = target(clip, int(t), settings.arch.components)
            target_sizes.append(np.linalg.norm(truth, axis=0)[inside])
            squares += float(np.square(truth[:, inside], dtype=np.float64).sum())
            cells += float(inside.sum() * len(truth))
        total = amount(clip, settings.arch.components, settings.grid.pitch_mm)
        force.append(np.linalg.norm(total, axis=1))
    scales = tuple(
        float(np.percentile(np.concatenate(v), 99.9)) for v in (motion, strain, target_sizes, force)
    )
    if min(scales) <= 0:
        raise UserError("the training sequences have no motion or no force")
    return Scales(scales[0], scales[1], scales[2], scales[3], (squares / cells) ** 0.5)
