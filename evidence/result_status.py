"""Whether stored results still stand: how far the probes that they depend on have moved since then.

A result holds the sketches of the probes that its study needs (`evidence.guard`), as they were when it was
made. They are always compared with the guard of today, so that small changes of many commits add up.
"""

import datetime
import hashlib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evidence import report
from evidence.guard import guard
from evidence.guard.guard import Change, Sketches
from evidence.report import CHECKOUT, RESULTS
from synth.system.checked_file import write_whole

_STATE = re.compile(r"^\*State: .*\*\n\n", re.M)
_TITLE = re.compile(r"\A# .*\n\n")


@dataclass(frozen=True)
class Status:
    """One stored result."""

    file: Path
    command: str
    commit: str
    date: str
    cpu_hours: float | None
    timed: bool
    """Whether it holds times: they are of a date and a machine, and no change of code makes them wrong."""
    needs: tuple[str, ...]
    """The probes whose sketches it holds; empty: none are known."""
    moved: tuple[Change, ...]
    """Those that have moved since."""
    missing: tuple[str, ...]
    """Probes that its study needs today, and whose sketches it does not hold."""

    @property
    def stands(self) -> bool:
        """Whether it is what a run of today would measure, within the probes' tolerances."""
        return bool(self.needs) and not self.moved and not self.missing

    def describe(self) -> str:
        """`stands`, `out of date, ...: flow 0.8% (confidence)` or `old`, and `times of DATE`."""
        state = "stands" if self.stands else "old: made before the guard, or without probes"
        if self.needs and not self.stands:
            changes = [change.text() for change in self.moved]
            changes += [f"{name} (a newer probe)" for name in self.missing]
            state = "out of date, as these have changed: " + ", ".join(changes)
        return f"{state}; times are of {self.date or 'an unknown date'}" if self.timed else state

    def row(self) -> dict[str, Any]:
        """Cells of a table."""
        name = str(self.file.relative_to(CHECKOUT)) if self.file.is_relative_to(CHECKOUT) else self.file.name
        provenance = {"made": self.date, "commit": self.commit, "CPU-hours": self.cpu_hours}
        return {
            "result": name,
            "state": self.describe(),
            **provenance,
            "command": self.command.split("\n")[0],
        }


def gather(results: Path = RESULTS, today: Sketches | None = None) -> list[Status]:
    """Status of every JSON file of a folder but the guard, by name; `today`: sketches to compare with."""
    from evidence import study  # which stamps its results by this module

    today = guard.read_sketches() if today is None else today
    files = sorted(path for path in results.rglob("*.json") if path.name != guard.FILE.name)
    studies = [entry for entry in map(study.load, study.names()) if entry.result]
    needs = {file: entry.needs for entry in studies for file in files if file.match(entry.result)}
    return [_read(file, today, needs.get(file, ())) for file in files]


def stamp(needs: Iterable[str], timed: bool = False) -> dict[str, Any]:
    """What a result stores about what it depends on: the sketches of its probes, from the stored guard."""
    today = guard.read_sketches()
    return {"timed": timed, "needs": {name: today[name] for name in needs}}


def stamp_files(files: Iterable[Path], needs: Sequence[str], timed: bool = False) -> None:
    """Adds commit, date and `stamp` to results that another program has written."""
    provenance = {"commit": report.commit(), "date": datetime.date.today().isoformat()}
    for file in files:
        data = json.loads(file.read_text("utf-8")) | provenance | stamp(needs, timed)
        write_whole(file, json.dumps(data, indent=1, allow_nan=False) + "\n", durable=False)


def write_states(results: Path = RESULTS) -> None:
    """Writes the state of each result below the title of its page."""
    for status in gather(results):
        page = status.file.with_name("README.md")
        if page.is_file():
            text = _STATE.sub("", page.read_text("utf-8"))
            line = f"*State: {status.describe()}.*\n\n"
            title = _TITLE.match(text)
            end = title.end() if title else 0
            write_whole(page, text[:end] + line + text[end:], durable=False)


def content(path: Path, patterns: Sequence[str] = ("*.json", "*.yaml")) -> str:
    """Hash of a file, or of a folder's files: by default JSON and YAML, which hold hashes of arrays."""
    total = hashlib.blake2b(digest_size=8)
    found = [path] if path.is_file() else [p for pattern in patterns for p in path.rglob(pattern)]
    files = [file for file in found if file.is_file()]
    for file in sorted(files):
        total.update(f"{file.relative_to(path)}\n".encode() + file.read_bytes())
    return total.hexdigest()


def data(*paths: Path, home: Path = CHECKOUT) -> dict[str, str]:
    """Content hashes by path in the checkout, or by name for data elsewhere; results store them."""
    return {
        str(path.relative_to(home)) if path.is_relative_to(home) else path.name: content(path)
        for path in map(Path.resolve, paths)
    }


def _read(file: Path, today: Mapping[str, Any], study_needs: Sequence[str]) -> Status:
    """Status of a file; `study_needs`: probes that the study of this result needs today."""
    stored = json.loads(file.read_text("utf-8"))
    stored = stored if isinstance(stored, dict) else {}
    before: Sketches = stored.get("needs", {})
    changes = tuple(change for change in guard.compare(before, today) if change.moved)
    provenance = {key: str(stored.get(key) or "") for key in ("command", "commit", "date")}
    # A probe that no longer exists can't vouch for anything.
    needs = tuple(before) if set(before) <= set(today) else ()
    return Status(
        file,
        **provenance,
        cpu_hours=stored.get("cpu_hours"),
        timed=bool(stored.get("timed")),
        needs=needs,
        moved=changes,
        missing=tuple(name for name in study_needs if name not in before),
    )
