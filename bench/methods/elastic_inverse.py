"""Physics without learning: the loads that best explain the displacement seen, under two priors.

Seen from above, a load along the view moves tissue in the picture ten times less than one across it. Spread
loads across the view can imitate it, so the smooth prior answers badly along the view; one contact can't.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.optimize import minimize

from bench.methods.compliance import Compliance

Floats = NDArray[np.float64]

_RATIOS = np.geomspace(1e-7, 1e1, 33)
_ALONG_VIEW = 5.0
"""Loads along the view are let be this much larger a priori, as in depth-weighted minimum-norm imaging;
where a second eye sees them move tissue as far as others, they are not."""
_RADII_MM = (3.0, 4.0, 5.0, 6.0)
_LOG_RADII = (np.log(2.0), np.log(9.0))
_CORRELATED = 3.0
"""Degrees of freedom count so much more in cross-validation, for errors of flow that go together (Cummins,
Filloon and Nychka, J. Amer. Stat. Assoc. 2001, with 1.4)."""
_SMOOTH_MM = 4.0
_NEAR_MM, _NEAR_SMOOTH_MM = 3.0, 3.0
_ROAM_MM = 2.0


def tikhonov(compliance: Compliance, displacement: Floats, weight: Floats) -> Floats:
    """Total of the smallest smooth loads that explain the displacement, weighed by cross-validation.

    Golub, Heath and Wahba, "Generalized cross-validation as a method for choosing a good ridge parameter"
    (Technometrics 1979).

    Args:
        compliance: for the points seen.
        displacement: (P, C) mm, C = 2 of one eye, 3 of two, as the compliance.
        weight: (P,) >= 0; 0 where nothing is seen; or (P, C), of each component.

    Returns:
        (3,) mN for E = 1 kPa, camera axes.
    """
    # Loads 4 mm wide overlap so much that rows and columns 2.4 mm apart carry them as well as closer ones.
    spacing = _spacing(compliance)
    sparse = (np.round(compliance.nodes / spacing) % max(1, round(2.4 / spacing)) == 0).all(axis=1)
    return _smallest(compliance, displacement, weight, _SMOOTH_MM, sparse.astype(np.float64))


def tikhonov_near(compliance: Compliance, displacement: Floats, weight: Floats) -> Floats:
    """The same with the prior variance of a load falling off from where `one_contact` stands.

    Loads far from the contact, which could imitate one along the view, are thought unlikely beforehand.

    Args, returns: as `tikhonov`.
    """
    place = contact(compliance, displacement, weight).place
    away = np.square(compliance.nodes - place[:2]).sum(axis=1) / _NEAR_MM**2
    return _smallest(compliance, displacement, weight, _NEAR_SMOOTH_MM, np.exp(-away))


def _smallest(
    compliance: Compliance, displacement: Floats, weight: Floats, smooth_mm: float, prior: Floats
) -> Floats:
    """Tikhonov's answer with loads `smooth_mm` wide at the nodes, `prior` their standard deviations."""
    used = prior > 0.05
    root = np.sqrt(_by_row(weight, displacement))
    along = _ALONG_VIEW if displacement.shape[1] == 2 else 1.0
    size = np.array([1.0, 1.0, along]) * prior[used, None]
    a = (atoms(compliance, smooth_mm)[:, used] * size).reshape(len(root), -1) * root[:, None]
    u = displacement.T.ravel() * root
    values, vectors = eigh(a.T @ a)
    values = np.maximum(values, 0)
    projected = vectors.T @ (a.T @ u)
    inside = np.divide(projected**2, values, out=np.zeros_like(values), where=values > 1e-12 * values[-1])
    outside = max(float(u @ u - inside.sum()), 0.0)
    n = float((root > 0).sum())
    levels = np.maximum(_RATIOS * values[-1], 1e-30)
    damp = levels[:, None] / (values + levels[:, None])
    free = np.maximum(n - _CORRELATED * (1 - damp).sum(axis=1), 1e-9)
    score = (outside + (inside * damp**2).sum(axis=1)) / free**2
    x = vectors @ (projected / (values + levels[int(np.argmin(score))]))
    return np.asarray((x.reshape(-1, 3) * size).sum(axis=0), np.float64)


def _by_row(weight: Floats, displacement: Floats) -> Floats:
    """(C P,) weights in the order of the matrix's rows."""
    every = weight if weight.ndim == 2 else np.repeat(weight[:, None], displacement.shape[1], axis=1)
    return np.asarray(every.T.ravel(), np.float64)


def _spacing(compliance: Compliance) -> float:
    """Of the nodes' lattice [mm]."""
    steps = np.diff(np.unique(np.round(compliance.nodes[:, 0], 6)))
    return float(steps.min()) if len(steps) else 1.0


def one_contact(compliance: Compliance, displacement: Floats, weight: Floats) -> Floats:
    """Force of the single contact (place, radius and three components) that explains the displacement best.

    The sparsest prior there is: the first step of matching pursuit (Mallat and Zhang, IEEE Trans. Signal
    Processing 1993) over contacts of four radii at every node, then place and radius moved freely with the
    force solved for at each (variable projection, Golub and Pereyra, SIAM J. Numer. Anal. 1973). The last
    step is what finds the force along the view: a contact misplaced by half a millimetre looks like one.

    Args, returns: as `tikhonov`.
    """
    return contact(compliance, displacement, weight).force


