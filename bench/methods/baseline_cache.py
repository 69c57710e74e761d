"""Baselines fitted once for a model: what is fitted on its sequences is kept for the next recording."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence

import sklearn

from bench.methods.baselines import Rule
from synth.dataset import provenance
from synth.system import cache

_MOST = 8


def cached_rules(hashes: Sequence[str], source: str, fit: Callable[[], dict[str, Rule]]) -> dict[str, Rule]:
    """The fitted rules of a set of sequences, from this user's cache if they were fitted before.

    Args:
        hashes: content hashes of the sequences, in the order that they are fitted in.
        source: which displacement they are fitted on.
        fit: fits them.
    """
    code = provenance.source("synth", "learn", "bench/methods")
    key = "\n".join([code, sklearn.__version__, source, *hashes]).encode()
    # Half a file, of a disk that was full, is no fit; nor is one of another Python.
    faults = EOFError, pickle.UnpicklingError, AttributeError, ImportError
    return cache.cached("baselines/pickle", key, fit, pickle.dumps, pickle.loads, faults, _MOST)
