"""The tuned job as a file: the person's own text with the changed keys, and why, as comments."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap

from synth.errors import UserError
from synth.job import reader
from synth.job.schema import Job
from synth.system import foreign_yaml
from synth.system.text_lines import hang
from synth.tune.search import Joint, Row, Tuned, own

_PATHS = ("anatomy.mesh", "appearance.photo", "render.calibration")
_WIDTH = 98
_TABLE = 78  # and a comment's sign: eighty columns


def write_tuned(found: Tuned, source: str, overrides: Sequence[str], out: Path) -> Job:
    """Writes the tuned job to `out`, which must not exist, and gives it back as read from there.

    Raises:
        UserError: the file exists or cannot be written.
    """
    text = commented(found, source, overrides, out.resolve().parent)
    try:
        with out.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise UserError(f"{out}: exists already") from None
    except OSError as error:
        raise UserError(f"{out}: cannot be written ({error.strerror})") from error
    return reader.load_job(str(out))


def commented(found: Tuned, source: str, overrides: Sequence[str], folder: Path) -> str:
    """The text of the tuned job.

    Args:
        found: what was measured.
        source, overrides: as given to `reader.load_job`.
        folder: where the file will be, from which relative paths start.
    """
    written, label, home = reader.read_source(source)
    yaml = YAML(typ="rt")
    yaml.width = 110
    tree = foreign_yaml.load(written, label)
    if not isinstance(tree, CommentedMap):
        tree = CommentedMap()
    for one in overrides:
        key, _, value = one.partition("=")
        _set(tree, key.strip(), foreign_yaml.load(value, one), "")
    values = found.job.model_dump(mode="json")
    if home != folder:
        for key in _PATHS:
            block, _, name = key.partition(".")
            if values[block][name] is not None:
                _set(tree, key, values[block][name], "")
    for key, value, why in changes(found):
        _set(tree, key, value, why)
    body = io.StringIO()
    yaml.dump(tree, body)
    head = "\n".join(f"# {line}".rstrip() for line in [*summary(found), "", *lines(found)])
    return f"{head}\n\n{body.getvalue()}"


def changes(found: Tuned) -> list[tuple[str, Any, str]]:
    """Keys that change, their new values and why."""
    out = []
    for knob, level in zip(found.knobs, found.chosen, strict=True):
        before = own(knob, found.job)
        if level == before:
            continue
        row, was = _row(found, knob.name, level.words), _row(found, knob.name, before.words)
        why = (
            f"was {before.words}: the error of the force grows by {_grown(row.change)} over full fidelity's "
            f"instead of {_grown(was.change)}, "
            f"a frame saves {100 * (row.saved - was.saved):.0f}% of full cost"
        )
        out += [(key, value, why) for key, value in level.changes.items() if _value(found.job, key) != value]
    return out


def summary(found: Tuned) -> list[str]:
    """What was asked, what came out, on what."""
    own_cost, best = found.own.cost, found.best
    words = (
        f"Written by synth tune for a budget of {_percent(found.budget.share)} of the force, by which its "
        f"error may grow over full fidelity's ({_setting(found, found.full.levels)}). This job takes "
        f"{_percent(best.error)} of it ({', '.join(_percent(e) for e in best.errors)} in {len(best.errors)} "
        f"probe sequences), the job as it was took {_percent(found.own.error)}. The force read from "
        f"recovered displacement is off by {_percent(best.total)}, as it was {_percent(found.own.total)}, "
        f"at full fidelity {_percent(found.full.total)}. A frame costs {best.cost:.2f} "
        f"CPU-s (physics, scene, rendering, flow) instead of {own_cost:.2f}, at full fidelity "
        f"{found.full.cost:.2f}. {len(found.tried)} settings were measured as a whole."
    )
    lines = textwrap.wrap(words, _WIDTH)
    if best.levels == found.full.levels:
        lines.append("Nothing cheaper kept the budget: this is full fidelity itself.")
    elif best.levels == found.own.levels:
        lines.append("Nothing cheaper kept the budget: this is the job as it was.")
    return lines


def lines(found: Tuned) -> list[str]:
    """Each level of each knob by itself, as a table; "was": what the job had."""
    mine = {knob.name: own(knob, found.job).words for knob in found.knobs}
    picked = {knob.name: level.words for knob, level in zip(found.knobs, found.chosen, strict=True)}
    out = [
        f"{'':14s} {'':17s} {'error':>12} {'of the':>12}   saves",
        f"{'knob':14s} {'level':17s} {'of force':>12} {'budget':>12} a frame",
    ]
    for row in found.rows:
        marks = [
            word for word, levels in (("chosen", picked), ("was", mine)) if levels[row.knob] == row.level
        ]
        front = f"{row.knob:14s} {row.level:17s} "
        moves = f"{_grown(row.change):>12} {_percent(row.error):>12} {100 * row.saved:6.0f}%"
        told = hang(front, row.why, _TABLE) if row.why else [front + moves]
        told[-1] = f"{told[-1]}  {', '.join(marks)}".rstrip()
        out += told
    return out


def as_dict(found: Tuned) -> dict[str, Any]:
    """All that was measured, ready for JSON; errors are parts of the force, infinite ones None."""
    return {
        "budget": found.budget.share,
        "knobs": [
            vars(row) | {"error": _finite(row.error), "change": _finite(row.change)} for row in found.rows
        ],
        "full": whole(found, found.full),
        "own": whole(found, found.own),
        "tried": [whole(found, one) for one in found.tried],
        "best": whole(found, found.best),
        "sequences": list(found.kinds),
        "changes": {key: value for key, value, _ in changes(found)},
    }


def whole(found: Tuned, one: Joint) -> dict[str, Any]:
    """A setting measured as a whole, ready for JSON."""
    return {
        "setting": {knob.name: words for knob, words in zip(found.knobs, one.levels, strict=True)},
        "promised": _finite(one.promised),
        "error": _finite(one.error),
        "errors": [_finite(e) for e in one.errors],
        "totals": [_finite(e) for e in one.totals],
        "apart": [_finite(e) for e in one.apart],
        "cpu_s_a_frame": _finite(one.cost),
    }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _setting(found: Tuned, levels: Sequence[str]) -> str:
    return ", ".join(f"{knob.name} {words}" for knob, words in zip(found.knobs, levels, strict=True))


def _row(found: Tuned, knob: str, level: str) -> Row:
    return next(row for row in found.rows if (row.knob, row.level) == (knob, level))


def _percent(share: float) -> str:
    return f"{100 * share:.2g}%" if np.isfinite(share) else "out of range"


def _grown(share: float) -> str:
    return f"{100 * share:+.2g}%" if np.isfinite(share) else "out of range"


def _value(job: Job, key: str) -> Any:
    block, _, name = key.partition(".")
    return job.model_dump(mode="json")[block][name]


def _set(tree: CommentedMap, key: str, value: Any, why: str) -> None:
    """Sets a dotted key, its reason as a comment above it."""
    *blocks, name = key.split(".")
    block, depth = tree, 0
    for step in blocks:
        if not isinstance(block.get(step), CommentedMap):
            block[step] = CommentedMap()
        block, depth = block[step], depth + 1
    block[name] = value
    if why:
        text = "\n".join(textwrap.wrap(why, _WIDTH - 2 * depth))
        block.yaml_set_comment_before_after_key(name, before=text, indent=2 * depth)
