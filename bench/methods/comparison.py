"""The methods that stand beside a model in every table: physics alone, plug-ins, and fitted baselines."""

from __future__ import annotations

from pathlib import Path

from bench.methods import baselines, plugins
from bench.methods.baseline_cache import cached_rules
from bench.methods.physics import Physics
from bench.methods.protocol import Method
from learn.checkpoint import read_card
from learn.data.clips import read_clip
from synth.dataset.store import Dataset
from synth.errors import UserError

MAIN = "D2FNet"
"""Name under which the given model stands in every table."""
PHYSICS = "physics"
"""The same of the inverse."""
FUSION = "network and physics"
"""The same of the one answer that both make."""


def untrained() -> dict[str, Method]:
    """Those that need no training data."""
    return {PHYSICS: Physics()}


def simpler_methods(train: Path | None, model: Path | None, stereo: bool = False) -> dict[str, Method]:
    """Those that need no data, those of installed packages, and, given the training data, ridge.

    Ridge is fitted on the model's own fit sequences, once for a model; for a recording with a second eye on
    motion in three dimensions, if the data have it.

    Raises:
        UserError: none of the model's sequences is in `train`, or a plug-in takes a name of ours.
    """
    methods = untrained()
    others = plugins.installed()
    if taken := {FUSION, MAIN, *methods, baselines.RIDGE} & set(others):
        raise UserError(f"method {min(taken)}: a plug-in's name is taken by one of ours; rename it")
    methods |= others
    if train is None or model is None:
        return methods
    hashes = set(read_card(model).split.get("fit", []))
    chosen = [s for s in Dataset(train) if s.attrs["content_hash"] in hashes]
    if not chosen:
        raise UserError(f"{train}: holds none of the sequences that {model} was fitted on")
    source = "recovered" if all("flow_recovered" in s for s in chosen) else "ideal"
    if stereo and all("motion_recovered" in s for s in chosen):
        source = "motion"

    def fit() -> dict[str, baselines.Rule]:
        return baselines.fitted_rules([read_clip(s, baselines.GRID, (source,)) for s in chosen], source)

    rules = cached_rules([s.attrs["content_hash"] for s in chosen], source, fit)
    return methods | baselines.as_methods(rules, source)
