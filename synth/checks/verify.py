"""`synth verify`: all checks of a dataset, each with its counts, time and worst measure."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from synth.checks import contents, optics, physics_checks, stereo_checks
from synth.checks.measurements import Invariant, Measure, Nothing, truth
from synth.dataset import index, location, provenance, sequence_split
from synth.dataset.dataset_folder import Folder
from synth.dataset.store import open_sequence
from synth.errors import UserError
from synth.job import identity
from synth.system.stopwatch import Stopwatch
from synth.system.terminal import hang

_FAST_FRAMES, _FRAMES = 2, 8
_FAST_SEQUENCES = 20

INVARIANTS: dict[str, Invariant] = {
    function.__name__: function
    for function in (
        contents.seal,
        contents.schema,
        physics_checks.rest,
        physics_checks.force,
        physics_checks.compliance,
        physics_checks.visibility,
        physics_checks.warp,
        physics_checks.forward_backward,
        optics.picture,
        optics.camera,
        optics.contact,
        stereo_checks.stereo,
    )
}
"""All invariants of a sequence by name, in the order of their checks; docstrings are their meanings."""

MEANINGS = {
    "dataset": "Job, index and sequences agree.",
    "splits": "No anatomy or copy is on two sides, no held-out family in training.",
    "readable": "Every store can be opened and every chunk decoded.",
    **contents.VALUES,
    **{name: (function.__doc__ or "").split("\n")[0] for name, function in INVARIANTS.items()},
}
"""The condition of each check by its name."""

_NOTHING = {
    "contact": "no whole contact in view",
    "compliance": "no load in two frames in turn",
    "warp": f"no {physics_checks.LEAST_MOVING_PX} visible pixels move by over 3 px",
}
"""The reason for which a check has measured nothing in any frame; else no tissue is visible."""


@dataclass
class Check:
    """All measures of one name."""

    name: str
    meaning: str
    count: int = 0
    bad: int = 0
    skipped: int = 0  # sequences in which there is nothing to measure
    why: dict[str, int] = field(default_factory=dict)  # the reasons, each with its number of sequences
    worst: float = 0.0
    limit: float = 0.0
    unit: str = "-"  # of worst and limit
    offender: str = ""  # place of the worst measure
    cpu_s: float = 0.0
    failures: list[str] = field(default_factory=list)  # places of all bad measures

    def add(self, measure: Measure | Nothing, owner: str) -> None:
        if isinstance(measure, Nothing):
            self.skipped += 1
            self.why[measure.why] = self.why.get(measure.why, 0) + 1
            return
        self.count += 1
        place = f"{owner}: {measure.place}"
        if not measure.good:
            self.bad += 1
            self.failures.append(place)
        if measure.severity > (Measure(self.worst, self.limit, "").severity if self.offender else 0):
            self.worst, self.limit, self.unit = measure.value, measure.limit, measure.unit
            self.offender = place


@dataclass(frozen=True)
class VerifyReport:
    """The results for one dataset."""

    root: str
    sequences: int
    fast: bool
    checks: list[Check]
    cautions: dict[str, list[int]] = field(default_factory=dict)
    """What is doubtful about the mechanics of another program, each with the sequences of which it is."""

    @property
    def good(self) -> bool:
        return not any(check.bad for check in self.checks)

    @property
    def verdict(self) -> str:
        """Whether it is good, by how many checks, and which of them had nothing to look at, and why."""
        failed = [check.name for check in self.checks if check.bad]
        measured_count = sum(check.count > 0 for check in self.checks)
        text = f"good: {measured_count} checks"
        if self.cautions:
            several = "are doubts" if len(self.cautions) > 1 else "is a doubt"
            doubts = f"there {several} about the mechanics.source, listed above"
            text = f"doubtful: {measured_count} checks hold, but {doubts}"
        if failed:
            text = f"not good: {len(failed)} of {measured_count} checks failed: {', '.join(failed)}"
        for what, measured in ("nothing", False), ("in some sequences nothing", True):
            empty = [check for check in self.checks if check.skipped and bool(check.count) == measured]
            if empty:
                reasons = ", ".join(f"{check.name} ({' or '.join(check.why)})" for check in empty)
                text += f"; {len(empty)} had {what} to check: {reasons}"
        return text

    def as_dict(self) -> dict[str, Any]:
        return {**asdict(self), "good": self.good, "verdict": self.verdict}

    def lines(self) -> list[str]:
        """Lines of text: a table of the checks with their worst measures, then every failure."""
        rows = [("check", "count", "bad", "skipped", "worst", "limit", "unit", "CPU s", "where")]
        for check in self.checks:
            worst = (f"{check.worst:.3g}", f"{check.limit:.3g}", check.unit) if check.offender else ("",) * 3
            counts = (check.name, str(check.count), str(check.bad), str(check.skipped))
            rows.append((*counts, *worst, f"{check.cpu_s:.2f}", check.offender))
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        table = []
        for *cells, place in rows:
            front = "".join(f"{cell:<{width}}  " for cell, width in zip(cells, widths, strict=False))
            table += hang(front, place)
        failures = [f"{check.name}: {failure}" for check in self.checks for failure in check.failures]
        doubts = [
            f"doubtful in {len(sequences)} sequences, first {sequences[0]}: {text}"
            for text, sequences in self.cautions.items()
        ]
        return [*table, *failures, *doubts, self.verdict]


def verify_dataset(root: Path, *, fast: bool = False) -> VerifyReport:
    """Checks a dataset and all of its sequences. UserError if the folder contains no dataset.

    `fast`: only some frames of some sequences, without checksums.
    """
    folder = Folder(root)
    description, indices = folder.read_description(), folder.list_sealed()
    checks = {name: Check(name, meaning) for name, meaning in MEANINGS.items()}
    watch = Stopwatch()
    with watch.stage("dataset"):
        for name, owner, good, message in _check_dataset(folder, description, indices):
            checks[name].add(truth(good, message), owner)
    if fast and len(indices) > _FAST_SEQUENCES:
        indices = [indices[k] for k in np.linspace(0, len(indices) - 1, _FAST_SEQUENCES).astype(int)]
    for key in indices:
        path = location.store(folder.root, key)
        for name, measure in check_sequence(path, description["identity"], watch, fast=fast):
            checks[name].add(measure, path.name)
    for name, check in checks.items():
        check.cpu_s = watch.cpu_s(name)
        if not check.count + check.skipped:
            check.add(
                Nothing("not with --fast" if fast and name == "checksum" else "no sequence is readable"), ""
            )
    return VerifyReport(
        str(root), len(indices), fast, list(checks.values()), index.list_cautions(root, indices)
    )


def check_sequence(
    path: Path, job: str, watch: Stopwatch, *, fast: bool = False
) -> Iterator[tuple[str, Measure | Nothing]]:
    """Measures of one store by name of check; `job` is the dataset's identity, `watch` times each check.

    `fast`: only some frames, without checksums.
    """

    def without_path(error: UserError) -> str:
        return str(error).removeprefix(f"{path}: ").removeprefix(f"{path}")

    try:
        sequence = open_sequence(path, sealed=False)
        size = np.linalg.norm(sequence["force"][:], axis=1) if "force" in sequence else np.zeros(1)
    except UserError as error:
        yield "readable", truth(False, without_path(error))
        return
    yield "dataset", truth(sequence.attrs.get("job") == job, "belongs to another job")
    # Frames are that of the largest load, and some spread over the sequence.
    spread = np.linspace(0, sequence.frames - 1, _FAST_FRAMES if fast else _FRAMES).round().astype(int)
    frames, fault = sorted({int(np.argmax(size)), *spread.tolist()}), ""
    try:
        yield from contents.check_values(sequence, frames, fast, watch)
    except UserError as error:
        fault = without_path(error)
    for name, invariant in INVARIANTS.items():
        empty = Nothing(_NOTHING.get(name, "no tissue in view"))
        try:
            with watch.stage(name):
                measures = list(invariant(sequence, frames)) or [empty]
        except UserError as error:
            fault = fault or without_path(error)
            continue
        except (KeyError, IndexError, TypeError, ValueError) as error:
            measures = [truth(False, f"attributes are missing or invalid ({error!r})")]
        yield from ((name, measure) for measure in measures)
    yield "readable", truth(not fault, fault)


def _check_dataset(
    folder: Folder, description: dict[str, Any], indices: list[int]
) -> Iterator[tuple[str, str, bool, str]]:
    """Yields name of check, file, whether it holds, and the message if it doesn't."""
    job = folder.job()
    makers = {provenance.word(maker) for maker in description.get("generators", [])}
    try:
        same = identity.identify_job(job) == description["identity"] or provenance.fingerprint() not in makers
    except UserError:
        same = True  # the mesh or photograph may be missing
    yield "dataset", "dataset.json", same, "the job was edited after rendering"
    yield "dataset", "dataset", bool(indices), "no sequence was finished"
    missing = sorted(set(range(job.sequences)) - set(indices) - set(folder.failures()))
    yield "dataset", "dataset", not missing, f"{len(missing)} sequences are missing, first {missing[:1]}"
    surplus = [key for key in indices if key >= job.sequences]
    yield "dataset", "dataset", not surplus, f"sequences beyond those of the job: {surplus[:3]}"
    try:
        rows = {row["index"]: row for row in index.read_index(folder.root).to_pylist()}
    except UserError as error:
        yield "dataset", index.NAME, False, str(error)
        return
    for key in indices:
        try:
            sequence = open_sequence(location.store(folder.root, key), sealed=False)
        except UserError:
            continue  # reported by the check of that sequence
        row = rows.get(key, {})
        differing = [name for name, value in index.row_of(sequence).items() if row.get(name) != value]
        yield "dataset", index.NAME, not differing, f"row {key} differs in {', '.join(differing)}"
        is_known = sequence.attrs.get("versions", {}).get("generator") in makers
        yield "dataset", sequence.path.name, is_known, "its version is not in dataset.json"
    lost_keys = sorted(key for key, row in rows.items() if row["status"] == "done" and key not in indices)
    yield "dataset", index.NAME, not lost_keys, f"rows without a sequence: {lost_keys[:3]}"
    try:
        stored = sequence_split.read_stored(folder.root)
    except UserError as error:
        yield "splits", sequence_split.NAME, False, str(error)
        return
    leaks = sequence_split.find_leaks(list(rows.values()), stored) or sequence_split.find_misplaced(
        list(rows.values()), stored
    )
    yield "splits", index.NAME, not leaks, "; ".join(leaks[:3]) or "none"
