"""Reading the series of a job, of any kind."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from synth.fem.external import series
from synth.fem.external.recorded import find_run, read_arrays
from synth.fem.external.series import MeshSeries, Units
from synth.fem.external.vtk_series import read_files
from synth.job import identity
from synth.job.schema import Job, MechanicsSection


def read_job_series(job: Job, index: int) -> MeshSeries:
    """The series of sequence `index` of a job with `mechanics.source`. UserError: it can't be used.

    Sequences use the sources in turn.
    """
    given = job.mechanics
    sources = identity.list_sources(given)
    one = given.model_copy(update={"source": sources[index % len(sources)]})
    written = tuple((file.stat().st_mtime_ns, file.stat().st_size) for file in identity.list_files(one))
    return _read(one, job.fem.footprint_mm[0], written)


@lru_cache(maxsize=2)
def _read(given: MechanicsSection, patch_mm: float, written: object) -> MeshSeries:
    """`written`: times and sizes of the files, which distinguish them from others that replaced them."""
    assert given.source is not None
    return read_series(given.source, _units(given), given.force, given.instruments, patch_mm)


def _units(given: MechanicsSection) -> Units:
    return Units(given.unit_mm, given.unit_mn, given.dt_s)


def read_series(
    source: Path,
    units: Units,
    force: str | None = None,
    instruments: str | None = None,
    patch_mm: float = 4.0,
) -> MeshSeries:
    """The series in `source`, of any kind.

    Args:
        source: a pattern with * or a collection of VTK files, a run of the published recorder, an .npz,
            or a folder that holds one of these.
        units: what the files do not state.
        force: `nodal:NAME`, `traction:NAME`, or a table of the total force, a .csv in the folder of the files
            (see `press`). None: it is not known.
        instruments: a table of tips and shafts there (see `equip`). None: there are none.
        patch_mm: radius of the contact that a table's force is spread over.

    Raises:
        UserError: in one line, with the file's name.
    """
    folder = source if source.is_dir() else source.parent
    table = folder / force if force is not None and force.lower().endswith(".csv") else None
    field, run = None if table else force, find_run(source) if source.is_dir() else None
    if source.is_dir() and len(alone := list(source.glob("*.npz"))) == 1:
        source = alone[0]
    if run is not None or source.suffix == ".npz":
        found = read_arrays(run or source, units, field, recorded=run is not None)
    else:
        found = read_files(source, units, field)
    if table is not None:
        found = series.press(found, table, units, patch_mm)
    return found if instruments is None else series.equip(found, folder / instruments, units)
