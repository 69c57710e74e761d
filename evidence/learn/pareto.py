"""Time and error of networks: each preset's and others on the same grid.

Without --dataset only times.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes

from evidence import report, result_status
from evidence.learn.runs import base_settings, by_sequence, carry_out
from evidence.paired_means import difference, mean_of
from evidence.study import Study
from learn.checkpoint import ModelCard
from learn.data.clips import load_clips
from learn.data.grid import Grid, Scales
from learn.inference.convert import examples, to_onnx
from learn.inference.predict import input_names
from learn.network.registry import build
from learn.network.shape import Architecture, Shape
from learn.settings import PRESETS, TrainingSettings, replace
from synth.flow.onnx_network import open_network

OTHERS: Mapping[str, tuple[tuple[int, int, int], ...]] = {
    "live": ((16, 4, 3), (8, 4, 4), (12, 4, 4), (16, 4, 4)),
    "cpu": ((16, 2, 4), (16, 4, 4), (16, 4, 3), (8, 2, 4), (8, 4, 4)),
    "tiny": ((16, 2, 3), (8, 2, 3), (16, 4, 2)),
}
"""Width, stem and levels of networks that cost about as much as a preset's or less, and of the preset's."""
HEAVY: tuple[tuple[int, int, int, int], ...] = (
    (256, 32, 4, 4), (256, 16, 2, 4), (256, 16, 1, 4), (256, 32, 1, 4), (128, 32, 4, 4), (128, 32, 1, 4),
)  # fmt: skip
"""Grid, width, stem and levels of networks that are only timed, including the published one."""
ROUNDS = 4  # of timing all networks in turn


def measure(
    dataset: Path | None = None, cache: Path = Path("runs/networks"), repeats: int = 60, seeds: int = 1
) -> dict[str, Any]:
    """Errors of networks trained in equal steps, and the time of one frame on one core."""
    shapes = [(PRESETS[name].size, *shape) for name, group in OTHERS.items() for shape in group]
    by_shape = {} if dataset is None else errors(dataset, cache, seeds)
    rows = time_networks([*shapes, *HEAVY], repeats)
    return {
        "torch": torch.__version__,
        "data": result_status.data(*filter(None, [dataset])),
        "trained": {name: PRESETS[name].loss for name in OTHERS if by_shape},
        "rows": [row | by_shape.get(key(row), {}) for row in rows],
    }


def errors(dataset: Path, cache: Path, seeds: int) -> dict[tuple[int, ...], dict[str, Any]]:
    """Errors of `OTHERS`, trained with the loss and dropout of their preset, else as `base_settings`, fold 0.

    Returns:
        By grid, width, stem and levels: `map_rmse` [mN/mm²], mean over sequences with its interval, and
        `against`, its difference from the preset's, relative.
    """
    by_shape = {}
    for name, group in OTHERS.items():
        preset = PRESETS[name]
        clips = load_clips(dataset, Grid(preset.size), ("ideal",), cache=cache)
        common = replace(base_settings(), size=preset.size, loss=preset.loss)
        runs: dict[tuple[int, ...], list[dict[str, Any]]] = {}
        for shape, seed in product(group, range(seeds)):
            width, stem, levels = shape
            dropout = preset.arch.model_dump()["dropout"]
            arch = {"width": width, "stem": stem, "levels": levels, "dropout": dropout}
            settings = replace(common, arch=replace(common.arch, **arch), seed=seed)
            title = f"{preset.size}-w{width}-stem{stem}-depth{levels}-seed{seed}"
            runs.setdefault(shape, []).append(carry_out(title, settings, clips, cache))
        base = by_sequence(runs[_shape(preset.arch)], "map_rmse")
        for network, network_runs in runs.items():
            rmse = by_sequence(network_runs, "map_rmse")
            against = [value / float(base.mean()) for value in difference(base, rmse)]
            by_shape[(preset.size, *network)] = {"map_rmse": mean_of(rmse), "against": against}
    return by_shape


def key(row: Mapping[str, Any]) -> tuple[int, int, int, int]:
    """Grid, width, stem and levels of a row's network."""
    return row["size"], row["width"], row["stem"], row["levels"]


def preset_of(row: Mapping[str, Any]) -> str:
    """Names of the monocular presets with a row's network."""
    monocular = {
        name: preset for name, preset in PRESETS.items() if _shape(preset.arch) and not preset.arch.depth
    }
    return ", ".join(
        name for name, preset in monocular.items() if key(row) == (preset.size, *_shape(preset.arch))
    )


