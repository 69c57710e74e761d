"""Sequences of studies: rendered where they are missing, and on coarser grids."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np

from evidence import cache
from learn.data.clips import Clip
from learn.data.grid import settled
from synth.arrays import Map
from synth.dataset import location
from synth.dataset.store import Sequence, open_sequence
from synth.job import identity
from synth.job.schema import Job
from synth.sequence import pipeline


def folder_of(job: Job, name: str, work: Path) -> Path:
    """Folder in `work` of a job's sequences, by the job and the versions of what renders it."""
    return work / f"{name}-{job.seed}-{cache.key(identity.identify_job(job), versions=cache.SCENES)}"


def render(job: Job, index: int, folder: Path) -> Sequence:
    """A sequence of a job in `folder`, rendered unless it is there. Raises UserError if it is refused."""
    store = location.store(folder, index)
    if not store.exists():
        folder.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(store.with_suffix(".zarr.part"), ignore_errors=True)
        pipeline.render_sequence(job, index, folder, lambda stage, done, of: None)
    return open_sequence(store)


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
