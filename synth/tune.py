"""Goal-oriented fidelity: the cheapest job whose forces stay within a budget of those at full fidelity.

A few probe sequences are computed at full fidelity and with one knob turned at a time. What a knob does to
the force read from them (`tune_reading`) adds up to first order, with its sign, sequence by sequence; costs
multiply stage by stage. That only orders the candidates: the cheapest one that promises to keep the budget is
then measured as a whole, on further sequences too, and given up for the next if it does not keep it.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth import tune_knobs
from synth.errors import UserError
from synth.fem.validity import choose
from synth.job import Job
from synth.tune_found import Budget as Budget
from synth.tune_found import Joint as Joint
from synth.tune_found import Row as Row
from synth.tune_found import Tuned as Tuned
from synth.tune_journal import Journal
from synth.tune_knobs import Knob, Level
from synth.tune_probe import Measured, Probe

Floats = NDArray[np.float64]
Report = Callable[[int, int, str], None]
"""Told after each measurement: how many are done, how many there will be at least, and what it found."""

_SIDE_TETS = 1600  # laws and time steps are compared on this mesh, where they cost little
_SIDE_SIZE = 0.5  # all of the picture but its size is compared at about this part of it
_TRIES = 6
_DRAWS = 5
_STEP = (0.6, 0.95)  # after a broken promise, the next may be this part of it
_NOTHING = 0.01  # saving less than this part of a frame's cost is no reason to change a job


@dataclass
class _Bench:
    """Measures settings on probe sequences, and remembers."""

    job: Job
    journal: Journal
    report: Report
    total: int
    done: int = 0
    _probes: dict[int, tuple[Job, Probe]] = field(default_factory=dict, repr=False)

    def measure(self, index: int, words: str, changes: Mapping[str, Any], pictures: bool) -> Measured | str:
        """One setting on one sequence; a text where that cannot be carried out."""
        key = f"{index} {sorted(changes.items())} {pictures}"
        found = self.journal.get(key)
        if found is None:
            job, probe = self._probe(index)
            try:
                found = probe.measure(tune_knobs.changed(job, changes), pictures)
            except UserError as error:
                found = str(error)
            self.journal.put(key, found)
        self.done += 1
        self.total = max(self.total, self.done)
        self.report(self.done, self.total, f"sequence {index}: {words}")
        return found

    def _probe(self, index: int) -> tuple[Job, Probe]:
        """A probe sequence; draws that the job itself could not carry out are passed over."""
        if index not in self._probes:
            for _, other in self._probes.values():
                other.rest()
            finest = tune_knobs.finest(tune_knobs.of(self.job))
            for attempt in range(_DRAWS):
                job = probing(self.job, index, attempt)
                try:
                    self._probes[index] = (job, Probe(tune_knobs.changed(job, finest), 0))
                    break
                except UserError:
                    if attempt == _DRAWS - 1:
                        raise
        return self._probes[index]


def run(job: Job, budget: Budget, journal_file: Path, probes: int, checks: int, report: Report) -> Tuned:
    """Finds the cheapest job within the budget.

    Args:
        job: what is to be made cheaper.
        budget: how far its forces may move.
        journal_file: keeps what is measured, so that a run that was stopped goes on; removed at the end.
        probes: sequences that every knob is measured on.
        checks: further ones that whole settings are measured on.
        report: progress.

    Raises:
        UserError: a probe sequence cannot be carried out at full fidelity.
    """
    knobs = tune_knobs.of(job)
    state = hashlib.blake2b(job.model_dump_json().encode(), digest_size=8).hexdigest()
    journal = Journal(journal_file, f"{state} {probes}")
    levels = sum(len(knob.levels) for knob in knobs)
    total = probes * (levels + 2) + 2 * probes + 3 * checks
    bench = _Bench(job, journal, report, total)
    sweep = _Sweep(knobs, bench, probes)
    whole = range(probes + checks)
    full = joint(bench, whole, "full fidelity", [knob.levels[0] for knob in knobs], 0.0)
    own_levels = [own(knob, job) for knob in knobs]
    mine = joint(bench, whole, "the job as it is", own_levels, sweep.error(own_levels))
    tried: list[Joint] = []
    allowed = budget.share
    seen: set[tuple[str, ...]] = set()
    while True:
        picked = sweep.cheapest(allowed, own_levels, seen)
        if picked is None or len(tried) == _TRIES - 1:
            picked = [knob.levels[0] for knob in knobs]  # full fidelity is what the budget is counted from
        promised = sweep.error(picked)
        seen.add(tuple(level.words for level in picked))
        tried.append(joint(bench, whole, f"try {len(tried) + 1}", picked, promised))
        if tried[-1].error <= budget.share or picked == [knob.levels[0] for knob in knobs]:
            break
        # Promises are held to less, by what this one missed, but a single surprise is not taken for the rule.
        allowed *= float(np.clip(budget.share / tried[-1].error, *_STEP))
    journal.remove()
    kinds = tuple(scenario_kind(job, index) for index in whole)
    return Tuned(job, budget, tuple(knobs), tuple(picked), tuple(sweep.rows), full, mine, tuple(tried), kinds)


def again(found: Tuned, journal_file: Path, first: int, count: int, report: Report) -> tuple[Joint, Joint]:
    """The job as it was and the tuned one, measured on sequences that had no part in the choice.

    Args:
        found: the answer.
        journal_file: as in `run`.
        first: number of the first such sequence; the choice used those below.
        count: how many.
        report: progress.
    """
    state = hashlib.blake2b(found.job.model_dump_json().encode(), digest_size=8).hexdigest()
    bench = _Bench(found.job, Journal(journal_file, f"{state} again {first}"), report, 3 * count)
    whole = range(first, first + count)
    mine = [own(knob, found.job) for knob in found.knobs]
    before = joint(bench, whole, "the job as it is", mine, float("nan"))
    after = joint(bench, whole, "the tuned job", found.chosen, float("nan"))
    bench.journal.remove()
    return before, after


def probing(job: Job, index: int, attempt: int = 0) -> Job:
    """A job of one sequence like those of `job`, but none of them; gestures and families in turn."""
    digest = hashlib.blake2b(f"tune {job.seed} {index} {attempt}".encode(), digest_size=7).digest()
    gestures, families = job.fem.gestures, job.appearance.families
    return tune_knobs.changed(
        job,
        {
            "seed": int.from_bytes(digest, "big"),
            "sequences": 1,
            "fem.gestures": [gestures[index % len(gestures)]],
            "appearance.families": [families[index % len(families)]],
        },
    )


def scenario_kind(job: Job, index: int) -> str:
    """Gesture of a probe sequence's first instrument."""
    return job.fem.gestures[index % len(job.fem.gestures)]


