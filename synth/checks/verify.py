"""Checking a dataset against its own invariants: each named, counted, timed, with its worst offender."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from synth.checks import contents
from synth.checks.measure import Measure, truth
from synth.checks.physics import INVARIANTS
from synth.dataset import index, location, provenance, split
from synth.dataset.folder import Folder
from synth.dataset.store import Sequence, open_sequence
from synth.errors import UserError
from synth.job import identity
from synth.system.stopwatch import Stopwatch
from synth.system.text_lines import hang

_FAST_FRAMES = 2
_FAST_SEQUENCES = 20


@dataclass
class Check:
    """All measures of one name."""

    name: str
    meaning: str
    count: int = 0
    bad: int = 0
    worst: float = 0.0
    limit: float = 0.0
    unit: str = "-"
    """Of worst and limit."""
    offender: str = ""
    cpu_s: float = 0.0
    failures: list[str] = field(default_factory=list)
    """Every sequence with a bad measure, and its worst one."""

    @property
    def good(self) -> bool:
        return not self.bad

    def add(self, measure: Measure, who: str) -> None:
        self.count += 1
        where = f"{who}: {measure.where}"
        if not measure.good:
            self.bad += 1
            self.failures.append(where)
        if measure.severity > 0 and (
            not self.offender or measure.severity > Measure(self.worst, self.limit, "").severity
        ):
            self.worst, self.limit, self.offender = measure.value, measure.limit, where
            self.unit = measure.unit


@dataclass(frozen=True)
class Report:
    """The outcome for one dataset."""

    root: str
    sequences: int
    fast: bool
    checks: list[Check]

    @property
    def good(self) -> bool:
        return all(check.good for check in self.checks)

    def as_dict(self) -> dict[str, Any]:
        return {**asdict(self), "good": self.good}

    def lines(self) -> list[str]:
        """For a person: each check and where its worst measure is, wrapped, then every failure in a line."""
        head = ("check", "count", "bad", "worst", "limit", "unit", "CPU s", "where")
        rows = [head, *(_row(check) for check in self.checks)]
        widths = [max(len(row[k]) for row in rows) for k in range(len(head) - 1)]
        table = []
        for *cells, where in rows:
            front = "".join(f"{cell:<{wide}}  " for cell, wide in zip(cells, widths, strict=True))
            table += hang(front, where)
        failures = [f"{check.name}: {failure}" for check in self.checks for failure in check.failures]
        return [*table, *failures, "good" if self.good else "not good"]


def _row(check: Check) -> tuple[str, ...]:
    numbers = (f"{check.worst:.3g}", f"{check.limit:.3g}", check.unit) if check.offender else ("", "", "")
    return (check.name, str(check.count), str(check.bad), *numbers, f"{check.cpu_s:.2f}", check.offender)


def verify_dataset(root: Path, *, fast: bool = False) -> Report:
    """Checks every sequence and the dataset around them.

    Fast: some frames of some sequences, and no checksums.

    Raises:
        UserError: the folder holds no dataset.
    """
    folder = Folder(root)
    described, sealed = folder.described(), folder.sealed()
    checks = _checks()
    watch = Stopwatch()
    with watch.stage("dataset"):
        for name, measure, who in _dataset(folder, described, sealed):
            checks[name].add(measure, who)
    checks["dataset"].cpu_s += watch.cpu_s("dataset")
    chosen = sealed
    if fast and len(sealed) > _FAST_SEQUENCES:
        chosen = [sealed[k] for k in np.linspace(0, len(sealed) - 1, _FAST_SEQUENCES).astype(int)]
    for key in chosen:
        _sequence(location.store(folder.root, key), described["identity"], checks, fast)
    return Report(str(root), len(chosen), fast, list(checks.values()))


def verify_sequence(path: Path, job: str) -> list[Check]:
    """Checks one store, which belongs to the job of that identity."""
    checks = _checks()
    _sequence(path, job, checks, fast=False)
    return list(checks.values())


def _checks() -> dict[str, Check]:
    checks = {
        "dataset": Check("dataset", "the job, the index and the sequences agree"),
        "splits": Check("splits", "no anatomy, copy or held-out family is on a side where it may not be"),
        "readable": Check("readable", "every store opens and every chunk decodes"),
    }
    checks.update({name: Check(name, meaning) for name, meaning in contents.CHECKS.items()})
    for name, invariant in INVARIANTS.items():
        checks[name] = Check(name, (invariant.__doc__ or "").split("\n")[0])
    return checks


def _sequence(path: Path, name: str, checks: dict[str, Check], fast: bool) -> None:
    try:
        sequence = open_sequence(path, sealed=False)
        frames = _frames(sequence, fast)
    except UserError as error:
        checks["readable"].add(Measure(1.0, 0.0, _without(path, str(error))), path.name)
        return
    own = sequence.attrs.get("job") == name
    checks["dataset"].add(truth(own, "belongs to another job"), path.name)
    broken, watch = "", Stopwatch()
    try:
        for key, measure in contents.check_contents(sequence, frames, fast, watch):
            checks[key].add(measure, path.name)
    except UserError as error:
        broken = _without(path, str(error))
    for key, invariant in INVARIANTS.items():
        try:
            with watch.stage(key):
                measures = list(invariant(sequence, frames))
        except UserError as error:
            broken = broken or _without(path, str(error))
            continue
        except (KeyError, IndexError, TypeError, ValueError) as error:
            measures = [Measure(1.0, 0.0, f"attributes are missing or odd ({error!r})")]
        for measure in measures:
            checks[key].add(measure, path.name)
    for key, check in checks.items():
        check.cpu_s += watch.cpu_s(key)
    checks["readable"].add(truth(not broken, broken or "reads"), path.name)


def _frames(sequence: Sequence, fast: bool) -> list[int]:
    """The frames to look at closely: where the load is greatest, and some between."""
    force = np.linalg.norm(sequence["force"][:], axis=1)
    count = _FAST_FRAMES if fast else 8
    spread = np.linspace(0, sequence.frames - 1, count).round().astype(int)
    return sorted({int(np.argmax(force)), *(int(t) for t in spread)})


def _dataset(
    folder: Folder, described: dict[str, Any], sealed: list[int]
) -> Iterator[tuple[str, Measure, str]]:
    """(check, measure, whose)."""
    job = folder.job()
    makers = {provenance.word(one) for one in described.get("generators", [])}
    try:
        same = identity.identify_job(job) == described["identity"] or provenance.fingerprint() not in makers
    except UserError:
        same = True  # the mesh or the photograph need not travel with the dataset
    yield "dataset", truth(same, "the job is not the one that was rendered"), "dataset.json"
    failed = set(folder.failures())
    missing = sorted(set(range(job.sequences)) - set(sealed) - failed)
    yield (
        "dataset",
        truth(not missing, f"{len(missing)} sequences are missing, first {missing[:1]}"),
        "dataset",
    )
    strangers = [key for key in sealed if key >= job.sequences]
    yield "dataset", truth(not strangers, f"sequences that the job does not have: {strangers[:3]}"), "dataset"
    try:
        rows = {row["index"]: row for row in index.read_index(folder.root).to_pylist()}
    except UserError as error:
        yield "dataset", truth(False, str(error)), index.NAME
        return
    for key in sealed:
        try:
            found = open_sequence(location.store(folder.root, key), sealed=False)
        except UserError:
            continue  # found and named by the check of that sequence
        now, row = index.row_of(found), rows.get(key, {})
        differing = [name for name, value in now.items() if row.get(name) != value]
        yield "dataset", truth(not differing, f"row {key} differs in {', '.join(differing)}"), index.NAME
        maker = found.attrs.get("versions", {}).get("generator")
        known = maker in makers
        yield "dataset", truth(known, "made by a version that dataset.json does not name"), found.path.name
    surplus = sorted(key for key, row in rows.items() if row["status"] == "done" and key not in sealed)
    yield "dataset", truth(not surplus, f"rows without a sequence: {surplus[:3]}"), index.NAME
    try:
        rule = split.read_rule(folder.root)
    except UserError as error:
        yield "splits", truth(False, str(error)), split.NAME
        return
    leaking = split.leaks(list(rows.values()), rule) or _misplaced(list(rows.values()), rule)
    yield "splits", truth(not leaking, "; ".join(leaking[:3]) or "none"), index.NAME


def _misplaced(rows: list[dict[str, Any]], rule: split.Rule) -> list[str]:
    """Sequences that the index puts on another side than the rule does."""
    try:
        sides = split.assign_sides(rows, rule)
    except UserError:  # too few groups to have some on every side
        sides = [None] * len(rows)
    return [
        f"sequence {row['index']} is in {row['split']}, by the rule in {side}"
        for row, side in zip(rows, sides, strict=True)
        if row["split"] != side
    ]


def _without(path: Path, text: str) -> str:
    return text.removeprefix(f"{path}: ").removeprefix(f"{path}")
