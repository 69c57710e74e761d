"""Baselines fitted once for a model: what is fitted on its sequences is kept for the next recording."""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
from collections.abc import Callable, Sequence
from pathlib import Path

import sklearn

from bench.methods import baselines
from bench.methods.baselines import Rule
from synth.system import cache

_MOST = 8


def keep_rules(hashes: Sequence[str], source: str, fit: Callable[[], dict[str, Rule]]) -> dict[str, Rule]:
    """The fitted rules of a set of sequences, from this user's cache if they were fitted before.

    Args:
        hashes: content hashes of the sequences, in the order that they are fitted in.
        source: which displacement they are fitted on.
        fit: fits them.
    """
    code = Path(baselines.__file__).read_bytes()
    said = "\n".join([sklearn.__version__, source, *hashes]).encode()
    folder = cache.folder("baselines")
    file = folder / f"{hashlib.sha256(code + said).hexdigest()[:32]}.pickle"
    # Half a file, of a disk that was full, is no fit; nor is one of another Python.
    with contextlib.suppress(OSError, EOFError, pickle.UnpicklingError, AttributeError, ImportError):
        rules: dict[str, Rule] = pickle.loads(file.read_bytes())
        return rules
    rules = fit()
    part = file.with_suffix(f".{os.getpid()}")
    with contextlib.suppress(OSError):
        part.write_bytes(pickle.dumps(rules))
        part.replace(file)
        for old in sorted(folder.glob("*.pickle"), key=lambda one: one.stat().st_mtime)[:-_MOST]:
            old.unlink()
    return rules
