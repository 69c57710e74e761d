"""One page on several recordings, a lab's afternoon: force, interval and findings of each, pooled scores."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.scoring import pool
from bench.scoring.force_metrics import METRICS
from bench.scoring.result import Result, as_json
from bench.scoring.score import score
from bench.scoring.score_report import load_template
from synth.errors import UserError
from synth.system.checked_file import write_whole

Tree = dict[str, Any]
_POOLED = "mae_of_peak", "mae_mn", "r", "r2", "peak_mae"
PAGE = "report.html"


def report_recordings(recordings: Sequence[Path], out: Path, command: str) -> list[Tree]:
    """Scores each recording into a folder of its name in `out`, and writes `out`/report.html and pool.json.

    A recording that can't be scored is a row that says why. Returns the rows; UserError: two of one name.
    """
    names = [folder.resolve().name for folder in recordings]
    if duplicates := {name for name in names if names.count(name) > 1}:
        raise UserError(
            f"two recordings are called {min(duplicates)}: rename one, each has a folder of its name"
        )
    out.mkdir(parents=True, exist_ok=True)
    rows, trees = list[Tree](), list[Tree]()
    for name, folder in zip(names, recordings, strict=True):
        try:
            result = score(folder, out=out / name)
        except UserError as error:
            rows.append({"recording": name, "why": str(error), "report": False})
            continue
        trees.append(as_json(result))
        rows.append(describe_row(result))
    pooled = _pool(trees, out, command)
    write_whole(out / PAGE, render_session(rows, pooled), durable=False)
    return rows


def describe_row(result: Result) -> Tree:
    """A scored recording's row: largest force and its interval [mN], scores over the peak, findings."""
    main = result.methods[result.main]
    row: Tree = {"recording": result.recording, "why": result.refused, "report": True}
    row["findings"] = [f"{finding.cause}: {finding.message}" for finding in result.findings]
    if result.refused or not np.isfinite(main.size_mn).any():
        return row
    k = int(np.nanargmax(main.size_mn))
    row["largest_mn"], row["absolute"] = float(main.size_mn[k]), result.absolute
    if main.low_mn is not None and main.high_mn is not None and math.isfinite(main.high_mn[k]):
        row["low_mn"], row["high_mn"] = float(main.low_mn[k]), float(main.high_mn[k])
    scores = {key: main.scores.get(key, math.nan) for key in ("mae_of_peak", "r")}
    row |= {key: value for key, value in scores.items() if math.isfinite(value)}
    if "coverage" in main.interval:
        row["holds"] = main.interval["coverage"]
    return row


def _pool(trees: Sequence[Tree], out: Path, command: str) -> Tree | None:
    """The pooled scores, also written as pool.json and README.md; None if none can be pooled."""
    paths = [out / tree["recording"] for tree in trees]
    try:
        pooled = pool.pool(pool.read(paths))
    except UserError:  # without sensors there are rows, but no scores
        return None
    pool.write(pooled, out, command)
    return pooled


def render_session(rows: Sequence[Mapping[str, Any]], pooled: Mapping[str, Any] | None) -> str:
    """The page as text."""
    scores = {} if pooled is None else pooled["methods"][pooled["main"]]["scores"]
    means = {METRICS[key].heading: (scores[key], METRICS[key].digits) for key in _POOLED if key in scores}
    return load_template("session.html.jinja").render(rows=rows, means=means, pooled=pooled)
