"""`bench stability learn`: where training diverges, what bad data costs, and that bad input says so."""

from __future__ import annotations

import json as json_
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console

from bench.output import charts, result_page
from bench.output.machine import describe
from bench.output.write import keep
from evidence.learn import corruptions as disturb
from evidence.learn.bad_input import bad_inputs
from evidence.learn.experiment import RESULTS, ideal_runs, small
from evidence.learn.labels import clips as labels
from evidence.learn.runs import model_folder
from evidence.measuring import measuring
from learn.data.clips import Clip
from learn.data.grid import Grid
from learn.data.split import Split, nested
from learn.evaluation.evaluate import Report, evaluate
from learn.inference.predict import Predictor, load_predictor
from learn.loss import GHOSTLESS
from learn.settings import Settings, replace
from learn.training.threads import set_threads
from learn.training.train import train
from synth.errors import UserError
from synth.job import reader
from synth.job.schema import Job

RATES = (5e-4, 2e-3, 1e-2, 5e-2)
WEIGHTS = ((0.0, 0.0), (0.5, 0.0), (0.5, 8.0))
"""Share of the R² term and price of force off contact: the first is MSE, the last `ghostless`."""
LABEL_NOISE = (0.0, 0.1, 0.3)
FLOW_NOISE = ((0.005, 0.0), (0.02, 0.0), (0.005, 1.0), (0.02, 1.0), (0.05, 1.0))
"""Size [mm] and blob scale [mm]."""
UNSEEN = ("grasp", "retract")
PAIRS = 20
"""Sequences with two instruments at once."""

Say = Callable[[str], None]
Row = dict[str, Any]


@measuring("--cache cache --seeds 2")
def stability(
    cache: Annotated[Path, typer.Option(help="Folder for packed sequences and trained models; made once.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for results.")] = RESULTS / "stability",
    seeds: Annotated[int, typer.Option(min=1, help="Seeds of each learning rate and loss weight.")] = 5,
    only: Annotated[str, typer.Option(help="Only the part of this name.")] = "",
    json: Annotated[bool, typer.Option("--json", help="Print JSON on stdout.")] = False,
) -> None:
    """Learning rates × loss weights × seeds, noise, wrong E and scale, unseen gestures, bad input."""
    set_threads(1)
    say = Console(stderr=True).print
    out.mkdir(parents=True, exist_ok=True)
    job, grid = reader.load_job(str(RESULTS / "data/labels.yaml")), Grid(small().size)
    clips = labels(job, grid, cache)
    study = {run.name: run for run in ideal_runs()}
    trained = {n: model_folder(study[f"{n}-fold0-seed0"], clips, cache) for n in ("mse", "ghostless")}
    split = nested(clips, 3, 0, 0)
    folder = cache / "models/stability"
    parts: dict[str, Callable[[], list[Row]]] = {
        "rates": lambda: _rates(clips, split, folder, seeds, say),
        "labels": lambda: _label_noise(clips, split, folder, say),
        "gestures": lambda: _gestures(clips, split, folder),
        "contacts": lambda: _contacts(clips, split, labels(_two(job), grid, cache), trained),
        "confidence": lambda: _confidence(clips, split, folder),
        "shown": lambda: [r for n, m in trained.items() for r in _shown(clips, split, n, m)],
        "bad-input": lambda: bad_inputs(trained["mse"], folder / "bad"),
    }
    if only and only not in parts:
        raise UserError(f"unknown part {only!r}: one of {', '.join(parts)}")
    for name, part in parts.items():
        file = out / f"{name}.json"
        if (not only or name == only) and not file.is_file():
            keep(out, file.name, {"machine": describe(), "rows": part()})
            say(f"{name}: done")
    result_page.write(drawn(out), out)
    if json:
        print(json_.dumps({n: f["rows"] for n, f in _found(out).items()}))
    else:
        Console().print(f"{out / 'README.md'}")


def drawn(out: Path) -> result_page.Page:
    """What the parts in `out` say, and how much R² of the map each disturbance leaves."""
    found, shown = _found(out), []
    for name, one in found.items():
        rows = [row for row in one["rows"] if row.get("map R²") is not None]
        values = {
            ", ".join(f"{said}{row[k]}" for k, said in _SAID.items() if k in row): row["map R²"]
            for row in rows
        }
        if values:
            shown.append(
                charts.Chart(
                    _TITLES[name], "R² of the map, pooled over tested sequences", charts.bars(values)
                )
            )
    return result_page.Page(
        "Learn: where it breaks",
        next(iter(found.values())),
        shown,
        [result_page.Section(_TITLES[name], one["rows"]) for name, one in found.items()],
        (_HOW,),
        "bench stability learn --cache CACHE",
        "README.md",
    )


