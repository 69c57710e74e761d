"""Clips of studies on coarser grids."""

from dataclasses import replace

import numpy as np

from learn.data.clips import Clip
from learn.data.grid import settled
from synth.arrays import Map


def coarser(clip: Clip, times: int = 2) -> Clip:
    """The clip on a grid of `times` wider cells: mean displacement of a cell's tissue, all of its force."""

    def blocks(values: Map) -> Map:
        n = values.shape[-1] // times
        pooled: Map = values.reshape(*values.shape[:-2], n, times, n, times).mean((-3, -1))
        return pooled

    def mean(values: Map) -> Map:
        return (blocks(values * clip.mask) / share * mask).astype(np.float32)

    cover = blocks(np.asarray(clip.mask))
    mask = (cover > 0.5).astype(np.float32)
    share = np.where(mask > 0, cover, np.float32(1))
    return replace(
        clip,
        mask=mask,
        displacement={name: mean(np.asarray(moved)) for name, moved in clip.displacement.items()},
        confidence=mean(np.asarray(clip.confidence)),
        density=np.stack([settled(d, mask) for d in blocks(np.asarray(clip.density))]),
    )
