"""The table of what was measured, and the tuned job: the person's own text with changed keys below it."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap

from synth.job import identity, reader
from synth.system import checked_file
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
    tree = checked_file.load_yaml(text, label, places=True)
    given = (override.partition("=")[::2] for override in overrides)
    keys = {key.strip(): checked_file.load_yaml(value, key, places=True) for key, value in given}
    if folder != out.resolve().parent:  # from which relative paths will start
        job = reader.load_job(source, overrides).model_dump(mode="json")
        paths = {f"{section}.{name}": job[section][name] for section, name in identity.FILES}
        keys |= {key: path for key, path in paths.items() if path is not None}
    changes = differences(tuned.best.settings, tuned.own.settings)
    keys |= {key: list(one) if isinstance(one, tuple) else one for key, one in changes.items()}
    for key, value in keys.items():
        *sections, name = key.split(".")
        block = tree
        for section in sections:
            block[section] = block.get(section) or CommentedMap()
            block = block[section]
        block[name] = value
    body, yaml = io.StringIO(), YAML(typ="rt")
    yaml.width = 110
    yaml.dump(tree, body)
    head = "".join(f"# {line}".rstrip() + "\n" for line in table(tuned))
    with out.open("x", encoding="utf-8") as file:
        file.write(f"{head}\n{body.getvalue()}")
