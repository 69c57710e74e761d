"""Goal-oriented fidelity: the cheapest job whose force error is within a budget of full fidelity's.

One parameter at a time is changed on a few probe sequences: errors add up at most, costs multiply stage by
stage. In that order whole jobs are measured, on further sequences too.
"""

from __future__ import annotations

import itertools
import json
import math
import re
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from scipy import stats

from synth.arrays import Floats
from synth.dataset import provenance
from synth.errors import UserError
from synth.fem.law_choice import CHEAPEST_FIRST, LARGEST_LOAD
from synth.job import identity, reader
from synth.job.schema import Job
from synth.render.mitsuba import adapter
from synth.system import cache, packages
from synth.system.config_file import ConfigFile, override
from synth.tune.probe import Probe

_DRAWS = 5  # of a probe sequence, until full fidelity carries one out
_TRIES, _CAREFUL = 6, 0.7  # of whole jobs; a miss is stepped back from to this part of the growth it adds
_STORED = 5000  # measurements, in the user's cache
_CHEAPER = 0.98  # costs that differ by less than 2%, to which they are known, count as equal

Settings = Mapping[str, str | int | tuple[int, int]]
"""Values by the dotted keys of the job."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Settings for every key of the grid on N sequences; infinite where they cannot be carried out."""

    settings: Settings
    growths: Floats  # (N,) of the force error over full fidelity's, as a share of the force
    errors: Floats  # (N,) of the force from recovered displacement, as a share of the force
    growth: float  # mean over sequences
    margin: float  # half the 95% confidence interval of that mean; infinite for one sequence
    stages: Floats  # (4,) CPU-s a frame of physics, scene, rendering and flow, mean over sequences


class Measurements:
    """Measurements of settings on sequences like a job's own, stored in the user's cache: a run can go on."""

    def __init__(self, job: Job) -> None:
        self.job, self.grid = job, list_settings(job)
        explicit = change_job(job, {"fem.law": own_law(job)})
        self.original: Settings = {key: attrgetter(key)(explicit) for key in self.grid}
        self.full: Settings = {key: settings[0] for key, settings in self.grid.items()}
        machine = packages.machine(), adapter.pick(job.render.variant)  # costs are of this machine
        self._made_by = f"{crc32(job.model_dump_json().encode())} {provenance.fingerprint()} {machine}"
        self._probes: dict[int, tuple[Job, Probe]] = {}

    def evaluate(self, settings: Settings, sequences: Sequence[int]) -> Evaluation:
        """Measures settings as a whole. UserError if not even full fidelity can carry a sequence out."""
        full = np.array([self._measure(number, self.full) for number in sequences])
        label, recovered, *stages = np.transpose([self._measure(number, settings) for number in sequences])
        # Never below 0, so that no sequence pays for another.
        growths, margin, n = np.maximum(label, recovered - full[:, 1]), float("inf"), len(label)
        if n > 1 and np.isfinite(growths).all():
            margin = float(stats.t.ppf(0.975, n - 1) * stats.sem(growths))
        mean = float(growths.mean())
        return Evaluation(settings, growths, recovered, mean, margin, np.mean(stages, axis=1))

    def _measure(self, sequence: int, settings: Settings) -> list[float]:
        """As `Probe.measure`; all infinite if the settings cannot be carried out."""

        def make() -> list[float]:
            (job, probe), results = self._probe(sequence), [np.inf] * 6
            with suppress(*[UserError] * (settings != self.full)):
                results = probe.measure(change_job(job, settings))
            print(f"sequence {sequence}: {show(settings, self.original)}", file=sys.stderr, flush=True)
            return results

        key = f"{self._made_by} {sequence} {sorted(settings.items())}".encode()
        dump, load = (lambda results: json.dumps(results).encode()), json.loads
        return cache.load_or_make("tune/json", key, make, dump, load, (ValueError,), _STORED)

    def _probe(self, sequence: int) -> tuple[Job, Probe]:
        """A sequence's job and probe; draws that full fidelity cannot carry out are passed over."""
        kinds, families = self.job.fem.gestures, self.job.appearance.families
        changes: dict[str, Any] = {
            "sequences": 1,
            "fem.gestures": [kinds[sequence % len(kinds)]],
            **self.full,
        }
        changes["appearance.families"] = [families[sequence % len(families)]]  # in turn
        for attempt in range(_DRAWS):
            if sequence not in self._probes:
                changes["seed"] = crc32(f"tune {self.job.seed} {sequence} {attempt}".encode())
                job = change_job(self.job, changes)
                with suppress(*[UserError] * (attempt < _DRAWS - 1)):
                    self._probes[sequence] = job, Probe(job)
        return self._probes[sequence]


