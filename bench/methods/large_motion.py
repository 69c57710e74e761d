"""The force behind large motion: what is seen to move is imposed on tissue that stiffens as it strains.

The linear inverse errs by 15 to 40% where loads are tenths of a newton. There springs join every visible
point of the surface to the place d_p where it was seen,

    W(u) + 1/2 sum k_p |u_p - d_p|^2 -> min,

W the energy of a block under Ogden's law, k_p less where the motion is less certain; the springs' ends are
then moved on by what tissue lags. The pull of those at the contact, where tissue moves by a quarter of the
largest motion, is the force: neither its place nor its form has to be found, and where the tissue's edge is
seen, what holds it hardly matters. Places that move apart from those within reach of the loads don't count:
the linear inverse, whose gain is sought, doesn't see them, and at the picture's border motion is often wrong.

Where it is not seen, it lies between what is seen and far away. An opening that is too small resists the
motion at the picture's border, one that is too wide lets go of it: springs beside the contact then pull with
it or against it, by up to the force itself. Of the two extremes that mixture is the answer of which these
springs pull nothing: beside the instrument nothing pulls.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.sparse as sp
from scipy.ndimage import gaussian_filter, label

from bench.methods.compliance import DOME_MM, OPENING_MM, TO_CAMERA, TissueKind
from learn.data.grid import Grid
from synth.arrays import Floats, Map, Mask
from synth.fem import surface_embedding
from synth.fem.driven_contact import Balance
from synth.fem.equilibrium import ExcessiveLoad
from synth.fem.membrane import MembraneSheet
from synth.fem.mesh import tetrahedra
from synth.fem.mesh.tetrahedra import Tets
from synth.fem.surface_embedding import Embedding
from synth.fem.system import assemble

STEEP = {2: 0.3, 3: 0.15}
"""By its components: slope of the motion, mm per mm and after smoothing, beyond which it is large. From two
components no force is solved, so that of them only what surely leaves the linear range counts."""
_SURE_MM = 0.6  # deviation of a motion whose spring is half as firm: what is hardly known imposes less
_TETS = 1600
_FIRM_PER_MM = 8.0  # k over E and area, as of a driven contact of 5 mm
_LEAST_JACOBIAN = 0.1
_FIRST, _SHORTEST = 0.5, 0.05  # steps of the imposed motion, as parts of it
_MOVED = 0.25  # part of the largest motion that a point has whose springs' pull counts
_REFINEMENTS = 1
_LEAST_MM = 0.02  # lower limit of a deviation
_WHOLE = 0.9  # least radius of what is seen, in openings, whose mesh is fine under the whole opening
OPEN_MM = 40.0  # opening of a block without a skull near
_SMOOTH_MM = 0.5, 1.5  # least and largest standard deviation of the means over neighbours
_PER_MM = 10.0  # that deviation over that of the motion


@dataclass(frozen=True, eq=False)
class SeenMotion:
    """Motion of the visible surface between rest and a frame, at points of a regular grid."""

    points: Floats  # (P, 2) mm from the middle of the grid, camera x and y
    moved: Floats  # (P, C) mm, camera axes
    firmness: Floats  # (P,) 0..1, of a point's spring over that of the surest point
    area_mm2: float  # of a point
    slope: float  # largest slope within reach, mm per mm
    is_near: Mask  # (P,) within reach of the loads


def measure_motion(
    moved: Map, deviation: Map, mask: Map, grid: Grid, middle_mm: Floats | None = None
) -> SeenMotion:
    """Motion on a grid, by means over neighbours that are weighted by its precision.

    `moved`, `deviation`: (C, N, N) mm; `mask`: (N, N) above 0.5 where there is tissue; `middle_mm`: (2,) of
    the loads from the middle of the grid, camera x and y.
    """
    inside = mask > 0.5
    weight = inside / (np.square(deviation, dtype=np.float64) + _LEAST_MM**2)

    def smooth(sigma_mm: float) -> Floats:
        sigma = sigma_mm / grid.pitch_mm
        total = np.stack([gaussian_filter(part, sigma) for part in weight])
        mean = [gaussian_filter(w * d, sigma) for w, d in zip(weight, moved, strict=True)]
        return np.asarray(np.stack(mean) / np.maximum(total, 1e-12))

    least_mm, most_mm = _SMOOTH_MM
    rows, columns = np.nonzero(inside)
    places = np.stack([columns, rows], axis=1) - (grid.size - 1) / 2
    points = np.asarray(places * grid.pitch_mm, np.float64)
    is_near = np.linalg.norm(points - (0.0 if middle_mm is None else middle_mm), axis=1) <= OPENING_MM
    slopes = np.array(np.gradient(smooth(most_mm), grid.pitch_mm, axis=(1, 2)))  # (2, C, N, N)
    slope = np.linalg.norm(slopes, axis=(0, 1))[inside][is_near].max(initial=0.0)
    spread = deviation[:, inside].max(axis=0)
    mean = smooth(min(max(_PER_MM * float(np.median(spread)), least_mm), most_mm))
    firmness = 1 / (1 + np.square(spread / _SURE_MM, dtype=np.float64))
    firmness /= firmness.max(initial=1e-9)
    return SeenMotion(points, mean[:, inside].T, firmness, grid.pitch_mm**2, float(slope), is_near)


def reaction(motion: SeenMotion, tissue: TissueKind, opening_mm: float | None, alpha: float) -> Floats:
    """Force (3,) mN for E = 1 kPa, camera axes, that moves the surface so.

    `opening_mm`: radius of the opening; None: its edge is not seen; `alpha`: exponent of Ogden's law. Raises
    ExcessiveLoad: no equilibrium is found, or elements turn inside out.
    """
    seen_mm = float(np.sqrt(len(motion.points) * motion.area_mm2 / np.pi))
    if opening_mm is not None:
        is_wide = seen_mm > _WHOLE * opening_mm
        return _pull(motion, tissue, opening_mm, None if is_wide else seen_mm, alpha)[0]
    least_mm = float(np.linalg.norm(motion.points, axis=1).max())  # the skull covers no tissue that is seen
    narrow, wide = (
        _pull(motion, tissue, radius, seen_mm, alpha) for radius in (least_mm, max(OPEN_MM, least_mm))
    )
    # Pulls beside the contact along the force, and the part of the wide opening at which they vanish.
    excess, lack = (float(side @ force) / float(force @ force) for force, side in (narrow, wide))
    share = 0.5 if excess == lack else float(np.clip(excess / (excess - lack), 0, 1))
    return (1 - share) * narrow[0] + share * wide[0]


def _pull(
    motion: SeenMotion, tissue: TissueKind, opening_mm: float, focus_mm: float | None, alpha: float
) -> tuple[Floats, Floats]:
    """Pulls (3,) mN for E = 1 kPa, camera axes, of the springs at the contact and of those beside it.

    `focus_mm`: radius in which the mesh is fine; None: all of the opening.
    """
    radii = round(opening_mm, 1), None if focus_mm is None else round(focus_mm, 1)
    volume, embedding = _block(tissue.edge == "slipping", *radii, len(motion.points), motion.points.tobytes())
    sheet = MembraneSheet(tissue.membrane, max(tissue.stretch, _LEAST_STRETCH)) if tissue.membrane else None
    system = assemble(volume, "ogden", tissue.poisson, sheet, alpha)
    value = embedding.value
    stiffness = _FIRM_PER_MM * motion.area_mm2 * motion.firmness[:, None]
    nodal = value.T @ sp.diags_array(stiffness[:, 0]) @ value
    balance = Balance(system, sp.csr_array(sp.kron(nodal, np.eye(3), format="csr")))
    observed = targets = motion.moved @ TO_CAMERA
    u, energy, part, step = np.zeros_like(volume.points), 0.0, 0.0, _FIRST
    while part < 1:
        next_part = min(part + step, 1.0)
        start = u * (next_part / part) if part else u
        try:
            pull = next_part * (value.T @ (stiffness * targets))
            u, _, energy, _ = balance.find(pull, start, u, energy, _LEAST_JACOBIAN)
        except ExcessiveLoad:
            step *= 0.5
            if step < _SHORTEST:
                raise
        else:
            part = next_part
    for _ in range(_REFINEMENTS):  # the springs' ends are moved on by as much as the tissue lags
        targets = targets + observed - value @ u
        u, _, energy, _ = balance.find(value.T @ (stiffness * targets), u, u, energy, _LEAST_JACOBIAN)
    traction, (contact, beside) = stiffness * (targets - value @ u), _find_contact(motion)
    return TO_CAMERA @ traction[contact].sum(axis=0), TO_CAMERA @ traction[beside].sum(axis=0)


def _find_contact(motion: SeenMotion) -> tuple[Mask, Mask]:
    """Which points (P,) move with the contact, and which lie beside it."""
    size = np.linalg.norm(motion.moved, axis=1)
    moving = size >= _MOVED * size[motion.is_near].max(initial=0.0)
    column, row = (
        np.rint((motion.points - motion.points.min(axis=0)) / np.sqrt(motion.area_mm2)).astype(int).T
    )
    image = np.zeros((row.max() + 1, column.max() + 1), bool)
    image[row, column] = moving
    place = label(image, np.ones((3, 3)))[0][row, column]
    return moving & np.isin(place, place[moving & motion.is_near]), ~moving


_LEAST_STRETCH = 1.001  # of a membrane at rest: a slack one has no stiffness across


@lru_cache(maxsize=4)
def _block(
    slips: bool, opening_mm: float, focus_mm: float | None, count: int, points: bytes
) -> tuple[Tets, Embedding]:
    """The block and the embedding of points (P, 2) mm in its surface."""
    focus = [] if focus_mm is None else [(0.0, 0.0, focus_mm)]
    volume = tetrahedra.block(_TETS, focus, opening_mm=opening_mm, dome_mm=DOME_MM, slips=slips)
    world = np.frombuffer(points).reshape(count, 2) * [1.0, -1.0]
    places = np.column_stack([world, tetrahedra.dome(world, DOME_MM)])
    return volume, surface_embedding.embed(volume, places)
