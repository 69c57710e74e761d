"""`bench experiment second-eye`: force from one camera and from two, by baseline, resolution and cost."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from sklearn.decomposition import TruncatedSVD

from bench.methods.baselines import GRID
from bench.output import charts, result_page
from evidence import kept
from evidence.end_to_end import models
from evidence.end_to_end.pipelines import errors
from evidence.measuring import measuring
from learn.data.clips import Clip, load_clips
from learn.data.grid import Grid
from learn.data.split import Split
from learn.evaluation.statistics import interval
from learn.settings import preset, replace
from synth.dataset.store import Dataset
from synth.errors import UserError

Floats = NDArray[np.float64]
Answer = Callable[[Clip], Floats]

SOURCES = {
    "one eye, true": "ideal",
    "one eye, recovered": "recovered",
    "two eyes, true": "motion-ideal",
    "two eyes, recovered": "motion",
}
_RECOVERED = ("one eye, recovered", "two eyes, recovered")
_FOLDS = 5
_COMPONENTS = 100  # of displacement: ridge on all of it takes a hundred times as long
_NETWORK_SIZE = 64


@measuring(
    "b24-320 b24-640 b4-320 b12-320 b30-320 --epochs 40",
    out="docs/results/flow/second-eye",
    file="second-eye.json",
    page=lambda found, folder: result_page.write(drawn(found), folder),
    text="index.html",
)
def experiment(
    data: Annotated[
        list[Path],
        typer.Argument(
            help="Stereo datasets with recovered motion: one to fit on, then others of the same scenes."
        ),
    ],
    epochs: Annotated[
        int, typer.Option(min=0, help="Of a network beside ridge, trained on the first four fifths; 0: none.")
    ] = 0,
    work: Annotated[
        Path, typer.Option(help="Folder that keeps each row: an interrupted run goes on from there.")
    ] = Path("runs/second-eye"),
) -> dict[str, Any]:
    """Error of the force from one eye and from two: ridge fitted on the first dataset, asked on all."""
    sets = {root: load_clips(root, GRID, SOURCES.values(), cache=work / "clips") for root in data}
    told = sets[data[0]]
    for root, asked in sets.items():
        _check_scenes(root, asked, told)
    few = min((len(asked) for asked in list(sets.values())[1:]), default=0)
    rows: dict[str, list[dict[str, Any]]] = {"rows": [], "same_scenes": [], "networks": []}
    for way, source in SOURCES.items():
        fits = cache(partial(_folds, told, source))
        for root, asked in [(data[0], told), *((root, asked[:few]) for root, asked in sets.items() if few)]:
            found = _kept(work, [__name__, way, _words(told), _words(asked)], partial(_said, fits, asked))
            where = "rows" if asked is told else "same_scenes"
            rows[where].append(described(root, way) | figures(found, [clip.force for clip in asked]))
    for way in _RECOVERED if epochs else ():
        found = _kept(
            work, [__name__, "network", way, epochs, _words(told)], partial(_network, data[0], way, epochs)
        )
        last = told[-len(found) :]
        more = {"fitted_on": _fitted(len(told)), "epochs": epochs}
        rows["networks"].append(
            described(data[0], way) | figures(found, [clip.force for clip in last]) | more
        )
    return rows


def _kept(work: Path, said: Sequence[Any], compute: Callable[[], list[Floats]]) -> list[Floats]:
    """Answers that are computed once."""
    found = kept.result(work, "answers", kept.word(*said), lambda: [one.tolist() for one in compute()])
    return [np.array(one) for one in found]


def _words(clips: Sequence[Clip]) -> list[str]:
    return [clip.content_hash for clip in clips]


def _said(fits: Callable[[], Sequence[Answer]], asked: Sequence[Clip]) -> list[Floats]:
    return [fits()[i % len(fits())](clip) for i, clip in enumerate(asked)]


def fit_ridge(fit: Sequence[Clip], source: str) -> Answer:
    """Ridge on the principal components of displacement in eight turns; answers (T, 3) mN."""
    x, force, group = models.samples(fit, source)
    # Not centred: no motion stays zero.
    count = min(_COMPONENTS, min(x.shape) - 1)
    basis = TruncatedSVD(count, random_state=0).fit(x)
    ridge = models.fit_ridge(basis.transform(x), force, group)
    return lambda clip: clip.young_kpa * np.asarray(ridge.predict(basis.transform(models.rows(clip, source))))


def _folds(clips: Sequence[Clip], source: str) -> list[Answer]:
    """For each fold, ridge that has not seen its sequences."""
    count = min(_FOLDS, len(clips))
    return [fit_ridge([c for i, c in enumerate(clips) if i % count != k], source) for k in range(count)]


def _check_scenes(root: Path, asked: Sequence[Clip], told: Sequence[Clip]) -> None:
    """UserError if a dataset's scenes are not those of the first: a fold could have seen them."""
    for one, other in zip(asked, told, strict=False):
        if not np.allclose(one.force, other.force, rtol=1e-3, atol=1e-6):
            raise UserError(f"{root}: {one.name} is of another scene than in the first dataset")
    if len(asked) > len(told):
        raise UserError(f"{root}: has more sequences than the first dataset")


