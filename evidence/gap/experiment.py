"""`bench gap`: the experiment's trainings, its table, its verdict."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.bootstrap import Interval
from bench.output import charts, machine, result_page
from bench.output import write as results
from evidence.gap import gap
from evidence.gap.runs import KEYS, Tests, Training, carry_out, kept_flow, rounded, write_table
from evidence.measuring import shortened
from learn.data.clips import Clip, load_clips
from learn.data.split import Split, folds, groups, nested
from learn.evaluation.statistics import interval
from learn.settings import Settings, replace
from synth.dataset.store import Dataset
from synth.errors import UserError

Curve = NDArray[np.float64]
KINDS = ("R", "N", "mixed")
_TESTS = {
    "I": "ideal flow",
    "R": "recovered flow",
    "I'": "ideal flow, unseen family",
    "R'": "recovered flow, unseen family",
}
_UNITS = {"force_mae": "mean error of the total force [mN]", "map_rmse": "RMSE of the force map [mN/mm²]"}


def run(
    dataset: Path,
    out: Path,
    cache: Path,
    settings: Settings,
    held_out: str,
    flows: Sequence[str],
    seeds: int,
    command: str,
    say: Callable[[str], None],
    unseen: Path | None = None,
    fit: int | None = None,
) -> dict[str, Any]:
    """Trains, asks and writes runs.parquet, results.json, README.md and chart.svg.

    Args:
        dataset: rendered, with recovered flow of the back end `tvl1`, of several appearance families.
        out: folder for the results.
        cache: folder for packed sequences, trained networks and their errors.
        settings: of every training.
        held_out: family that no training sees.
        flows: back ends of the recovered flow, each a whole experiment.
        seeds: networks a training; a sequence's error is the mean over them.
        command: as typed, folders by their names, for the README.
        say: told what is under way.
        unseen: a dataset that is the unseen world instead of a family of `dataset`.
        fit: of `dataset` only so many sequences, the first ones.

    Raises:
        UserError: no such family, or data that lacks a flow.
    """
    stored = list(Dataset(dataset))[:fit]
    clips = load_clips(dataset, settings.grid, ("ideal", "recovered"), cache=cache)[:fit]
    if unseen is None:
        split, seen_test = parts(clips, held_out, settings)
    else:
        held_out = unseen.name
        others = load_clips(unseen, settings.grid, ("ideal", "recovered"), cache=cache)
        split, seen_test = beside(clips, others, settings)
        stored, clips = [*stored, *Dataset(unseen)], [*clips, *others]
    runs: dict[Training, dict[str, Any]] = {}
    for flow in flows:
        used = clips
        if flow != "tvl1":
            say(f"recovering flow with {flow}")
            used = [kept_flow(s, c, flow, settings.grid, cache) for s, c in zip(stored, clips, strict=True)]
        tests = _tests([used[i] for i in seen_test], [used[i] for i in split.test])
        for kind in ("I", *KINDS):
            for seed in range(seeds):
                training = Training(kind, flow, seed)
                runs[training] = rounded(carry_out(training, used, split, settings, tests, cache, say))
    tree = {
        "command": command,
        "machine": machine.describe(),
        "settings": settings.as_dict(),
        "held_out": held_out,
        "sequences": {
            "fit": len(split.fit),
            "select": len(split.select),
            "test": len(seen_test),
            "unseen family": len(split.test),
        },
        "seeds": seeds,
    } | compared(runs)
    write_table(runs, out / "runs.parquet")
    write(tree, out)
    return tree


def _tests(seen: Sequence[Clip], unseen: Sequence[Clip]) -> Tests:
    return {
        "I": (seen, "ideal"),
        "R": (seen, "recovered"),
        "I'": (unseen, "ideal"),
        "R'": (unseen, "recovered"),
    }


def compared(runs: Mapping[Training, Mapping[str, Any]]) -> dict[str, Any]:
    """What the trainings come to, by flow; and flows against each other."""
    by: dict[str, dict[str, list[Mapping[str, Any]]]] = {}
    for training, run in runs.items():
        by.setdefault(training.flow, {}).setdefault(training.kind, []).append(run)
    return {
        "flows": {flow: summary(trained) for flow, trained in by.items()},
        "better_flow": better_flow({flow: trained["I"] for flow, trained in by.items()}),
    }


def parts(clips: Sequence[Clip], held_out: str, settings: Settings) -> tuple[Split, tuple[int, ...]]:
    """Fit and select, with the held-out family as test; and a test of the seen families, an eighth of them.

    No two of the four share a sequence or an anatomy.
    """
    split = nested(clips, settings.folds, settings.fold, 0, held_out)
    rest = (*split.fit, *split.select)
    aside = {rest[i] for i in folds([clips[i] for i in rest], 5, 1)[0]}
    fit = tuple(i for i in split.fit if i not in aside)
    select = tuple(i for i in split.select if i not in aside)
    if not fit or not select:
        raise UserError("too few anatomies for fit, select and two tests: render more sequences")
    return Split(fit, select, split.test), tuple(sorted(aside))


def beside(
    clips: Sequence[Clip], unseen: Sequence[Clip], settings: Settings
) -> tuple[Split, tuple[int, ...]]:
    """Fit and select from `clips`, with all of `unseen`, which follow them, as test; and a test of `clips`.

    Raises:
        UserError: a sequence or an anatomy is on both sides, or too few are left.
    """
    aside = folds(clips, 5, 1)[0]
    rest = [i for i in range(len(clips)) if i not in set(aside)]
    inner = nested([clips[i] for i in rest], settings.folds, settings.fold, 0)
    fit, select = (tuple(rest[i] for i in part) for part in ((*inner.fit, *inner.test), inner.select))
    number = groups([*clips, *unseen])
    if set(number[: len(clips)]) & set(number[len(clips) :]):
        raise UserError("the dataset that is to be unseen shares an anatomy with the other")
    return Split(fit, select, tuple(range(len(clips), len(number)))), tuple(sorted(aside))


def summary(trained: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, Any]:
    """Errors with intervals, and the share of the gap each training closes, for every measure."""
    out: dict[str, Any] = {"noise": trained["N"][0]["noise"], "errors": {}, "closed": {}, "verdict": {}}
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
        apart = gap.paired(of["N"]["R'"], of["R"]["R'"], np.random.default_rng(0))
        out["verdict"][key] = gap.verdict(closed, apart)
    return out


def better_flow(untrained: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, Any]:
    """The share of OpenCV's gap that our flow closes before any retraining; empty unless both were run.

    Args:
        untrained: by flow, the results of the network trained on ideal flow.
    """
    if not {"tvl1", "opencv-tvl1"} <= set(untrained):
        return {}
    ours, plain = untrained["tvl1"], untrained["opencv-tvl1"]
    return {
        key: asdict(
            gap.closed(
                _errors(plain, "R'", key),
                _errors(ours, "R'", key),
                _errors(plain, "I'", key),
                np.random.default_rng(0),
            )
        )
        for key in KEYS
    }


def _errors(runs: Sequence[Mapping[str, Any]], test: str, key: str) -> Curve:
    """(S,) errors by sequence, the mean over seeds."""
    rows = [[math.nan if v is None else v for v in run["errors"][test][key]] for run in runs]
    return np.asarray(np.mean(rows, axis=0), np.float64)


def write(tree: dict[str, Any], out: Path) -> None:
    """results.json, README.md and chart.svg."""
    tree = shortened(_plain(tree))
    results.keep(out, "results.json", tree)
    result_page.write(drawn(tree), out)


def drawn(tree: Mapping[str, Any]) -> result_page.Page:
    """What `results.json` says."""
    bars, sections = [], []
    for group, (flow, found) in enumerate(tree["flows"].items()):
        for kind, test in (("I", "I'"), *((kind, "R'") for kind in ("I", *KINDS))):
            value = found["errors"][KEYS[0]][kind][test]
            name = f"{flow}: {kind} on {_TESTS[test].split(',')[0]}"
            bars.append(charts.Row(name, value["mean"], (value["low"], value["high"]), group))
        noise = found["noise"]
        said = (
            f"Fitted noise: gain {noise['gain']:.3f}, {noise['sigma_mm']:.3f} mm a component, "
            f"correlated over {noise['reach_cells']:.1f} cells."
        )
        sections.append(result_page.Section(f"Flow by {flow}", words=(said,)))
        for key in KEYS:
            rows = [
                {"trained on": kind}
                | {_TESTS[test]: _text((v["low"], v["high"]), v["mean"]) for test, v in tests.items()}
                | {"share of the gap closed": _closed(found["closed"][key].get(kind))}
                for kind, tests in found["errors"][key].items()
            ]
            heading = f"{flow}: {_UNITS[key]}"
            sections.append(result_page.Section(heading, rows, (found["verdict"][key],)))
    words = [
        f"Ours instead of plain OpenCV TV-L1 under the network trained on ideal flow, {_UNITS[key]}: "
        f"{better['undefined'] or _text(better['interval'], better['share'])} of OpenCV's gap closed."
        for key, better in tree["better_flow"].items()
    ]
    if words:
        sections.append(result_page.Section("A better flow, before any retraining", words=words))
    title = f"Unseen ({tree['held_out']}): trained on ... tested on ..."
    return result_page.Page(
        "The sim-to-real gap",
        tree,
        [charts.Chart(title, _UNITS[KEYS[0]], tuple(bars))],
        sections,
        (
            "Does training on the flow recovered from rendered frames close the gap that training on ideal "
            "displacement leaves? I: trained on ideal flow, R: on recovered, N: on ideal with noise fitted "
            "to the recovered flow's error, mixed: ideal first, recovered later.",
            f"{_counts(tree['sequences'])}; held out: {tree['held_out']}; {tree['seeds']} network(s) "
            "a training, errors averaged over them; 95% BCa intervals.",
        ),
        name="README.md",
    )


def _closed(found: Mapping[str, Any] | None) -> str | None:
    if found is None:
        return None
    return "undefined" if found["undefined"] else _text(found["interval"], found["share"])


def _counts(sequences: dict[str, int]) -> str:
    return ", ".join(f"{count} sequences {name}" for name, count in sequences.items())


def _text(ends: Interval, mean: float) -> str:
    return f"{mean:.3g} [{ends[0]:.3g}, {ends[1]:.3g}]"


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def settings_of(preset: str, epochs: int | None) -> Settings:
    """A preset of `learn train` for this experiment: magnitude output, all scored alike."""
    from learn.settings import preset as named

    base = named(preset)
    base = replace(base, arch=replace(base.arch, output="magnitude"))
    return base if epochs is None else replace(base, epochs=epochs)
