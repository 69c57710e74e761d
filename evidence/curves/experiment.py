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
from evidence.study import STEREO_MOTION, Study
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


def fit_estimator(
    estimator: Estimator, fit: Sequence[Clip], select: Sequence[Clip], steps: int, work: Path
) -> Estimate:
    """An estimator fitted on `fit`: a network, in about `steps` batches and stored in `work`, with its epoch
    selected by `select`; or ridge."""
    if estimator.model == RIDGE:
        ridge = models.fit_ridge_on_components(fit, estimator.source)
        return lambda clip: ridge(clip, estimator.source)
    frames = sum(clip.frames for clip in fit)
    arch = NETWORKS[estimator.model] | {"output": "vector", "confidence": True, "relative": True}
    settings = TrainingSettings.model_validate(
        {
            "size": GRID.size,
            "arch": arch | {"depth": estimator.cameras == 2},
            "loss": "mse-frame",
            "input": estimator.source,
            "epochs": int(np.clip(round(steps * _BATCH / frames), _LEAST, _MOST)),
            "batch": _BATCH,
            "learning_rate": 2e-3,
            "schedule": "cosine",
            "seed": 0,
        }
    )
    split = Split(tuple(range(len(fit))), tuple(range(len(fit), len(fit) + len(select))), ())
    predictor = training.fit(estimator.slug, [*fit, *select], split, settings, work)
    return partial(models.read_force, predictor, source=estimator.source)


def figures(estimate: Estimate, part: Sequence[Clip], bare: Sequence[bool]) -> dict[str, Any]:
    """Errors relative to the force, means over the sequences `part` with intervals, and the gain.

    Returns:
        `whole`, `across`, `along` the line of sight, `force_size`, and of sequences without a membrane
        `bare`, each [mean, low, high] or None; of the forces' sizes the `gain` of predicted on true and the
        `slope` of true on predicted.
    """
    predicted, true = [estimate(clip) for clip in part], [clip.force for clip in part]
    sizes, true_sizes = ([np.linalg.norm(force, axis=1) for force in forces] for forces in (predicted, true))
    relative = models.errors(predicted, true)
    columns = {
        "force_size": [
            float(np.sqrt(np.square(a - b).mean() / np.square(b).mean()))
            for a, b in zip(sizes, true_sizes, strict=True)
        ],
        "whole": relative["errors"],
        "across": relative["across"],
        "along": relative["along"],
        "bare": [error for error, is_bare in zip(relative["errors"], bare, strict=True) if is_bare],
    }
    row: dict[str, Any] = {
        name: [round(value, 4) for value in mean_of(values)] if values else None
        for name, values in columns.items()
    }
    all_predicted, all_true = np.concatenate(sizes), np.concatenate(true_sizes)
    # The mean of a posterior shrinks towards zero (gain below 1) and is right on average (slope of 1): a gain
    # is a fault only where the slope differs from 1.
    cross = float(all_predicted @ all_true)
    row["gain"] = round(cross / float(all_true @ all_true), 3)
    row["slope"] = round(cross / max(float(all_predicted @ all_predicted), 1e-30), 3)
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
    size_list = [int(n) for n in sizes.split(",")]
    if max(size_list) > (remaining := len(Dataset(data)) - test - select):
        raise UserError(f"--sizes: at most {remaining}: {data} has no more after --test and --select")
    clips, *others = (load_clips(root, GRID, SOURCES.values(), cache=work / "clips") for root in datasets)
    tests: Tests = {
        name: (part, [clip.membrane != "intact" for clip in part])
        for name, part in zip([SAME, *(root.name for root in ood)], [clips[:test], *others], strict=True)
    }
    generation_s = generation_cpu_s(data)
    rows = []
    for size, model, cameras in product(size_list, (RIDGE, *NETWORKS), SOURCES):
        estimator = Estimator(model, cameras, size)
        rows += measure_estimator(estimator, clips[test:], select, tests, steps, generation_s, work)
    return {
        "data": result_status.data(*datasets),
        "generation_cpu_s": generation_s,
        "tested": {name: len(part) for name, (part, _) in tests.items()},
        "rows": rows,
    }