def figures(said: Sequence[Floats], true: Sequence[Floats]) -> dict[str, Any]:
    """Mean over sequences of the force's error as a part of the force, with BCa intervals; (T, 3) mN each."""
    found = errors(said, true)
    row: dict[str, Any] = {"sequences": len(true)}
    for key, name in (("errors", "whole"), ("across", "across"), ("along", "along")):
        mean = interval(np.array(found[key]), np.random.default_rng(0))
        row |= {
            name: _rounded(mean.mean),
            f"{name}_low": _rounded(mean.low),
            f"{name}_high": _rounded(mean.high),
        }
    return row


def _rounded(value: float) -> float:
    return round(float(value), 4)


def described(root: Path, way: str) -> dict[str, Any]:
    """What a dataset's rig is, and what recovering costs a frame [CPU s]."""
    dataset = Dataset(root)
    first = dataset[0]
    height, width = first.size
    render = first.attrs["right"]
    eyes = ("flow", "stereo") if way.startswith("two") else ("flow",)
    spent = [sum(one.attrs["timings"][stage]["cpu_s"] for stage in eyes) / one.frames for one in dataset]
    return {
        "way": way,
        "size": f"{width} x {height}",
        "baseline_mm": render["baseline_mm"],
        "distance_mm": round(float(np.median(first["depth"][0][first["tissue"][:]]))),
        "cost_s": _rounded(float(np.median(spent))) if way.endswith("recovered") else None,
    }


def _fitted(count: int) -> int:
    """How many are left to fit on: an eighth chooses the network's epoch, a fifth is asked."""
    return count - count // 5 - max(1, count // 8)


def _network(root: Path, way: str, epochs: int) -> list[Floats]:
    """Answers on the last fifth of the small network trained on the rest: few sequences for one."""
    from learn.inference.predict import load_predictor
    from learn.training.train import train

    source = SOURCES[way]
    clips = load_clips(root, Grid(_NETWORK_SIZE), (source,))
    n, chooser = len(clips), tuple(range(max(1, len(clips) // 8)))
    asked = tuple(range(len(chooser) + _fitted(n), n))
    base = preset("eyes-live", frames=0, schedule="cosine", batch=8)
    arch = replace(base.arch, depth=source == "motion", stem=2)
    settings = replace(base, size=_NETWORK_SIZE, arch=arch, input=source, epochs=epochs)
    folder = Path(tempfile.mkdtemp())
    try:
        train(clips, Split(tuple(range(len(chooser), asked[0])), chooser, asked), settings, folder / "model")
        predictor = load_predictor(folder / "model")
    finally:
        shutil.rmtree(folder)
    return [models.read_force(predictor, clips[i], source) for i in asked]


def drawn(found: Mapping[str, Any]) -> result_page.Page:
    """What `second-eye.json` says: one eye against two, and against baseline, resolution and cost."""
    shown = _panels(found["same_scenes"]) if found["same_scenes"] else []
    sections = [result_page.Section("Ridge, folds over sequences", found["rows"])]
    if found["same_scenes"]:
        sections.append(result_page.Section("The same scenes, seen by other rigs", found["same_scenes"]))
    if found["networks"]:
        sections.append(result_page.Section("A small network", found["networks"]))
    return result_page.Page("Force from one eye and from two", found, shown, sections)


def _panels(rows: Sequence[Mapping[str, Any]]) -> list[charts.Panel]:
    narrow = min((row["size"] for row in rows), key=lambda size: int(size.split()[0]))

    def curve(way: str, x: str, some: Sequence[Mapping[str, Any]]) -> charts.Curve:
        mine = sorted((row for row in some if row["way"] == way), key=lambda row: row[x])
        ends = tuple((row["whole_low"], row["whole_high"]) for row in mine)
        return charts.Curve(
            way, tuple(row[x] for row in mine), tuple(row["whole"] for row in mine), ends=ends
        )

    by_base = [row for row in rows if row["size"] == narrow]
    by_cost = [row for row in rows if row["cost_s"] is not None]
    return [
        charts.Panel(
            f"By baseline, {narrow}",
            "baseline [mm]",
            "error of the force",
            tuple(curve(way, "baseline_mm", by_base) for way in SOURCES),
        ),
        charts.Panel(
            "By cost, all rigs",
            "CPU s a frame",
            "error of the force",
            tuple(
                charts.Curve(
                    way,
                    tuple(row["cost_s"] for row in by_cost if row["way"] == way),
                    tuple(row["whole"] for row in by_cost if row["way"] == way),
                    labels=tuple(
                        f"{row['baseline_mm']:g} mm, {row['size']}" for row in by_cost if row["way"] == way
                    ),
                )
                for way in _RECOVERED
            ),
        ),
    ]
