"""The dataset's folder: its job, the lock of the current run, finished and failed sequences."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from synth.dataset import location, provenance
from synth.errors import UserError
from synth.formats import FOLDER, check_format
from synth.job import identity, job_writer
from synth.job.microscope import BLUR_WIDTH_PX
from synth.job.schema import Job
from synth.job.types import PronyTerms
from synth.plugins import STORED
from synth.system import checked_file, file_lock
from synth.system.checked_file import write_whole as write_whole
from synth.system.config_file import validate_values

_NAME = "dataset.json"
_GATE_S = 3600.0  # that a part waits for the others to begin, or for one that writes the index


class _Described(BaseModel):
    """The content of `dataset.json`."""

    format_version: int = 1
    identity: str
    job: dict[str, Any]
    generators: list[dict[str, str]]


@dataclass(frozen=True)
class Part:
    """One of `count` runs that share a dataset without knowing of each other, as those of a SLURM array."""

    number: int  # from 1
    count: int

    def __contains__(self, index: int) -> bool:
        return index % self.count == self.number - 1

    @property
    def name(self) -> str:
        return f"{self.number:05d}-of-{self.count:05d}"


def parse_part(text: str) -> Part:
    """A part such as 3/40. UserError: it is none."""
    match = re.fullmatch(r"\s*(\d{1,5})\s*/\s*(\d{1,5})\s*", text)
    part = Part(int(match[1]), int(match[2])) if match else None
    if part is None or not 1 <= part.number <= part.count:
        raise UserError(f"--part {text}: give NUMBER/COUNT, the number from 1, such as 3/40")
    return part


class Folder:
    """A dataset's folder. All state is read from disk, so that it survives a crash.

    `part`: of the dataset, that a run computes; None: all of it.
    """

    def __init__(self, root: Path, part: Part | None = None) -> None:
        self.root, self.part = root, part
        self.state = root / ".run"
        self.logs = self.state / "logs"
        self.scratch = self.state / "scratch"
        self.lock_fd = -1
        self.turn_file = self.state / "turn"
        self.turn = 0

    @property
    def is_begun(self) -> bool:
        """Whether it has a job."""
        return os.path.lexists(self.root / _NAME)

    def read_description(self) -> dict[str, Any]:
        """The content of `dataset.json`. UserError if it is missing, damaged or of an unsupported format."""
        if not self.is_begun:
            raise UserError(f"{self.root}: is not a dataset ({_NAME} is missing)")
        content = checked_file.read_json(self.root / _NAME)
        if isinstance(content, dict):
            check_format(content.get("format_version", 1), FOLDER, str(self.root / _NAME))
        return validate_values(_Described, content, f"{self.root / _NAME}: is damaged").model_dump()

    def job(self) -> Job:
        """The dataset's job; its plug-ins need not be installed."""
        description = self.read_description()
        job = description["job"]
        render, sensor = job.get("render"), job.get("sensor")
        if description["format_version"] < 4 and isinstance(render, dict) and isinstance(sensor, dict):
            render["scenery"] = [part for part in render.get("scenery", ()) if part != "cottonoid"]
            sensor["blur_px"] = sensor.get("blur_px", 0.0) * BLUR_WIDTH_PX / render.get("size", (640,))[0]
        return validate_values(Job, job, f"{self.root / _NAME}: is damaged", STORED)

    def refuse_replaced(self, job: Job, name: str) -> None:
        """Raises UserError if files of the folder's own job are no longer those that it was begun with.

        `name`: identity of `job` by its files as they are now.
        """
        if not self.is_begun or (description := self.read_description())["identity"] == name:
            return
        if not _list_changes(description["job"], job.model_dump(mode="json")):
            files = "mechanics.source, anatomy.mesh, appearance.photo, render.calibration or fem.instrument"
            why = f"a file of {files} was replaced since the dataset was begun"
            raise UserError(f"{self.root}: {why}; restore it, or choose another folder")

    def list_sealed(self) -> list[int]:
        """Indices of the finished sequences, in order."""
        with os.scandir(self.root) as entries:
            indices = [location.index_of(entry.name) for entry in entries]
        return sorted(index for index in indices if index is not None)

    def failures(self) -> dict[int, dict[str, Any]]:
        """`{index: {"reason", "kind", "tries", "log"}}` of the failed sequences."""
        failures = {}
        for path in sorted((self.state / "failed").glob("*.json")):
            with suppress(UserError, ValueError):  # damaged: the sequence is computed again
                failure = checked_file.read_json(path)
                if isinstance(failure, dict) and isinstance(failure.get("reason"), str):
                    failures[int(path.stem)] = failure
        return failures

    def mark_failed(self, failure: dict[str, Any]) -> None:
        """Marks the sequence `failure["index"]` as failed, until `synth render --retry`."""
        write_whole(self.state / "failed" / f"{failure['index']:06d}.json", json.dumps(failure, indent=1))
        self.sweep(failure["index"])

    def clear_failures(self, indices: Iterable[int] | None = None) -> None:
        """Deletes the marks of failed sequences, all of the part if `indices` is None."""
        for index in filter(self.computes, self.failures()) if indices is None else indices:
            (self.state / "failed" / f"{index:06d}.json").unlink(missing_ok=True)

    def sweep(self, index: int) -> None:
        """Deletes the unfinished store of sequence `index`."""
        store = location.store(self.root, index)
        leftover = store.with_name(f"{store.name}.part")
        if leftover.exists() and not store.exists():
            shutil.rmtree(leftover)

    def computes(self, index: int) -> bool:
        """Whether a sequence is of its part."""
        return self.part is None or index in self.part

    @property
    def lock_file(self) -> Path:
        """Locked during a run of its part."""
        return self.state / ("lock" if self.part is None else f"part-{self.part.name}.lock")

    @property
    def progress_file(self) -> Path:
        """Progress of the current run of its part, for `synth status`."""
        return self.state / ("progress.json" if self.part is None else f"part-{self.part.name}.json")

    def running(self) -> list[Path]:
        """Progress files of the runs that write to it now, other than of its own part."""
        locks = {self.state / "lock": self.state / "progress.json"}
        locks |= {lock: lock.with_suffix(".json") for lock in self.state.glob("part-*.lock")}
        return [file for lock, file in locks.items() if lock != self.lock_file and file_lock.is_held(lock)]

    @contextmanager
    def gate(self) -> Iterator[None]:
        """Excludes the others while one of several runs begins, or completes the dataset. `Locked` after an
        hour."""
        with file_lock.hold(self.state / "gate", _GATE_S):
            yield

    def sweep_all(self) -> None:
        """Deletes all files of interrupted attempts; beside runs of other parts, only its own stores."""
        if self.part is not None and self.running():
            for index in filter(self.computes, location.list_unfinished(self.root)):
                self.sweep(index)
            return
        for folder in (*self.root.glob("*.zarr.part"), *self.scratch.glob("*")):
            shutil.rmtree(folder)
        places = (self.root, self.state, self.state / "failed")
        parts = (part for place in places for part in place.glob(f".*{checked_file.PART}"))
        for file in (*parts, *self.logs.glob("worker-*.log")):
            file.unlink()

    def invalidate_workers(self) -> None:
        """Makes workers of an earlier run on other machines end, by a new turn."""
        try:
            last_turn = int(self.turn_file.read_text())
        except (FileNotFoundError, ValueError):
            last_turn = 0
        self.turn = last_turn + 1
        write_whole(self.turn_file, str(self.turn), durable=False)

    def discard(self) -> None:
        """Deletes the files of a run without a finished sequence."""
        for name in (_NAME, "job.yaml", "index.parquet"):
            (self.root / name).unlink(missing_ok=True)
        shutil.rmtree(self.state)


