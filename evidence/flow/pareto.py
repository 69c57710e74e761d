"""Flow's error against time for estimators and their settings, the default marked."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import cv2
import torch
from matplotlib.axes import Axes

from evidence import report
from evidence.flow.measure import mean_errors
from evidence.flow.scenes import Recipe, pairs
from evidence.study import Study
from synth.flow.estimator import Estimator, create
from synth.flow.opencv import Dis, OpenCvTvl1
from synth.flow.tvl1 import Tvl1, TVL1Settings


def measure(count: int = 4, seed: int = 2613, also: str = "") -> dict[str, Any]:
    """Endpoint and divergence error against milliseconds on `count` pairs; seed 6 was tuned on.

    `also`: names of further estimators, separated by commas.
    """
    image_pairs = list(pairs(Recipe(), count, seed))
    rows: list[dict[str, Any]] = []
    others = [(name, "", create(name), None) for name in also.split(",") if name]
    for family, label, estimator, warm in [*_candidates(), *others]:
        labels = {"family": family, "setting": label, "default": "(default)" in label}
        rows.append(labels | mean_errors(estimator, image_pairs, warm=warm))
    on = "warped procedural cortex, 224², 10 px pull, tool, highlights; CPU time of one thread"
    return {"on": on, "torch": torch.__version__, "opencv": cv2.__version__, "rows": rows}


def _candidates() -> list[tuple[str, str, Estimator, float | None]]:
    """(family, setting, estimator, share of the true flow to start from)."""
    s = TVL1Settings()
    variants = {
        "warps 2": replace(s, warps=2, coarse_warps=2),
        "warps 4": replace(s, warps=4),
        "cold (default)": s,
        "warps 16": replace(s, warps=16),
        "no gradient": replace(s, gradient=0.0),
        "no median": replace(s, median=False),
        "Huber 0.03": replace(s, huber=0.03),
        "lambda / 3": replace(s, weight=s.weight / 3),
        "lambda x 3": replace(s, weight=3 * s.weight),
        "one lambda": replace(s, noise=0.0, steep=0.0, coarse_weight=1.0),
        "no membrane": replace(s, hidden_huber=0.0),
    }
    warm = {"warm 2 warps": replace(s, warps=2, coarse_warps=2), "warm (default)": s}
    opencv_variants = {
        f"lambda {w:g}, {n} warps": OpenCvTvl1(w, n) for w in (0.06, 0.1, 0.2) for n in (2, 3, 6)
    }
    return [
        *(("tvl1", label, Tvl1(setting), None) for label, setting in variants.items()),
        ("tvl1", "uncorrected", Tvl1(s, corrected=False), None),
        *(("tvl1 warm", label, Tvl1(setting), 0.9) for label, setting in warm.items()),
        *(("opencv-tvl1", label, estimator, None) for label, estimator in opencv_variants.items()),
        ("dis", "medium", Dis(), None),
    ]


def page(data: Mapping[str, Any]) -> report.Page:
    """Draws `pareto.json`."""
    groups = {
        family: family_rows for (family,), family_rows in report.group_rows(data["rows"], "family").items()
    }

    def draw(axes: Axes, key: str, label: str) -> None:
        axes.set(xlabel="CPU time [s]", ylabel=label, xscale="log", yscale="log")
        report.scatter(axes, groups, "cpu_s", key, "{setting}")
        report.set_log(axes)
        report.legend(axes)

    chart = report.chart(
        lambda axes: draw(axes, "mean", "mean endpoint error [px]"),
        lambda axes: draw(axes, "divergence", "divergence, relative RMS error"),
    )
    columns = ("family", "setting", "default", "mean", "contact", "divergence", "cpu_s")
    rows = [{key: row[key] for key in columns} for row in data["rows"]]
    best = min(rows, key=lambda row: float(row["mean"]))
    still = data["rows"][0]["still"]
    words = [
        f"**Least endpoint error: {best['family']}, {best['setting']}, {best['mean']:.3f} px in "
        f"{best['cpu_s']:.3f} CPU-s; of no flow {still:.1f} px.** Errors in px, of the divergence relative "
        f"to its RMS; {data['on']}."
    ]
    return report.Page("Flow: error against time", data, words, [report.Section("", rows)], chart)


STUDY = Study(
    measure,
    "flow/pareto/pareto.json",
    page,
    needs=("mesh", "mechanics", "picture", "truth", "flow"),
    timed=True,
)
