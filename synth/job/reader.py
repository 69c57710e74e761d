"""Reading a job: its file, overrides, files it names, schema; mistakes named at their place."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from importlib import resources
from pathlib import Path

from synth.errors import UserError, as_path, did_you_mean
from synth.job import identity
from synth.job.schema import Job
from synth.system import checked_file
from synth.system.config_file import ConfigFile, Mistake


def names() -> list[str]:
    """Jobs that come with the program."""
    jobs = (resources.files("synth.job") / "named").iterdir()
    return sorted(entry.name.removesuffix(".yaml") for entry in jobs if entry.name.endswith(".yaml"))


def load_job(source: str | Path, overrides: Sequence[str] = ()) -> Job:
    """The job in `source`, with overrides applied.

    Args:
        source: path of a job file, or one of `names()`. A path wins when it exists.
        overrides: `section.key=value`, the value in YAML. Relative paths in them start at the working
            directory, those in a file at the file.

    Raises:
        UserError: one line for every mistake, `job.yaml:12:3: render.sppp: unknown key; did you mean 'spp'?`
    """
    as_path("job", source)
    text, label, folder = read_source(str(source))
    return parse_job(text, label, folder, overrides)


def as_job(job: Job | str | Path) -> Job:
    """The job itself, or what `load_job` reads; errors as there."""
    return job if isinstance(job, Job) else load_job(job)


def read_source(source: str) -> tuple[str, str, Path]:
    """Text of a job file or named job, its name in messages, and where its relative paths start."""
    if os.path.lexists(source):
        text = checked_file.read_text(Path(source), checked_file.LARGEST_YAML)
        return text, source, Path(source).resolve().parent
    if source not in names():
        shown = [name for name in names() if name != "mission"]  # made the networks that come along
        hint = did_you_mean(source, names()) or f"; nor a job called so ({', '.join(shown)})"
        raise UserError(f"{source[:80]}: no such file{hint}")
    text = (resources.files("synth.job") / "named" / f"{source}.yaml").read_text("utf-8")
    return text, f"{source} (a named job)", Path.cwd()


def parse_job(text: str, label: str, folder: Path, overrides: Sequence[str] = ()) -> Job:
    """The job in `text`; `label` names it in messages and its relative paths start at `folder`."""
    config = ConfigFile(text, label)
    config.change(overrides)
    return config.validate(Job, _find_files(config, folder))


def _find_files(config: ConfigFile, folder: Path) -> Iterator[Mistake]:
    """Makes the names of files absolute; what is wrong with one of them."""
    for at, largest in identity.FILES.items():
        block = config.values.get(at[0])
        name = block.get(at[1]) if isinstance(block, dict) else None
        if not isinstance(name, str):
            continue
        try:
            path = ((Path.cwd() if at in config.changes else folder) / Path(name).expanduser()).resolve()
            checked_file.check_file(path, largest)
            config.values[at[0]][at[1]] = str(path)
        except UserError as error:
            yield Mistake(at, str(error))
        except (RuntimeError, ValueError, OSError):  # no such home, a NUL, a circle of links, too long
            yield Mistake(at, f"{name[:80]!r} is no name of a file")
