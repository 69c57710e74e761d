"""CPU time of the mechanics of each world, in turn in one process: mesh, equations and every frame."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from evidence import kept
from evidence.mechanics.worlds import PLAIN, STEEP, WORLDS
from learn.evaluation.statistics import interval
from synth.errors import UserError
from synth.job.law_limits import RIGID_GESTURES
from synth.job.schema import Job
from synth.sequence import pipeline, scenario

Seconds = dict[str, list[float | None]]
"""World → CPU seconds a frame of every scene; None: it was refused."""

_ALSO = {"pointwise elements": {"volume": "pointwise"}}
"""Of which only the cost is asked."""


def worlds() -> dict[str, Mapping[str, Any]]:
    """Those that cost something of their own, with what the job says of them."""
    own = {name: world.fem for name, world in WORLDS.items() if not world.without}
    return own | _ALSO


def measure(
    scenes: int, rounds: int, seed: int, work: Path, report: Callable[[str], None] = lambda line: None
) -> Seconds:
    """The least of the rounds, of scenes of the default job; a rigid tip's and its like are those that press.

    Args:
        scenes: how many; each is kept in `work` when it is done.
        rounds: how often each is done, all worlds in turn; once more at first, which compiles.
        seed: of the scenes.
        work: folder.
        report: told of every scene.
    """
    found: Seconds = {name: [] for name in worlds()}
    warm = False
    for k in range(scenes):

        def compute(index: int = k, again: int = rounds + (not warm)) -> dict[str, float | None]:
            turns = [timed(index, seed) for _ in range(again)][-rounds:]
            return {name: min((turn[name] for turn in turns), key=lambda s: s or 0.0) for name in worlds()}

        file = kept.word(__name__, seed, rounds, worlds(), k)
        began = time.process_time()
        for name, spent in kept.result(work / "costs", f"scene-{k}", file, compute).items():
            found[name].append(spent)
        warm = warm or time.process_time() - began > 1
        report(f"cost of scene {k + 1} of {scenes}")
    return found


def timed(index: int, seed: int, job: Mapping[str, Any] | None = None) -> dict[str, float | None]:
    """CPU seconds a frame of one scene in every world, None where it is refused; `job`: what else it says."""
    found: dict[str, float | None] = {}
    for name, fem in worlds().items():
        kinds = {"gestures": RIGID_GESTURES} if name in PRESSING else {}
        asked = Job.model_validate(
            {"seed": seed, "sequences": 10**6, **(job or {}), "fem": kinds | dict(fem)}
        )
        case = scenario.draw(asked, index)
        pipeline.cortex(asked, case)  # the surface is every world's
        began = time.process_time()
        try:
            pipeline.move(asked, case, *pipeline.build(asked, case))
        except UserError:
            found[name] = None
            continue
        found[name] = round((time.process_time() - began) / asked.frames, 5)
    return found


PRESSING = (STEEP, "rigid tip")
"""Worlds whose scenes are those that a rigid tip can do."""


@dataclass(frozen=True)
class Ratio:
    """What a world costs of another's cost."""

    ratio: float
    low: float
    high: float
    worst: float
    scenes: int
    against: str


def ratios(found: Mapping[str, list[float | None]], seed: int) -> dict[str, Ratio]:
    """Geometric mean over scenes with its BCa interval, and the worst scene."""
    made = {}
    for name in found:
        against = WORLDS[name].against if name in WORLDS else PLAIN
        pairs = [(a, b) for a, b in zip(found[name], found[against], strict=True) if a and b]
        logs = np.log([a / b for a, b in pairs])
        mean = interval(logs, np.random.default_rng(seed))
        ratio, low, high, worst = (float(np.exp(x)) for x in (mean.mean, mean.low, mean.high, logs.max()))
        made[name] = Ratio(ratio, low, high, worst, len(pairs), against)
    return made
