"""Reading the series of a job, of any kind."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from synth.errors import UserError
from synth.fem.external import plausibility, series
from synth.fem.external.recorded import find_run, read_arrays
from synth.fem.external.series import MeshSeries, Units
from synth.fem.external.vtk_series import read_files
from synth.job import identity
from synth.job.schema import Job, MechanicsSection, table_of

_PULLING = {"forceps", "bayonet", "suction", "none"}  # instruments that may pull


def read_job_series(job: Job, index: int) -> MeshSeries:
    """The series of sequence `index` of a job with `mechanics.source`, as `read_series`; its `cautions` are
    complete. UserError: also for files that are replaced while they are read."""
    given = job.mechanics
    sources = identity.list_sources(given)
    source = given.model_copy(update={"source": sources[index % len(sources)]})
    out, radius, fem = job.anatomy.craniotomy.direction, job.fem.footprint_mm[0], job.fem
    young = fem.young_kpa[0] if fem.young_kpa[0] == fem.young_kpa[1] else None
    pulls = bool(_PULLING.intersection(fem.names) or fem.own_instruments)
    return _read(source, radius, young, None if pulls else out, _state_of(source))


def forget() -> None:
    """Frees the series that were read last."""
    _read.cache_clear()


def _state_of(given: MechanicsSection) -> tuple[tuple[int, ...], ...]:
    """What distinguishes the files of a series from others that replaced them."""
    every = (file.stat() for file in identity.list_files(given))
    return tuple((one.st_ino, one.st_mtime_ns, one.st_ctime_ns, one.st_size) for one in every)


@lru_cache(maxsize=2)
def _read(
    given: MechanicsSection,
    patch_mm: float,
    young_kpa: float | None,
    out: tuple[float, float, float] | None,
    written: object,
) -> MeshSeries:
    """`written`: as of `_state_of`; `out`: outwards, where a load that pulls is doubtful."""
    assert given.source is not None
    units = Units(given.unit_mm, given.unit_mn, given.dt_s)
    found = read_series(given.source, units, given.force, given.instruments, patch_mm)
    doubts = doubt_load(found, young_kpa)
    if found.force is not None and out is not None:
        doubts += plausibility.find_pull_doubt(found.force, np.array(out))
    if _state_of(given) != written:
        raise UserError(f"{given.source}: was replaced while it was read")
    return replace(found, cautions=(*found.cautions, *doubts))


def doubt_load(series: MeshSeries, young_kpa: float | None) -> list[str]:
    """Doubts on the load of a series, if it has one; see `plausibility`."""
    if series.force is None or any(one.startswith("nodes") for one in series.cautions):
        return []  # nor of false motion
    motion = series.points, series.faces, series.displacement, series.force
    return plausibility.find_load_doubts(*motion, young_kpa) + plausibility.find_mirror_doubt(*motion)


def read_series(
    source: Path,
    units: Units,
    force: str | None = None,
    instruments: str | None = None,
    patch_mm: float = 4.0,
) -> MeshSeries:
    """The series in files of any kind.

    `source`, `force`, `instruments`: as in the job's section `mechanics`; `units`: what files do not state;
    `patch_mm`: radius of the contact that a table's force is spread over. UserError: they can't be used.
    """
    folder = source if source.is_dir() else source.parent
    run, table = find_run(source) if source.is_dir() else None, table_of(force)
    field = force if table is None else None
    if source.is_dir() and len(alone := list(source.glob("*.npz"))) == 1:
        source = alone[0]
    if run is not None or source.suffix == ".npz":
        found = read_arrays(run or source, units, field, recorded=run is not None)
    else:
        found = read_files(source, units, field)
    if table is not None:
        found = series.press(found, identity.inside(folder, table), units, patch_mm)
    return found if instruments is None else series.equip(found, identity.inside(folder, instruments))
