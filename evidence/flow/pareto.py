"""`bench pareto flow`: error against time for estimators and their settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Annotated, Any

import cv2
import torch
import typer

from bench.output import charts, machine, result_page
from evidence.flow.measure import measure
from evidence.flow.scenes import Recipe, pairs
from evidence.measuring import measuring
from synth.flow.estimator import Estimator
from synth.flow.opencv import Dis, OpenCvTvl1
from synth.flow.tvl1 import Settings, Tvl1


@measuring(
    "--out runs/flow --count 2",
    out=...,
    said="Folder for pareto.json, chart.svg, index.html.",
    file="pareto.json",
    page=lambda found, out: result_page.write(drawn(found), out),
)
def pareto(
    count: Annotated[int, typer.Option(min=1, help="Pairs a point.")] = 4,
    seed: Annotated[int, typer.Option(min=0, help="Root of every draw.")] = 2613,
) -> dict[str, Any]:
    """Flow: endpoint and divergence error against milliseconds, the default marked."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    made = list(pairs(Recipe(), count, seed))
    rows: list[dict[str, Any]] = []
    for family, label, estimator, warm in _candidates():
        error = measure(estimator, made, warm=warm)
        default = label in ("cold (default)", "warm (default)")
        what = {
            "family": family,
            "setting": label,
            "estimator": "tvl1" if isinstance(estimator, Tvl1) else family,
            "settings": asdict(estimator.settings) if isinstance(estimator, Tvl1) else None,
            "checked": not isinstance(estimator, Tvl1) or estimator.checked,
            "warm": warm is not None,
            "default": default,
        }
        rows.append(what | asdict(error))
        typer.echo(f"{family}: {label}", err=True)
    return {
        "on": "warped procedural cortex, 224², 10 px pull, tool, highlights; CPU time of one thread",
        "machine": machine.describe() | {"torch": torch.__version__, "opencv": cv2.__version__},
        "rows": rows,
    }


def drawn(found: Mapping[str, Any]) -> result_page.Page:
    """What the data say."""
    tables = [result_page.Section("All settings", found["rows"])]
    return result_page.Page("Flow: error against time", found, panels(found), tables)


def panels(found: Mapping[str, Any]) -> list[charts.Panel]:
    """Charts of `pareto.json`: endpoint and divergence error against time."""
    rows, made = found["rows"], []
    for title, key in (("endpoint error", "mean"), ("divergence error (relative RMS)", "divergence")):
        curves = []
        for family in dict.fromkeys(str(row["family"]) for row in rows):
            own = [row for row in rows if row["family"] == family]
            curves.append(
                charts.Curve(
                    family,
                    tuple(1e3 * float(row["cpu_s"]) for row in own),
                    tuple(float(row[key]) for row in own),
                    tuple(str(row["setting"]) for row in own),
                    ringed=tuple(k for k, row in enumerate(own) if row["default"]),
                )
            )
        unit = "EPE mean [px]" if key == "mean" else "relative RMS"
        made.append(
            charts.Panel(f"Flow: {title}", "CPU time [ms]", unit, tuple(curves), True, True, front=True)
        )
    return made


def _candidates() -> list[tuple[str, str, Estimator, float | None]]:
    """(family, setting, estimator, share of the true flow to start from)."""
    s = Settings()
    ours = [("warps 2", replace(s, warps=2)), ("cold (default)", s), ("warps 8", replace(s, warps=8)),
            ("no gradient", replace(s, gradient=0.0)), ("no median", replace(s, median=False)),
            ("Huber 0.03", replace(s, huber=0.03)), ("lambda / 3", replace(s, weight=s.weight / 3)),
            ("lambda x 3", replace(s, weight=3 * s.weight)), ("one lambda", replace(s, noise=0.0, steep=0.0)),
            ("no membrane", replace(s, hidden_huber=0.0))]  # fmt: skip
    warm = [("warm 1 warp", replace(s, warm_warps=1)), ("warm 2 warps", replace(s, warm_warps=2)),
            ("warm (default)", s)]  # fmt: skip
    cv = [(f"lambda {w:g}, {n} warps", OpenCvTvl1(w, n)) for w in (0.06, 0.1, 0.2) for n in (2, 3, 6)]
    return [
        *(("tvl1", label, Tvl1(setting), None) for label, setting in ours),
        ("tvl1", "unchecked", Tvl1(s, checked=False), None),
        *(("tvl1 warm", label, Tvl1(setting), 0.9) for label, setting in warm),
        *(("opencv-tvl1", label, estimator, None) for label, estimator in cv),
        ("dis", "medium", Dis(), None),
    ]