@lru_cache
def read_relaxation(sequence: Path) -> PronyTerms:
    """Relaxation of a stored sequence's tissue, by its dataset's job; empty without a dataset around it."""
    folder = Folder(sequence.parent)
    return folder.job().fem.relaxation if folder.is_begun else ()


@contextmanager
def claim(root: Path, job: Job, *, mix_versions: bool = False, part: Part | None = None) -> Iterator[Folder]:
    """The folder for `job`, created or continued, and locked for this process; other content stays unchanged.

    More sequences than before extend the dataset; `mix_versions` continues another version's; `part`: runs of
    other parts may write to it meanwhile. UserError: the dataset of another job or version, other files,
    another run, or no permission.
    """
    folder, created, fresh = Folder(root, part), not root.exists(), not (root / _NAME).exists()
    name = identity.identify_job(job)
    try:
        _refuse_foreign(folder, job, name)
        run_files = (folder.state, *folder.state.glob("*"), *folder.state.glob("*/*"))
        for place in (*run_files, *root.glob("*.zarr.part")):
            if place.is_symlink():  # a run writes or deletes here
                raise UserError(f"{place}: is a link; remove it")
        folder.state.mkdir(parents=True, exist_ok=True)
        with ExitStack() as locks:
            with folder.gate():
                if part is None and folder.running():
                    raise file_lock.Locked
                others = {file.stem.partition("-of-")[2] for file in folder.running()}
                if part is not None and others - {f"{part.count:05d}"}:  # a whole run, or another division
                    raise file_lock.Locked
                folder.lock_fd = locks.enter_context(file_lock.hold(folder.lock_file))
                _refuse_foreign(folder, job, name)
                _begin(folder, job, name, _makers(folder, mix_versions))
            try:
                yield folder
            finally:
                if part is None:
                    folder.invalidate_workers()
                    if fresh and not folder.list_sealed() and not folder.failures():
                        folder.discard()
                        if created and not any(root.iterdir()):  # an interrupted sequence may be left
                            root.rmdir()
    except file_lock.Locked:
        raise UserError(f"{root}: another run is writing to it") from None
    except OSError as error:
        if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.ENOTDIR):
            raise UserError(f"{root}: cannot be written ({os.strerror(error.errno)})") from error
        raise


