"""A Bayesian linear inverse: from displacement to loads and their uncertainty.

    d = C f / E + N a + e

d: displacement at P points, C: the compliance. Loads f are smooth loads spread over the opening, plus one
contact of unknown position and width. N a is the tissue's own motion: the six monomials up to degree 2 per
component. e has the flow's stated deviations, enlarged because its errors are correlated, and a model error
in proportion to the local displacement, since the compliance is that of a generic shape.

Everything is Gaussian except position, width and prior standard deviations of the loads, which are
marginalised over a grid by each frame's likelihood (Bishop, Pattern Recognition and Machine Learning, 2006,
ch. 3; rank-3 updates of evidence by the matrix determinant lemma).
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations_with_replacement
from typing import Any
from zipfile import BadZipFile

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve, eigh
from scipy.special import logsumexp

from bench.methods import compliance
from bench.methods.compliance import OPENING_MM, Lattice, TissueKind
from bench.methods.force_mixture import ForceMixture
from synth.arrays import Floats, Map
from synth.formats import COMPLIANCE, MESH
from synth.system import cache
from synth.system.terminal import say_if_long

Axes = tuple[float, float, float]


@dataclass(frozen=True)
class ModelConstants:
    """Constants of the model, by hand where no source is given; errors: docs/results/scoring/fusion."""

    rank: int = 100  # directions of displacement retained of the compliance
    smooth_mm: float = 2.0  # correlation length of the smooth loads
    smooth: tuple[float, ...] = (0.03, 0.15, 0.75)  # deviations of their total, per component [mN/kPa]
    radii_mm: tuple[float, ...] = (2.4, 3.4, 4.8)  # of contacts, whose load falls as (1 - r^2 / R^2)^2
    reach_mm: float = 9.5  # largest distance of a contact from the centre of the opening, whose radius is 12
    contacts: tuple[Axes, ...] = ((1.0, 1.0, 1.0), (5.0, 5.0, 5.0))
    """Standard deviations of a contact's force along x, y, z [mN/kPa]."""
    presses: tuple[Axes, ...] = ((0.2, 0.2, 5.0), (0.05, 0.05, 5.0))
    """With one camera also these, along the optical axis: without them 107 of 120 drawn presses lay outside
    their interval, with them 10 (docs/design.md)."""
    correlated: float = 3.0  # factor of flow's variances: errors at neighbouring points are correlated
    misfit: float = 0.1  # model error, as a share of the local displacement
    around_mm: float = 1.5  # range of "local": with each point alone coverage is 80%, not 90% (design.md)
    unmet: float = 2.0  # inflates the tissue's own motion: short spans miss parts of a cycle (science.md)
    independent: float = 0.003
    """Share of the covariance of the tissue's own motion without correlations. Modes of a tenth fit the far
    field of a press: on 10 sequences of `mission-ood` with a drawn pulse added, 15 s of it without contact,
    strong forces were too small by 30%, with this by 22, without a pulse by 19."""
    least_mm: float = 0.005  # lower limit of flow's deviation
    draws: int = 128  # of hypotheses in a posterior


MODEL = ModelConstants()


@dataclass(frozen=True, eq=False)
class LoadBasis:
    """A compliance in the few directions of displacement that smooth loads can cause, E = 1 kPa."""

    motion: Floats  # (C P, R + 6 C) mm: orthonormal directions, then the polynomials
    size: Floats  # (R,) standard deviation along each direction under loads of unit size
    force: Floats  # (3, R) total force per coefficient [mN/mm]
    omitted: Floats  # (3,) variance of the total force in the omitted directions, loads of unit size
    contacts: Map  # (R, H, 3) coefficients of contacts of 1 mN along each axis
    loads: Floats  # (3 K, R) mN at the nodes per coefficient
    shares: Floats  # (K, H) share of each contact carried by each node
    around: Floats  # (P, P) weights of means over neighbouring points
    lattice: Lattice


