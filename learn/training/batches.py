"""Batches of frames: which, turned how, and as tensors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from learn.data.clips import Clip, amount, sources, target
from learn.data.grid import Scales, channels, divergence, membrane_code
from learn.settings import TrainingSettings
from synth.errors import UserError

UNTOLD = 1 / 3
"""Share of frames that a network with `arch.membrane` learns from without being told: a user may not know."""


class Batch(NamedTuple):
    """Frames on one device, in physical units."""

    displacement: Tensor
    """(B, 2, N, N) mm, with depth (B, 3, N, N)."""
    mask: Tensor
    """(B, 1, N, N) 0/1."""
    confidence: Tensor
    """(B, 1, N, N) 0..1, with depth (B, 2, N, N)."""
    target: Tensor
    """(B, C, N, N) in the unit of `Scales.target`."""
    membrane: Tensor
    """(B,) what is told of each frame's membrane, as `membrane_code`."""

    def to(self, device: torch.device) -> Batch:
        return Batch(*(values.to(device, non_blocking=True) for values in self))

    def turned(self, turn: int) -> Batch:
        """All of it turned as `turned` says; confidences are scalars each."""
        planes = turned(self.confidence.flatten(0, 1)[:, None], turn)
        return Batch(
            turned(self.displacement, turn),
            turned(self.mask, turn),
            planes.reshape(self.confidence.shape),
            turned(self.target, turn),
            self.membrane,
        )


class FrameItem(NamedTuple):
    """One frame to be given out."""

    clip: int
    frame: int
    source: str
    """Which displacement, as in `learn.data.clips.FIELDS`."""
    turn: int = 0
    """0-7, as of `turned`."""
    told: bool = False
    """Whether the network is told what is known of the membrane."""


def add_surface_motion(batch: Batch, settings: TrainingSettings, generator: torch.Generator) -> Batch:
    """The batch with a motion of the whole surface on top of half of its frames, as `surface_motion_mm` says.

    `generator`: on the CPU, so that every device draws the same.
    """
    moved = batch.displacement
    count, planes, size = moved.shape[0], moved.shape[1], moved.shape[-1]
    axis = torch.linspace(-1, 1, size)
    x, y = axis.expand(size, size), axis[:, None].expand(size, size)
    shapes = torch.stack([torch.ones_like(x), x, y, 1 - x**2 - y**2])
    amount = torch.randn(count, planes, len(shapes), generator=generator)
    along = torch.arange(planes) == 2
    amount *= settings.surface_motion_mm * torch.where(along, 1.0, 1 / 3)[:, None] / len(shapes) ** 0.5
    amount *= (torch.rand(count, generator=generator) < 0.5)[:, None, None]
    sway = torch.einsum("bps,syx->bpyx", amount, shapes).to(moved)
    return batch._replace(displacement=moved + sway * batch.mask)


def inputs(batch: Batch, settings: TrainingSettings, scales: Scales) -> Tensor:
    """The network's channels for a batch."""
    extra = batch.confidence if settings.arch.confidence else None
    told = batch.membrane if settings.arch.membrane else None
    return channels(batch.displacement, batch.mask, settings.grid.pitch_mm, scales, extra, told)


def turned(values: Tensor, turn: int) -> Tensor:
    """Fields (B, C, N, N) turned by `turn` % 4 × 90° (counter-clockwise as seen), from 4 on mirrored first.

    With two or three channels the first two are x, y components and turn with the field; a single channel is
    a scalar. Divergence is computed after this, so it needs no rule of its own.
    """
    vector = values.shape[1] > 1
    sign = values.new_tensor([-1.0, 1.0, 1.0][: values.shape[1]]).view(1, -1, 1, 1)
    if turn >= 4:
        values = values.flip(-1)
        values = values * sign if vector else values
    for _ in range(turn % 4):
        values = values.rot90(dims=(2, 3))
        if vector:
            values = torch.cat([values[:, 1:2], -values[:, :1], values[:, 2:]], dim=1)
    return values