def _found(out: Path) -> dict[str, Any]:
    return {n: json_.loads((out / f"{n}.json").read_text()) for n in _TITLES if (out / f"{n}.json").is_file()}


_SAID = dict.fromkeys(("trained with", "contacts", "gesture", "shown", "trained"), "") | {
    "confidence": "confidence: ",
    "s": "s = ",
}
"""What names a row, and what is said before it."""
_HOW = (
    "On the sequences of `../data/labels.yaml`, fold 0 of 3 on a 64² grid, one thread. Learning rates and "
    "label noise with a network of width 8 and stem 4 (two and four epochs a run), gestures and confidence "
    "with the study's network at half its epochs, the others with the study's `mse-fold0-seed0` and "
    "`ghostless-fold0-seed0`. R² is pooled over frames (force) or cells (map) of the tested sequences."
)
_TITLES = {
    "rates": "Learning rate × loss weights, over seeds",
    "labels": "Labels off by a factor exp(N(0, s)), one draw a fitted sequence",
    "gestures": "Gestures never seen in training",
    "contacts": "Two instruments at once, for networks that have seen one",
    "confidence": "Flow that fails over a fifth of the picture, with and without its confidence",
    "shown": "What a trained network is shown at test time",
    "bad-input": "Bad input, and the one line it gets",
}


def _tiny(**changes: Any) -> Settings:
    base = replace(small(), epochs=2, **changes)
    return replace(base, arch=replace(base.arch, width=8, stem=4, levels=2))


def _fit(clips: Sequence[Clip], split: Split, settings: Settings, folder: Path) -> Predictor:
    train(clips, split, settings, folder)
    return load_predictor(folder)


def _numbers(report: Report, young: str = "known") -> Row:
    s = report.summary(young)
    return {
        "map R²": round(s["map_r2_pooled"], 3),
        "force R²": round(s["force_r2_pooled"], 3),
        "force bias [mN]": round(s["force_bias"], 3),
        "force MAE [mN]": round(s["force_mae"], 3),
        "off contact [mN]": round(s["stray_mn"], 4),
        "ghost area": round(s["ghost_relative"], 5),
    }


def _rates(clips: list[Clip], split: Split, folder: Path, seeds: int, say: Say) -> list[Row]:
    """A run diverges where training stops itself, or ends no better than saying the mean."""
    rows = []
    for rate in RATES:
        for share, stray in WEIGHTS:
            scores, lost = [], 0
            for seed in range(seeds):
                objective = replace(GHOSTLESS, r2_weight=share, stray_weight=stray)
                settings = _tiny(learning_rate=rate, objective=objective, seed=seed)
                named = folder / f"rate{rate:g}-r2{share:g}-price{stray:g}-{seed}"
                try:
                    card = train(clips, split, settings, named)
                    scores.append(card.score)
                    lost += not card.score > 0
                except UserError as stopped:
                    say(str(stopped))
                    lost += 1
            rows.append(
                {
                    "learning rate": rate,
                    "share of R²": share,
                    "price": stray,
                    "seeds": seeds,
                    "diverged": lost,
                    "select R², mean": round(float(np.mean(scores)), 3) if scores else None,
                    "spread (sd)": round(float(np.std(scores, ddof=1)), 3) if len(scores) > 1 else None,
                }
            )
            say(str(rows[-1]))
    return rows


def _label_noise(clips: list[Clip], split: Split, folder: Path, say: Say) -> list[Row]:
    rows = []
    for sigma in LABEL_NOISE:
        rng, used = np.random.default_rng(1), list(clips)
        for i in split.fit:
            used[i] = disturb.mislabelled(clips[i], sigma, rng)
        model = _fit(used, split, replace(_tiny(), epochs=4), folder / f"labels{sigma:g}")
        rows.append({"s": sigma} | _numbers(evaluate(model, [clips[i] for i in split.test], "ideal")))
        say(str(rows[-1]))
    return rows