def _begin(folder: Folder, job: Job, name: str, makers: list[dict[str, str]]) -> None:
    """Writes the job into a folder that is locked, and removes what interrupted runs left."""
    for place in (folder.state / "failed", folder.logs, folder.scratch):
        place.mkdir(exist_ok=True)
    values = job.model_dump(mode="json")
    description = _Described(format_version=FOLDER, identity=name, job=values, generators=makers)
    text = description.model_dump_json(indent=1) + "\n"
    if not folder.running() or not folder.is_begun or (folder.root / _NAME).read_text("utf-8") != text:
        write_whole(folder.root / _NAME, text)
        head = "# The job of this dataset, with all values.\n"
        write_whole(folder.root / "job.yaml", head + job_writer.dump_job(job))
    if folder.part is None:
        folder.invalidate_workers()
    folder.sweep_all()


def _refuse_foreign(folder: Folder, job: Job, name: str) -> None:
    root = folder.root
    if not root.exists():
        return
    if not root.is_dir():
        raise UserError(f"{root}: is a file; choose a folder")
    if not (root / _NAME).exists():
        others = sorted(entry.name for entry in root.iterdir() if not entry.name.startswith("."))
        # Another part may have begun the dataset between the two looks: that file is its first.
        if not (root / _NAME).exists():
            if others:
                raise UserError(f"{root}: contains other files ({others[0]}); choose an empty or new folder")
            return
    description = folder.read_description()
    if (
        description["identity"] != name
        and not folder.list_sealed()
        and not folder.failures()
        and not folder.running()
    ):
        return  # nothing was finished of the other one, and nobody computes it
    if description["identity"] != name:
        changes = _list_changes(description["job"], job.model_dump(mode="json"))
        what = ", ".join(changes[:4]) or "another mesh or photograph"
        raise UserError(f"{root}: contains the dataset of another job ({what}); choose another folder")
    if (count := folder.job().sequences) > job.sequences:
        raise UserError(f"{root}: contains {count} sequences of this job; sequences={job.sequences} is fewer")


def _makers(folder: Folder, mix: bool) -> list[dict[str, str]]:
    """The versions that created the dataset, including this one. UserError if they may not be mixed."""
    this_maker, count = provenance.generator(), len(folder.list_sealed()) if folder.root.is_dir() else 0
    makers: list[dict[str, str]] = folder.read_description()["generators"] if count else []
    if mix or not count or [*map(provenance.word, makers)] == [provenance.word(this_maker)]:
        names = {provenance.word(maker) for maker in makers}
        return [*makers, *([] if provenance.word(this_maker) in names else [this_maker])]
    last_versions = provenance.select_compared(makers[-1]) if makers else {}
    changed = (
        key for key in provenance.select_compared(this_maker) if last_versions.get(key) != this_maker[key]
    )
    changes = [f"{key} {last_versions.get(key, 'unknown')}, now {this_maker[key]}" for key in changed]
    what = "; ".join(changes) or "several versions"
    raise UserError(
        f"{folder.root}: its {count} sequences were made by another version of this program ({what}): "
        "choose another folder, or continue it with --mix-versions"
    )


def _list_changes(old_values: dict[str, Any], new_values: dict[str, Any], prefix: str = "") -> list[str]:
    changes = []
    for key in sorted((old_values.keys() | new_values.keys()) - {"card"}):
        old, new = old_values.get(key), new_values.get(key)
        if isinstance(old, dict) and isinstance(new, dict):
            changes += _list_changes(old, new, f"{prefix}{key}.")
        elif old != new and f"{prefix}{key}" != "sequences":
            changes.append(f"{prefix}{key} is {json.dumps(old)} there and {json.dumps(new)} here")
    return changes
