"""Several scored recordings as one answer: means over recordings, intervals over specimens."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.bootstrap import over_groups
from bench.scoring.metrics import METRICS
from bench.scoring.result import MOST_LOST
from synth.errors import UserError
from synth.publish.svg import svg
from synth.system import checked_file
from synth.system.checked_file import write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCORES = tuple(
    (key, METRICS[key].heading)
    for key in ("mae_mn", "mae_of_peak", "r", "shape_error", "ccc", "r2", "bias_mn", "contact_f1",
                "ghost_rate", "peak_mae", "impulse_mae", "dropout")
)  # fmt: skip
_CALIBRATED = (
    *((key, f"{METRICS[key].heading}, gain set") for key in ("mae_of_peak", "r2")),
    ("gain", METRICS["gain"].heading),
)


def read(paths: Sequence[Path]) -> list[dict[str, Any]]:
    """The score.json of each path (a file, or a folder of `bench score`), in the order given.

    Raises:
        UserError: none given, one that is no score, recordings twice, or different main methods.
    """
    found = []
    for path in paths:
        file = path / "score.json" if path.is_dir() else path
        try:
            tree = checked_file.read_json(file)
        except UserError as error:
            raise UserError(f"{path}: holds no readable score.json ({error})") from None
        if not isinstance(tree, dict) or tree.get("format") != "sulcus-score":
            raise UserError(f"{path}: not written by `bench score`")
        found.append(tree)
    if not found:
        raise UserError("no scores to pool")
    names = [tree["recording"] for tree in found]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise UserError(f"recording {min(twice)} is given twice")
    if not any(_reason(tree) == "" for tree in found):
        why = "; ".join(f"{tree['recording']}: {_reason(tree)}" for tree in found)
        raise UserError(f"no recording that can be pooled ({why})")
    if len({tree["main"] for tree in found}) > 1:
        raise UserError("the scores are of different main methods")
    return found


def pool(found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Means over recordings with 95% intervals, specimens resampled; methods that all have.

    Recordings that were not scored (no sensor, clocks not aligned, too much lost) are left out and named.
    """
    every, found = found, [tree for tree in found if not _reason(tree)]
    methods = [m for m in found[0]["methods"] if all(m in tree["methods"] for tree in found)]
    specimens = [tree["settings"]["meta"].get("specimen") or tree["recording"] for tree in found]
    main = found[0]["main"]
    out: dict[str, Any] = {}
    for method in methods:
        rows = [tree["methods"][method] for tree in found]
        out[method] = {
            "scores": {key: _mean([row["scores"].get(key) for row in rows], specimens) for key, _ in SCORES},
            "calibrated": {
                key: _mean([row["calibrated"].get(key) for row in rows], specimens) for key, _ in _CALIBRATED
            },
        }
        own = [tree["methods"][main]["scores"]["mae_mn"] for tree in found]
        other = [row["scores"]["mae_mn"] for row in rows]
        apart = [a - b for a, b in zip(_numbers(own), _numbers(other), strict=True)]
        out[method]["main_worse_by_mn"] = None if method == main else _mean(apart, specimens)
    return {
        "format": "sulcus-pool",
        "version": 1,
        "main": main,
        "recordings": [tree["recording"] for tree in found],
        "left_out": {tree["recording"]: _reason(tree) for tree in every if _reason(tree)},
        "each": [_each(tree) for tree in found],
        "specimens": len(set(specimens)),
        "frames": sum(tree["frames"] for tree in found),
        "methods": out,
    }


def _reason(tree: dict[str, Any]) -> str:
    """Why a recording is left out, as its own report gives no number; empty if it isn't."""
    if tree.get("fault"):
        return f"nothing can be measured: {tree['fault']}"
    lost = tree.get("lost") or {}
    if (lost.get("share") or 0.0) > lost.get("most", MOST_LOST):
        return f"{100 * lost['share']:.0f}% of its frames were lost"
    refused = (tree.get("sync") or {}).get("refused")
    if refused:
        return f"clocks not aligned: {refused}"
    return "" if tree["scores"] else "no sensor"


def _each(tree: dict[str, Any]) -> dict[str, Any]:
    """What is said of one recording: its main method's scores and how its clocks were aligned."""
    found = tree.get("sync") or {}
    return {
        "recording": tree["recording"],
        "frames": tree["frames"],
        **{key: tree["scores"].get(key) for key in ("event_peak_mn", "mae_of_peak", "r")},
        "offset_s": found.get("offset_s"),
        "offset_deviation_s": found.get("deviation_s"),
        "lost": (tree.get("lost") or {}).get("share"),
    }


