"""Relaxation of the tissue: what is left of its elastic force, by Fung's quasi-linear viscoelasticity.

Displacement alone gives the elastic force F(t). With a Prony series of lost shares p and times tau the tissue
bears F(t) (1 - sum p) + sum p q(t), where q follows F and decays with tau (Taylor, Pister & Goudreau, Int. J.
Numer. Methods Eng. 2, 1970). Under several contacts it holds for each; here they share one history.
"""

from __future__ import annotations

import numpy as np

from synth.arrays import Floats
from synth.job.types import PronyTerms


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


def measure_share_left(force: Floats, time_s: Floats, terms: PronyTerms) -> Floats:
    """(T,) the part of an elastic force (T, C) that is left, along it, from 0 to 1: tissue that creeps back
    without contact moves, but bears nothing."""
    relaxed = relax(force, time_s, terms)
    along = (relaxed * force).sum(axis=1) / np.maximum(np.square(force).sum(axis=1), 1e-12)
    return np.asarray(along.clip(0, 1))
