"""Sequences for learning without a picture: physics and projection only, straight onto the network's grid.

Whatever asks only for ideal flow needs no light. The motion, camera and label are those of the pipeline
(same functions, same draws), a core-second a sequence; nothing here can stand in for recovered flow.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evidence import cache as kept
from learn.data.clips import Clip
from learn.data.grid import Grid, Resampler, centre, settled
from synth.geometry.triangles import Shape
from synth.job.schema import Job
from synth.render import truth
from synth.render.anatomy import rim
from synth.render.camera import camera
from synth.sequence import mechanics, scenario

FINE = 128
"""Cells along the edge of the grid that labels are made on, at least."""


def clips(job: Job, grid: Grid, cache: Path) -> list[Clip]:
    """All sequences of a job with ideal flow on a grid of 64², 128² or 256² cells, cached.

    Labels are made on 128² or finer; 64² is four cells of that in one.
    """
    return [_one(job, index, grid, cache) for index in range(job.sequences)]


def _one(job: Job, index: int, grid: Grid, cache: Path) -> Clip:
    if grid.size >= FINE:
        return whole(job, index, grid, cache)
    fine = Grid(FINE, grid.extent_mm)

    def make() -> Clip:
        return coarser(whole(job, index, fine, cache), fine, fine.size // grid.size)

    return kept.clip(cache / f"{key(job, index, fine)}-{grid.size}", make)


def whole(job: Job, index: int, grid: Grid, cache: Path) -> Clip:
    """One sequence with ideal flow on a grid, cached."""
    name = key(job, index, grid)
    return kept.clip(cache / name, lambda: clip(job, index, grid, name))


def coarser(clip: Clip, grid: Grid, times: int) -> Clip:
    """The clip on a grid of `times` wider cells: mean displacement of a cell's tissue, all of its force."""

    def blocks(values: NDArray[np.float32]) -> NDArray[np.float32]:
        n = grid.size // times
        pooled: NDArray[np.float32] = values.reshape(*values.shape[:-2], n, times, n, times).mean((-3, -1))
        return pooled

    cover = blocks(np.asarray(clip.mask))
    mask = (cover > 0.5).astype(np.float32)
    share = np.where(mask > 0, cover, np.float32(1))
    density = blocks(np.asarray(clip.density))
    return replace(
        clip,
        mask=mask,
        displacement={
            k: (blocks(np.asarray(v)) / share * mask).astype(np.float32) for k, v in clip.displacement.items()
        },
        confidence=blocks(np.asarray(clip.confidence)),
        density=np.stack([settled(d, mask) for d in density]),
    )


def key(job: Job, index: int, grid: Grid) -> str:
    """One word for all that labels depend on, the code that makes them too; flow estimators aren't asked."""
    parts = job.model_dump(mode="json", include={"seed", "frames", "fps", "anatomy", "fem", "render"})
    return kept.key(parts, index, grid.size, grid.extent_mm)


def clip(job: Job, index: int, grid: Grid, name: str) -> Clip:
    """One sequence of a job: deformed, projected, put on the grid."""
    case = scenario.draw_scenario(job, index)
    view = camera.place(case.view, job.render)
    surface, tets = mechanics.build(job, case)
    motion = mechanics.move(job, case, surface, tets)
    frame = rim.build(surface, job.anatomy.craniotomy.radius_mm, case.appearance, view.mm_per_px).shape
    still = truth.trace_rest(view, Shape(surface.vertices, surface.faces), frame)
    resample = Resampler(
        (still.tissue.shape[0], still.tissue.shape[1]), still.scale_mm_per_px, centre(still.tissue), grid
    )
    mask = (resample.cover(still.tissue) > 0.5).astype(np.float32)
    moved = np.empty((job.frames, 2, grid.size, grid.size), np.float32)
    density = np.empty((job.frames, 3, grid.size, grid.size), np.float32)
    rest = None
    for t in range(job.frames):
        place = truth.at_rest_pixels(still, surface.faces, motion.rest + motion.displacement[t])
        seen = camera.project(view, place.reshape(-1, 3).astype(np.float64)).reshape(*place.shape[:2], 2)
        rest = seen if rest is None else rest
        flow = np.where(still.tissue[..., None], seen - rest, 0.0).transpose(2, 0, 1)
        moved[t] = resample.mean(flow * still.scale_mm_per_px, still.tissue) * mask
        load = truth.at_rest_pixels(still, surface.faces, motion.traction[t] @ view.rotation.T)
        amount = load.transpose(2, 0, 1) * still.area
        per_cell = settled(resample.sum(amount), mask)
        density[t] = per_cell / np.float32(grid.pitch_mm**2 * case.tissue.young_kpa)
    return Clip(
        name=f"{index:06d}",
        content_hash=name,
        group=str(case.relief.seed),
        family=case.family,
        gesture=case.gesture.kind,
        young_kpa=case.tissue.young_kpa,
        mask=mask,
        displacement={"ideal": moved},
        confidence=np.ones((job.frames, grid.size, grid.size), np.float32),
        density=density,
        force=motion.force @ view.rotation.T,
    )
