"""The series of another program that a job names."""

from __future__ import annotations

from synth.fem.external.read_series import forget as forget
from synth.fem.external.read_series import read_checked_series
from synth.fem.external.series import MeshSeries, Units
from synth.job.schema import Job
from synth.system import series_files

_PULLING = {"forceps", "bayonet", "suction", "none"}  # that may pull, as may one's own


def read_job_series(job: Job, index: int) -> MeshSeries:
    """The series of sequence `index` of a job with `mechanics.source`; its `cautions` are complete.

    UserError: its files can't be used, or are replaced while they are read.
    """
    mechanics, fem = job.mechanics, job.fem
    assert mechanics.source is not None
    sources = series_files.list_sources(mechanics.source)
    pulls = not _PULLING.isdisjoint(fem.names) or bool(fem.own_instruments)
    return read_checked_series(
        sources[index % len(sources)],
        Units(mechanics.unit_mm, mechanics.unit_mn, mechanics.dt_s),
        mechanics.force,
        mechanics.instruments,
        patch_mm=fem.footprint_mm[0],
        young_kpa=fem.young_kpa[0] if fem.young_kpa[0] == fem.young_kpa[1] else None,
        outward=None if pulls else job.anatomy.craniotomy.direction,
    )