@dataclass(frozen=True)
class Tuned:
    """The tuned job and all that was measured."""

    budget: float
    full: Evaluation
    original: Evaluation  # the job as given
    best: Evaluation
    rows: tuple[Evaluation, ...]  # each change by itself, on the probes, then whole jobs


def parse_budget(text: str) -> float:
    """0.03 of `force 3%`: by how much the force error may grow. UserError for anything else."""
    match = re.fullmatch(r"\s*force\s+(\d+(?:\.\d+)?)\s*%\s*", text)
    if not match or not 0 < float(match[1]) < 100:
        raise UserError(f"--budget {text!r}: is written as 'force 3%', more than 0 and less than 100")
    return float(match[1]) / 100


def tune(measurements: Measurements, budget: float, probes: int, checks: int) -> Tuned:
    """Finds the cheapest settings that let the force error grow by at most a budget, a part of the force.

    Every setting is measured on `probes` sequences, whole jobs on `checks` more. The answer never costs more
    than the job, unless that misses the budget by more than its margin. UserError: full fidelity fails.
    """
    grid, probe_indices, all_indices = measurements.grid, range(probes), range(probes + checks)
    full = measurements.evaluate(measurements.full, all_indices)
    original = measurements.evaluate(measurements.original, all_indices)
    start = original if np.isfinite(original.growth) and original.growth - original.margin <= budget else full
    changes = [(key, value) for key in grid for value in grid[key] if value != start.settings[key]]
    single_changes = {
        (key, value): measurements.evaluate({**start.settings, key: value}, probe_indices)
        for key, value in changes
    }
    base, candidates = measurements.evaluate(start.settings, probe_indices), []
    for values in itertools.product(*grid.values()):
        settings = dict(zip(grid, values, strict=True))
        parts = [single_changes[change] for change in settings.items() if change in single_changes]
        growth = base.growth + sum(evaluation.growth - base.growth for evaluation in parts)
        cost = np.prod(
            [base.stages, *(evaluation.stages / base.stages for evaluation in parts)], axis=0
        ).sum()
        if growth <= budget and cost < _CHEAPER * base.stages.sum():
            order = round(np.log(cost) / np.log(_CHEAPER)), -len(differences(settings, original.settings))
            candidates.append((order, growth, settings))
    best, trials, allowed = start, list[Evaluation](), budget
    for _, growth, settings in sorted(candidates, key=lambda candidate: candidate[0], reverse=True):
        if growth <= allowed and best is start and len(trials) < _TRIES:
            evaluation = measurements.evaluate(settings, all_indices)
            trials.append(evaluation)
            if evaluation.growth > budget:
                allowed = base.growth + _CAREFUL * (growth - base.growth)
            elif evaluation.stages.sum() < _CHEAPER * start.stages.sum():
                best = evaluation
    measured = [
        evaluation for evaluation in single_changes.values() if evaluation.settings != original.settings
    ]
    return Tuned(budget, full, original, best, (*measured, full, original, *trials))


def own_law(job: Job) -> str:
    """The material law of a job; auto where it has both kinds of contact, each with a law of its own."""
    return job.fem.law if len({*job.fem.contact}) > 1 else job.fem.chosen_law[0]