def _gestures(clips: list[Clip], split: Split, folder: Path) -> list[Row]:
    seen = {
        side: tuple(i for i in getattr(split, side) if clips[i].gesture not in UNSEEN)
        for side in ("fit", "select")
    }
    without = Split(seen["fit"], seen["select"], split.test)
    models = {
        "seen": _fit(clips, split, replace(small(), epochs=4), folder / "seen"),
        f"without {', '.join(UNSEEN)}": _fit(clips, without, replace(small(), epochs=4), folder / "unseen"),
    }
    rows = []
    for gesture in sorted({c.gesture for c in clips}):
        asked = [clips[i] for i in split.test if clips[i].gesture == gesture]
        for name, model in models.items():
            rows.append(
                {"gesture": gesture, "sequences": len(asked), "trained": name}
                | _numbers(evaluate(model, asked, "ideal"))
            )
    return rows


def _two(job: Job) -> Job:
    """The study's sequences with two instruments each, on anatomies of their own."""
    fem = job.fem.model_copy(update={"instruments": (2, 2)})
    return job.model_copy(update={"fem": fem, "sequences": PAIRS, "seed": job.seed + 1})


def _contacts(clips: list[Clip], split: Split, two: list[Clip], trained: dict[str, Path]) -> list[Row]:
    test = [clips[i] for i in split.test]
    plain = [c for c in test if c.gesture in ("pull", "push", "tap")]
    pairs = [disturb.both(a, b) for a, b in zip(plain[0::2], plain[1::2], strict=False)]
    cases = {"one": test, "two, superposed": pairs, "two, simulated together": two}
    return [
        {"contacts": case, "sequences": len(asked), "trained with": name}
        | _numbers(evaluate(load_predictor(model), asked, "ideal"))
        for case, asked in cases.items()
        for name, model in trained.items()
    ]


def _confidence(clips: list[Clip], split: Split, folder: Path) -> list[Row]:
    rng, grid = np.random.default_rng(2), Grid(small().size)
    torn = [disturb.hidden(c, 0.05, 0.2, grid, rng) for c in clips]
    rows = []
    for channel in (False, True):
        base = replace(small(), epochs=4, input="recovered")
        settings = replace(base, arch=replace(base.arch, confidence=channel))
        model = _fit(torn, split, settings, folder / f"confidence-{channel}")
        test = [torn[i] for i in split.test]
        cases = (
            {"given": test, "missing": [disturb.unsure(c) for c in test]} if channel else {"no channel": test}
        )
        for name, asked in cases.items():
            rows.append({"confidence": name} | _numbers(evaluate(model, asked, "recovered")))
    return rows


def _shown(clips: list[Clip], split: Split, name: str, model: Path) -> list[Row]:
    predictor, grid, rng = load_predictor(model), Grid(small().size), np.random.default_rng(3)
    test = [clips[i] for i in split.test]
    plain = evaluate(predictor, test, "ideal")
    rows: list[Row] = [{"shown": "as it is"} | _numbers(plain)]
    for young, text in (("half", "E taken ×½"), ("double", "E taken ×2"), ("unknown", "E unknown")):
        rows.append({"shown": text} | _numbers(plain, young))
    for sigma, patch in FLOW_NOISE:
        asked = [disturb.noisy(c, sigma, patch, grid, rng) for c in test]
        what = f"noise {sigma:g} mm, {f'{patch:g} mm blobs' if patch else 'cell by cell'}"
        rows.append({"shown": what} | _numbers(evaluate(predictor, asked, "ideal")))
    for factor in (0.8, 1.2):
        found = _numbers(evaluate(predictor, [disturb.scaled(c, factor) for c in test], "ideal"))
        # The map has moved against its truth: only the total can be compared.
        rows.append(
            {"shown": f"mm/px taken ×{factor:g}"}
            | found
            | {"map R²": None, "off contact [mN]": None, "ghost area": None}
        )
    rows.append({"shown": "nothing moves"} | _still(predictor, [disturb.still(c) for c in test]))
    jitter = [disturb.noisy(disturb.still(c), 0.005, 1.0, grid, rng) for c in test]
    rows.append({"shown": "nothing moves, noise 0.005 mm, 1 mm blobs"} | _still(predictor, jitter))
    return [{"trained with": name} | row for row in rows]


def _still(predictor: Predictor, clips: Sequence[Clip]) -> Row:
    """R² has no meaning where the truth is nothing."""
    return _numbers(evaluate(predictor, clips, "ideal")) | {"map R²": None, "force R²": None}
