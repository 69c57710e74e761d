"""Noise and error of recovered flow against cost, by light paths, integrator, vertices and size."""

import time
from collections.abc import Mapping
from inspect import signature
from itertools import product
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from evidence import report
from evidence.render.render_case import Case, case
from evidence.study import Study
from synth.arrays import Map, Mask
from synth.flow.opencv import Dis
from synth.job.schema import Job, RenderSection
from synth.render.scene import Renderer

_LIFT = 1.5
_STAGE = signature(Renderer.stage).parameters
_DEFAULT = RenderSection().spp, _STAGE["integrator"].default, RenderSection().size[0]
_INTEGRATORS = ("direct", "path3")


def measure(
    spp: str = "1,2,4,8,16",
    width: str = "640,256",
    vertices: str = "6000,12000,40000",
    frames: int = 12,
    seed: int = 11,
) -> dict[str, Any]:
    """Flow error and noise of rendered frames against the CPU time that they took.

    `spp`: light paths a pixel; `width`: of the image, 4:3; `vertices`: of the surface, in addition to the
    default of that size; `frames`: over which the time of a whole frame is measured.
    """
    rows: list[dict[str, Any]] = []
    for width_px in (int(part) for part in width.split(",")):
        sections: dict[str, Any] = {"seed": seed, "render": {"size": (width_px, width_px * 3 // 4)}}
        setup = case(Job.model_validate(sections), 0)
        settings = list(product((int(part) for part in spp.split(",")), _INTEGRATORS[:1]))
        settings += [(_DEFAULT[0], kind) for kind in _INTEGRATORS[1:]]
        for paths, kind in settings:
            row = {"spp": paths, "integrator": kind, "width": width_px}
            row["default"] = (paths, kind, width_px) == _DEFAULT
            rows.append(row | {"vertices": len(setup.vertices)} | measure_setting(setup, paths, kind))
        for count in (int(part) for part in vertices.split(",")):
            other_setup = case(Job.model_validate(sections | {"anatomy": {"vertices": count}}), 0)
            row = dict(zip(("spp", "integrator", "width"), (*_DEFAULT[:2], width_px), strict=True))
            row |= {"default": False, "vertices": len(other_setup.vertices)}
            rows.append(row | measure_setting(other_setup, *_DEFAULT[:2]))
    cost = frame_cost(case(Job(seed=seed), 0), frames)
    return {"seed": seed, "lift_mm": _LIFT, "rows": rows, "frame": cost}


def measure_setting(setup: Case, spp: int, kind: str) -> dict[str, float]:
    """CPU seconds an image, its noise, and the error of DIS flow for a pull of 1.5 mm.

    Noise is measured on two images of the tissue (`noises`), flow error over visible tissue away from the
    instrument.
    """
    renderer = setup.renderer
    stage = renderer.stage(setup.state(), spp=spp, integrator=kind)
    stage.render(0)
    times_s, pictures = [], []
    for seed, lift in ((1, 0.0), (2, 0.0), (3, _LIFT)):
        start = time.process_time()
        renderer.move(stage, setup.state(lift))
        pictures.append(stage.render(seed))
        times_s.append(time.process_time() - start)
    first, second, lifted = pictures
    tissue = renderer.rest.tissue & ~renderer.render(setup.state(), 0).tool
    truth = renderer.render(setup.state(_LIFT), 4)
    rest, now = (renderer.develop(picture, 9 + k) for k, picture in enumerate((first, lifted)))
    usable, inside = np.ones_like(tissue), tissue & truth.visible
    flow, _ = Dis().flow(rest, now, usable, usable)
    error = np.linalg.norm(flow - truth.flow, axis=-1)[inside]
    return {
        "cpu_s": float(np.median(times_s)),
        **noises(first, second, tissue),
        "flow_median_px": float(np.median(error)),
        "flow_p95_px": float(np.quantile(error, 0.95)),
    }


def noises(first: Map, second: Map, inside: Mask, white: float = 1.0) -> dict[str, float]:
    """Root mean square noise of an image over a mask, relative to the mean: of its radiance, where reflected
    lamps dominate, and after clipping at the radiance of a white surface, as in a camera."""
    kinds = {"noise": (first, second), "noise_clipped": (np.minimum(first, white), np.minimum(second, white))}
    return {
        kind: float(np.sqrt(((a - b)[inside] ** 2).mean() / 2) / a[inside].mean())
        for kind, (a, b) in kinds.items()
    }


def frame_cost(setup: Case, frames: int) -> dict[str, float]:
    """CPU-seconds of a frame: update, image, sensor and ground truth; the first one is warm-up."""
    times_s = []
    for k in range(frames + 1):
        start = time.process_time()
        setup.renderer.render(setup.state(0.1 * k), k)
        times_s.append(time.process_time() - start)
    low, middle, high = np.quantile(times_s[1:], (0, 0.5, 1)).tolist()
    return {"cpu_s_least": low, "cpu_s_median": middle, "cpu_s_most": high}


def page(data: Mapping[str, Any]) -> report.Page:
    """Flow error and noise against time."""
    groups = {
        f"{kind}, {width} px, {vertices} vertices": group
        for (width, kind, vertices), group in report.group_rows(
            data["rows"], "width", "integrator", "vertices"
        ).items()
    }

    def draw(axes: Axes, key: str, label: str) -> None:
        axes.set(xlabel="CPU s a picture", ylabel=label, xscale="log", yscale="log")
        report.scatter(axes, groups, "cpu_s", key, "{spp} spp")
        report.set_log(axes)
        report.legend(axes)

    chart = report.chart(
        lambda axes: draw(axes, "flow_median_px", "flow error, median [px]"),
        lambda axes: draw(axes, "noise_clipped", "noise / mean, clipped"),
    )
    tables = [report.Section("All settings", data["rows"])]
    tables += [report.Section("A whole frame", [data["frame"]])]
    return report.Page("Rendering: flow error and noise against time", data, (), tables, chart)


STUDY = Study(
    measure,
    "render/pareto/pareto.json",
    page,
    needs=("mesh", "mechanics", "picture", "truth", "flow"),
    timed=True,
)