def own(knob: Knob, job: Job) -> Level:
    """The level of a knob that a job has."""
    values = job.model_dump(mode="json")
    if knob.name == "law":
        law = choose(job.fem.law, job.fem.largest_load, job.fem.tolerance)[0]
        return next((one for one in knob.levels if one.words == law), knob.levels[0])
    for level in knob.levels:
        if all(_value(values, key) == value for key, value in level.changes.items() if key != "fem.order"):
            return level
    return knob.levels[0]


def joint(
    bench: _Bench, sequences: Sequence[int], name: str, levels: Sequence[Level], promised: float
) -> Joint:
    """A setting as a whole, against full fidelity, on some sequences."""
    changes = merged(levels)
    finest = tune_knobs.finest(tune_knobs.of(bench.job))
    errors, costs = [], []
    for index in sequences:
        exact = bench.measure(index, "full fidelity", finest, True)
        found = exact if changes == finest else bench.measure(index, name, changes, True)
        if isinstance(exact, str):
            raise UserError(f"probe sequence {index}: {exact}")
        if isinstance(found, str):
            errors.append(np.inf)
            continue
        errors.append(max(_size(found.label), _size(_minus(found.seen, exact.seen))))
        costs.append(cost(found, bench.job.frames))
    mean = float(np.mean(costs)) if costs else float("nan")
    return Joint(name, tuple(level.words for level in levels), promised, tuple(errors), mean)


def merged(levels: Sequence[Level]) -> dict[str, Any]:
    """The changes of one level of every knob."""
    return {key: value for level in levels for key, value in level.changes.items()}


def cost(found: Measured, frames: int) -> float:
    """CPU-s a frame in a sequence of so many."""
    stages = found.cost
    once = stages.get("physics", 0.0) + stages.get("scene", 0.0)
    return once / frames + stages.get("render", 0.0) + stages.get("flow", 0.0)


