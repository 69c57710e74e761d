"""A dataset from a script, as `synth render` makes it."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

from synth.engine.journal import Watcher
from synth.engine.progress import Bars
from synth.engine.run import Options, Summary, run_job
from synth.job.schema import Job


class _Unwatched(Watcher):
    """A watcher that does nothing."""


def render(job: Job, out: str | Path, *, progress: bool | Watcher = False, **options: Any) -> Summary:
    """Renders the dataset of a job into a folder; one that is there for the same job is continued.

    Sequences are computed in processes of their own, so this works from a notebook too. A sequence that fails
    doesn't end the run: `Summary.failed` has its reason.

    Args:
        job: the job; `load_job` reads one.
        out: the folder.
        progress: True draws bars, in a terminal or a notebook; an object with the methods of `Watcher` is
            told what happens.
        options: as the command's: `workers`, `engine`, `gpus`, `memory_gb`, `mix_versions`.

    Raises:
        UserError: the folder is not for this job, the disk is full, or the job cannot be carried out.
    """
    chosen = Options(**options)
    with Bars() if progress is True else nullcontext(progress or _Unwatched()) as watcher:
        return run_job(job, Path(out), chosen, watcher)
