"""The table of what was measured, and the tuned job: the person's own text with changed keys below it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from synth.job import identity, reader
from synth.system.config_file import ConfigFile
from synth.tune.grid import differences, show
from synth.tune.search import Tuned


def table(tuned: Tuned) -> list[str]:
    """The budget, then a line for every setting by itself and for whole jobs."""
    lines = [
        f"Written by synth tune: the force error may grow by {100 * tuned.budget:g}% of the force over full",
        "fidelity's. Each change by itself, then whole jobs; ± is a 95% interval over sequences.",
        "",
        f"{'grows by':>16s}{'force error':>14s}{'CPU-s a frame':>16s}",
    ]
    for row in tuned.rows:
        margin = f" ± {100 * row.margin:.2g}" if np.isfinite(row.margin) else ""
        figures = f"{f'{100 * row.growth:.2g}{margin}%':>16s}{100 * row.errors.mean():13.2g}%"
        figures += f"{row.stages.sum():16.3g}"
        if not np.isfinite(row.growth):
            figures = f"{'cannot be carried out':>46s}"
        words = "full fidelity" if row is tuned.full else show(row.settings, tuned.own.settings)
        lines.append(f"{figures}   {words}{'  <- this job' if row is tuned.best else ''}")
    return lines


def write(tuned: Tuned, source: str, overrides: Sequence[str], out: Path) -> None:
    """Writes the tuned job of the one that `reader.load_job` reads. FileExistsError if `out` exists."""
    text, label, folder = reader.read_source(source)
    config, keys = ConfigFile(text, label), dict[str, Any]()
    config.change(overrides)
    if folder != out.resolve().parent:  # from which relative paths will start
        job = reader.load_job(source, overrides).model_dump(mode="json")
        paths = {f"{section}.{name}": job[section][name] for section, name in identity.FILES}
        keys = {key: path for key, path in paths.items() if path is not None}
    changes = differences(tuned.best.settings, tuned.own.settings)
    config.change(f"{key}={json.dumps(value)}" for key, value in (keys | dict(changes)).items())
    head = "".join(f"# {line}".rstrip() + "\n" for line in table(tuned))
    with out.open("x", encoding="utf-8") as file:
        file.write(f"{head}\n{config.dump()}")