class _Sweep:
    """Every knob turned by itself, and what that promises of all of them."""

    def __init__(self, knobs: list[Knob], bench: _Bench, probes: int) -> None:
        self._knobs, self._frames = knobs, bench.job.frames
        self._moves: list[list[list[Floats] | None]] = [[] for _ in knobs]
        self._ratios: list[list[dict[str, float]]] = [[] for _ in knobs]
        self._why: dict[tuple[int, int], str] = {}
        finest = tune_knobs.finest(knobs)
        exact = [_whole(bench.measure(k, "full fidelity", finest, True)) for k in range(probes)]
        self._cost = {
            stage: float(np.median([e.cost.get(stage, 0.0) for e in exact]))
            for stage in ("physics", "scene", "render", "flow")
        }
        # One sequence after the other: its full fidelity is computed once.
        tables = [[self._one(bench, k, knob, finest) for knob in knobs] for k in range(probes)]
        for i, knob in enumerate(knobs):
            for j in range(len(knob.levels)):
                cells = [tables[k][i][j] for k in range(probes)]
                broken = next((cell for cell in cells if isinstance(cell, str)), None)
                good = [cell for cell in cells if not isinstance(cell, str)]
                self._moves[i].append(None if broken else [move for move, _ in good])
                stages = {stage for _, ratio in good for stage in ratio}
                self._ratios[i].append(
                    {
                        stage: float(np.median([ratio.get(stage, 1.0) for _, ratio in good]))
                        for stage in stages
                    }
                )
                if broken:
                    self._why[i, j] = broken
        self.rows = [
            Row(
                knob.name,
                level.words,
                self._alone(i, j),
                1 - self._price([(i, j)]) / self._price([]),
                self._why.get((i, j), ""),
            )
            for i, knob in enumerate(knobs)
            for j, level in enumerate(knob.levels)
        ]

    def error(self, levels: Sequence[Level]) -> float:
        """Of the force, by adding up; inf where a knob broke."""
        at = [knob.levels.index(level) for knob, level in zip(self._knobs, levels, strict=True)]
        return self._error(at)

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
            price = self._price(list(enumerate(at)))
            found.append((price, sum(a != b for a, b in zip(levels, mine, strict=True)), levels))
        if not found:
            return None
        least = min(price for price, _, _ in found)
        near = [one for one in found if one[0] <= (1 + _NOTHING) * least]
        return min(near, key=lambda one: (one[1], one[0]))[2]

    def _one(
        self, bench: _Bench, index: int, knob: Knob, finest: dict[str, Any]
    ) -> list[tuple[Floats, dict[str, float]] | str]:
        """Each level's move of the force on one sequence, and its cost by stage over the finest level's."""
        base = dict(finest)
        if knob.name in ("law", "time"):
            base |= {"fem.tets": min(_SIDE_TETS, finest["fem.tets"])}
        elif knob.kind != "physics" and knob.name != "size":
            base |= self._side()
        pictures = knob.kind != "physics"
        zero = _whole(bench.measure(index, f"{knob.name}, finest", base, pictures))
        out: list[tuple[Floats, dict[str, float]] | str] = [(np.zeros_like(zero.label), {})]
        for level in knob.levels[1:]:
            found = bench.measure(index, f"{knob.name} {level.words}", base | dict(level.changes), pictures)
            if isinstance(found, str):
                out.append(found)
                continue
            move = _minus(found.seen, zero.seen) if pictures else found.label - zero.label
            ratio = {s: found.cost[s] / zero.cost[s] for s in found.cost if zero.cost.get(s, 0.0) > 0}
            out.append((move, ratio))
        return out

    def _side(self) -> dict[str, Any]:
        size = next(knob for knob in self._knobs if knob.name == "size")
        wide = _SIDE_SIZE * size.levels[0].changes["render.size"][0]
        nearest = min(size.levels, key=lambda level: abs(level.changes["render.size"][0] - wide))
        return dict(nearest.changes)

    def _alone(self, i: int, j: int) -> float:
        at = [0] * len(self._knobs)
        at[i] = j
        return self._error(at)

    def _error(self, at: Sequence[int]) -> float:
        parts = [self._moves[i][j] for i, j in enumerate(at) if j]
        if any(part is None for part in parts):
            return float("inf")
        moves = [part for part in parts if part is not None]
        if not moves:
            return 0.0
        sums = [sum(part[k] for part in moves) for k in range(len(moves[0]))]
        return float(np.mean([_size(np.asarray(one)) for one in sums]))

    def _price(self, at: Sequence[tuple[int, int]]) -> float:
        stages = dict(self._cost)
        for i, j in at:
            for stage, ratio in self._ratios[i][j].items():
                stages[stage] *= ratio
        return (stages["physics"] + stages["scene"]) / self._frames + stages["render"] + stages["flow"]


def _size(errors: Floats) -> float:
    """Root mean square over frames of (K, I)."""
    return float(np.sqrt(np.square(errors).sum(axis=1).mean()))


def _minus(one: Floats | None, other: Floats | None) -> Floats:
    if one is None or other is None:
        return np.zeros((1, 1))  # no force is read from pictures
    return one - other


def _whole(found: Measured | str) -> Measured:
    if isinstance(found, str):
        raise UserError(f"a probe sequence cannot be carried out at full fidelity: {found}")
    return found


def _value(values: Mapping[str, Any], key: str) -> Any:
    block, _, name = key.rpartition(".")
    return (values[block] if block else values)[name]
