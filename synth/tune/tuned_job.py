"""The tuned job as a file: the person's own text with the changed keys, and what was measured as comments."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap

from synth.job import identity, reader
from synth.system import checked_file
from synth.tune.parameters import show
from synth.tune.search import Tuned


def write(tuned: Tuned, source: str, overrides: Sequence[str], out: Path) -> None:
    """Writes the tuned job.

    Args:
        tuned: what was measured.
        source, overrides: the job as given to `reader.load_job`.
        out: must not exist.

    Raises:
        FileExistsError: it does.
    """
    text, label, folder = reader.read_source(source)
    tree = checked_file.load_yaml(text, label, places=True)
    for override in overrides:
        key, _, value = override.partition("=")
        _set(tree, key.strip(), checked_file.load_yaml(value, override, places=True))
    if folder != out.resolve().parent:  # from which relative paths will start
        job = reader.load_job(source, overrides).model_dump(mode="json")
        for section, name in identity.FILES:
            if job[section][name] is not None:
                _set(tree, f"{section}.{name}", job[section][name])
    for key, setting in tuned.changes.items():
        new = list(setting) if isinstance(setting, tuple) else setting
        _set(tree, key, new, f"was {show(tuned.own.settings[key])}")
    body = io.StringIO()
    yaml = YAML(typ="rt")
    yaml.width = 110
    yaml.dump(tree, body)
    head = "\n".join(f"# {line}".rstrip() for line in table(tuned))
    with out.open("x", encoding="utf-8") as file:
        file.write(f"{head}\n\n{body.getvalue()}")


def _set(tree: CommentedMap, key: str, value: Any, comment: str = "") -> None:
    """Sets a dotted key, with a comment above it."""
    *sections, name = key.split(".")
    block = tree
    for section in sections:
        if not isinstance(block.get(section), CommentedMap):
            block[section] = CommentedMap()
        block = block[section]
    block[name] = value
    if comment:
        block.yaml_set_comment_before_after_key(name, before=comment, indent=2 * len(sections))


def table(tuned: Tuned) -> list[str]:
    """What was asked, and all that was measured: each setting by itself, then whole jobs."""
    lines = [
        f"Written by synth tune: the error of the force may grow by {_percent(tuned.budget)} of the force",
        "over full fidelity's. Each setting by itself, then whole jobs:",
        "",
        f"{'':26s}{'grows by':>12s}{'error of force':>17s}{'CPU-s a frame':>16s}",
    ]
    for one in (*tuned.alone, tuned.full, tuned.own, *tuned.tried):
        values = f"{_percent(one.error):>12s}{_percent(np.mean(one.totals)):>17s}{one.cost:16.3g}"
        lines.append(f"{one.name:26s}{values}{'  this job' if one is tuned.best else ''}")
    return lines


def _percent(share: float | np.floating) -> str:
    return f"{100 * share:.2g}%" if np.isfinite(share) else "fails"