class FrameDataset:
    """All frames of some clips, given out in batches."""

    def __init__(self, clips: Sequence[Clip], settings: TrainingSettings) -> None:
        self.clips, self.settings = list(clips), settings
        self.sources = sources(settings.input)
        if not self.clips:
            raise UserError("no sequence to take frames from")
        for clip in self.clips:
            if clip.mask.shape != (settings.size, settings.size):
                raise UserError(
                    f"{clip.name}: on a {clip.mask.shape[0]}² grid, the model takes {settings.size}²"
                )

    def order(self, rng: np.random.Generator, share_recovered: float) -> list[FrameItem]:
        """The frames of one epoch, turned at random, in random order."""
        items: list[tuple[int, int]] = []
        for c, clip in enumerate(self.clips):
            frames = np.arange(clip.frames)
            if 0 < self.settings.frames < clip.frames:
                frames = rng.choice(clip.frames, self.settings.frames, replace=False)
            items += [(c, int(t)) for t in frames]
        if 0 < self.settings.epoch_frames < len(items):
            kept = rng.choice(len(items), self.settings.epoch_frames, replace=False)
            items = [items[i] for i in kept]
        source = [self.sources[0]] * len(items)
        if len(self.sources) == 2:
            source = [self.sources[int(u < share_recovered)] for u in rng.random(len(items))]
        turn = rng.integers(0, 8, len(items))
        order = rng.permutation(len(items))
        told = [False] * len(items)
        if self.settings.arch.membrane:
            told = [bool(one) for one in rng.random(len(items)) >= UNTOLD]
        return [FrameItem._make((*items[i], source[i], int(turn[i]), told[i])) for i in order]

    def sequential(self, clip: int, source: str) -> Iterator[Batch]:
        """All frames of one clip, in order, as they are."""
        step = self.settings.batch
        for start in range(0, self.clips[clip].frames, step):
            stop = min(start + step, self.clips[clip].frames)
            yield self.batch([FrameItem(clip, t, source) for t in range(start, stop)])

    def batch(self, items: Sequence[FrameItem]) -> Batch:
        """The frames named by `items`, as tensors."""
        frames = []
        for c, t, source, turn, told in items:
            clip = self.clips[c]
            truth = target(clip, t, self.settings.target, self.settings.arch.components)
            arrays = clip.displacement[source][t], clip.mask[None], clip.sure(source)[t], truth
            known = np.float32(membrane_code(clip.membrane) if told else 0)
            one = Batch(*(torch.from_numpy(np.array(values))[None] for values in (*arrays, known)))
            frames.append(one.turned(turn))
        return Batch(*map(torch.cat, zip(*frames, strict=True)))


def measure_scales(clips: Sequence[Clip], settings: TrainingSettings, frames: int = 16) -> Scales:
    """99.9th percentiles over tissue cells of up to `frames` evenly spaced frames of every clip.

    Raises UserError if nothing moves or nothing is loaded.
    """
    moved, strain, wanted, force = [], [], [], []
    squares, cells = 0.0, 0.0
    for clip in clips:
        mask = torch.from_numpy(np.array(clip.mask))[None, None]
        inside = clip.mask > 0
        for t in np.unique(np.linspace(0, clip.frames - 1, frames).astype(int)):
            for source in sources(settings.input):
                u = torch.from_numpy(np.array(clip.displacement[source][t]))[None]
                moved.append(np.linalg.norm(clip.displacement[source][t], axis=0)[inside])
                strain.append(np.abs(divergence(u, mask, settings.grid.pitch_mm)[0, 0].numpy()[inside]))
            truth = target(clip, int(t), settings.target, settings.arch.components)
            wanted.append(np.linalg.norm(truth, axis=0)[inside])
            squares += float(np.square(truth[:, inside], dtype=np.float64).sum())
            cells += float(inside.sum() * len(truth))
        total = amount(clip, settings.target, settings.arch.components, settings.grid.pitch_mm)
        force.append(np.linalg.norm(total, axis=1))
    found = tuple(float(np.percentile(np.concatenate(v), 99.9)) for v in (moved, strain, wanted, force))
    if min(found) <= 0:
        raise UserError("the training sequences hold no motion or no force: there is nothing to learn")
    return Scales(found[0], found[1], found[2], found[3], (squares / cells) ** 0.5)
