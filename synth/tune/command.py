"""`synth tune`: heavy imports are inside, as in `cli`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def tune(
    job: Annotated[str, typer.Argument(help="A job file, or a named job: tiny, demo, paper.")],
    overrides: Annotated[
        list[str] | None, typer.Argument(help="Changes to the job, as section.key=value.")
    ] = None,
    budget: Annotated[
        str,
        typer.Option(help="By how much the error of the force may grow over full fidelity's: 'force 3%'."),
    ] = "force 3%",
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="The job to write; JOB.tuned.yaml if not given.")
    ] = None,
    probes: Annotated[int, typer.Option(min=1, max=50, help="Sequences for every setting.")] = 3,
    checks: Annotated[int, typer.Option(min=0, max=50, help="Further sequences for whole jobs.")] = 3,
) -> None:
    """Writes the cheapest job whose error of the force is within a budget of full fidelity's.

    A few probe sequences are computed at full fidelity and with one parameter changed at a time (law, mesh,
    time step, surface, size of picture, paths); the settings chosen are measured as a whole. A
    run that was stopped goes on when it is given again.
    """
    from synth.errors import UserError
    from synth.job import reader
    from synth.tune import search, tuned_job
    from synth.tune.measurements import Measurements

    share = search.parse_budget(budget)
    loaded = reader.load_job(job, overrides or [])
    target = out or Path(f"{Path(job).stem}.tuned.yaml")
    if target.exists():
        raise UserError(f"{target}: exists already")
    if not target.resolve().parent.is_dir():
        raise UserError(f"{target}: its folder does not exist")
    journal = target.with_name(f"{target.name}.part")
    tuned = search.tune(Measurements(loaded, journal), share, probes, checks)
    tuned_job.write(tuned, job, overrides or [], target)
    journal.unlink(missing_ok=True)
    print("\n".join([*tuned_job.table(tuned), "", f"wrote {target}"]))
