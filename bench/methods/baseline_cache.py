"""A cache of baselines, so that they are fitted once per model and not once per recording."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence

import sklearn

from bench.methods.baselines import Rule
from synth.dataset import provenance
from synth.system import cache

_MOST = 8


def cached_rules(hashes: Sequence[str], source: str, fit: Callable[[], dict[str, Rule]]) -> dict[str, Rule]:
    """The baselines fitted on a set of sequences, from this user's cache if they were fitted before.

    Args:
        hashes: content hashes of the sequences, in the order of fitting.
        source: the displacement they are fitted on.
        fit: fits them.
    """
    code = provenance.source("synth", "learn", "bench/methods")
    key = "\n".join([code, sklearn.__version__, source, *hashes]).encode()
    # Files that were cut off by a full disk, or written by another version of Python, are fitted again.
    faults = EOFError, pickle.UnpicklingError, AttributeError, ImportError
    return cache.cached("baselines/pickle", key, fit, pickle.dumps, pickle.loads, faults, _MOST)