def _shape(arch: Shape) -> tuple[int, ...]:
    """Width, stem and levels; empty for another kind of network."""
    return (arch.width, arch.stem, arch.levels) if isinstance(arch, Architecture) else ()


def time_networks(shapes: Sequence[tuple[int, int, int, int]], repeats: int) -> list[dict[str, Any]]:
    """CPU time of one frame from displacement on the grid to the force map on it, by ONNX Runtime.

    Networks of `HEAVY` are timed at least five times, others `repeats` times, all of them in turn, so that
    variations of the machine's speed affect all alike.
    """
    archs = [(size, Architecture(width=w, stem=s, levels=n)) for size, w, s, n in shapes]  # type: ignore[arg-type]
    frames = [_frame(arch, size) for size, arch in archs]
    times: list[list[float]] = [[] for _ in shapes]
    for _ in range(ROUNDS):
        for shape, frame, samples in zip(shapes, frames, times, strict=True):
            samples += _time(frame, -(-(5 if shape in HEAVY else repeats) // ROUNDS))
    return [
        {
            "size": size,
            "width": arch.width,
            "stem": arch.stem,
            "levels": arch.levels,
            "parameters": sum(p.numel() for p in build("d2fnet", arch).parameters()),
            "ms_p50": float(np.median(samples)),
        }
        for (size, arch), samples in zip(archs, times, strict=True)
    ]


def _frame(arch: Architecture, size: int) -> Callable[[], object]:
    """A function that processes one frame as in live use, prepared."""
    torch.manual_seed(0)
    scales = Scales(0.2, 0.03, 0.07, 2.0, 0.003)
    card = ModelCard(TrainingSettings(size=size, arch=arch), scales, 1.0, {}, {})
    session = open_network(to_onnx(build("d2fnet", arch).eval(), card)[0], "network")
    planes = dict(zip(input_names(card), (values.numpy() for values in examples(card, 1)), strict=True))
    return lambda: session.run(None, planes)


def _time(frame: Callable[[], object], repeats: int) -> Iterator[float]:
    """CPU milliseconds of every frame after three for warm-up."""
    for k in range(3 + repeats):
        start = time.process_time()
        frame()
        if k >= 3:
            yield 1e3 * (time.process_time() - start)


def page(data: Mapping[str, Any]) -> report.Page:
    """Pareto fronts, one for each grid, and the table."""
    rows = data["rows"]
    chart = (
        report.chart(*(partial(_draw, name=name, rows=rows) for name in OTHERS)) if data["trained"] else ""
    )
    table = [
        {"network": f"w{row['width']} stem{row['stem']} depth{row['levels']} {row['size']}²"}
        | {"preset": preset_of(row) or None, "parameters [M]": row["parameters"] / 1e6}
        | {"p50 [ms]": row["ms_p50"]}
        | {"map RMSE [mN/mm²]": report.mean_cell(row["map_rmse"]) if "map_rmse" in row else None}
        | {"difference from the preset": report.mean_cell(row["against"]) if "against" in row else None}
        for row in sorted(rows, key=lambda row: float(row["ms_p50"]))
    ]
    words = (
        "From displacement to the force map, a frame at a time; CPU time of one thread.",
        "Trained for equal steps on the same batches; mean over tested sequences with BCa interval, and the "
        "difference from the grid's preset relative to its error. Compare within a grid only: a coarser one "
        "averages over more of a contact's rim. The published network (32, no stem, 256²) can't be trained "
        "on a CPU.",
    )
    sections = [report.Section("", table)]
    return report.Page("Networks: time and error", data, words, sections, chart)


def _draw(axes: Axes, name: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Paired differences from a preset, which are smaller than the spread over sequences."""
    rows = [
        {**row, "difference": 100 * row["against"][0], "default": preset_of(row)}
        for row in rows
        if row["size"] == PRESETS[name].size and "against" in row
    ]
    for row in rows:
        axes.vlines(row["ms_p50"], *(100 * end for end in row["against"][1:]), color="#c9ced6", zorder=0)
    groups = {
        f"stem of {stem}": stem_rows for (stem,), stem_rows in sorted(report.group_rows(rows, "stem").items())
    }
    report.scatter(axes, groups, "ms_p50", "difference", "w{width} depth{levels} {default}")
    axes.set(title=f"Networks on {PRESETS[name].size}² and the preset {name}")
    axes.set(xlabel="median time a frame [ms]", ylabel="map RMSE, difference from the preset's [%]")
    report.legend(axes)


STUDY = Study(
    measure,
    "learn/pareto/pareto.json",
    page,
    ("--dataset {mission} --cache {work}/networks",),
    needs=("mesh", "mechanics", "truth", "network"),
    timed=True,
)
