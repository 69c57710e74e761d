"""Share of the sim-to-real gap closed by training on recovered flow, and by training with fitted noise.

Four trainings on one split: ideal flow (I), recovered flow (R), ideal flow plus noise fitted to the recovered
flow's error (N), and a mixture. Each is tested on ideal and on recovered flow, in distribution and out of
distribution (').

Run: python -m evidence.gap.experiment DATASET --unseen OTHER --work runs/gap
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from evidence import report, status
from evidence.folds import folds, nested
from evidence.gap import gap
from evidence.gap.runs import KEYS, Training, carry_out, with_flow
from learn.data.clips import Clip, load_clips
from learn.evaluation.statistics import interval, paired
from learn.settings import preset, replace
from learn.split import Split, groups
from learn.training.threads import set_threads
from synth.dataset.store import Dataset
from synth.errors import UserError

Curve = NDArray[np.float64]
KINDS = ("R", "N", "mixed")
_TESTS = {
    "I": "ideal flow",
    "R": "recovered flow",
    "I'": "ideal flow, out of distribution",
    "R'": "recovered flow, out of distribution",
}
_UNIT = "mean error of the total force [mN]"


def main(
    dataset: Annotated[Path, typer.Argument(help="Dataset with recovered flow of the back end tvl1.")],
    unseen: Annotated[Path, typer.Option(help="Dataset out of distribution, only tested on.")],
    work: Annotated[Path, typer.Option(help="Folder for packed sequences, networks and errors.")],
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = report.RESULTS / "gap",
    fit: Annotated[int | None, typer.Option(min=20, help="Use only so many sequences of `dataset`.")] = None,
    flow: Annotated[list[str] | None, typer.Option(help="Back ends of the recovered flow.")] = None,
    named: Annotated[str, typer.Option("--preset", help="Preset of `learn train`.")] = "tiny",
    epochs: Annotated[int | None, typer.Option(min=1, help="Epochs; the preset's if not given.")] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Networks a training.")] = 2,
) -> None:
    """Share of the sim-to-real gap closed by training on recovered flow, and by fitted noise."""
    set_threads(1)
    settings = preset(named)
    settings = replace(
        settings,
        arch=replace(settings.arch, output="magnitude"),  # the same metrics for all
        epochs=epochs or settings.epochs,
    )
    known = load_clips(dataset, settings.grid, ("ideal", "recovered"), cache=work)[:fit]
    others = load_clips(unseen, settings.grid, ("ideal", "recovered"), cache=work)
    split, own_test = parts(known, others)
    stored, clips = [*list(Dataset(dataset))[:fit], *Dataset(unseen)], [*known, *others]
    runs: dict[Training, dict[str, Any]] = {}
    for backend in flow or ["tvl1", "opencv-tvl1"]:
        used = clips
        if backend != "tvl1":
            pairs = zip(stored, clips, strict=True)
            used = [with_flow(s, c, backend, settings.grid, work) for s, c in pairs]
        ours, theirs = [used[i] for i in own_test], [used[i] for i in split.test]
        tests = {
            "I": (ours, "ideal"),
            "R": (ours, "recovered"),
            "I'": (theirs, "ideal"),
            "R'": (theirs, "recovered"),
        }
        for kind in ("I", *KINDS):
            for seed in range(seeds):
                one = Training(kind, backend, seed)
                typer.echo(f"{kind}, {backend}, seed {seed}", err=True)
                runs[one] = carry_out(one, used, split, settings, tests, work)
    sizes = (split.fit, split.select, own_test, split.test)
    found: dict[str, Any] = {
        "data": status.data(dataset, unseen),
        "settings": settings.model_dump(),
        "held_out": unseen.name,
        "sequences": dict(zip(("fit", "select", "test", "unseen"), map(len, sizes), strict=True)),
        "seeds": seeds,
        "flows": compared(runs),
    }
    shown = {flow: _verdict(one) for flow, one in found["flows"].items()}
    report.publish(out, "results.json", found, page, shown)


def compared(runs: Mapping[Training, Mapping[str, Any]]) -> dict[str, Any]:
    """Errors and shares of the gap of all trainings, by flow estimator."""
    by: dict[str, dict[str, list[Mapping[str, Any]]]] = {}
    for training, run in runs.items():
        by.setdefault(training.flow, {}).setdefault(training.kind, []).append(run)
    return {flow: _plain(summary(trained)) for flow, trained in by.items()}


def parts(clips: Sequence[Clip], unseen: Sequence[Clip]) -> tuple[Split, tuple[int, ...]]:
    """Split with fit and select from `clips` and `unseen`, which follow them, as test; and a test of `clips`.

    Raises:
        UserError: an anatomy is in both datasets, or too few sequences are left.
    """
    aside = folds(clips, 5, 1)[0]
    rest = [i for i in range(len(clips)) if i not in set(aside)]
    inner = nested([clips[i] for i in rest], 5, 0, 0)
    fit, select = (tuple(rest[i] for i in part) for part in ((*inner.fit, *inner.test), inner.select))
    number = groups([*clips, *unseen])
    if set(number[: len(clips)]) & set(number[len(clips) :]):
        raise UserError("--unseen: shares an anatomy with the other dataset")
    return Split(fit, select, tuple(range(len(clips), len(number)))), tuple(sorted(aside))


def summary(trained: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, Any]:
    """Errors with intervals, and the share of the gap closed by each training, for every metric."""
    out: dict[str, Any] = {
        "noise": trained["N"][0]["noise"],
        "errors": {},
        "closed": {},
        "noise_less_real": {},
    }
    for key in KEYS:
        of = {kind: {test: _errors(runs, test, key) for test in _TESTS} for kind, runs in trained.items()}
        out["errors"][key] = {
            kind: {test: asdict(interval(values, np.random.default_rng(0))) for test, values in tests.items()}
            for kind, tests in of.items()
        }
        closed = {
            kind: gap.closed(of["I"]["R'"], of[kind]["R'"], of["I"]["I'"], np.random.default_rng(0))
            for kind in KINDS
        }
        out["closed"][key] = {kind: asdict(value) for kind, value in closed.items()}
        more = paired(of["R"]["R'"], of["N"]["R'"], np.random.default_rng(0)).difference
        out["noise_less_real"][key] = (more.low, more.high)
    return out


def _errors(runs: Sequence[Mapping[str, Any]], test: str, key: str) -> Curve:
    """Errors by sequence (S,), means over seeds."""
    rows = [[math.nan if v is None else v for v in run["errors"][test][key]] for run in runs]
    return np.asarray(np.mean(rows, axis=0), np.float64)


def page(found: Mapping[str, Any]) -> report.Page:
    """Errors of the trainings on the flow of recordings, and the tables."""
    bars, sections = [], []
    for group, (flow, one) in enumerate(found["flows"].items()):
        for kind, test in (("I", "I'"), *((kind, "R'") for kind in ("I", *KINDS))):
            value = one["errors"][KEYS[0]][kind][test]
            name = f"{flow}: {kind} on {_TESTS[test].split(',')[0]}"
            bars.append(report.Row(name, value["mean"], (value["low"], value["high"]), group))
        rows = [
            {"trained on": kind}
            | {
                _TESTS[test]: report.mean_cell([v[key] for key in ("mean", "low", "high")])
                for test, v in tests.items()
            }
            | {"share of the gap closed": _closed(one["closed"][KEYS[0]].get(kind))}
            for kind, tests in one["errors"][KEYS[0]].items()
        ]
        sections.append(report.Section(f"{flow}: {_UNIT}", rows))
    return report.Page(
        "Sim-to-real gap: training on recovered flow",
        found,
        [report.Chart(f"Out of distribution ({found['held_out']})", _UNIT, tuple(bars))],
        sections,
        (
            *(f"**Flow by {flow}: {_verdict(one)}**" for flow, one in found["flows"].items()),
            "Gap: error on recovered flow less error on ideal flow, out of distribution, after training on "
            "ideal flow. I: trained on ideal flow, R: on recovered, N: on ideal with noise fitted to the "
            "recovered flow's error, mixed: ideal first, recovered later (as stereo presets are). "
            f"Sequences: {', '.join(f'{n} {name}' for name, n in found['sequences'].items())}; "
            f"networks a training: {found['seeds']}; 95% BCa intervals.",
        ),
    )


def _verdict(found: Mapping[str, Any]) -> str:
    """Result of the first metric, for one flow estimator."""
    closed, (low, high) = found["closed"][KEYS[0]], found["noise_less_real"][KEYS[0]]
    return (
        f"training on recovered flow closes {_closed(closed['R'])} of the gap, with fitted noise "
        f"{_closed(closed['N'])}; the error with noise less that with recovered flow is {low:.3g} to "
        f"{high:.3g} mN."
    )


def _closed(found: Mapping[str, Any] | None) -> str | None:
    if found is None:
        return None
    if found["undefined"]:
        return "undefined"
    return report.percent([found["share"], *found["interval"]])


def _plain(value: Any) -> Any:
    """The value with None for NaN, which strict JSON parsers reject."""
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


if __name__ == "__main__":
    typer.run(main)
