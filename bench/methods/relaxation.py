"""Relaxation of the tissue: what is left of its elastic force, by Fung's quasi-linear viscoelasticity.

Displacement alone gives the elastic force F(t). With a Prony series of lost shares p and times tau the tissue
bears F(t) (1 - sum p) + sum p q(t), where q follows F and decays with tau (Taylor, Pister & Goudreau, Int. J.
Numer. Methods Eng. 2, 1970). The series is the whole stiffness', a membrane's too.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.methods.method_interface import ForceEstimate
from synth.arrays import Floats, Map, Mask
from synth.job.types import PronyTerms

_LEAST = 0.05  # share: an estimate of exactly zero would be taken for a certain one


def relax(force: Floats, time_s: Floats, terms: PronyTerms) -> Floats:
    """Force (T, C) after relaxation, of an elastic force (T, C) that is linear between rising times [s] (T,).

    Before the first time it is 0, and changes to the first force at once.
    """
    relaxed = (1 - sum(share for share, _ in terms)) * force
    for share, tau in terms:
        state = force[0]
        relaxed[0] += share * state
        for t in range(1, len(force)):
            steps = max((time_s[t] - time_s[t - 1]) / tau, 1e-12)
            state = np.exp(-steps) * state - np.expm1(-steps) / steps * (force[t] - force[t - 1])
            relaxed[t] += share * state
    return np.asarray(relaxed)


def measure_share_left(load: Map | Floats, time_s: Floats, trusted: Mask, terms: PronyTerms) -> Floats:
    """(T,) the part of an elastic load (T, C) that is left, along it, up to 1; interpolated where a frame is
    not `trusted` (T,).

    It is hardly anything where tissue creeps back without contact, which moves but bears nothing. More
    than the elastic load is not left: on the way back a contact that holds would pull, and few hold.
    Without terms, and without trusted frames, all is left.
    """
    share = np.ones(len(load))
    if not terms or not trusted.any():
        return share
    known, known_s = np.asarray(load, np.float64)[trusted], time_s[trusted]
    relaxed = relax(known, known_s, terms)
    along = (relaxed * known).sum(axis=1) / np.maximum(np.square(known).sum(axis=1), 1e-12)
    return np.asarray(np.interp(time_s, known_s, along.clip(_LEAST, 1)))


def relax_estimates(
    estimates: Sequence[ForceEstimate], time_s: Floats, trusted: Mask, terms: PronyTerms
) -> tuple[list[ForceEstimate], Floats]:
    """Estimates (T) of a method for elastic tissue, each by the share of its own force that is left; and the
    shares (T,)."""
    force = np.nan_to_num(np.stack([estimate.force_mn for estimate in estimates]))
    share = measure_share_left(force, time_s, trusted, terms)
    return [estimate.scale_by(part) for estimate, part in zip(estimates, share, strict=True)], share
