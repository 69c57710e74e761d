"""Physics without learning: the loads that best explain the displacement seen, under two priors.

Seen from above, a load along the view moves tissue in the picture ten times less than one across it, so both
answer well for forces across the view and badly for forces along it.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from bench.compliance import Compliance

Floats = NDArray[np.float64]

_RATIOS = np.geomspace(1e-7, 1e1, 33)
_ALONG_VIEW = 5.0
"""Loads along the view are let be this much larger a priori, as in depth-weighted minimum-norm imaging."""
_RADII_MM = (3.0, 4.0, 5.0, 6.0)
_SMOOTH_MM = 4.0


def tikhonov(compliance: Compliance, displacement: Floats, weight: Floats) -> Floats:
    """Total of the smallest smooth loads that explain the displacement, weighed by cross-validation.

    Golub, Heath and Wahba, "Generalized cross-validation as a method for choosing a good ridge parameter"
    (Technometrics 1979).

    Args:
        compliance: for the points seen.
        displacement: (P, 2) mm.
        weight: (P,) >= 0; 0 where nothing is seen.

    Returns:
        (3,) mN for E = 1 kPa, camera axes.
    """
    root = np.sqrt(np.tile(weight, 2))
    size = np.array([1.0, 1.0, _ALONG_VIEW])
    a = (atoms(compliance, _SMOOTH_MM) * size).reshape(len(root), -1) * root[:, None]
    u = displacement.T.ravel() * root
    values, vectors = eigh(a.T @ a)
    values = np.maximum(values, 0)
    projected = vectors.T @ (a.T @ u)
    inside = np.divide(projected**2, values, out=np.zeros_like(values), where=values > 1e-12 * values[-1])
    outside = max(float(u @ u - inside.sum()), 0.0)
    n = 2 * float((weight > 0).sum())
    levels = np.maximum(_RATIOS * values[-1], 1e-30)
    damp = levels[:, None] / (values + levels[:, None])
    score = (outside + (inside * damp**2).sum(axis=1)) / np.maximum(n - (1 - damp).sum(axis=1), 1e-9) ** 2
    x = vectors @ (projected / (values + levels[int(np.argmin(score))]))
    return np.asarray((x.reshape(-1, 3) * size).sum(axis=0), np.float64)


def one_contact(compliance: Compliance, displacement: Floats, weight: Floats) -> Floats:
    """Force of the single contact (place, radius and three components) that explains the displacement best.

    The sparsest prior there is: the first step of matching pursuit (Mallat and Zhang, IEEE Trans. Signal
    Processing 1993) over contacts of four radii at every node.

    Args, returns: as `tikhonov`.
    """
    root = np.tile(weight, 2)
    u = displacement.T.ravel() * root
    best, force = 0.0, np.zeros(3)
    for radius in _RADII_MM:
        a = atoms(compliance, radius)
        gram = np.einsum("mna,mnb->nab", a * root[:, None, None], a, optimize=True)
        right = np.einsum("mna,m->na", a, u, optimize=True)
        gram += 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-30 * np.eye(3)
        x = np.linalg.solve(gram, right[..., None])[..., 0]
        explained = (x * right).sum(axis=1)
        k = int(explained.argmax())
        if explained[k] > best:
            best, force = float(explained[k]), x[k]
    return np.asarray(force, np.float64)


@lru_cache(maxsize=8)
def atoms(compliance: Compliance, radius_mm: float) -> Floats:
    """Displacement for contacts of 1 mN spread as (1 - r^2/a^2)^2 about each node, (2 P, K, 3) mm."""
    count = len(compliance.nodes)
    apart = np.square(compliance.nodes[:, None] - compliance.nodes[None]).sum(axis=-1) / radius_mm**2
    share = np.clip(1 - apart, 0, None) ** 2 * compliance.node_area[:, None]
    share /= share.sum(axis=0)
    by_node = compliance.matrix.reshape(-1, count, 3)
    return np.asarray(np.einsum("mka,kn->mna", by_node, share, optimize=True), np.float64)
