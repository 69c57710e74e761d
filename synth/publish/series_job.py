"""A first job for another program's series: what files state is set, the rest is left open."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from synth.arrays import Floats
from synth.fem.external.read_series import read_series
from synth.fem.external.series import MeshSeries, Units
from synth.fem.external.vtk_series import MOTION_NAMES
from synth.fem.surface_embedding import vertex_area
from synth.job import job_writer

_RADIUS_MM = 12.0
_FLAT = 1e-3  # height of a point over the middle of a sheet, relative to the radius
_DT_S = 0.04  # written where files carry no time


def as_job(source: Path) -> str:
    """The text of a job for the series in `source`. UserError: it can't be read."""
    series = read_series(source, Units(dt_s=_DT_S, guess=True))
    point, direction, radius = _find_opening(series)
    frames = max(3, min(len(series.time), 250))
    labels = [f"nodal:{name}, traction:{name}" for name in series.fields if name.lower() not in MOTION_NAMES]
    lines = [
        f"# {series.summary}.",
        *(f"# DOUBTFUL: {caution}" for caution in series.cautions),
        "# Look at it:  synth preview THIS_FILE      Render it:  synth render THIS_FILE -o OUT",
        "# Every key:   synth new",
        "sequences: 1  # more: the same motion, other vessels, lamps and instruments",
        f"frames: {frames}",
        f"fps: {(frames - 1) / series.time[-1]:.6g}  # frames are interpolated between the files' states",
        "mechanics:",
        f"  source: {job_writer.scalar(source.resolve())}",
        f"  unit_mm: {series.unit_mm:g}  # from the size of the surface; is it right?",
        *([] if series.timed else [f"  dt_s: {_DT_S}  # PLEASE SET: the files state no time"]),
        "  # For a label, state the force on the surface from outside, its unit, and the tissue's stiffness:",
        f"  # force: {', '.join([*labels, 'or force.csv with time, fx, fy, fz, x, y, z'])}",
        "  # unit_mn: 1000  # for N",
        "# fem: {young_kpa: 1.0, poisson: 0.45}",
        "anatomy:",
        "  craniotomy:  # where the surface moves most, in the files' axes",
        f"    point: {np.round(point, 3).tolist()}  # mm",
        f"    direction: {np.round(direction, 4).tolist()}",
        f"    radius_mm: {radius:.3g}",
    ]
    return "\n".join(lines) + "\n"


def _find_opening(series: MeshSeries) -> tuple[Floats, Floats, float]:
    """Point [mm], outward direction and radius [mm] of an opening where the surface moves most."""
    points = series.points
    peak_mm = np.linalg.norm(series.displacement, axis=2).max(axis=0)
    weight = vertex_area(points, series.faces) * (peak_mm > 0.7 * peak_mm.max())
    middle = weight @ points / weight.sum()
    point = points[np.linalg.norm(points - middle, axis=1).argmin()]
    radius = min(_RADIUS_MM, 0.4 * float(np.sort(np.ptp(points, axis=0))[1]))
    distance_mm = np.linalg.norm(points - point, axis=1)
    neighbours = np.argsort(distance_mm)[: max(12, int((distance_mm < radius / 2).sum()))]
    # The normal of their plane, as faces may be turned either way; outwards is away from the body's middle.
    normal = np.linalg.svd(points[neighbours] - points[neighbours].mean(axis=0))[2][2]
    height = normal @ (point - points.mean(axis=0))
    is_outwards = (height if abs(height) > _FLAT * radius else normal.sum()) > 0
    return point, normal if is_outwards else -normal, radius
