"""The grid of fidelities: keys of a job that cost time and move the force, each with its settings."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from synth.job.laws import CHEAPEST_FIRST, LARGEST_LOAD
from synth.job.schema import Job
from synth.system.config_file import override

Settings = Mapping[str, str | int | tuple[int, int]]
"""Values by the dotted keys of the job."""


def list_settings(job: Job) -> dict[str, list[Any]]:
    """Settings by key, finest first and the job's own among them; only keys with more than one."""
    fem, (width, height), vertices = job.fem, job.render.size, job.anatomy.vertices
    law = fem.chosen_law[0]
    grid: dict[str, list[Any]] = {
        "fem.law": [law],
        "fem.tets": _finest_first({fem.tets, 4000, 2500, 1600, 800}),
    }
    if law in CHEAPEST_FIRST:  # a plug-in's is another tissue, not a dearer way to the same one
        linear = ["linear"] if fem.largest_load <= LARGEST_LOAD["linear"] else []
        grid["fem.law"] = list(dict.fromkeys(["neo-hookean", *linear, law]))
    if fem.time == "dynamic":
        grid["fem.time"] = ["dynamic", "quasi-static"]
    if job.flow.backend != "ideal":  # else no force is estimated from pictures, however good
        if "vertices" in job.anatomy.model_fields_set:  # else they follow the picture's size
            grid["anatomy.vertices"] = _finest_first({vertices, min(10_000, vertices)})
        # In its exact proportions: contacts are drawn within what the camera shows. Even, for codecs.
        wide, high = 2 * width // (unit := math.gcd(width, height)), 2 * height // unit
        steps = [round(part * width / wide) for part in (0.75, 0.6, 0.5, 0.4)]
        sizes = [(step * wide, step * high) for step in steps]
        # Below 96 pixels, flow has no pyramid to speak of.
        grid["render.size"] = _finest_first({(width, height), *(size for size in sizes if min(size) >= 96)})
        grid["render.spp"] = _finest_first({job.render.spp, 8, 4, 2})
    return {key: settings for key, settings in grid.items() if len(settings) > 1}


def _finest_first(values: set[Any]) -> list[Any]:
    return sorted(values, reverse=True)


def changed(job: Job, changes: Mapping[str, Any]) -> Job:
    """The job with the values of dotted keys changed. UserError where they don't go together."""
    return override(job, [f"{key}={json.dumps(value)}" for key, value in changes.items()])


def differences(settings: Settings, start: Settings) -> Settings:
    """The settings that differ from a start."""
    return {key: value for key, value in settings.items() if value != start[key]}


def show(settings: Settings, start: Settings) -> str:
    """The same in words."""
    return (
        ", ".join(f"{key} {one}" for key, one in differences(settings, start).items()) or "the job as given"
    )
