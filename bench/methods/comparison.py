"""The methods that every model is compared with: physics, plug-ins and fitted baselines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import sklearn

from bench.methods import baselines, plugins
from bench.methods.baselines import Baseline, Linear
from bench.methods.matrix_cache import cached_matrix
from bench.methods.physics import Physics
from bench.methods.protocol import Method
from learn.checkpoint import read_card
from learn.data.clips import has_depth, read_clip
from synth.dataset import provenance
from synth.dataset.store import Dataset
from synth.errors import UserError

# Names of the methods in tables, reports and score.json.
MAIN = "D2FNet"  # the given model
PHYSICS = "physics"
FUSION = "network and physics"


def untrained() -> dict[str, Method]:
    """Methods that need no training data."""
    return {PHYSICS: Physics()}


def simpler_methods(train: Path | None, model: Path | None, stereo: bool = False) -> dict[str, Method]:
    """Physics, the plug-ins of installed packages and, with training data, ridge regression.

    Ridge is fitted on the model's own fit sequences; for a stereo recording on motion in three dimensions if
    the data have it. UserError if none of the sequences is in `train`, or a plug-in has the name of a method
    of ours.
    """
    methods, others = untrained(), plugins.installed()
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

    def fit() -> Linear:
        return baselines.fit_ridge([read_clip(s, baselines.GRID, (source,)) for s in chosen], source)

    rule = cached_rule([s.attrs["content_hash"] for s in chosen], source, fit)
    return methods | {baselines.RIDGE: Baseline(rule, has_depth(source))}


def cached_rule(hashes: Sequence[str], source: str, fit: Callable[[], Linear]) -> Linear:
    """The result of `fit`, from this user's cache if it was fitted before on sequences of these `hashes`."""
    code = provenance.source("synth", "learn", "bench/methods")
    key = "\n".join([code, sklearn.__version__, source, *hashes]).encode()
    return Linear(cached_matrix("baselines", key, lambda: fit().matrix, most=8))