def write(tree: dict[str, Any], out: Path, command: str) -> None:
    """pool.json, README.md and chart.svg in the folder `out`."""
    tree = tree | {"command": command}
    files = {
        "pool.json": json.dumps(tree, indent=1, allow_nan=False) + "\n",
        "README.md": page(tree),
        "chart.svg": chart(tree),
    }
    out.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        write_whole(out / name, text, durable=False)


def page(tree: Mapping[str, Any]) -> str:
    """Markdown; methods that beat the main one are marked."""
    methods = tree["methods"]
    first = methods[tree["main"]]["scores"]
    hidden = ("bias_mn", "impulse_mae", "dropout")
    shown = [(key, head) for key, head in SCORES if key not in hidden and key in first]
    own = _number(first["mae_mn"]["mean"])
    rows = []
    for method, found in methods.items():
        better = method != tree["main"] and _number(found["scores"]["mae_mn"]["mean"]) < own
        rows.append(
            {"method": f"{method} (better)" if better else method}
            | {head: _text(found["scores"][key], METRICS[key].digits) for key, head in shown}
            | {head: _text(found["calibrated"][key], METRICS[key].digits) for key, head in _CALIBRATED}
        )
    parts = [
        f"# {_count(tree)}, {tree['specimens']} specimens, {tree['frames']} frames",
        f"    {tree['command']}",
        "Means over recordings; in brackets 95% intervals, specimens resampled.",
        *(f"Recording {lost} is left out: {why}." for lost, why in tree["left_out"].items()),
        f"![{_count(tree)}](chart.svg)",
        _table(rows),
        f"## By recording, {tree['main']}",
        _table([_line(row) for row in tree["each"]]),
    ]
    return "\n\n".join(parts) + "\n"


def chart(tree: Mapping[str, Any]) -> str:
    """SVG of every method's mean error and its interval."""
    errors = {name: found["scores"]["mae_of_peak"] for name, found in tree["methods"].items()}
    at = np.arange(len(errors))
    colours = ["#1f6feb" if name == tree["main"] else "#c2352b" for name in errors]
    mean, low, high = ([_number(e[key]) for e in errors.values()] for key in ("mean", "low", "high"))

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.hlines(at, low, high, color=colours, linewidth=2)
        axes.scatter(mean, at, 26, colours)
        axes.set(title=_count(tree), xlabel="mean error as a share of the event peak")
        axes.set_yticks(at, list(errors))
        axes.set_ylim(len(errors) - 0.4, -0.6)
        axes.set_xlim(left=0)

    return svg(960, 70 + 19 * len(errors), draw)


def _count(tree: Mapping[str, Any]) -> str:
    return f"{len(tree['recordings'])} recordings"


def _table(rows: Sequence[Mapping[str, str]]) -> str:
    """Rows of the same columns in Markdown."""
    lines = [list(rows[0]), ["---"] * len(rows[0]), *([*row.values()] for row in rows)]
    return "\n".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in lines)


def _line(row: Mapping[str, Any]) -> dict[str, str]:
    """One recording for the table."""
    offset = "–"
    if row["offset_s"] is not None:
        offset = f"{1e3 * row['offset_s']:.0f} ± {1e3 * _number(row['offset_deviation_s']):.0f}"
    return {
        "recording": row["recording"],
        "frames": str(row["frames"]),
        "event peak [mN]": f"{_number(row['event_peak_mn']):.2f}",
        "MAE of it": f"{_number(row['mae_of_peak']):.1%}",
        "r": f"{_number(row['r']):.3f}",
        "clocks' offset [ms]": offset,
    } | ({"lost": f"{row['lost']:.0%}"} if row.get("lost") is not None else {})


def _mean(values: Sequence[float | None], specimens: Sequence[str]) -> dict[str, float | None]:
    numbers = _numbers(values)
    good = [v for v in numbers if math.isfinite(v)]
    low, high = over_groups(numbers, list(specimens), np.random.default_rng(0))
    plain = [v if math.isfinite(v) else None for v in (low, high)]
    return {"mean": float(np.mean(good)) if good else None, "low": plain[0], "high": plain[1], "n": len(good)}


def _numbers(values: Sequence[float | None]) -> list[float]:
    return [_number(value) for value in values]


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _text(value: dict[str, float | None], digits: int) -> str:
    if value["mean"] is None:
        return "–"
    text = f"{value['mean']:.{digits}f}"
    if value["low"] is None or value["high"] is None:
        return text
    return f"{text} [{value['low']:.{digits}f}, {value['high']:.{digits}f}]"