@dataclass(frozen=True, eq=False)
class Observation:
    """One frame's displacement at the compliance's points."""

    moved: Floats  # (C, P) mm
    deviation: Floats  # (C, P) mm, stated; infinite where no tissue is visible

    @property
    def size_mm(self) -> float:
        """Root mean square displacement where tissue is visible."""
        visible = np.isfinite(self.deviation)
        return float(np.sqrt(np.mean(self.moved[visible] ** 2))) if visible.any() else 0.0

    @property
    def signal_mm(self) -> float:
        """Root mean square displacement in excess of the stated deviation."""
        visible = np.isfinite(self.deviation)
        excess = self.moved[visible] ** 2 - self.deviation[visible] ** 2
        return float(np.sqrt(np.maximum(excess, 0).mean())) if visible.any() else 0.0


@dataclass(frozen=True, eq=False)
class Posterior:
    """Loads of a frame and their uncertainty."""

    evidence: float  # logarithm of the marginal likelihood
    force: ForceMixture  # over E [mN/kPa]
    load: Floats  # (K, 3) mean load at the nodes
    own_amplitudes: Floats  # (M,) mean amplitudes of the modes of the tissue's own motion


@lru_cache(maxsize=32)
def load_basis(components: int, tissue: TissueKind) -> LoadBasis:
    """The reduced compliance of a tissue, observed in 2 or 3 components: from this user's cache, or computed
    (half a CPU-second, and one for each block and Poisson's ratio) and stored there."""
    stored, lattice = _fetch_basis(components, tissue), compliance.lattice()
    shares = _contact_shares(lattice)
    distance2 = np.square(lattice.points[:, None] - lattice.points[None]).sum(axis=-1)
    weights = np.exp(-distance2 / (2 * MODEL.around_mm**2))
    polynomial_basis = np.kron(np.eye(components), polynomials(lattice.points))
    return LoadBasis(
        np.hstack([stored["motion"], polynomial_basis]),
        stored["size"],
        stored["force"],
        stored["omitted"],
        stored["contacts"].transpose(0, 2, 1),
        stored["loads"].astype(np.float64),
        shares,
        weights / weights.sum(axis=1, keepdims=True),
        lattice,
    )


@lru_cache(maxsize=8)
def load_basis_alone(components: int, tissue: TissueKind) -> LoadBasis:
    """The same for a tissue that is likely to be the only one of its Poisson's ratio: computed at half the
    cost of a first one."""
    _fetch_basis(components, tissue, alone=True)
    return load_basis(components, tissue)


def _fetch_basis(components: int, tissue: TissueKind, *, alone: bool = False) -> dict[str, Any]:
    constants = MODEL.rank, MODEL.smooth_mm, MODEL.radii_mm, MODEL.reach_mm
    key = f"{MESH} {COMPLIANCE} {components} {tissue} {compliance.SETTINGS} {constants}".encode()
    faults = ValueError, EOFError, KeyError, BadZipFile  # of files that were cut off: they are computed again
    with say_if_long(_WAIT):
        return cache.load_or_make(
            "basis/npz", key, lambda: _reduce(components, tissue, alone), _dump, _load, faults, _STORED
        )


_WAIT = "physics: computing how tissue yields under loads, once on this machine (some 10 s of a processor)"
_STORED = 128  # bases in the cache, of some 1.5 MB: those of five recordings about which nothing is stated


