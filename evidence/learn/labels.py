"""Training sequences without images: physics and projection only, directly on the network's grid.

Ideal flow needs no rendering. Motion, camera and label are those of the pipeline (same functions, same random
numbers), a core-second a sequence. Recovered flow is not available.
"""

from functools import partial
from pathlib import Path

import numpy as np

from evidence import cache as stored
from evidence.datasets import coarser
from learn.data.clips import Clip
from learn.data.grid import Grid, GridView, settled
from synth.job.schema import Job
from synth.render import truth
from synth.render.anatomy import rim
from synth.render.camera import camera
from synth.sequence.simulation import simulate

FINE = 128  # least cells along the edge of the grid on which labels are made


def clips(job: Job, grid: Grid, cache: Path) -> list[Clip]:
    """All sequences of a job with ideal flow on a grid of 64², 128² or 256² cells, cached.

    Labels are made on 128² or finer; 64² is four cells of that in one.
    """
    if grid.size >= FINE:
        return [whole(job, index, grid, cache) for index in range(job.sequences)]
    fine = Grid(FINE, grid.extent_mm)

    def make(index: int) -> Clip:
        return coarser(whole(job, index, fine, cache), fine.size // grid.size)

    folders = [cache / f"{key(job, index, fine)}-{grid.size}" for index in range(job.sequences)]
    return [stored.clip(folder, partial(make, index)) for index, folder in enumerate(folders)]


def whole(job: Job, index: int, grid: Grid, cache: Path) -> Clip:
    """One sequence with ideal flow on a grid, cached."""
    name = key(job, index, grid)
    return stored.clip(cache / name, lambda: clip(job, index, grid, name))


def key(job: Job, index: int, grid: Grid) -> str:
    """Key of everything that labels depend on, including code, and not of flow estimators."""
    parts = job.model_dump(mode="json", include={"seed", "frames", "fps", "anatomy", "fem", "render"})
    return stored.key(parts, index, grid.size, grid.extent_mm)


def clip(job: Job, index: int, grid: Grid, name: str) -> Clip:
    """One sequence of a job: deformed, projected, resampled on the grid."""
    scene = simulate(job, index)
    case, view, surface, motion = scene.scenario, scene.view, scene.surface, scene.motion
    frame = rim.build(surface, job.anatomy.craniotomy.radius_mm, case.appearance, view.mm_per_px).shape
    still = truth.trace_rest(view, scene.shape, frame)
    cells = GridView(still.tissue, still.scale_mm_per_px, grid)
    moved = np.empty((job.frames, 2, grid.size, grid.size), np.float32)
    density = np.empty((job.frames, 3, grid.size, grid.size), np.float32)
    rest = None
    for t in range(job.frames):
        place = truth.at_rest_pixels(still, surface.faces, surface.vertices + motion.displacement[t])
        pixel = camera.project(view, place.reshape(-1, 3).astype(np.float64)).reshape(*place.shape[:2], 2)
        rest = pixel if rest is None else rest
        flow = np.where(still.tissue[..., None], pixel - rest, 0.0).transpose(2, 0, 1)
        moved[t] = cells.mean(flow * still.scale_mm_per_px) * cells.mask
        load = truth.at_rest_pixels(still, surface.faces, motion.traction[t] @ view.rotation.T)
        amount = load.transpose(2, 0, 1) * still.area
        per_cell = settled(cells.sum(amount), cells.mask)
        density[t] = per_cell / np.float32(grid.pitch_mm**2 * case.tissue.young_kpa)
    return Clip(
        name=f"{index:06d}",
        content_hash=name,
        group=str(case.relief.seed),
        young_kpa=case.tissue.young_kpa,
        mask=cells.mask,
        displacement={"ideal": moved},
        confidence=np.ones((job.frames, grid.size, grid.size), np.float32),
        density=density,
        force=motion.force @ view.rotation.T,
    )