@dataclass(frozen=True, eq=False)
class ContactFit:
    """A contact that explains a displacement."""

    place: Floats
    """(3,) x, y [mm] and the logarithm of its radius [mm]."""
    force: Floats
    """(3,) mN for E = 1 kPa, camera axes."""


def contact(compliance: Compliance, displacement: Floats, weight: Floats) -> ContactFit:
    """The contact of `one_contact`.

    Without any motion it stands in the middle and carries nothing. The last answer is remembered: two of the
    baselines ask for the same one.
    """
    return _contact(compliance, displacement.shape[1], displacement.tobytes(), weight.tobytes())


@lru_cache(maxsize=1)
def _contact(compliance: Compliance, components: int, moved: bytes, sure: bytes) -> ContactFit:
    displacement, weight = np.frombuffer(moved).reshape(-1, components), np.frombuffer(sure)
    if len(weight) != len(displacement):
        weight = weight.reshape(displacement.shape)
    # A start needs no more than every other point.
    square = _by_row(weight, displacement)[::2]
    u = displacement.T.ravel()[::2]
    best, start = 0.0, np.zeros(3)
    for radius in _RADII_MM:
        a = atoms(compliance, radius)[::2]
        gram = np.einsum("mna,mnb->nab", a * square[:, None, None], a, optimize=True)
        right = np.einsum("mna,m->na", a, u * square, optimize=True)
        gram += 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-30 * np.eye(3)
        explained = (np.linalg.solve(gram, right[..., None])[..., 0] * right).sum(axis=1)
        k = int(explained.argmax())
        if explained[k] > best:
            best, start = float(explained[k]), np.array([*compliance.nodes[k], np.log(radius)])
    if best <= 0:
        return ContactFit(np.zeros(3), np.zeros(3))
    return _settle(compliance, displacement, weight, start)


def _settle(compliance: Compliance, displacement: Floats, weight: Floats, start: Floats) -> ContactFit:
    """Moves place and radius of a contact to where it explains the displacement best, the force solved for.

    `start`: (3,) x, y [mm] and the logarithm of the radius.
    """
    root = np.sqrt(_by_row(weight, displacement))
    u = displacement.T.ravel() * root
    by_node = compliance.matrix.reshape(len(root), -1, 3)
    farthest = float(np.linalg.norm(compliance.nodes, axis=1).max())
    # The normal equations of the nodes nearby, once: most of the search stays among them.
    near = np.linalg.norm(compliance.nodes - start[:2], axis=1) < np.exp(start[2]) + _ROAM_MM
    columns = by_node[:, near].transpose(0, 2, 1).reshape(len(root), -1) * root[:, None]
    normal = (columns.T @ columns).reshape(3, near.sum(), 3, near.sum()).transpose(0, 2, 1, 3).copy()
    right = (columns.T @ u).reshape(3, -1)

    def fit(place: Floats) -> tuple[float, Floats]:
        """Square of what a contact at x, y of radius exp(third) leaves unexplained, and its force."""
        inside = np.hypot(*place[:2]) <= farthest and _LOG_RADII[0] < place[2] < _LOG_RADII[1]
        share = kernel(compliance, place)
        under = share > 0
        if under.sum() < 3 or not inside:
            return np.inf, np.zeros(3)
        if not (under & ~near).any():
            held = share[near]
            gram, seen = normal @ held @ held, right @ held
        else:
            a = np.tensordot(by_node[:, under], share[under], axes=(1, 0)) * root[:, None]
            gram, seen = a.T @ a, a.T @ u
        force = np.linalg.solve(gram + 1e-12 * np.trace(gram) * np.eye(3), seen)
        return float(u @ u - force @ (2 * seen - gram @ force)), force

    corners = start + np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0.25]])
    found = minimize(
        lambda place: fit(place)[0],
        start,
        method="Nelder-Mead",
        options={"initial_simplex": corners, "xatol": 1e-2, "fatol": 1e-6 * float(u @ u), "maxiter": 120},
    )
    return ContactFit(found.x, fit(found.x)[1])


def kernel(compliance: Compliance, place: Floats) -> Floats:
    """Share (K,) of a contact's force that each node carries; they add up to 1, or all are 0 far outside."""
    apart = np.square(compliance.nodes - place[:2]).sum(axis=1) / np.exp(2 * place[2])
    share = np.clip(1 - apart, 0, None) ** 2 * compliance.node_area
    return np.asarray(share / max(float(share.sum()), 1e-30), np.float64)


@lru_cache(maxsize=8)
def atoms(compliance: Compliance, radius_mm: float) -> Floats:
    """Displacement for contacts of 1 mN spread as (1 - r^2/a^2)^2 about each node, (C P, K, 3) mm."""
    count = len(compliance.nodes)
    apart = np.square(compliance.nodes[:, None] - compliance.nodes[None]).sum(axis=-1) / radius_mm**2
    share = np.clip(1 - apart, 0, None) ** 2 * compliance.node_area[:, None]
    share /= share.sum(axis=0)
    by_node = compliance.matrix.reshape(-1, count, 3)
    return np.asarray(np.einsum("mka,kn->mna", by_node, share, optimize=True), np.float64)
