"""Where the code's defaults stand among the points measured: on the front, or how far off it.

The defaults are taken from the code and looked for in the committed data by what they are, not by a mark that
the data carry: a default that is changed without being measured is not found.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from inspect import signature
from pathlib import Path
from typing import Any

from synth.errors import UserError

RESULTS = Path("docs/results")
ALLOWED = 0.05
"""How far off its front a default may be."""

Key = tuple[Any, ...]


@dataclass(frozen=True)
class Point:
    """One setting measured."""

    key: Key
    """What it is, comparable with what the code says."""
    name: str
    cost: float
    error: float
    ends: tuple[float, float] | None = None
    """Interval of the error."""
    beyond: tuple[float, float] | None = None
    """Interval of the error less the default's, from the same sequences; a front has it or none of it."""


@dataclass(frozen=True)
class Front:
    """One room's points, and where the default is among them."""

    room: str
    cost: str
    """What cost is, with its unit."""
    error: str
    points: tuple[Point, ...]
    default: Key

    def find(self) -> Point:
        """The default's point. UserError if it was not measured."""
        for point in self.points:
            if point.key == self.default:
                return point
        raise UserError(f"{self.room}: the default {self.default} is not among the points measured")

    def excess(self) -> float:
        """By what part the default costs more, or errs more, than the front at its error, or at its cost.

        The smaller of the two; 0 on the front.
        """
        mine = self.find()
        cost = min(p.cost for p in self.points if p.error <= mine.error)
        error = min(p.error for p in self.points if p.cost <= mine.cost)
        return min(mine.cost / cost, mine.error / error if error else math.inf) - 1

    def holds(self) -> bool:
        """Near enough to the front; where errors have intervals, unless a point is better beyond doubt."""
        if self.find().ends is not None:
            return self.beaten_by() is None
        return self.excess() <= ALLOWED

    def beaten_by(self) -> Point | None:
        """A point that is no dearer and beyond doubt better: its interval ends below the default's begins.

        Where both were asked about the same sequences the interval of the difference says so, and only a
        difference that is more than allowed counts. None where there are no intervals.
        """
        mine = self.find()
        if mine.ends is None:
            return None
        for point in self.points:
            if point.cost <= mine.cost and _better(point, mine):
                return point
        return None


def _better(point: Point, mine: Point) -> bool:
    if point.beyond is not None:
        return point.beyond[1] < 0 and point.error < (1 - ALLOWED) * mine.error
    return point.ends is not None and mine.ends is not None and point.ends[1] < mine.ends[0]


def gather(results: Path = RESULTS) -> list[Front]:
    """The front of every room that has data under `results`.

    Raises:
        UserError: a file is missing or not what the room writes.
    """
    return [
        _fem(read(results / "fem/pareto/pareto.json")),
        _render(read(results / "render/pareto/pareto.json")),
        *_flow(read(results / "flow/pareto/pareto.json")),
        *_learn(results),
        *_end_to_end(read(results / "end-to-end/pareto.json")),
    ]


def _fem(found: Mapping[str, Any]) -> Front:
    from synth.job.schema import Fem

    fem = Fem()
    law = fem.chosen_law[0]
    points = [
        Point(
            (row["law"], row["order"], row["tets"]),
            f"{row['law']} P{row['order']}, {row['tets']}",
            float(row["ms_a_frame"]),
            100 * float(row["error"]),
        )
        for row in found["rows"]
    ]
    cost, error = "CPU ms a frame", "displacement [%]"
    return Front("fem", cost, error, tuple(points), (law, fem.order, fem.tets))


def _render(found: Mapping[str, Any]) -> Front:
    from synth.job.schema import Render
    from synth.render.scene import Studio

    stage = signature(Studio.stage).parameters
    render = Render()
    default = (render.spp, stage["sampler"].default, stage["integrator"].default, render.size[0])
    points = [
        Point(
            (row["spp"], row["sampler"], row["integrator"], row["width"]),
            f"{row['spp']} spp, {row['sampler']}, {row['integrator']}",
            float(row["cpu_s"]),
            float(row["flow_median_px"]),
        )
        for row in found["rows"]
        if row["width"] == default[3]  # of another size is another question
    ]
    return Front("render", "CPU s a picture", "flow, median [px]", tuple(points), default)


