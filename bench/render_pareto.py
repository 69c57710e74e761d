"""Noise and recovered flow against cost, over light paths, sampler, integrator and size."""

from __future__ import annotations

import json as json_
import time
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer

from bench import machine
from bench.render_case import Case, case
from synth.job import Job
from synth.render import instrument

_LIFT = 1.5
_DEFAULT = (4, "multijitter", "direct", 640)


def pareto(
    spp: Annotated[list[int], typer.Option(help="Light paths a pixel to try.")] = [1, 2, 4, 8, 16],  # noqa: B006
    sampler: Annotated[list[str], typer.Option(help="Mitsuba samplers to try.")] = [  # noqa: B006
        "multijitter",
        "ldsampler",
        "independent",
    ],
    integrator: Annotated[list[str], typer.Option(help="direct, or path and a depth.")] = ["direct", "path3"],  # noqa: B006
    width: Annotated[list[int], typer.Option(help="Widths of the picture, 4:3.")] = [640, 320],  # noqa: B006
    seed: Annotated[int, typer.Option(help="Of the job.")] = 11,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder for pareto.json and chart.")] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON to standard output.")] = False,
) -> None:
    """Flow error and noise of rendered frames against the CPU time that they took."""
    from rich.console import Console
    from rich.table import Table

    rows = []
    for wide in width:
        ours = case(Job.model_validate({"seed": seed, "render": {"size": (wide, wide * 3 // 4)}}), 0)
        settings = list(product(spp, sampler[:1], integrator[:1]))
        settings += [(_DEFAULT[0], s, integrator[0]) for s in sampler[1:]]
        settings += [(_DEFAULT[0], sampler[0], i) for i in integrator[1:]]
        for paths, pattern, kind in settings:
            row = {"spp": paths, "sampler": pattern, "integrator": kind, "width": wide}
            row["default"] = (paths, pattern, kind, wide) == _DEFAULT
            rows.append(row | measure(ours, paths, pattern, kind))
    found = {"seed": seed, "lift_mm": _LIFT, "machine": machine.describe(), "rows": rows}
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / "pareto.json").write_text(json_.dumps(found, indent=1) + "\n", "utf-8")
        (out / "pareto.svg").write_text(chart(rows), "utf-8")
    if json:
        print(json_.dumps(found))
        return
    names = ("spp", "sampler", "integrator", "width", "cpu_s", "noise", "flow_median_px", "flow_p95_px")
    table = Table(*names, "default")
    for row in rows:
        table.add_row(*(str(row[name]) for name in names), "*" if row["default"] else "")
    Console(width=120).print(table)


def measure(ours: Case, spp: int, sampler: str, kind: str) -> dict[str, float]:
    """Seconds of CPU a picture, its noise, and what DIS flow makes of a pull of 1.5 mm.

    Noise is the root mean square over tissue of the difference of two pictures over sqrt(2), as a share of
    their mean. Flow error is against the truth, over visible tissue away from the instrument.
    """
    studio = ours.studio
    forceps = instrument.build(("forceps",))
    tool = instrument.pose(forceps, ours.tips, ours.shafts)
    stage = studio.stage(ours.vertices, tool, spp=spp, integrator=kind, sampler=sampler)
    stage.render(0)
    spent, pictures = [], []
    for seed, lift in ((1, 0.0), (2, 0.0), (3, _LIFT)):
        start = time.process_time()
        stage.move("cortex", ours.moved(lift))
        stage.move("tool", instrument.pose(forceps, ours.held(lift), ours.shafts))
        pictures.append(stage.render(seed))
        spent.append(time.process_time() - start)
    one, two, three = pictures
    tissue = studio.still.tissue & ~studio.frame(ours.vertices, ours.tips, ours.shafts, 0).tool
    noise = float(np.sqrt(((one - two)[tissue] ** 2).mean() / 2) / one[tissue].mean())
    truth = studio.frame(ours.moved(_LIFT), ours.held(_LIFT), ours.shafts, 4)
    rest, now = (studio.develop(picture, 9 + k) for k, picture in enumerate((one, three)))
    estimator = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    grey = [cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) for rgb in (rest, now)]
    flow = estimator.calc(grey[0], grey[1], np.zeros((*grey[0].shape, 2), np.float32))
    inside = tissue & truth.visible
    error = np.linalg.norm(flow - truth.flow, axis=-1)[inside]
    return {
        "cpu_s": round(float(np.median(spent)), 3),
        "noise": round(noise, 4),
        "flow_median_px": round(float(np.median(error)), 3),
        "flow_p95_px": round(float(np.quantile(error, 0.95)), 3),
    }


def chart(rows: list[dict[str, Any]]) -> str:
    """Noise against CPU time as an SVG, one dot a setting, the default ringed."""
    x = np.log10([row["cpu_s"] for row in rows])
    y = np.log10([max(row["noise"], 1e-5) for row in rows])
    left, right, low, high = x.min() - 0.1, x.max() + 0.1, y.min() - 0.1, y.max() + 0.1
    parts = [
        '<svg xmlns="http://www.w3.org/2000/svg" width="640" height="420" font-family="sans-serif" '
        'font-size="11"><rect width="640" height="420" fill="white"/>'
        '<text x="320" y="412" text-anchor="middle">CPU s a picture (log)</text>'
        '<text x="14" y="210" transform="rotate(-90 14 210)" text-anchor="middle">noise / mean (log)</text>'
    ]
    for row, a, b in zip(rows, x, y, strict=True):
        px, py = 50 + 560 * (a - left) / (right - left), 380 - 360 * (b - low) / (high - low)
        ring = ' stroke="#c2352b" stroke-width="3"' if row["default"] else ""
        colour = "#1f6feb" if row["width"] == rows[0]["width"] else "#2b7a4b"
        parts.append(f'<circle cx="{px:.1f}" cy="{py:.1f}" r="5" fill="{colour}"{ring}/>')
        label = f"{row['spp']} {row['sampler']} {row['integrator']} {row['width']}"
        parts.append(f'<text x="{px + 8:.1f}" y="{py + 4:.1f}">{label}</text>')
    return "".join(parts) + "</svg>\n"
