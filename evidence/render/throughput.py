"""Frames a second on a compiled variant, and what limits them: meant for `cuda_ad_rgb`, runs on any."""

from __future__ import annotations

import time
from typing import Annotated, Any

import numpy as np
import typer

from evidence.measuring import measuring
from evidence.render.case import case
from synth.geometry.triangles import Shape
from synth.job.schema import Job
from synth.render import instrument, truth


@measuring("--spp 4 --out runs/gpu", said="Folder for throughput.json.", file="throughput.json")
def throughput(
    variant: Annotated[str, typer.Option(help="As in a job's render.variant.")] = "cuda_ad_rgb",
    spp: Annotated[list[int], typer.Option(help="Light paths a pixel.")] = [4, 16],  # noqa: B006
    frames: Annotated[int, typer.Option(min=2, help="Frames to time, after three of warm-up.")] = 60,
    seed: Annotated[int, typer.Option(help="Of the job.")] = 11,
) -> dict[str, Any]:
    """Frames a second at 640x480 and each step's share of a frame, by the wall clock."""
    rows = [measure(variant, paths, frames, seed) for paths in spp]
    return {"variant": variant, "seed": seed, "rows": rows}


def measure(variant: str, spp: int, frames: int, seed: int) -> dict[str, Any]:
    """Median seconds of each step, and frames a second if they follow one another.

    The picture comes back to the host within `render`, so its end is the device's end.
    """
    job = Job.model_validate({"seed": seed, "render": {"variant": variant, "spp": spp}})
    ours = case(job, 0)
    studio = ours.studio
    forceps = instrument.build(("forceps",))
    stage = studio.stage(ours.vertices, instrument.pose(forceps, ours.tips, ours.shafts), spp)
    spent: dict[str, list[float]] = {"move": [], "render": [], "sensor": [], "truth": []}

    def move(vertices: Any, tool: Any) -> None:
        stage.move("cortex", vertices)
        stage.move("tool", tool)

    for k in range(frames + 3):
        lift = 0.1 * (k % 20)
        vertices, tool = ours.moved(lift), instrument.pose(forceps, ours.held(lift), ours.shafts)
        clock = [time.perf_counter()]
        stage.move("cortex", vertices)
        stage.move("tool", tool)
        clock.append(time.perf_counter())
        radiance = stage.render(k)
        clock.append(time.perf_counter())
        studio.develop(radiance, k)
        clock.append(time.perf_counter())
        surface, held = Shape(vertices, studio.surface.faces), Shape(tool, forceps.faces)
        truth.now(studio.camera, studio.still, surface, studio.rim.shape, held)
        clock.append(time.perf_counter())
        for name, seconds in zip(spent, np.diff(clock).tolist(), strict=True):
            spent[name].append(seconds)
    median = {name: float(np.median(values[3:])) for name, values in spent.items()}
    whole = sum(median.values())
    return {
        "spp": spp,
        "frames_a_second": round(1 / whole, 2),
        "pictures_a_second": round(1 / (median["move"] + median["render"]), 2),
        "seconds": {name: round(value, 4) for name, value in median.items()},
        "limited_by": max(median, key=lambda name: median[name]),
    }
