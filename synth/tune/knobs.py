"""The knobs of a job that cost time and move the force: their levels, finest first."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from synth.errors import UserError
from synth.job.law_limits import CHEAPEST_FIRST, LARGEST_LOAD
from synth.job.schema import Job

FINE_TETS, FINE_SPP, FINE_WARPS = 4000, 8, 6
_TETS, _SPP, _WARPS, _SIZES = (2500, 1600, 800), (4, 2), (3, 2, 1), (0.75, 0.6, 0.5, 0.4)
_VERTICES = 10_000
_FEWEST_PX = 96  # of the picture's short side: below, flow has no pyramid to speak of

Changes = Mapping[str, Any]
"""Keys of a job, dotted, and their values."""


@dataclass(frozen=True)
class Level:
    """One setting of one knob."""

    words: str
    changes: Changes


@dataclass(frozen=True)
class Knob:
    """What may be turned."""

    name: str
    kind: str
    """`physics` moves the truth, `picture` what is seen, `surface` both, `flow` what is made of it."""
    levels: tuple[Level, ...]
    """Full fidelity first."""
    turned: bool = True
    """False: measured and told, but left as the job has it. Pictures without highlights or without blur are
    other pictures, not cheaper ones, and what is trained on them is another network."""


def list_knobs(job: Job) -> list[Knob]:
    """The knobs that a job has, with its own value among the levels.

    Raises:
        UserError: the job asks for what no cheaper picture can be measured against.
    """
    if job.render.subsurface == "volume":
        raise UserError("render.subsurface: volume is a reference itself; tune the job with blur")
    knobs = [*_physics_knobs(job), *_world_knobs(job)]
    if job.flow.backend == "ideal":
        return knobs  # no force is read from its pictures, so nothing here can say how good they must be
    vertices = [job.anatomy.vertices, min(_VERTICES, job.anatomy.vertices)]
    knobs += [_number("vertices", "surface", "anatomy.vertices", vertices), *_picture_knobs(job)]
    if job.flow.backend == "tvl1":
        warps = [max(FINE_WARPS, job.flow.warps), job.flow.warps, *_WARPS]
        knobs.append(_number("warps", "flow", "flow.warps", warps))
    return knobs


def _physics_knobs(job: Job) -> list[Knob]:
    """Law, mesh, elements and, of dynamics, the time step."""
    fem = job.fem
    own_law = "neo-hookean" if fem.law == "auto" else fem.law
    laws = ["neo-hookean", *(law for law in ("stable", "linear") if fem.largest_load <= LARGEST_LOAD[law])]
    if own_law not in CHEAPEST_FIRST:
        laws = [own_law]  # a plug-in's is another tissue, not a cheaper way to the same one
    elif own_law not in laws:
        laws.append(own_law)
    tets = _down([max(FINE_TETS, fem.tets), fem.tets, *_TETS])
    knobs = [
        Knob("law", "physics", tuple(Level(law, {"fem.law": law}) for law in laws)),
        Knob("tets", "physics", tuple(Level(f"{n} P2", {"fem.order": 2, "fem.tets": n}) for n in tets)),
    ]
    if fem.volume != "pointwise":
        means, points = Level("averaged", {"fem.volume": fem.volume}), {"fem.volume": "pointwise"}
        knobs.append(Knob("volume", "physics", (means, Level("pointwise", points))))
    if fem.time == "dynamic":
        frame = 1 / job.fps
        steps = _down([fem.dt_s / 2, fem.dt_s, *([frame] if frame > fem.dt_s else [])])
        levels = [Level(f"steps of {dt:.3g} s", {"fem.dt_s": dt}) for dt in steps[::-1]]
        knobs.append(Knob("time", "physics", (*levels, Level("at rest", {"fem.time": "quasi-static"}))))
    return knobs


def _world_knobs(job: Job) -> list[Knob]:
    """What a living brain has and a plain one has not: told, not turned, since the plain one is another
    world."""
    fem, values = job.fem, job.model_dump(mode="json")["fem"]
    plain: dict[str, tuple[str, str, Any]] = {}
    if fem.membrane.intact > 0:
        plain["membrane"] = "membrane", "stripped", values["membrane"] | {"intact": 0.0}
    if fem.poisson != (0.4, 0.4):
        plain["poisson"] = "nu {:g} to {:g}".format(*fem.poisson), "nu 0.4", [0.4, 0.4]
    if fem.skull != ("bonded",):
        plain["skull"] = " or ".join(fem.skull), "bonded", ["bonded"]
    if fem.contact == "rigid" and fem.depth_mm is None:
        plain["contact"] = "rigid tip", "traction", "traction"
    return [
        Knob(
            name,
            "physics",
            (Level(words, {f"fem.{name}": values[name]}), Level(other, {f"fem.{name}": value})),
            turned=False,
        )
        for name, (words, other, value) in plain.items()
    ]


def _picture_knobs(job: Job) -> list[Knob]:
    """Size, light paths and, where the job has them, lens and highlights."""
    render, glare = job.render, job.light.glare
    sizes = [render.size]
    for part in _SIZES:
        # Multiples of 8, in the shape that was asked for.
        wide = max(8, round(part * render.size[0] / 8) * 8)
        size = (wide, max(8, round(wide * render.size[1] / render.size[0] / 8) * 8))
        if min(size) >= _FEWEST_PX and size not in sizes:
            sizes.append(size)
    knobs = [
        Knob("size", "picture", tuple(Level(f"{w} x {h}", {"render.size": [w, h]}) for w, h in sizes)),
        _number("spp", "picture", "render.spp", [max(FINE_SPP, render.spp), render.spp, *_SPP]),
    ]
    if render.aperture_mm > 0:
        lens = Level("lens", {"render.aperture_mm": render.aperture_mm})
        pinhole = Level("pinhole", {"render.aperture_mm": 0.0})
        knobs.append(Knob("depth of field", "picture", (lens, pinhole), turned=False))
    if glare[1] > 0:
        wet = Level("wet highlights", {"light.glare": list(glare)})
        few = Level("few highlights", {"light.glare": [0.0, 0.0]})
        knobs.append(Knob("light", "picture", (wet, few), turned=False))
    return knobs


def _number(name: str, kind: str, key: str, values: Iterable[int]) -> Knob:
    """A knob that is one number of the job, the finer the larger."""
    return Knob(name, kind, tuple(Level(f"{n}", {key: n}) for n in _down(values)))


def finest(knobs: Iterable[Knob]) -> dict[str, Any]:
    """Changes that set every knob to full fidelity."""
    return {key: value for knob in knobs for key, value in knob.levels[0].changes.items()}


def changed(job: Job, changes: Changes) -> Job:
    """The job with some keys set."""
    values = job.model_dump(mode="json")
    for key, value in changes.items():
        block, _, name = key.rpartition(".")
        (values[block] if block else values)[name] = value
    return Job.model_validate(values)


def _down(values: Iterable[Any]) -> list[Any]:
    """Different values, the largest first."""
    return sorted(set(values), reverse=True)