def _reduce(components: int, tissue: TissueKind, alone: bool = False) -> dict[str, Any]:
    """What of a `LoadBasis` depends on the tissue, by attribute; large arrays in single precision."""
    lattice = compliance.lattice()
    matrix, count, rank = compliance.solve(tissue, components, alone=alone), len(lattice.nodes), MODEL.rank
    distance2 = np.square(lattice.nodes[:, None] - lattice.nodes[None]).sum(axis=-1)
    kernel = np.exp(-distance2 / (2 * MODEL.smooth_mm**2)) * lattice.node_area[:, None] * lattice.node_area
    root = np.linalg.cholesky(kernel + 1e-6 * np.trace(kernel) / count * np.eye(count))
    root /= np.linalg.norm(root.sum(axis=0))
    smooth = (matrix.reshape(-1, count) @ root).reshape(len(matrix), 3 * count)
    values, vectors = eigh(smooth.T @ smooth, subset_by_index=[3 * count - rank, 3 * count - 1])
    vectors, size = vectors[:, ::-1], np.sqrt(values[::-1])
    motion = smooth @ (vectors / size)
    loads = root @ vectors.reshape(3, count, rank)  # (3, K, R)
    total = loads.sum(axis=1)
    by_load = (motion.T @ matrix).reshape(rank, 3, count)
    contacts = by_load @ _contact_shares(lattice)  # (R, 3, H): each axis is contiguous
    return {
        "motion": motion.astype(np.float32),
        "size": size,
        "force": total / size,
        # Of loads of unit size, along all directions, the total's variance is 1.
        "omitted": 1 - np.square(total).sum(axis=1),
        "contacts": contacts.astype(np.float32),
        "loads": (loads / size).transpose(1, 0, 2).reshape(3 * count, rank).astype(np.float32),
    }


def _contact_shares(lattice: Lattice) -> Floats:
    """Share (K, H) of each contact carried by each node: radius by radius, at every node within reach."""
    distance2 = np.square(lattice.nodes[:, None] - lattice.nodes[None]).sum(axis=-1)
    within = np.hypot(*lattice.nodes.T) <= MODEL.reach_mm
    spread = [
        np.clip(1 - distance2 / r**2, 0, None) ** 2 * lattice.node_area[:, None] for r in MODEL.radii_mm
    ]
    return np.concatenate([(part / part.sum(axis=0))[:, within] for part in spread], axis=1)


def _dump(stored: dict[str, Any]) -> bytes:
    np.savez(buffer := io.BytesIO(), **stored)
    return buffer.getvalue()


def _load(data: bytes) -> dict[str, Any]:
    with np.load(io.BytesIO(data), allow_pickle=False) as stored:
        return {name: stored[name] for name in ("motion", "size", "force", "omitted", "contacts", "loads")}


def polynomials(points: Floats) -> Floats:
    """Polynomials of second degree at points (P, 2) mm, (P, 6), of size 1 at the opening's edge."""
    x, y = points.T / OPENING_MM
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


def own_motion(basis: LoadBasis, contact_free: list[Observation], *, correlated: bool = True) -> Floats:
    """Modes of the tissue's own motion in coefficients of the polynomials, (C, 6, M) mm, with amplitudes of
    unit deviation: a moment estimate from frames without contact that show all components.

    Their correlations matter: breathing lifts and bends the surface as one, a contact bends it alone. Modes
    within the noise are included: without them intervals are too narrow. Not `correlated`: one size per
    component, for frames that may have contacts.
    """
    components = len(basis.motion) // len(basis.lattice.points)
    terms = polynomials(basis.lattice.points)
    excess = []
    for frame in contact_free:
        coefficients, errors = list[Floats](), list[Floats]()
        for axis in range(components):
            weight = 1 / (MODEL.correlated * (frame.deviation[axis] ** 2 + MODEL.least_mm**2))
            gram = terms.T @ (terms * weight[:, None])
            if np.linalg.cond(gram) < 1e8:
                errors.append(np.linalg.inv(gram))
                coefficients.append(errors[-1] @ (terms.T @ (weight * frame.moved[axis])))
        if len(coefficients) == components:
            vector = np.concatenate(coefficients)
            excess.append(np.outer(vector, vector) - block_diag(*errors))
    if not excess:
        return np.zeros((components, terms.shape[1], 0))
    if correlated:
        mean = (1 - MODEL.independent) * np.mean(excess, axis=0)
        mean += MODEL.independent / (1 - MODEL.independent) * np.diag(np.maximum(np.diag(mean), 0))
    else:
        size = np.mean(excess, axis=0).diagonal().reshape(components, -1).mean(axis=1)
        mean = np.diag(np.repeat(size, terms.shape[1]))
    values, vectors = eigh(mean)
    modes = MODEL.unmet * vectors[:, values > 0] * np.sqrt(values[values > 0])
    return np.asarray(modes.reshape(components, terms.shape[1], -1), np.float64)