def _flow(found: Mapping[str, Any]) -> list[Front]:
    from synth.flow.tvl1 import Settings
    from synth.job.schema import Flow

    # Cold and warm starts are two tasks. Without its backward check tvl1 has no confidence to give.
    default = (Flow().backend, _settings(asdict(Settings())))
    fronts = []
    for room, warm in (("flow, cold", False), ("flow, warm", True)):
        points = [
            Point(
                (row["estimator"], _settings(row["settings"])),
                f"{row['family']}, {row['setting']}",
                1e3 * float(row["cpu_s"]),
                float(row["mean"]),
            )
            for row in found["rows"]
            if row["warm"] == warm and row["checked"]
        ]
        fronts.append(Front(room, "CPU ms a frame", "endpoint error [px]", tuple(points), default))
    return fronts


def _learn(results: Path) -> list[Front]:
    from evidence.learn import preset_errors
    from learn.settings import PRESETS

    # A front a grid, as rendering has one a picture's width: errors on two grids aren't comparable. Without
    # intervals: they are over sequences, which all networks share, and would call any two networks equal.
    data = read(results / "learn/pareto/data-cpu.json")
    known = preset_errors.errors(results / "learn")
    fronts = []
    for size, name in sorted(preset_errors.GRIDS.items()):
        points = []
        default = preset_errors.shape(PRESETS[name].arch), size
        for row in data["rows"]:
            if (row["size"], row["layout"], row["precision"]) == (size, "quick", "fp32"):
                key = preset_errors.shape(preset_errors.architecture(row["arch"])), size
                # Networks have different seeds: the preset's error and, of another, what it errs more over
                # the seeds that both have.
                found = known.get(key)
                if found is not None and (key == default or found.against is not None):
                    more = 0.0 if found.against is None else found.against.mean
                    error = known[default].error.mean * (1 + more)
                    points.append(Point(key, row["name"], row["ms_p50"], error))
        unit = "map RMSE [mN/mm²]"
        fronts.append(Front(f"learn, {name}", "CPU ms a frame", unit, tuple(points), default))
    return fronts


def _end_to_end(found: Mapping[str, Any]) -> list[Front]:
    """Two of every model: of the whole force, and of its part across the line of sight."""
    from evidence.end_to_end.pareto import PARTS, difference
    from evidence.end_to_end.pipelines import default_world
    from synth.job.schema import Flow

    world = default_world()
    default = (world.law, world.tets, world.spp, Flow().backend)
    fronts = []
    for model in dict.fromkeys(row["model"] for row in found["rows"]):
        own = {
            (row["law"], row["tets"], row["spp"], row["flow"]): row
            for row in found["rows"]
            if row["model"] == model
        }
        usual = own.get(default)
        for part, errors in PARTS.items():
            points = []
            for key, row in own.items():
                beyond = None
                if usual is not None and row is not usual:
                    _, low, high = difference(usual[errors], row[errors], 0)
                    beyond = (100 * low, 100 * high)
                name = f"{row['law']} {row['tets']}, {row['spp']} spp, {row['flow']}"
                mean, *ends = (100 * float(row[f"{part}{end}"]) for end in ("rmse", "low", "high"))
                points.append(Point(key, name, float(row["cpu_s"]), mean, (ends[0], ends[1]), beyond))
            room = f"end to end{', across' if part else ''}, {model}"
            unit = "RMSE of the force [%]"
            fronts.append(Front(room, "CPU s a frame", unit, tuple(points), default))
    return fronts


def _settings(values: Mapping[str, Any] | None) -> Key | None:
    return None if values is None else tuple(sorted(values.items()))


def read(path: Path) -> dict[str, Any]:
    """A room's results. UserError if they cannot be read."""
    try:
        found: dict[str, Any] = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read ({error})") from error
    return found


def table(fronts: Sequence[Front]) -> list[dict[str, Any]]:
    """One line a front, for a page."""
    rows = []
    for front in fronts:
        mine = front.find()
        rows.append(
            {
                "room": front.room,
                "default": mine.name,
                "cost": mine.cost,
                "unit of cost": front.cost,
                "error": mine.error,
                "unit of error": front.error,
                "off the front": f"{100 * front.excess():.1f}%",
                "points": len(front.points),
            }
        )
    return rows
