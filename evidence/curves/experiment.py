"""Learning curves: error of the force against fitted sequences, by model and cameras.

Every estimator is fitted on 24, 72, 144 sequences of one dataset and tested on held-out sequences of it
and on whole datasets out of distribution. Each row is stored at once: an interrupted run continues.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import product, starmap
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from evidence import report, result_cache, result_status, training
from evidence.curves import models
from evidence.paired_means import mean_of
from evidence.study import Study
from learn.data.clips import Clip, load_clips
from learn.data.grid import Grid
from learn.settings import TrainingSettings
from learn.split import Split
from synth.arrays import Floats
from synth.dataset.store import Dataset
from synth.errors import UserError

Estimate = Callable[[Clip], Floats]  # clip → force (T, 3) mN, camera axes

RIDGE = "ridge"
NETWORKS = {"d2fnet-s": {"width": 16, "stem": 4, "levels": 3, "dropout": 0.0}}
SOURCES = {1: "recovered", 2: "motion"}  # displacement for fitting and testing, by number of cameras
GRID = Grid(64)
_BATCH, _LEAST, _MOST = 16, 4, 80  # frames a batch, epochs
SAME = "in distribution"  # tested sequences of the dataset that estimators are fitted on
Tests = Mapping[str, tuple[Sequence[Clip], Sequence[bool]]]  # clips, and whether each lacks a membrane
_PARTS = {"whole": "Error of the force", "along": "Its part along the line of sight"}
_NAMES = {1: "monocular", 2: "stereo"}


@dataclass(frozen=True)
class Estimator:
    """One point of a curve."""

    model: str
    cameras: int
    size: int  # sequences fitted on

    @property
    def slug(self) -> str:
        return f"{self.model}-{self.cameras}-{self.size}"

    @property
    def source(self) -> str:
        """Name of its displacement in clips."""
        return SOURCES[self.cameras]


def fitted(one: Estimator, fit: Sequence[Clip], select: Sequence[Clip], steps: int, work: Path) -> Estimate:
    """An estimator fitted on `fit`: a network, in about `steps` batches and stored in `work`, with its epoch
    selected by `select`; or ridge."""
    if one.model == RIDGE:
        ridge = models.fit_ridge_on_components(fit, one.source)
        return lambda clip: ridge(clip, one.source)
    frames = sum(clip.frames for clip in fit)
    arch = NETWORKS[one.model] | {"output": "vector", "confidence": True, "relative": True}
    settings = TrainingSettings.model_validate(
        {
            "size": GRID.size,
            "arch": arch | {"depth": one.cameras == 2},
            "loss": "mse-frame",
            "input": one.source,
            "epochs": int(np.clip(round(steps * _BATCH / frames), _LEAST, _MOST)),
            "batch": _BATCH,
            "learning_rate": 2e-3,
            "schedule": "cosine",
            "seed": 0,
        }
    )
    split = Split(tuple(range(len(fit))), tuple(range(len(fit), len(fit) + len(select))), ())
    predictor = training.fit(one.slug, [*fit, *select], split, settings, work)
    return partial(models.read_force, predictor, source=one.source)


def figures(estimate: Estimate, part: Sequence[Clip], bare: Sequence[bool]) -> dict[str, Any]:
    """Errors relative to the force, means over the sequences `part` with intervals, and the gain.

    Returns:
        `whole`, `across`, `along` the line of sight, `force_size`, and of sequences without a membrane
        `bare`, each [mean, low, high] or None; of the forces' sizes the `gain` of predicted on true and the
        `slope` of true on predicted.
    """
    predicted, true = [estimate(clip) for clip in part], [clip.force for clip in part]
    sizes, own = ([np.linalg.norm(force, axis=1) for force in forces] for forces in (predicted, true))
    off = models.errors(predicted, true)
    found = {
        "force_size": [
            float(np.sqrt(np.square(a - b).mean() / np.square(b).mean()))
            for a, b in zip(sizes, own, strict=True)
        ],
        "whole": off["errors"],
        "across": off["across"],
        "along": off["along"],
        "bare": [e for e, alone in zip(off["errors"], bare, strict=True) if alone],
    }
    row: dict[str, Any] = {
        name: [round(value, 4) for value in mean_of(values)] if values else None
        for name, values in found.items()
    }
    all_predicted, all_true = np.concatenate(sizes), np.concatenate(own)
    # The mean of a posterior shrinks towards zero (gain below 1) and is right on average (slope of 1): a gain
    # is a fault only where the slope differs from 1.
    both = float(all_predicted @ all_true)
    row["gain"] = round(both / float(all_true @ all_true), 3)
    row["slope"] = round(both / max(float(all_predicted @ all_predicted), 1e-30), 3)
    return row


def measure(
    datasets: list[Path],
    sizes: str = "24,72,144",
    steps: int = 4000,
    test: int = 56,
    select: int = 40,
    work: Path = Path("runs/curves"),
) -> dict[str, Any]:
    """Error of the force against fitted sequences, by model and cameras.

    `datasets`: the first one's sequences test, select an epoch and are fitted on, in this order, so that
    tested ones stay the same as it grows; the others are only tested on. `sizes`: comma-separated; `steps`:
    approximate number of training batches; `work`: folder of packed sequences, networks and rows.
    """
    data, *ood = datasets
    numbers = [int(n) for n in sizes.split(",")]
    if max(numbers) > (left := len(Dataset(data)) - test - select):
        raise UserError(f"--sizes: at most {left}: {data} has no more after --test and --select")
    clips, *others = (load_clips(root, GRID, SOURCES.values(), cache=work / "clips") for root in datasets)
    tests: Tests = {
        name: (part, [clip.membrane != "intact" for clip in part])
        for name, part in zip([SAME, *(root.name for root in ood)], [clips[:test], *others], strict=True)
    }
    spent = generation_cpu_s(data)
    rows = []
    for size, model, cameras in product(numbers, (RIDGE, *NETWORKS), SOURCES):
        one = Estimator(model, cameras, size)
        rows += measure_estimator(one, clips[test:], select, tests, steps, spent, work)
    return {
        "data": result_status.data(*datasets),
        "generation_cpu_s": spent,
        "tested": {name: len(part) for name, (part, _) in tests.items()},
        "rows": rows,
    }


def measure_estimator(
    one: Estimator,
    clips: Sequence[Clip],
    select: int,
    tests: Tests,
    steps: int,
    generation_s: float,
    work: Path,
) -> list[dict[str, Any]]:
    """Errors of an estimator, one row for each test, cached.

    `clips`: the first `select` may select an epoch, the others are fitted on; `generation_s`: CPU time of
    rendering a sequence.
    """
    chosen, fit = clips[: min(select, max(4, one.size // 5))], clips[select : select + one.size]
    parts = (fit, chosen, *(part for part, _ in tests.values()))
    key = result_cache.key(asdict(one), steps, [clip.content_hash for part in parts for clip in part])

    def compute() -> list[dict[str, Any]]:
        began = time.process_time()
        estimate = fitted(one, fit, chosen, steps, work / "networks")
        spent = time.process_time() - began
        hours = (spent + one.size * generation_s) / 3600
        return [
            asdict(one)
            | {"tested": name, "fit_cpu_s": round(spent, 1), "cpu_h": round(hours, 3)}
            | figures(estimate, part, bare)
            for name, (part, bare) in tests.items()
        ]

    found: list[dict[str, Any]] = result_cache.result(work / "rows", one.slug, key, compute)
    return found


def generation_cpu_s(root: Path) -> float:
    """Median CPU time of rendering a sequence [s]; the first of a process includes compilation."""
    return float(np.median([sum(one.stages_cpu_s.values()) for one in Dataset(root)]))


def page(found: Mapping[str, Any]) -> report.Page:
    """A panel for every tested dataset and number of cameras; tables with a column for every size."""
    groups = report.grouped(found["rows"], "tested", "cameras")
    groups = dict(sorted(groups.items(), key=lambda one: (one[0][0] != SAME, *one[0])))
    last = [*groups][-1][0]
    rows = [row for (tested, _), own in groups.items() if tested == last for row in own]
    return report.Page(
        "Learning curves",
        found,
        (
            f"**Least error of the force: {'; '.join(starmap(_verdict, groups.items()))}.**",
            "Root mean square error relative to that of the force, mean over sequences with 95% interval. "
            f"The tables are of {last}. Generation takes {found['generation_cpu_s']:.1f} CPU-s a sequence.",
        ),
        [report.Section(heading, _table(rows, part)) for part, heading in _PARTS.items()],
        report.chart(*(partial(_draw, group=group, rows=own) for group, own in groups.items())),
    )


def _verdict(group: tuple[Any, ...], rows: Sequence[Mapping[str, Any]]) -> str:
    best = min(rows, key=lambda row: float(row["whole"][0]))
    error = report.percent(best["whole"])
    return f"{group[0]}, {_NAMES[group[1]]}: {error} with {best['model']} on {best['size']} sequences"


def _draw(axes: Axes, group: tuple[Any, ...], rows: Sequence[Mapping[str, Any]]) -> None:
    for (model,), own in report.grouped(rows, "model").items():
        sizes, errors = zip(*sorted((row["size"], row["whole"][0]) for row in own), strict=True)
        axes.plot(sizes, errors, "-o", label=model)
    axes.set(title=f"{group[0]}, {_NAMES[group[1]]}", xlabel="fitted sequences", ylabel="error of the force")
    axes.set_ylim(0)
    report.legend(axes)


def _table(rows: Sequence[Mapping[str, Any]], part: str) -> list[dict[str, Any]]:
    return [
        {"cameras": cameras, "model": model}
        | {f"{row['size']} sequences": report.percent(row[part]) for row in own}
        for (cameras, model), own in report.grouped(rows, "cameras", "model").items()
    ]


STUDY = Study(
    measure,
    "learn/curves/curves.json",
    page,
    ("{mission} {mission-ood} --work {work}/curves",),
    needs=("mesh", "mechanics", "picture", "truth", "flow", "stereo", "network"),
)
