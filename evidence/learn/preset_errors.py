"""What networks get wrong that were trained as the presets are: `bench experiment learn --presets`.

Errors are compared on one grid only. A map's RMSE [mN/mm²] is of force density: a coarser grid's cells
average over more of a contact's rim, so that the same answer errs less on it, and which grid to take is a
question of how fine a map is wanted, as a picture's width is. Each preset stands among the networks trained
on its grid, with its loss, in as many steps; all say magnitudes, as the study does.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from evidence.learn.coarse_rmse import CELLS
from evidence.learn.experiment import BESIDE, small
from evidence.learn.run_table import column, read
from learn.evaluation.statistics import Interval, interval, paired
from learn.network.d2fnet import Architecture
from learn.settings import PRESETS, replace
from synth.errors import UserError

GRIDS = {PRESETS[name].size: name for name in BESIDE}
"""The preset that networks on a grid of this many cells are compared with."""


Shape = tuple[Literal["d2fnet", "unet", "monai-unet"], int, int, int, bool]
"""Name, width, stem, levels and detail: what sets the time a frame takes, of an architecture."""


def shape(arch: Architecture) -> Shape:
    """What names a network among others on its grid."""
    return arch.name, arch.width, arch.stem, arch.levels, arch.detail


@dataclass(frozen=True)
class Trained:
    """What a network that was trained gets wrong on the tested sequences."""

    error: Interval
    """Map RMSE [mN/mm²], mean over sequences; a sequence's is the mean over seeds."""
    wide: Interval
    """The same over cells of 0.56 mm (64²), answer and truth averaged onto them: comparable between grids."""
    force: Interval
    """Error of the total force [mN], comparable between grids."""
    seeds: int
    against: Interval | None
    """Its error less that of its grid's preset as a share of that, paired by sequences, over the seeds that
    both have; None for the preset itself and where there is none."""


Known = Mapping[tuple[Shape, int], Trained]


def errors(root: Path) -> Known:
    """Networks by shape and grid, trained as their grid's preset is: its loss, its dropout.

    `root`: learn's results. A run with another loss says nothing of the preset and is left out; so is one
    that differs from the study's in any other setting, or was tested on recovered flow.
    """
    found: dict[tuple[Shape, int], dict[int, dict[str, Any]]] = {}
    for run in [*read(root / "ideal"), *read(root / "presets")]:
        if not run["control"] and run["source"] == "ideal" and _alike(run["settings"]):
            tree = run["settings"]
            found.setdefault((shape(architecture(tree["arch"])), tree["size"]), {})[tree["seed"]] = run
    out = {}
    for key, seeds in found.items():
        runs = list(seeds.values())
        preset = found.get((shape(PRESETS[GRIDS[key[1]]].arch), key[1]), {})
        both = sorted(set(seeds) & set(preset))
        against = None
        if both and seeds is not preset:
            a, b = (_mean([own[seed] for seed in both], "map_rmse") for own in (preset, seeds))
            gap, base = paired(a, b, np.random.default_rng(0)).difference, float(a.mean())
            against = Interval(gap.mean / base, gap.low / base, gap.high / base, gap.n)
        wide = "map_rmse" if key[1] == CELLS else "map_rmse_wide"
        error, wider, force = (
            interval(_mean(runs, name), np.random.default_rng(0)) for name in ("map_rmse", wide, "force_mae")
        )
        out[key] = Trained(error, wider, force, len(runs), against)
    return out


def architecture(tree: dict[str, Any]) -> Architecture:
    """An architecture as a run's settings hold it."""
    return Architecture.model_validate(tree)


def _alike(tree: dict[str, Any]) -> bool:
    """Whether a run's settings are the study's but for a shape and a preset's grid, loss and dropout."""
    if tree["size"] not in GRIDS:
        return False
    preset, study, arch = PRESETS[GRIDS[tree["size"]]], small(), architecture(tree["arch"])
    sizes = {k: getattr(arch, k) for k in ("name", "width", "stem", "levels", "detail")}
    own = replace(study.arch, **sizes, dropout=preset.arch.dropout)
    loss = preset.objective.model_dump(mode="json")
    # Squared error has no weights: what else stood in its tree, in other versions, decided nothing.
    same = tree["objective"] == loss or tree["objective"]["kind"] == loss["kind"] == "mse"
    asked = replace(study, seed=tree["seed"], size=tree["size"], arch=own).as_dict()
    return same and _plain(asked) == _plain(tree)


def _plain(tree: dict[str, Any]) -> dict[str, Any]:
    """Settings as JSON holds them, but for the loss."""
    found: dict[str, Any] = json.loads(json.dumps(tree | {"objective": None}))
    return found


def _mean(runs: list[dict[str, Any]], name: str) -> NDArray[np.float64]:
    """The mean over runs, of the same sequences in the same order, of each sequence's number."""
    names = [[s["name"] for s in run["sequences"]] for run in runs]
    if any(other != names[0] for other in names):
        raise UserError(f"{', '.join(run['name'] for run in runs)}: were tested on different sequences")
    return np.asarray(np.mean([column([run], name) for run in runs], axis=0), np.float64)