def list_settings(job: Job) -> dict[str, list[Any]]:
    """Settings by key, finest first and the job's own among them; only keys with more than one."""
    fem, (width, height), vertices = job.fem, job.render.size, job.anatomy.vertices
    law = own_law(job)
    tets = sorted({fem.tets, 4000, 2500, 1600, 800}, reverse=True)
    grid: dict[str, list[Any]] = {"fem.law": [law], "fem.tets": tets}
    if law in CHEAPEST_FIRST:  # a plug-in's is another tissue, not a dearer way to the same one
        linear = ["linear"] if fem.largest_load <= LARGEST_LOAD["linear"] else []
        grid["fem.law"] = list(dict.fromkeys(["neo-hookean", *linear, law]))
    if fem.time == "dynamic":
        grid["fem.time"] = ["dynamic", "quasi-static"]
    if job.flow.backend != "ideal":  # else no force is estimated from pictures, however good
        if "vertices" in job.anatomy.model_fields_set:  # else they follow the picture's size
            grid["anatomy.vertices"] = sorted({vertices, min(10_000, vertices)}, reverse=True)
        # In its exact proportions: contacts are drawn within what the camera shows. Even, for codecs.
        wide, high = 2 * width // (unit := math.gcd(width, height)), 2 * height // unit
        steps = [round(part * width / wide) for part in (0.75, 0.6, 0.5, 0.4)]
        # Below 96 pixels, flow has no pyramid to speak of.
        sizes = {(step * wide, step * high) for step in steps if step * min(wide, high) >= 96}
        grid["render.size"] = sorted({(width, height), *sizes}, reverse=True)
        grid["render.spp"] = sorted({job.render.spp, 8, 4, 2}, reverse=True)
    return {key: settings for key, settings in grid.items() if len(settings) > 1}


def change_job(job: Job, changes: Mapping[str, Any]) -> Job:
    """The job with the values of dotted keys changed. UserError where they don't go together."""
    return override(job, [f"{key}={json.dumps(value)}" for key, value in changes.items()])


def differences(settings: Settings, start: Settings) -> Settings:
    """The settings that differ from a start."""
    return {key: value for key, value in settings.items() if value != start[key]}


def show(settings: Settings, start: Settings) -> str:
    """The same in words."""
    words = ", ".join(f"{key} {value}" for key, value in differences(settings, start).items())
    return words or "the job as given"


def lines(tuned: Tuned) -> list[str]:
    """The budget, then a line for every setting by itself and for whole jobs."""
    rows = [
        f"Written by synth tune: the force error may grow by {100 * tuned.budget:g}% of the force over full",
        "fidelity's. Each change by itself, then whole jobs; ± is a 95% interval over sequences.",
        "",
        f"{'grows by':>16s}{'force error':>14s}{'CPU-s a frame':>16s}",
    ]
    for row in tuned.rows:
        margin = f" ± {100 * row.margin:.2g}" if np.isfinite(row.margin) else ""
        figures = f"{f'{100 * row.growth:.2g}{margin}%':>16s}{100 * row.errors.mean():13.2g}%"
        figures += f"{row.stages.sum():16.3g}"
        if not np.isfinite(row.growth):
            figures = f"{'cannot be carried out':>46s}"
        words = "full fidelity" if row is tuned.full else show(row.settings, tuned.original.settings)
        rows.append(f"{figures}   {words}{'  <- this job' if row is tuned.best else ''}")
    return rows


def write_job(tuned: Tuned, source: str, overrides: Sequence[str], out: Path) -> None:
    """Writes the tuned job of the one that `reader.load_job` reads. FileExistsError if `out` exists."""
    text, label, folder = reader.read_source(source)
    config, keys = ConfigFile(text, label), dict[str, Any]()
    config.change(overrides)
    if folder != out.resolve().parent:  # from which relative paths will start
        job = reader.load_job(source, overrides).model_dump(mode="json")
        paths = {f"{section}.{name}": job[section][name] for section, name in identity.FILES}
        keys = {key: path for key, path in paths.items() if path is not None}
        if identity.find_meshes(job):
            keys |= {f"fem.{name}": job["fem"][name] for name in ("instrument", "instrument_list")}
    changes = differences(tuned.best.settings, tuned.original.settings)
    config.change(f"{key}={json.dumps(value)}" for key, value in (keys | dict(changes)).items())
    head = "".join(f"# {line}".rstrip() + "\n" for line in lines(tuned))
    with out.open("x", encoding="utf-8") as file:
        file.write(f"{head}\n{config.dump()}")
