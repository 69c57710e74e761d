"""The methods that every model is compared with: physics, plug-ins and fitted baselines."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import sklearn

from bench.methods import baselines, plugins
from bench.methods.baselines import Baseline, Linear
from bench.methods.physics import Physics
from bench.methods.protocol import Method
from learn.checkpoint import read_card
from learn.data.clips import has_depth, read_clip
from synth.dataset import provenance
from synth.dataset.store import Dataset
from synth.errors import UserError
from synth.system import cache

# Names of the methods in tables, reports and score.json.
MAIN = "D2FNet"  # the given model
PHYSICS = "physics"
FUSION = "network and physics"


def untrained() -> dict[str, Method]:
    """Methods that need no training data."""
    return {PHYSICS: Physics()}


def simpler_methods(train: Path | None, model: Path | None, stereo: bool = False) -> dict[str, Method]:
    """Physics, the plug-ins of installed packages and, with training data, ridge regression.

    Ridge is fitted once per model on the model's own fit sequences; for a stereo recording on motion in three
    dimensions if the data have it. Raises UserError if none of the model's sequences is in `train`, or a
    plug-in has the name of a method of ours.
    """
    methods = untrained()
    others = plugins.installed()
    if taken := {FUSION, MAIN, *methods, baselines.RIDGE} & set(others):
        raise UserError(f"method {min(taken)}: this name is reserved; rename the plug-in's method")
    methods |= others
    if train is None or model is None:
        return methods
    hashes = set(read_card(model).split.get("fit", []))
    chosen = [s for s in Dataset(train) if s.attrs["content_hash"] in hashes]
    if not chosen:
        raise UserError(f"{train}: has none of the sequences that {model} was fitted on")
    source = "recovered" if all("flow_recovered" in s for s in chosen) else "ideal"
    if stereo and all("motion_recovered" in s for s in chosen):
        source = "motion"

    def fit() -> dict[str, Linear]:
        return baselines.fitted_rules([read_clip(s, baselines.GRID, (source,)) for s in chosen], source)

    rules = cached_rules([s.attrs["content_hash"] for s in chosen], source, fit)
    return methods | {name: Baseline(rule, has_depth(source)) for name, rule in rules.items()}


def cached_rules(
    hashes: Sequence[str], source: str, fit: Callable[[], dict[str, Linear]]
) -> dict[str, Linear]:
    """The result of `fit`, from this user's cache if it was fitted before.

    `hashes`: content hashes of the sequences in the order of fitting; `source`: the displacement.
    """
    code = provenance.source("synth", "learn", "bench/methods")
    key = "\n".join([code, sklearn.__version__, source, *hashes]).encode()
    # Files that were cut off by a full disk are fitted again.
    faults = EOFError, ValueError, zipfile.BadZipFile
    return cache.cached("baselines/npz", key, fit, _dump, _load, faults, most=8)


def _dump(rules: dict[str, Linear]) -> bytes:
    np.savez(held := io.BytesIO(), allow_pickle=False, **{name: one.matrix for name, one in rules.items()})
    return held.getvalue()


def _load(data: bytes) -> dict[str, Linear]:
    with np.load(io.BytesIO(data), allow_pickle=False) as held:
        return {name: Linear(held[name]) for name in held.files}
