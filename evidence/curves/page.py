"""What `bench experiment curves` shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from bench.output import charts, result_page


def drawn(found: Mapping[str, Any]) -> result_page.Page:
    """What `curves.json` says."""
    rows = found["rows"]
    panels = [
        _panel(rows, f"{name}, {_eyes(eye)}", name, eye)
        for name in dict.fromkeys(row["asked"] for row in rows)
        for eye in sorted({row["eyes"] for row in rows})
    ]
    return result_page.Page(
        "Learning curves",
        found,
        panels,
        [result_page.Section("", [_told(row) for row in rows])],
        (
            "Root mean square error of the force as a part of the force's own, mean over sequences with its "
            "95% interval: of the whole vector, of its parts across and along the line of sight, and of its "
            "size alone, which is all that boosting says. Everything is asked with recovered displacement, "
            "whatever it was fitted on; only *exact* is fitted on true displacement and asked with it. "
            "*Bare*: the sequences without a membrane, whose force the surface does show. *Gain*: of said on "
            "true force, by size; *slope*: of true on said, 1 where a gain under 1 is but the caution of who "
            "isn't sure.",
            f"Generation takes {found['generation_cpu_s']:.1f} CPU-s a sequence; *CPU-h* is of generation "
            "and fitting together.",
        ),
        command="; ".join([*found.get("added", ()), str(found.get("command", ""))]),
        name="README.md",
    )


def _eyes(count: int) -> str:
    return "one eye" if count == 1 else "two eyes"


def _panel(rows: Sequence[Mapping[str, Any]], title: str, asked: str, eye: int) -> charts.Panel:
    mine = [row for row in rows if row["asked"] == asked and row["eyes"] == eye and row["whole"] is not None]
    curves = []
    for model, given in dict.fromkeys((row["model"], row["input"]) for row in mine):
        line: dict[int, list[float]] = {}
        for row in mine:
            if (row["model"], row["input"]) == (model, given):
                line.setdefault(row["size"], []).append(row["whole"][0])
        x = tuple(sorted(line))
        curves.append(
            charts.Curve(
                f"{model}, {given}", tuple(map(float, x)), tuple(sum(line[n]) / len(line[n]) for n in x)
            )
        )
    return charts.Panel(title, "fitted sequences", "error of the force", tuple(curves), log_x=True)


def _told(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row of the table."""

    return {
        "asked": row["asked"],
        "eyes": row["eyes"],
        "model": row["model"],
        "fitted on": row["input"],
        "sequences": row["size"],
        "seed": row["seed"],
        "whole": percent(row, "whole"),
        "across": percent(row, "across"),
        "along": percent(row, "along"),
        "size": percent(row, "force_size"),
        "bare": percent(row, "bare"),
        "map R²": row["map_r2"],
        "ghosts": row["ghosts"],
        "gain": row["gain"],
        "slope": row["slope"],
        "CPU-h": row["cpu_h"],
    }


def percent(row: Mapping[str, Any], key: str) -> str | None:
    """A share with its interval, as a cell of a table."""
    if row[key] is None:
        return None
    mean, low, high = row[key]
    if low is None:  # all alike, or too few to tell
        return f"{100 * mean:.0f}%"
    return f"{100 * mean:.0f}% [{100 * low:.0f}, {100 * high:.0f}]"
