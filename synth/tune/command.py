"""`synth tune`: heavy imports are inside, as in `cli`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def tune(
    job: Annotated[str, typer.Argument(help="A job file, or a named job: tiny, demo, paper.")],
    overrides: Annotated[list[str] | None, typer.Argument(help="Changes, as section.key=value.")] = None,
    budget: Annotated[str, typer.Option(help="By how much the force error may grow.")] = "force 3%",
    out: Annotated[Path | None, typer.Option("--out", "-o", help="To write; else JOB.tuned.yaml.")] = None,
    probes: Annotated[int, typer.Option(min=1, max=50, help="Sequences for every setting.")] = 3,
    checks: Annotated[int, typer.Option(min=0, max=50, help="Further sequences for whole jobs.")] = 3,
) -> None:
    """Writes the cheapest job whose force error is within a budget of full fidelity's.

    On a few probe sequences one parameter at a time is changed (law, mesh, time step, surface, picture,
    paths); the settings chosen are measured as a whole. The job gets no dearer unless it misses the
    budget. A run that was stopped goes on when it is given again.
    """
    from synth.errors import UserError
    from synth.job import reader
    from synth.tune import search, table

    share = search.parse_budget(budget)
    loaded = reader.load_job(job, overrides or [])
    out = out or Path(f"{Path(job).stem}.tuned.yaml")
    if out.exists() or not out.resolve().parent.is_dir():
        raise UserError(f"{out}: {'exists already' if out.exists() else 'its folder does not exist'}")
    tuned = search.tune(search.Measurements(loaded), share, probes, checks)
    table.write(tuned, job, overrides or [], out)
    print("\n".join([*table.table(tuned), "", f"wrote {out}"]))
