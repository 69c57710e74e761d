"""What each knob does to the force by itself, and what that promises of settings that turn several."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.errors import UserError
from synth.tune import knobs as tune_knobs
from synth.tune.knobs import Knob, Level
from synth.tune.probe import Measured
from synth.tune.result import Row

Floats = NDArray[np.float64]
Measure = Callable[[int, str, Mapping[str, Any], bool], Measured | str]
"""One setting (words, changes) on one sequence, with pictures or without."""

_SIDE_TETS = 1600  # laws and time steps are compared on this mesh, where they cost little
_SIDE_SIZE = 0.5  # all of the picture but its size is compared at about this part of it
_NOTHING = 0.01  # saving less than this part of a frame's cost is no reason to change a job


@dataclass(frozen=True)
class _Cell:
    """One level of one knob on one sequence, against the knob's finest level."""

    label: Floats
    """(K, I) by how much the force that the label stands for moves, as a part of the force."""
    seen: Floats
    """(K, I) by how much the force that is read moves."""
    ratio: dict[str, float]
    """Cost by stage over the finest level's."""


class Sweep:
    """Every knob turned by itself, and what that promises of all of them."""

    def __init__(self, knobs: list[Knob], measure: Measure, frames: int, probes: int) -> None:
        self._knobs, self._measure, self._frames = knobs, measure, frames
        self._finest = tune_knobs.finest(knobs)
        self._exact: dict[int, Measured] = {}
        self._cells: dict[int, list[list[_Cell | str]]] = {}
        for index in range(probes):
            self.learn(index)

    def learn(self, index: int) -> None:
        """Measures every knob on one more sequence."""
        # One sequence after the other: its full fidelity is computed once.
        self._exact[index] = _whole(self._measure(index, "full fidelity", self._finest, True))
        self._cells[index] = [self._one(index, knob) for knob in self._knobs]

    def knows(self, index: int) -> bool:
        """Whether every knob was measured on a sequence."""
        return index in self._cells

    def rows(self) -> list[Row]:
        """What each level of each knob does by itself."""
        full = self._price([0] * len(self._knobs))
        return [
            Row(
                knob.name,
                level.words,
                self._error(self._alone(i, j)),
                self._change(self._alone(i, j)),
                1 - self._price(self._alone(i, j)) / full,
                next((cell for cell in self._column(i, j) if isinstance(cell, str)), ""),
            )
            for i, knob in enumerate(self._knobs)
            for j, level in enumerate(knob.levels)
        ]

    def error(self, levels: Sequence[Level]) -> float:
        """Of the force, by adding up; inf where a knob broke."""
        return self._error(self._at(levels))

    def price(self, levels: Sequence[Level]) -> float:
        """Expected CPU-s a frame."""
        return self._price(self._at(levels))

    def cheapest(
        self, budget: float, mine: Sequence[Level], seen: set[tuple[str, ...]]
    ) -> list[Level] | None:
        """Levels that promise to keep the budget at the least cost, not among those `seen`.

        Where costs are as good as equal, the fewest changes to the job win.
        """
        found: list[tuple[float, int, list[Level]]] = []
        choices = [
            range(len(knob.levels)) if knob.turned else [knob.levels.index(level)]
            for knob, level in zip(self._knobs, mine, strict=True)
        ]
        for at in itertools.product(*choices):
            levels = [knob.levels[j] for knob, j in zip(self._knobs, at, strict=True)]
            if tuple(level.words for level in levels) in seen or not self._error(at) <= budget:
                continue
            price = self._price(at)
            found.append((price, sum(a != b for a, b in zip(levels, mine, strict=True)), levels))
        if not found:
            return None
        least = min(price for price, _, _ in found)
        near = [one for one in found if one[0] <= (1 + _NOTHING) * least]
        return min(near, key=lambda one: (one[1], one[0]))[2]

    def _one(self, index: int, knob: Knob) -> list[_Cell | str]:
        """What each level of a knob does on one sequence; a text where it cannot be carried out."""
        base = dict(self._finest)
        if knob.name in ("law", "time"):
            base |= {"fem.tets": _SIDE_TETS}
        elif knob.kind != "physics" and knob.name != "size":
            base |= self._side()
        pictures = knob.kind != "physics"
        zero = _whole(self._measure(index, f"{knob.name}, finest", base, pictures))
        still = np.zeros_like(zero.label)
        out: list[_Cell | str] = [_Cell(still, still, {})]
        for level in knob.levels[1:]:
            found = self._measure(index, f"{knob.name} {level.words}", base | dict(level.changes), pictures)
            if isinstance(found, str):
                out.append(found)
                continue
            label = found.label - zero.label
            ratio = {s: found.cost[s] / zero.cost[s] for s in found.cost if zero.cost.get(s, 0.0) > 0}
            # Without pictures, what is read moves as the truth does.
            out.append(_Cell(label, seen_error(found) - seen_error(zero) if pictures else label, ratio))
        return out

    def _side(self) -> dict[str, Any]:
        size = next(knob for knob in self._knobs if knob.name == "size")
        wide = _SIDE_SIZE * size.levels[0].changes["render.size"][0]
        nearest = min(size.levels, key=lambda level: abs(level.changes["render.size"][0] - wide))
        return dict(nearest.changes)

    def _at(self, levels: Sequence[Level]) -> list[int]:
        return [knob.levels.index(level) for knob, level in zip(self._knobs, levels, strict=True)]

    def _alone(self, i: int, j: int) -> list[int]:
        at = [0] * len(self._knobs)
        at[i] = j
        return at

    def _column(self, i: int, j: int) -> list[_Cell | str]:
        return [cells[i][j] for cells in self._cells.values()]

    def _sums(self, at: Sequence[int]) -> list[tuple[Floats, Floats, Floats]] | None:
        """By sequence, move of the label, error of the force read, the same at full fidelity; None where a
        knob broke."""
        out = []
        for index, cells in self._cells.items():
            parts = [cells[i][j] for i, j in enumerate(at) if j]
            known = [part for part in parts if isinstance(part, _Cell)]
            if len(known) < len(parts):
                return None
            exact = seen_error(self._exact[index])
            label = np.sum([np.zeros_like(exact), *(part.label for part in known)], axis=0)
            out.append((label, np.sum([exact, *(part.seen for part in known)], axis=0), exact))
        return out

    def _error(self, at: Sequence[int]) -> float:
        sums = self._sums(at)
        return float("inf") if sums is None else float(np.mean([taken(*one) for one in sums]))

    def _change(self, at: Sequence[int]) -> float:
        sums = self._sums(at)
        if sums is None:
            return float("inf")
        return float(np.mean([size(seen) - size(exact) for _, seen, exact in sums]))

    def _price(self, at: Sequence[int]) -> float:
        stages = {
            stage: float(np.median([one.cost.get(stage, 0.0) for one in self._exact.values()]))
            for stage in ("physics", "scene", "render", "flow")
        }
        for i, j in enumerate(at):
            good = [cell.ratio for cell in self._column(i, j) if isinstance(cell, _Cell)]
            for stage in {stage for ratio in good for stage in ratio}:
                stages[stage] *= float(np.median([ratio.get(stage, 1.0) for ratio in good]))
        return (stages["physics"] + stages["scene"]) / self._frames + stages["render"] + stages["flow"]


