"""Reading the series of a job, of any kind."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from synth.fem.external import series
from synth.fem.external.recorded import find_run, read_arrays
from synth.fem.external.series import MeshSeries, Units
from synth.fem.external.vtk_series import read_files
from synth.job import identity
from synth.job.schema import Job, MechanicsSection, table_of


def read_job_series(job: Job, index: int) -> MeshSeries:
    """The series of sequence `index` of a job with `mechanics.source`, as `read_series`."""
    given = job.mechanics
    sources = identity.list_sources(given)
    one = given.model_copy(update={"source": sources[index % len(sources)]})
    written = tuple((file.stat().st_mtime_ns, file.stat().st_size) for file in identity.list_files(one))
    return _read(one, job.fem.footprint_mm[0], written)


@lru_cache(maxsize=2)
def _read(given: MechanicsSection, patch_mm: float, written: object) -> MeshSeries:
    """`written`: times and sizes of the files, which distinguish them from others that replaced them."""
    assert given.source is not None
    units = Units(given.unit_mm, given.unit_mn, given.dt_s)
    return read_series(given.source, units, given.force, given.instruments, patch_mm)


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
        found = series.press(found, folder / table, units, patch_mm)
    return found if instruments is None else series.equip(found, folder / instruments)