def measure_estimator(
    estimator: Estimator,
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
    selection = clips[: min(select, max(4, estimator.size // 5))]
    fit = clips[select : select + estimator.size]
    parts = (fit, selection, *(part for part, _ in tests.values()))
    key = result_cache.key(asdict(estimator), steps, [clip.content_hash for part in parts for clip in part])

    def compute() -> list[dict[str, Any]]:
        start = time.process_time()
        estimate = fit_estimator(estimator, fit, selection, steps, work / "networks")
        fit_s = time.process_time() - start
        hours = (fit_s + estimator.size * generation_s) / 3600
        return [
            asdict(estimator)
            | {"tested": name, "fit_cpu_s": round(fit_s, 1), "cpu_h": round(hours, 3)}
            | figures(estimate, part, bare)
            for name, (part, bare) in tests.items()
        ]

    rows: list[dict[str, Any]] = result_cache.result(work / "rows", estimator.slug, key, compute)
    return rows


def generation_cpu_s(root: Path) -> float:
    """Median CPU time of rendering a sequence [s]; the first of a process includes compilation."""
    return float(np.median([sum(sequence.stages_cpu_s.values()) for sequence in Dataset(root)]))


def page(data: Mapping[str, Any]) -> report.Page:
    """A panel for every tested dataset and number of cameras; tables with a column for every size."""
    groups = report.group_rows(data["rows"], "tested", "cameras")
    groups = dict(sorted(groups.items(), key=lambda item: (item[0][0] != SAME, *item[0])))
    last = [*groups][-1][0]
    rows = [row for (tested, _), group_rows in groups.items() if tested == last for row in group_rows]
    return report.Page(
        "Learning curves",
        data,
        (
            f"**Least error of the force: {'; '.join(starmap(_verdict, groups.items()))}.**",
            "Root mean square error relative to that of the force, mean over sequences with 95% interval. "
            f"The tables are of {last}. Generation takes {data['generation_cpu_s']:.1f} CPU-s a sequence.",
        ),
        [report.Section(heading, _table(rows, part)) for part, heading in _PARTS.items()],
        report.chart(*(partial(_draw, group=group, rows=group_rows) for group, group_rows in groups.items())),
    )


def _verdict(group: tuple[Any, ...], rows: Sequence[Mapping[str, Any]]) -> str:
    best = min(rows, key=lambda row: float(row["whole"][0]))
    error = report.percent(best["whole"])
    return f"{group[0]}, {_NAMES[group[1]]}: {error} with {best['model']} on {best['size']} sequences"


def _draw(axes: Axes, group: tuple[Any, ...], rows: Sequence[Mapping[str, Any]]) -> None:
    for (model,), model_rows in report.group_rows(rows, "model").items():
        sizes, errors = zip(*sorted((row["size"], row["whole"][0]) for row in model_rows), strict=True)
        axes.plot(sizes, errors, "-o", label=model)
    axes.set(title=f"{group[0]}, {_NAMES[group[1]]}", xlabel="fitted sequences", ylabel="error of the force")
    axes.set_ylim(0)
    report.legend(axes)


def _table(rows: Sequence[Mapping[str, Any]], part: str) -> list[dict[str, Any]]:
    return [
        {"cameras": cameras, "model": model}
        | {f"{row['size']} sequences": report.percent(row[part]) for row in group_rows}
        for (cameras, model), group_rows in report.group_rows(rows, "cameras", "model").items()
    ]


STUDY = Study(
    measure,
    "learn/curves/curves.json",
    page,
    ("{mission} {mission-ood} --work {work}/curves",),
    needs=(*STEREO_MOTION, "network"),
)