def seen_error(found: Measured) -> Floats:
    """(K, I) error of the force read; of a job whose flow is the truth, that of the label."""
    return found.label if found.seen is None else found.seen


def _whole(found: Measured | str) -> Measured:
    if isinstance(found, str):
        raise UserError(f"a probe sequence cannot be carried out at full fidelity: {found}")
    return found


def taken(label: Floats, seen: Floats, exact: Floats) -> float:
    """What a setting takes of the budget in one sequence.

    Args:
        label: (K, I) by how much its true displacement moves the force, as a part of the force.
        seen: (K, I) by how much the force read from its recovered displacement is off.
        exact: (K, I) the same at full fidelity.
    """
    return max(size(label), size(seen) - size(exact), 0.0)


def size(errors: Floats) -> float:
    """Root mean square over frames of (K, I) errors, instruments together."""
    return float(np.sqrt(np.square(errors).sum(axis=1).mean()))


def merged(levels: Sequence[Level]) -> dict[str, Any]:
    """The changes of one level of every knob."""
    return {key: value for level in levels for key, value in level.changes.items()}


def cost(found: Measured, frames: int) -> float:
    """CPU-s a frame in a sequence of so many."""
    stages = found.cost
    once = stages.get("physics", 0.0) + stages.get("scene", 0.0)
    return once / frames + stages.get("render", 0.0) + stages.get("flow", 0.0)
