"""The parameters of a job that cost time and move the force, each with its settings, finest first."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from synth.job.laws import CHEAPEST_FIRST, LARGEST_LOAD
from synth.job.schema import Job
from synth.system.config_file import override

Setting = str | int | tuple[int, int]
"""The value of one parameter."""
Settings = Mapping[str, Setting]
"""Values of parameters by their keys in the job, dotted."""

_TETS, _SPP = (4000, 2500, 1600, 800), (8, 4, 2)
_SIZES = (0.75, 0.6, 0.5, 0.4)  # parts of the job's
_FEWEST_PX = 96  # of the picture's short side: below, flow has no pyramid to speak of
_VERTICES = 10_000
_SIDE_TETS, _SIDE_SIZE = 1600, 0.5  # where the others are compared, as a mesh and a part of the picture


@dataclass(frozen=True)
class Parameter:
    """One key of a job."""

    key: str
    settings: tuple[Setting, ...]
    """Full fidelity first; the job's own is among them."""
    own: Setting
    """What the job has."""
    base: Settings = field(default_factory=dict)
    """Where its settings are compared, if not at full fidelity: there they cost less and do the same."""


def list_parameters(job: Job) -> list[Parameter]:
    """The parameters of a job that have more than one setting."""
    fem, render = job.fem, job.render
    law = fem.chosen_law[0]
    laws = ["neo-hookean", *(["linear"] if fem.largest_load <= LARGEST_LOAD["linear"] else []), law]
    if law not in CHEAPEST_FIRST:
        laws = [law]  # a plug-in's is another tissue, not a cheaper way to the same one
    times = ("dynamic", "quasi-static") if fem.time == "dynamic" else (fem.time,)
    sizes = _sizes(render.size)
    side = min(sizes, key=lambda size: abs(size[0] - _SIDE_SIZE * render.size[0]))
    half: Settings = {} if side == render.size else {"render.size": side}
    coarse: Settings = {"fem.tets": _SIDE_TETS, **half}
    parameters = [
        Parameter("fem.law", tuple(dict.fromkeys(laws)), law, coarse),
        Parameter("fem.tets", _falling(fem.tets, *_TETS), fem.tets, half),
        Parameter("fem.time", times, fem.time, coarse),
    ]
    # With ideal flow no force is read from pictures, so nothing here says how good they must be.
    if job.flow.backend != "ideal":
        vertices = job.anatomy.vertices
        parameters += [
            Parameter("anatomy.vertices", _falling(vertices, min(_VERTICES, vertices)), vertices, half),
            Parameter("render.size", sizes, render.size),
            Parameter("render.spp", _falling(render.spp, *_SPP), render.spp, half),
        ]
    return [one for one in parameters if len(one.settings) > 1]


def _sizes(own: tuple[int, int]) -> tuple[tuple[int, int], ...]:
    """The picture's size and smaller ones, multiples of 8 in the shape that was asked for."""
    sizes = [own]
    for part in _SIZES:
        width = round(part * own[0] / 8) * 8
        size = (width, round(width * own[1] / own[0] / 8) * 8)
        if min(size) >= _FEWEST_PX:
            sizes.append(size)
    return tuple(dict.fromkeys(sizes))


def _falling(*values: int) -> tuple[int, ...]:
    """Different values, the largest and finest first."""
    return tuple(sorted(set(values), reverse=True))


def changed(job: Job, changes: Mapping[str, Any]) -> Job:
    """The job with the values of dotted keys changed. UserError where they don't go together."""
    return override(job, [f"{key}={json.dumps(value)}" for key, value in changes.items()])


def show(setting: Setting) -> str:
    """The value as people read it."""
    return " x ".join(map(str, setting)) if isinstance(setting, tuple) else str(setting)
