"""The openings that a brain offers: surveyed, the best of them tried as a job would."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from synth.errors import UserError
from synth.geometry import brain_surface
from synth.job import writer
from synth.job.schema import Anatomy, Craniotomy, Fem, Job
from synth.render.anatomy import survey
from synth.render.anatomy.survey import Ground, Site
from synth.sequence import scenario, scene

Floats = NDArray[np.float64]

_APART = 1.5  # of the opening's radius: chosen ones are different places
_HOLES = 2.0  # of its extent: how long the rim of a brain's hole may be
_TETS = 400  # of the volume that is tried: whether it meshes, not how well


@dataclass(frozen=True)
class Survey:
    """What was found on one brain."""

    path: Path
    vertices: Floats
    """(V, 3) mm, the file's axes."""
    faces: NDArray[np.int64]
    """(F, 3)."""
    radius_mm: float
    """Of the opening."""
    chosen: tuple[Site, ...]
    """The best, tried: a job can be carried out there."""
    others: tuple[Site, ...]
    """All other places looked at, judged by their surface alone."""

    @property
    def note(self) -> str:
        """What its user should know of the surface; empty if it is closed but for small holes."""
        edges = np.sort(np.concatenate([self.faces[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
        each, times = np.unique(edges, axis=0, return_counts=True)
        rim = each[times == 1]
        size = np.linalg.norm(np.diff(self.vertices[rim], axis=1)[:, 0], axis=1)
        count = len(self.vertices)
        joined = sp.coo_array((np.ones(len(rim)), (rim[:, 0], rim[:, 1])), (count, count))
        _, loop = connected_components(joined, directed=False)
        border = float(np.bincount(loop[rim[:, 0]], size, 1).max())  # of the longest rim
        if border <= _HOLES * float(np.ptp(self.vertices, axis=0).max()):
            return ""
        return (
            f"{self.path.name} is open along {border:.0f} mm: a sheet of cortex, not a brain. It can be "
            "opened and meshed, but displacement is then 20 to 35% off; close it first"
        )


def find_openings(path: Path, radius_mm: float, count: int) -> Survey:
    """The best `count` openings of a brain, far from one another.

    Args:
        path: its surface, in mm.
        radius_mm: of the opening.
        count: how many at most.

    Raises:
        UserError: the file cannot be used, or nowhere on it an opening of that radius works.
    """
    vertices, faces = brain_surface.read_brain(path)
    sites = survey.survey(Ground(vertices, faces), radius_mm)
    works = [site for site in sites if not site.fault]
    works = [site for site in works if not site.cut] or works
    chosen: list[Site] = []
    why = ""
    for site in survey.apart(works, _APART * radius_mm):
        try:
            try_opening(path, site, radius_mm)
        except UserError as error:
            why = str(error)
            continue
        chosen.append(site)
        if len(chosen) == count:
            break
    if not chosen:
        best = max(sites, key=lambda site: site.filled)
        raise UserError(
            f"{path.name}: nowhere an opening of {radius_mm:g} mm radius works ({why or best.fault}); "
            "lower the radius"
        )
    others = [site for site in sites if not any(site is one for one in chosen)]
    return Survey(path, vertices, faces, radius_mm, tuple(chosen), tuple(others))


def try_opening(path: Path, site: Site, radius_mm: float) -> None:
    """Builds surface and volume there, as a job would. UserError: they can't be."""
    job = Job(
        anatomy=Anatomy(mesh=path.resolve(), vertices=2500, craniotomy=craniotomy(site, radius_mm)),
        fem=Fem(tets=_TETS),
    )
    scene.build(job, scenario.draw(job, 0))


def craniotomy(site: Site, radius_mm: float) -> Craniotomy:
    """The job's section for a site."""
    x, y, z = (round(float(value), 2) for value in site.point)
    u, v, w = (round(float(value), 3) for value in site.direction)
    return Craniotomy(point=(x, y, z), direction=(u, v, w), radius_mm=radius_mm)


def also(sites: Sequence[Site], radius_mm: float) -> str:
    """Further openings as lines of the same job, commented out."""
    if not sites:
        return ""
    said = [craniotomy(site, radius_mm) for site in sites]
    listed = [
        f"    #   - {{point: {list(one.point or ())}, direction: {list(one.direction or ())}}}"
        for one in said
    ]
    return "\n".join(["    # also:  # the next best; sequences take them in turn", *listed]) + "\n"


def lines(path: Path, site: Site, radius_mm: float, folder: Path = Path()) -> str:
    """The job's lines for a site; the mesh as seen from `folder`, where the job file is to lie."""
    said = craniotomy(site, radius_mm)
    assert said.point is not None
    assert said.direction is not None
    mesh = os.path.relpath(path.resolve(), folder.resolve())
    return (
        "anatomy:\n"
        f"  mesh: {writer.scalar(Path(mesh))}\n"
        "  craniotomy:\n"
        f"    point: {list(said.point)}\n"
        f"    direction: {list(said.direction)}\n"
        f"    radius_mm: {radius_mm:g}\n"
    )