def evidence(basis: LoadBasis, frame: Observation, own_mm: Floats) -> float:
    """`infer(...).evidence` alone, at three quarters of the cost."""
    return float(logsumexp(_weigh(basis, frame, own_mm, _contact_sizes(frame))[1]))


def _contact_sizes(frame: Observation) -> Floats:
    """Standard deviations (S, 3) of a contact's force [mN/kPa]."""
    return np.array(MODEL.contacts + (MODEL.presses if len(frame.moved) == 2 else ()))


def infer(basis: LoadBasis, frame: Observation, own_mm: Floats) -> Posterior:
    """The posterior of a frame's loads; `own_mm`: the tissue's own motion, see `own_motion`."""
    rank, count = len(basis.size), basis.contacts.shape[1]
    sizes = _contact_sizes(frame)
    levels, score = _weigh(basis, frame, own_mm, sizes)
    # Systematic draws: each hypothesis is drawn in proportion to its probability, however many there are.
    cumulative = np.cumsum(np.exp(score - logsumexp(score)))
    draws = np.searchsorted(cumulative, (np.arange(MODEL.draws) + 0.5) / MODEL.draws * cumulative[-1])
    hypotheses, repeats = np.unique(draws, return_counts=True)
    share = repeats / MODEL.draws
    force, covariance = np.empty((len(hypotheses), 3)), np.empty((len(hypotheses), 3, 3))
    coefficients, contact_load = np.zeros(len(levels[0].mean)), np.zeros((len(basis.shares), 3))
    for k, (hypothesis, part) in enumerate(zip(hypotheses, share, strict=True)):
        level = levels[hypothesis // (len(sizes) * count + 1)]
        index = hypothesis % (len(sizes) * count + 1)
        force[k], covariance[k] = level.force, level.covariance
        mean = level.mean
        if index < len(sizes) * count:
            h = int(index % count)
            variance = np.linalg.inv(level.square[h] + np.diag(1 / sizes[index // count] ** 2))
            contact = variance @ level.pull[h]
            # A contact adds its own force and reduces that of the smooth loads.
            reduction = level.projection @ basis.contacts[:, h]
            net_force = np.eye(3) - basis.force @ reduction[:rank]
            force[k] += net_force @ contact
            covariance[k] += net_force @ variance @ net_force.T
            mean = mean - reduction @ contact
            contact_load += part * basis.shares[:, h, None] * contact
        coefficients += part * mean
    load = (basis.loads @ coefficients[:rank]).reshape(-1, 3) + contact_load
    mixture = ForceMixture(share, force, covariance)
    return Posterior(float(logsumexp(score)), mixture, load, coefficients[rank:])


def _weigh(
    basis: LoadBasis, frame: Observation, own_mm: Floats, sizes: Floats
) -> tuple[list[_Level], Floats]:
    """The smooth loads of each size, and the log evidence of every hypothesis, (L (S H + 1),): by size of the
    smooth loads, of the contact (`sizes`, (S, 3)) and its position, last the one without a contact."""
    rank = len(basis.size)
    moved = frame.moved.ravel()
    # Over neighbours: a point's own square would reduce the weight of points that err upwards.
    local = basis.around @ np.square(frame.moved).mean(axis=0)
    noise = MODEL.correlated * (frame.deviation**2 + MODEL.least_mm**2 + MODEL.misfit**2 * local)
    weight = 1 / noise.ravel()
    modes = own_mm.reshape(basis.motion.shape[1] - rank, -1)
    motion = np.hstack([basis.motion[:, :rank], basis.motion[:, rank:] @ modes])
    weighed = motion * weight[:, None]
    gram, moments = motion.T @ weighed, weighed.T @ moved
    is_known = weight > 0
    constant = float(
        moved @ (weight * moved) - np.log(weight[is_known]).sum() + is_known.sum() * np.log(2 * np.pi)
    )
    count = basis.contacts.shape[1]
    flat = basis.contacts.transpose(0, 2, 1).reshape(rank, -1)
    flat64 = flat.astype(np.float64)
    levels, evidences = list[_Level](), list[Floats]()
    for spread in MODEL.smooth:
        prior = np.concatenate([np.square(spread * basis.size), np.ones(modes.shape[1])])
        factor = cho_factor(gram + np.diag(1 / prior), lower=True)
        mean = cho_solve(factor, moments)
        log_det = 2 * np.log(np.diag(factor[0])).sum() + np.log(prior).sum()
        smooth_score = -0.5 * (constant - moments @ mean + log_det)
        projection = cho_solve(factor, gram[:, :rank])
        residual_gram = (gram[:rank, :rank] - gram[:, :rank].T @ projection).astype(np.float32)
        explained = (residual_gram @ flat).reshape(rank, 3, count)
        # Entries (a, b) of each contact's symmetric 3 x 3 matrix, summed over directions.
        square = np.empty((count, 3, 3))
        for a, b in combinations_with_replacement(range(3), 2):
            square[:, a, b] = np.einsum("rh,rh->h", basis.contacts[..., a], explained[:, b])
            square[:, b, a] = square[:, a, b]
        pull = ((moments[:rank] - gram[:, :rank].T @ mean) @ flat64).reshape(3, count).T
        padded = np.zeros((len(prior), 3))
        padded[:rank] = basis.force.T
        covariance = basis.force @ cho_solve(factor, padded)[:rank] + np.diag(basis.omitted) * spread**2
        total = basis.force @ mean[:rank], covariance
        level = _Level(mean, square, pull, projection, *total)
        levels.append(level)
        precision = square + np.eye(3) / np.square(sizes)[:, None, :, None]  # (S, H, 3, 3)
        quadratic, contact_log_det = _quadratic(precision, pull)
        gain = (
            smooth_score
            + 0.5 * (quadratic - contact_log_det)
            - np.log(sizes).sum(axis=1, keepdims=True)
            - np.log(count)
        )
        evidences += [gain.ravel(), np.array([smooth_score])]
    return levels, np.concatenate(evidences)


def _quadratic(matrix: Floats, vector: Floats) -> tuple[Floats, Floats]:
    """v' M^-1 v and log det M of symmetric positive definite 3 x 3 matrices (..., 3, 3) and vectors (..., 3).

    By cofactors: LAPACK takes a call for each matrix, ten times as long.
    """
    (a, b, c), (_, d, e), (*_, f) = np.moveaxis(matrix, (-2, -1), (0, 1))
    x, y, z = np.moveaxis(vector, -1, 0)
    aa, bb, cc, ab, ac, bc = (
        d * f - e * e,
        a * f - c * c,
        a * d - b * b,
        c * e - b * f,
        b * e - c * d,
        b * c - a * e,
    )
    det = a * aa + b * ab + c * ac
    fit = aa * x * x + bb * y * y + cc * z * z + 2 * (ab * x * y + ac * x * z + bc * y * z)
    return fit / det, np.log(det)


@dataclass(frozen=True, eq=False)
class _Level:
    """Smooth loads of one size, and the information on contacts that remains."""

    mean: Floats  # (R + M,) of the smooth loads' coefficients, and of the modes of the tissue's own motion
    square: Floats  # (H, 3, 3) precision of each contact's force, from what smooth loads can't explain
    pull: Floats  # (H, 3) that precision times the force
    projection: Floats  # (R + M, R) share of a displacement that smooth loads and own motion explain
    force: Floats  # (3,) total of the smooth loads
    covariance: Floats  # (3, 3) of that total
