"""Sequences of studies: rendered where they are missing, flow recovered by any estimator, coarser grids."""

import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from evidence import cache
from learn.data.clips import Clip
from learn.data.grid import Grid, GridView, settled
from synth.arrays import Map, Mask
from synth.dataset import location
from synth.dataset.store import Sequence, open_sequence
from synth.flow.estimator import Estimator
from synth.flow.track import track
from synth.job import identity
from synth.job.schema import Job
from synth.sequence import pipeline


def folder_of(job: Job, name: str, work: Path) -> Path:
    """Folder in `work` of a job's sequences, by the job and the code."""
    return work / f"{name}-{job.seed}-{cache.key(identity.identify_job(job))}"


def render(job: Job, index: int, folder: Path) -> Sequence:
    """A sequence of a job in `folder`, rendered unless it is there. Raises UserError if it is refused."""
    store = location.store(folder, index)
    if not store.exists():
        folder.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(store.with_suffix(".zarr.part"), ignore_errors=True)
        pipeline.render_sequence(job, index, folder, lambda stage, done, of: None)
    return open_sequence(store)


def recover_flow(
    sequence: Sequence, clip: Clip, estimator: str | Estimator, blocked: Mask, grid: Grid
) -> tuple[Clip, float]:
    """Clip with the recovered flow of its rendered sequence, and the CPU time of all frames' flow [s].

    `blocked`: (T, H, W) masked pixels: tool, specular highlights.
    """
    tissue = sequence["tissue"][:].astype(bool)
    scale = float(sequence.attrs["scale_mm_per_px"])
    view = GridView(tissue, scale, grid)
    moved, confidence = np.zeros_like(clip.displacement["ideal"]), np.ones_like(clip.confidence)
    rgb, began = sequence["rgb"][: clip.frames], time.process_time()
    followed = track(estimator, rgb, blocked[: clip.frames], tissue)
    spent = time.process_time() - began
    for t in range(1, clip.frames):
        moved[t] = view.mean(followed.flow[t].transpose(2, 0, 1) * scale) * clip.mask
        confidence[t] = view.mean(followed.confidence[t]) * clip.mask
    found = {**clip.displacement, "recovered": moved}
    return replace(clip, displacement=found, confidence=confidence), spent


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
