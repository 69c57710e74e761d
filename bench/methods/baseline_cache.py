"""Baselines fitted once for a model: what is fitted on its sequences is kept for the next recording."""

from __future__ import annotations

import contextlib
import hashlib
import pickle
from collections.abc import Callable, Sequence

import sklearn

from bench.methods.baselines import Rule
from synth.dataset import provenance
from synth.system import cache
from synth.system.checked_file import write_whole

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
    folder = cache.folder("baselines")
    file = folder / f"{hashlib.sha256(key).hexdigest()[:32]}.pickle"
    # Half a file, of a disk that was full, is no fit; nor is one of another Python.
    with contextlib.suppress(OSError, EOFError, pickle.UnpicklingError, AttributeError, ImportError):
        rules: dict[str, Rule] = pickle.loads(file.read_bytes())
        return rules
    rules = fit()
    with contextlib.suppress(OSError):
        write_whole(file, pickle.dumps(rules), durable=False)
        for old in sorted(folder.glob("*.pickle"), key=lambda one: one.stat().st_mtime)[:-_MOST]:
            old.unlink()
    return rules
