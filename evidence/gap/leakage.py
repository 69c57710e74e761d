"""What leakage does to a score: the same methods, data and folds, frames dealt at random or by recording.

Neighbouring frames show nearly the same flow and force. A split that deals single frames asks a method about
frames whose neighbours it was fitted on, and even one that only remembers does well.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console

from bench.bootstrap import over_groups
from bench.methods import baselines
from bench.methods.protocol import Answer
from bench.output import charts, machine, result_page, write
from bench.scoring import metrics
from evidence.measuring import measuring
from learn.data.clips import Clip, load_clips
from learn.data.split import groups

Curve = NDArray[np.float64]
_FOLDS = 5
_SPLITS = {"random frames": 0, "whole recordings": 1}
_HEADS = {"r": "r", "r2": "R²", "mae_mn": "MAE [mN]"}


@measuring("out --out runs/leakage")
def leakage(
    dataset: Annotated[Path, typer.Argument(help="Dataset with recovered flow.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")] = Path(
        "docs/results/leakage"
    ),
    seed: Annotated[int, typer.Option(help="Of the folds.")] = 0,
) -> None:
    """Random-frame against whole-recording split on one dataset: what leakage does to every simple method."""
    clips = load_clips(dataset, baselines.GRID, ("recovered",))
    found = {
        name: answers(clips, fold, Console(stderr=True))
        for name, fold in (
            ("random frames", _by_frame(clips, seed)),
            ("whole recordings", _by_recording(clips, seed)),
        )
    }
    tree = summary(clips, found)
    write.keep(out, "results.json", tree)
    result_page.write(drawn(tree), out)
    print(out / "README.md")


def drawn(tree: Mapping[str, Any]) -> result_page.Page:
    """What `results.json` says."""
    bars, rows = [], []
    for method, by in tree["methods"].items():
        row = {"method": method}
        for name, form in (("r", "{:.3f}"), ("r2", "{:.3f}"), ("mae_mn", "{:.2f} [{:.2f}, {:.2f}]")):
            for split in _SPLITS:
                found = by[split]
                ends = found["mae_interval"] if name == "mae_mn" else ()
                text = "–" if found[name] is None else form.format(found[name], *ends)
                row[f"{_HEADS[name]}, {split}"] = text
        rows.append(row)
        for split, found in by.items():
            ends = tuple(found["mae_interval"])
            bars.append(charts.Row(f"{method}: {split}", found["mae_mn"], ends, _SPLITS[split]))
    title = "The same methods, two ways to split"
    return result_page.Page(
        "What leakage does to a score",
        tree,
        [charts.Chart(title, "mean error of the total force [mN]", tuple(bars))],
        (result_page.Section("", rows),),
        (
            "Total force from recovered flow, E known, by methods fitted on the other folds: once with "
            "single frames dealt to the folds at random, once with whole recordings (and anatomies). Only "
            "the second says what a new recording would get.",
            f"{tree['recordings']} recordings, {tree['frames']} frames, {tree['folds']} folds; intervals: "
            "95%, anatomies resampled.",
        ),
        "synth render docs/results/gap/data.yaml -o DATA; bench experiment leakage DATA",
        "README.md",
    )


def answers(
    clips: Sequence[Clip],
    fold: Sequence[NDArray[np.intp]],
    console: Console,
    fit: Callable[[Sequence[Clip], str], dict[str, baselines.Rule]] = baselines.fitted_rules,
) -> dict[str, list[Curve]]:
    """Every method's force [mN] of every frame, each asked only in the fold it wasn't fitted on.

    Args:
        clips: on the baselines' grid, with recovered flow.
        fold: for each clip (T,) the fold of its frames.
        console: told which fold is under way.
        fit: makes the methods from clips and the name of their displacement.
    """
    said: dict[str, list[Curve]] = {}
    for k in range(_FOLDS):
        console.print(f"fold {k + 1} of {_FOLDS}")
        rules = fit(
            [_frames(c, f != k) for c, f in zip(clips, fold, strict=True) if (f != k).any()], "recovered"
        )
        for name, rule in rules.items():
            curves = said.setdefault(name, [np.full(c.frames, np.nan) for c in clips])
            for curve, clip, f in zip(curves, clips, fold, strict=True):
                for t in np.flatnonzero(f == k):
                    force = rule(clip.displacement["recovered"][t], clip.mask, clip.confidence[t])
                    curve[t] = clip.young_kpa * Answer(force).size_mn
    return said


def summary(clips: Sequence[Clip], found: dict[str, dict[str, list[Curve]]]) -> dict[str, Any]:
    """r, R² and MAE over all frames, by method and split; intervals of the MAE over recordings."""
    true = [np.linalg.norm(clip.force, axis=1) for clip in clips]
    names = [str(g) for g in groups(clips)]
    methods: dict[str, Any] = {}
    for split, by_method in found.items():
        for name, curves in by_method.items():
            values = metrics.agreement(np.concatenate(true), np.concatenate(curves))
            errors = [float(np.abs(a - b).mean()) for a, b in zip(true, curves, strict=True)]
            methods.setdefault(name, {})[split] = {
                "r": round(values["r"], 4) if np.isfinite(values["r"]) else None,
                "r2": round(values["r2"], 4),
                "mae_mn": round(values["mae_mn"], 4),
                "mae_interval": [round(v, 4) for v in over_groups(errors, names, np.random.default_rng(0))],
            }
    return {
        "recordings": len(clips),
        "frames": int(sum(clip.frames for clip in clips)),
        "folds": _FOLDS,
        "machine": machine.describe(),
        "methods": methods,
    }


def _by_frame(clips: Sequence[Clip], seed: int) -> list[NDArray[np.intp]]:
    rng = np.random.default_rng(seed)
    return [rng.integers(0, _FOLDS, clip.frames) for clip in clips]


def _by_recording(clips: Sequence[Clip], seed: int) -> list[NDArray[np.intp]]:
    number = np.array(groups(clips))
    names = np.random.default_rng(seed).permutation(np.unique(number))
    fold = {int(name): k % _FOLDS for k, name in enumerate(names)}
    return [np.full(clip.frames, fold[int(g)]) for clip, g in zip(clips, number, strict=True)]


def _frames(clip: Clip, kept: NDArray[np.bool_]) -> Clip:
    """The clip with some of its frames."""
    return replace(
        clip,
        displacement={name: np.asarray(values)[kept] for name, values in clip.displacement.items()},
        confidence=np.asarray(clip.confidence)[kept],
        density=np.asarray(clip.density)[kept],
        force=np.asarray(clip.force)[kept],
    )
