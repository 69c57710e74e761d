"""Reading a job: its file, overrides and the files it names; errors are reported with their line."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from synth.arguments import checked
from synth.errors import UserError, did_you_mean
from synth.job import identity
from synth.job.schema import Job
from synth.system import checked_file
from synth.system.config_file import ConfigFile, Loc, Mistake


def names() -> list[str]:
    """Names of the jobs in this package."""
    jobs = (resources.files("synth.job") / "named").iterdir()
    return sorted(entry.name.removesuffix(".yaml") for entry in jobs if entry.name.endswith(".yaml"))


@checked
def load_job(source: str | Path, overrides: Sequence[str] = ()) -> Job:
    """The job in `source`, with overrides applied.

    Args:
        source: path of a job file, or one of `names()`. A file wins when it exists. overrides:
        `section.key=value`, the value in YAML. Paths in them are relative to the working directory, those in
        a job file to the file.

    Raises:
        UserError: one line for each error, `job.yaml:12:3: render.sppp: unknown key; did you mean 'spp'?`
    """
    text, label, folder = read_source(str(source))
    return parse_job(text, label, folder, overrides)


def as_job(job: Job | str | Path) -> Job:
    """The job itself, or the one that `load_job` reads; raises as `load_job`."""
    return job if isinstance(job, Job) else load_job(job)


def read_source(source: str) -> tuple[str, str, Path]:
    """Text of a job file or named job, its name in messages, and the folder of its relative paths."""
    # `synth render mission -o mission` is repeated, and continued, next to its own folder.
    if os.path.lexists(source) and not (source in names() and os.path.isdir(source)):
        text = checked_file.read_text(Path(source), checked_file.LARGEST_YAML)
        return text, source, Path(source).resolve().parent
    if source not in names():
        # All but the training data of the pretrained networks.
        examples = [name for name in names() if name != "mission"]
        hint = did_you_mean(source, names()) or f", and no named job ({', '.join(examples)})"
        raise UserError(f"{source[:80]}: no such file{hint}")
    text = (resources.files("synth.job") / "named" / f"{source}.yaml").read_text("utf-8")
    return text, f"{source} (a named job)", Path.cwd()


def parse_job(text: str, label: str, folder: Path, overrides: Sequence[str] = ()) -> Job:
    """The job in `text`; `label` names it in messages, relative paths in it start at `folder`."""
    config = ConfigFile(text, label)
    config.change(overrides)
    return config.validate(Job, _find_files(config, folder))


def _find_files(config: ConfigFile, folder: Path) -> Iterator[Mistake]:
    """Makes the paths in a job absolute; yields the errors of those that can't be used."""
    places: list[tuple[Loc, int | None]] = [*identity.FILES.items(), (("mechanics", "source"), None)]
    places += [(place, checked_file.LARGEST_INSTRUMENT) for place in identity.find_meshes(config.values)]
    for place, largest in places:
        block = _look_up(config.values, place[:-1])
        name = _look_up(block, place[-1:])
        if not isinstance(name, str):
            continue
        overridden = any(place[: len(change)] == change for change in config.changes)
        try:
            path = ((Path.cwd() if overridden else folder) / Path(name).expanduser()).resolve()
            if place == ("appearance", "photo") and path.is_dir():
                identity.list_pictures(path)
            elif largest is not None:  # else a pattern, or a folder
                checked_file.check_file(path, largest)
            block[place[-1]] = str(path)
        except UserError as error:
            yield Mistake(place, str(error))
        except (RuntimeError, ValueError, OSError):  # no such home, a NUL, a loop of links, too long
            yield Mistake(place, f"{name[:80]!r} is not a valid path")


def _look_up(values: Any, place: Loc) -> Any:
    """The value at a place in blocks and lists; None if there is none."""
    for step in place:
        try:
            values = values[step]
        except (KeyError, IndexError, TypeError):
            return None
    return values
