"""Noise and recovered flow against cost, over light paths, sampler, integrator and size."""

from __future__ import annotations

import time
from collections.abc import Mapping
from inspect import signature
from itertools import product
from typing import Annotated, Any

import cv2
import numpy as np
import typer

from bench.output import charts, result_page
from evidence.measuring import measuring
from evidence.render.case import Case, case
from evidence.render.cycles import noises
from synth.job.schema import Job, Render
from synth.render import instrument
from synth.render.scene import Studio

_LIFT = 1.5
_STAGE = signature(Studio.stage).parameters
_DEFAULT = (Render().spp, _STAGE["sampler"].default, _STAGE["integrator"].default, Render().size[0])


@measuring(
    "--spp 2 --spp 8 --out runs/render",
    said="Folder for pareto.json and chart.",
    file="pareto.json",
    page=lambda found, out: result_page.write(drawn(found), out),
)
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
) -> dict[str, Any]:
    """Flow error and noise of rendered frames against the CPU time that they took."""
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
    return {"seed": seed, "lift_mm": _LIFT, "rows": rows}


def measure(ours: Case, spp: int, sampler: str, kind: str) -> dict[str, float]:
    """Seconds of CPU a picture, its noise, and what DIS flow makes of a pull of 1.5 mm.

    Noise is that of two pictures over tissue (`cycles.noises`). Flow error is against the truth, over
    visible tissue away from the instrument.
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
    truth = studio.frame(ours.moved(_LIFT), ours.held(_LIFT), ours.shafts, 4)
    rest, now = (studio.develop(picture, 9 + k) for k, picture in enumerate((one, three)))
    estimator = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    grey = [cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) for rgb in (rest, now)]
    flow = estimator.calc(grey[0], grey[1], np.zeros((*grey[0].shape, 2), np.float32))
    inside = tissue & truth.visible
    error = np.linalg.norm(flow - truth.flow, axis=-1)[inside]
    return {
        "cpu_s": round(float(np.median(spent)), 3),
        **noises(one, two, tissue),
        "flow_median_px": round(float(np.median(error)), 3),
        "flow_p95_px": round(float(np.quantile(error, 0.95)), 3),
    }


def drawn(found: Mapping[str, Any]) -> result_page.Page:
    """What the data say."""
    tables = [result_page.Section("All settings", found["rows"])]
    return result_page.Page("Rendering: flow error and noise against time", found, panels(found), tables)


def panels(found: Mapping[str, Any]) -> list[charts.Panel]:
    """Charts of `pareto.json`: what flow makes of the pictures, and their noise, against time."""
    made = []
    for key, unit in (
        ("flow_median_px", "flow error, median [px]"),
        ("noise", "noise / mean"),
        ("noise_clipped", "noise / mean, clipped"),
    ):
        curves = []
        for kind in dict.fromkeys((r["width"], r["sampler"], r["integrator"]) for r in found["rows"]):
            own = [r for r in found["rows"] if (r["width"], r["sampler"], r["integrator"]) == kind]
            curves.append(
                charts.Curve(
                    f"{kind[1]}, {kind[2]}, {kind[0]} px",
                    tuple(float(r["cpu_s"]) for r in own),
                    tuple(float(r[key]) for r in own),
                    tuple(f"{r['spp']} spp" for r in own),
                    ringed=tuple(k for k, r in enumerate(own) if r["default"]),
                )
            )
        made.append(
            charts.Panel(f"Render: {unit}", "CPU s a picture", unit, tuple(curves), True, True, front=True)
        )
    return made
