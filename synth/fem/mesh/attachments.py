"""Attachments inside the tissue (falx, tentorium, an adhesion) as springs in a ball or a sheet."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
import scipy.sparse as sp

from synth.arrays import Floats, Ints, Mask
from synth.errors import UserError
from synth.fem.mesh.element import bary_slope, scatter, shape
from synth.geometry.skull import Attachment

FIRM_PER_MM = 2.0  # springs of skull, dura and attachments, in E per mm: 10 times as stiff as the tissue


_FINE = 9
_GRID = np.array([i for i in product(range(_FINE), repeat=4) if sum(i) == _FINE - 1], np.float64)
_SAMPLES = (_GRID + 0.25) / _FINE
"""(165, 4) evenly spaced barycentric points: a sheet may be much thinner than the elements it crosses."""


def springs(points: Floats, cells: Ints, attachments: Sequence[Attachment]) -> sp.csr_array:
    """Springs (N, N) mm (mN/mm for E = 1 kPa) of all attachments on nodes (N, 3) mm of cells (M, 10), in
    their axes. UserError: an attachment holds no tissue."""
    total = sp.csr_array((len(points), len(points)))
    if not attachments:
        return total
    corner = points[cells[:, :4]]
    value, share = shape(_SAMPLES), bary_slope(corner)[1] / len(_SAMPLES)
    for k, attachment in enumerate(attachments):
        distance = np.linalg.norm(corner - attachment.point, axis=2).min(axis=1)
        reach = np.ptp(corner, axis=1).max(axis=1) * np.sqrt(3) + attachment.radius_mm
        chosen = np.flatnonzero(distance <= reach)
        coverage = contains(attachment, np.einsum("qc,mcd->mqd", _SAMPLES, corner[chosen]))
        is_touched = coverage.any(axis=1)
        if not is_touched.any():
            raise UserError(f"anatomy.attachments: number {k} holds no tissue; check its point and radius_mm")
        coverage, held_cells = coverage[is_touched], cells[chosen[is_touched]]
        width_mm = attachment.radius_mm if attachment.normal is None else attachment.thickness_mm
        weight = coverage * (FIRM_PER_MM / width_mm * share[chosen[is_touched]])[:, None]
        local = np.einsum("mq,qi,qj->mij", weight, value, value, optimize=True)
        total = total + scatter(local, held_cells, len(points))
    return sp.csr_array(total)


def contains(attachment: Attachment, positions: Floats) -> Mask:
    """Mask (...) of the points (..., 3) mm that an attachment holds."""
    offset = positions - np.asarray(attachment.point)
    inside = np.linalg.norm(offset, axis=-1) <= attachment.radius_mm
    if attachment.normal is not None:
        normal = np.asarray(attachment.normal) / np.linalg.norm(attachment.normal)
        inside &= np.abs(offset @ normal) <= 0.5 * attachment.thickness_mm
    return np.asarray(inside)
