"""Reading the series of another program, of any kind."""

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
from synth.system import series_files
from synth.system.series_files import resolve_inside, table_of


def read_checked_series(
    source: Path,
    units: Units,
    force: str | None = None,
    instruments: str | None = None,
    patch_mm: float = 4.0,
    young_kpa: float | None = None,
    outward: tuple[float, float, float] | None = None,
) -> MeshSeries:
    """A series as of `read_series`, whose `cautions` also tell what is doubtful about its load.

    `young_kpa`: of its tissue, None: not known; `outward`: direction out of the tissue, if no instrument may
    pull. The last two series are kept. UserError: also for files that are replaced while they are read.
    """
    stamp = _stamp_files(source, force, instruments)
    return _read(source, units, force, instruments, patch_mm, young_kpa, outward, stamp)


def forget() -> None:
    """Frees the series that were read last."""
    _read.cache_clear()


def _stamp_files(source: Path, force: str | None, instruments: str | None) -> tuple[tuple[int, ...], ...]:
    """What distinguishes the files of a series from others that replaced them."""
    stats = (file.stat() for file in series_files.list_files(source, force, instruments))
    return tuple((stat.st_ino, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_size) for stat in stats)


@lru_cache(maxsize=2)
def _read(
    source: Path,
    units: Units,
    force: str | None,
    instruments: str | None,
    patch_mm: float,
    young_kpa: float | None,
    outward: tuple[float, float, float] | None,
    stamp: tuple[tuple[int, ...], ...],
) -> MeshSeries:
    """`stamp`: as of `_stamp_files`, before the files are read."""
    series = read_series(source, units, force, instruments, patch_mm)
    doubts = doubt_load(series, young_kpa)
    if series.force is not None and outward is not None:
        doubts += plausibility.find_pull_doubt(series.force, np.array(outward))
    if _stamp_files(source, force, instruments) != stamp:
        raise UserError(f"{source}: was replaced while it was read")
    return replace(series, cautions=(*series.cautions, *doubts))


def doubt_load(series: MeshSeries, young_kpa: float | None) -> list[str]:
    """Doubts on the load of a series, if it has one; see `plausibility`."""
    if series.force is None or any(caution.startswith("nodes") for caution in series.cautions):
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
    if source.is_dir() and len(archives := list(source.glob("*.npz"))) == 1:
        source = archives[0]
    if run is not None or source.suffix == ".npz":
        motion = read_arrays(run or source, units, field, recorded=run is not None)
    else:
        motion = read_files(source, units, field)
    if table is not None:
        motion = series.press(motion, resolve_inside(folder, table), units, patch_mm)
    return motion if instruments is None else series.equip(motion, resolve_inside(folder, instruments))
