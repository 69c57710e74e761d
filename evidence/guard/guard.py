"""Comparison of the probes with the stored guard, and its renewal.

`docs/results/guard.json` holds the sketches of all probes and the versions that caches depend on. Its
difference in a commit is the statement "this commit moves flow by 0.8%".
"""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from typing import Annotated, Any

import typer

from evidence import report
from evidence.guard.probes import PROBES
from evidence.guard.sketch import Sketch, compare_all, sketch_all
from synth import formats
from synth.system.checked_file import write_whole

FILE = report.RESULTS / "guard.json"
_WORKERS = 2

Sketches = dict[str, dict[str, Sketch]]
"""By probe, then by array."""


@dataclass(frozen=True)
class Change:
    """How much a probe differs from a stored sketch of it."""

    probe: str
    relative: float
    """Largest relative change of its arrays; infinite for another shape or another set of arrays."""
    array: str
    """The array that changed most."""

    @property
    def moved(self) -> bool:
        """Whether the change is above the probe's tolerance."""
        return self.relative > PROBES[self.probe].tolerance

    def text(self) -> str:
        """`flow 0.8% (confidence)`."""
        percent = 100 * self.relative
        size = "another shape" if math.isinf(percent) else f"{percent:{'.0f' if percent >= 10 else '.2g'}}%"
        return f"{self.probe} {size} ({self.array})"


def read_sketches() -> Sketches:
    """The sketches of `docs/results/guard.json`."""
    sketches: Sketches = json.loads(FILE.read_text("utf-8"))["probes"]
    return sketches


def read_versions() -> dict[str, int]:
    """The versions of `docs/results/guard.json`, by their names in `synth.formats`."""
    versions: dict[str, int] = json.loads(FILE.read_text("utf-8"))["versions"]
    return versions


def versions() -> dict[str, int]:
    """The versions that caches depend on, as they are now."""
    names = dict.fromkeys(name for probe in PROBES.values() for name in probe.versions)
    return {name: getattr(formats, name) for name in names}


def run_probe(name: str) -> dict[str, Sketch]:
    """Runs a probe on one thread and sketches its arrays."""
    import cv2

    cv2.setNumThreads(1)
    return sketch_all(PROBES[name].run())


def run_probes(names: Sequence[str], workers: int = _WORKERS) -> Iterator[tuple[str, dict[str, Sketch]]]:
    """Runs probes, each in a process of its own; yields name and sketches as they end."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, max_tasks_per_child=1) as pool:
        futures = {pool.submit(run_probe, name): name for name in names}
        for future in as_completed(futures):
            yield futures[future], future.result()


def compare(
    before: Mapping[str, Mapping[str, Sketch]], now: Mapping[str, Mapping[str, Sketch]]
) -> list[Change]:
    """The changes of probes that both hold, in the order of the pipeline."""
    changes = []
    for name in PROBES:
        if name in before and name in now:
            by_array = compare_all(before[name], now[name])
            array = max(by_array, key=lambda key: by_array[key])
            changes.append(Change(name, by_array[array], array))
    return changes


def find_unraised(changes: Sequence[Change], before: Mapping[str, int], now: Mapping[str, int]) -> list[str]:
    """A message for each moved probe without a raised version: caches would return its old values."""
    lines = []
    for change in changes:
        names = PROBES[change.probe].versions
        if change.moved and not any(now[name] > before.get(name, 0) for name in names):
            lines.append(f"{change.probe} moved: raise {' or '.join(names)} in synth/formats.py")
    return lines


def main(
    probe: Annotated[list[str] | None, typer.Argument(help="Probes to run; all if none is named.")] = None,
    accept: Annotated[
        bool, typer.Option(help="Stores what is measured now in docs/results/guard.json.")
    ] = False,
) -> None:
    """Runs the probes and says by how much each differs from the stored guard; exit code 1 if one moved.

    With --accept the guard is rewritten; a probe that moved without its version being raised is refused.
    """
    names = probe or list(PROBES)
    if unknown := sorted(set(names) - set(PROBES)):
        raise typer.BadParameter(f"{unknown[0]}: one of {', '.join(PROBES)}")
    now: Sketches = {}
    for name, sketches in run_probes(names):
        now[name] = sketches
        print(f"{len(now)} of {len(names)}: {name}", file=sys.stderr, flush=True)
    before = read_sketches() if FILE.is_file() else {}
    old_versions = read_versions() if FILE.is_file() else {}
    changes = compare(before, now)
    for change in changes:
        typer.echo(f"{'MOVED' if change.moved else 'equal'}  {change.text()}")
    unraised = find_unraised(changes, old_versions, versions())
    for line in unraised:
        typer.echo(line)
    if accept and not unraised:
        # Sketches of probes that have not moved stay, so that small changes of many commits add up visibly.
        moved_probes = {change.probe for change in changes if change.moved}
        merged = {
            name: {**now.get(name, {}), **({} if name in moved_probes else before.get(name, {}))}
            for name in PROBES
        }
        # A version counts as stored only once all probes that may vouch for it have run.
        pending = {version for name in set(PROBES) - set(now) for version in PROBES[name].versions}
        new_versions = {
            key: old_versions.get(key, value) if key in pending else value
            for key, value in versions().items()
        }
        _write({name: sketches for name, sketches in merged.items() if sketches}, new_versions)
        from evidence import result_status  # which compares results with the guard

        result_status.write_states()
        return
    raise typer.Exit(int(bool(unraised) or any(change.moved for change in changes)))


def _write(sketches: Mapping[str, Any], numbering: Mapping[str, int]) -> None:
    lines = []
    for name, arrays in sketches.items():
        rows = ",\n".join(
            f"  {json.dumps(array)}: {json.dumps(numbers)}" for array, numbers in arrays.items()
        )
        lines.append(f" {json.dumps(name)}: {{\n{rows}\n }}")
    text = f'{{"versions": {json.dumps(dict(numbering))},\n"probes": {{\n' + ",\n".join(lines) + "\n}}\n"
    write_whole(FILE, text, durable=False)
