"""Goal-oriented fidelity: the cheapest job whose error of the force is within a budget of full fidelity's.

A few probe sequences are computed at full fidelity and with one knob turned at a time. What a knob does to
the force read from them (`force_reading`) adds up to first order, with its sign, frame by frame; costs
multiply stage by stage. That only orders the candidates: the cheapest one that promises to keep the budget is
then measured as a whole, on further sequences too, and given up for the next if it does not keep it. The
sequence that broke the promise is then measured knob by knob as well.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.dataset import provenance
from synth.errors import UserError
from synth.job.schema import Job
from synth.tune import knobs as tune_knobs
from synth.tune.checkpoint import Journal
from synth.tune.knobs import Knob, Level
from synth.tune.one_at_a_time import Sweep, cost, merged, seen_error, size, taken
from synth.tune.probe import Measured, Probe
from synth.tune.result import Budget as Budget
from synth.tune.result import Joint as Joint
from synth.tune.result import Row as Row
from synth.tune.result import Tuned as Tuned

Floats = NDArray[np.float64]
Report = Callable[[int, int, str], None]
"""Told after each measurement: how many are done, how many there will be at least, and what it found."""

_TRIES = 6
_DRAWS = 5
_STEP = (0.6, 0.95)  # after a broken promise, the next may be this part of it
_MORE = (1.05, 1.6)  # after a kept one


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
        else:
            self.total -= 1
        return found

    def _probe(self, index: int) -> tuple[Job, Probe]:
        """A probe sequence; draws that cannot be carried out at full fidelity are passed over."""
        for number, (_, other) in self._probes.items():
            if number != index:
                other.rest()
        if index not in self._probes:
            finest = tune_knobs.finest(tune_knobs.list_knobs(self.job))
            for attempt in range(_DRAWS):
                job = probing(self.job, index, attempt)
                try:
                    self._probes[index] = (job, Probe(tune_knobs.changed(job, finest), 0))
                    break
                except UserError:
                    if attempt == _DRAWS - 1:
                        raise
        return self._probes[index]


def tune_job(job: Job, budget: Budget, journal_file: Path, probes: int, checks: int, report: Report) -> Tuned:
    """Finds the cheapest job within the budget.

    Args:
        job: what is to be made cheaper.
        budget: by how much its error of the force may grow over full fidelity's.
        journal_file: keeps what is measured, so that a run that was stopped, or one with another budget, goes
            on from there; the caller's to remove.
        probes: sequences that every knob is measured on.
        checks: further ones that whole settings are measured on; every knob too, on one that breaks a
            promise.
        report: progress.

    Raises:
        UserError: a probe sequence cannot be carried out at full fidelity.
    """
    knobs = tune_knobs.list_knobs(job)
    journal = Journal(journal_file, _state(job))
    levels = sum(len(knob.levels) for knob in knobs)
    total = probes * (levels + 2) + 2 * probes + 3 * checks
    bench = _Bench(job, journal, report, total)
    sweep = Sweep(knobs, bench.measure, job.frames, probes)
    whole = range(probes + checks)
    full = joint(bench, whole, "full fidelity", [knob.levels[0] for knob in knobs], 0.0)
    own_levels = [own(knob, job) for knob in knobs]
    mine = joint(bench, whole, "the job as it is", own_levels, sweep.error(own_levels))
    # The budget is counted from full fidelity, which keeps it by itself.
    last = own_levels if mine.error <= budget.share else [knob.levels[0] for knob in knobs]
    limit = mine.cost if last is own_levels else np.inf
    best, tried = _try_settings(bench, sweep, whole, budget.share, own_levels, last, limit)
    if best is None:
        best = last, joint(bench, whole, f"try {len(tried) + 1}", last, sweep.error(last))
        tried.append(best[1])
    picked, answer = best
    kinds = tuple(scenario_kind(job, index) for index in whole)
    return Tuned(
        job, budget, tuple(knobs), tuple(picked), tuple(sweep.rows()), full, mine, tuple(tried), answer, kinds
    )


def _try_settings(
    bench: _Bench,
    sweep: Sweep,
    whole: range,
    share: float,
    own_levels: list[Level],
    last: list[Level],
    limit: float,
) -> tuple[tuple[list[Level], Joint] | None, list[Joint]]:
    """Measures settings as a whole, the cheapest first that promises to keep the budget.

    Args:
        bench, sweep: what measures, and what it promises.
        whole: sequences to measure on.
        share: the budget.
        own_levels: the job's.
        last: what is taken if nothing cheaper keeps the budget.
        limit: cost [CPU-s a frame] below which a setting must stay.

    Returns:
        The cheapest setting that kept the budget, None if there is none; and all that were measured.
    """
    tried: list[Joint] = []
    seen: set[tuple[str, ...]] = set()
    best: tuple[list[Level], Joint] | None = None
    allowed = share
    while len(tried) < _TRIES:
        picked = sweep.cheapest(allowed, own_levels, seen)
        if picked is None or sweep.price(picked) >= sweep.price(best[0] if best else last):
            break
        found = joint(bench, whole, f"try {len(tried) + 1}", picked, sweep.error(picked))
        seen.add(found.levels)
        tried.append(found)
        if found.error <= share and found.cost < limit:
            # It kept more than it promised: something cheaper may keep the budget too.
            best, limit = (picked, found), found.cost
            allowed *= float(np.clip(share / max(found.error, 1e-9), *_MORE))
            continue
        if best:
            break
        surprise = whole[int(np.argmax(found.errors))]
        if sweep.knows(surprise):
            # Promises are held to less, by what this one missed, but not to little for a single surprise.
            allowed *= float(np.clip(share / found.error, *_STEP))
        else:
            sweep.learn(surprise)  # which knob did it?
    return best, tried


def measure_again(
    found: Tuned, journal_file: Path, first: int, count: int, report: Report
) -> tuple[Joint, Joint, Joint]:
    """Full fidelity, the job as it was and the tuned one, on sequences that had no part in the choice.

    Args:
        found: the answer.
        journal_file: as in `tune_job`.
        first: number of the first such sequence; the choice used those below.
        count: how many.
        report: progress.
    """
    bench = _Bench(found.job, Journal(journal_file, _state(found.job)), report, 3 * count)
    whole = range(first, first + count)
    full = joint(bench, whole, "full fidelity", [knob.levels[0] for knob in found.knobs], float("nan"))
    mine = [own(knob, found.job) for knob in found.knobs]
    before = joint(bench, whole, "the job as it is", mine, float("nan"))
    after = joint(bench, whole, "the tuned job", found.chosen, float("nan"))
    return full, before, after


def _state(job: Job) -> str:
    """What a journal's measurements are of: the job and the code that makes sequences."""
    job_hash = hashlib.blake2b(job.model_dump_json().encode(), digest_size=8).hexdigest()
    return f"{job_hash} {provenance.fingerprint()}"


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
        law = job.fem.chosen_law[0]
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
    finest = tune_knobs.finest(tune_knobs.list_knobs(bench.job))
    errors: list[float] = []
    totals: list[float] = []
    apart: list[float] = []
    costs: list[float] = []
    for index in sequences:
        exact = bench.measure(index, "full fidelity", finest, True)
        found = exact if changes == finest else bench.measure(index, name, changes, True)
        if isinstance(exact, str):
            raise UserError(f"probe sequence {index}: {exact}")
        if isinstance(found, str):
            for each in (errors, totals, apart):
                each.append(np.inf)
            continue
        errors.append(taken(found.label, seen_error(found), seen_error(exact)))
        totals.append(size(seen_error(found)))
        apart.append(size(seen_error(found) - seen_error(exact)))
        costs.append(cost(found, bench.job.frames))
    mean = float(np.mean(costs)) if costs else float("nan")
    words = tuple(level.words for level in levels)
    return Joint(name, words, promised, tuple(errors), tuple(totals), tuple(apart), mean)


def _value(values: Mapping[str, Any], key: str) -> Any:
    block, _, name = key.rpartition(".")
    return (values[block] if block else values)[name]
