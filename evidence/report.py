"""Results of a measurement: data as JSON with their provenance, and a page with a chart.

A study (`evidence.study`) measures, and draws a `Page` from its data alone. Charts are matplotlib's; the
functions at the end draw what several pages need.
"""

from __future__ import annotations

import datetime
import json
import math
import os
import shlex
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from synth.publish.svg import svg
from synth.system.checked_file import write_whole
from synth.system.packages import machine

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Row = Mapping[str, Any]

CHECKOUT = Path(__file__).resolve().parents[1]
RESULTS = CHECKOUT / "docs/results"


@dataclass(frozen=True)
class Section:
    """A heading, paragraphs and a table; any of them may be empty."""

    heading: str
    rows: Sequence[Row] = ()
    words: Sequence[str] = ()  # paragraphs; one that begins with "- " is an item of a list


@dataclass(frozen=True)
class Page:
    """Words, a chart and tables."""

    title: str
    data: Mapping[str, Any]  # command, commit and machine are listed if they are in them
    words: Sequence[str] = ()  # paragraphs at the top; may hold Markdown's `code` and *emphasis*
    sections: Sequence[Section] = ()
    chart: str = ""  # SVG, by `chart`

    def text(self) -> str:
        """The page in Markdown: verdict first, provenance last."""
        provenance = [f"{key} {self.data[key]}" for key in ("commit", "seed") if key in self.data]
        provenance += [f"{key} {value}" for key, value in self.data.get("machine", {}).items()]
        parts = [f"# {self.title}", *self.words, *([f"![{self.title}](chart.svg)"] if self.chart else [])]
        for section in self.sections:
            parts += [f"## {section.heading}"] if section.heading else []
            parts += [*section.words, *([markdown(section.rows)] if section.rows else [])]
        parts += [f"Made by {', '.join(provenance)}:"] if provenance else []
        parts += [f"    {self.data['command']}"] if "command" in self.data else []
        return "\n\n".join(parts) + "\n"

    def write(self, folder: Path) -> None:
        """Writes README.md and chart.svg."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in (("README.md", self.text()), ("chart.svg", self.chart)):
            if text:
                write_whole(folder / name, text, durable=False)


def save(
    folder: Path, file: str, data: Mapping[str, Any], page: Callable[[Mapping[str, Any]], Page] | None = None
) -> None:
    """Writes data and the page drawn from them into a folder, and prints the page's text.

    Floats are rounded to six digits. `command`, `commit`, `machine` and `cpu_hours` (of this process and its
    children: less than the total where a cache held parts) are put before the data, unless these have them.
    """
    times = os.times()
    provenance = {
        "command": command(),
        "commit": commit(),
        "date": datetime.date.today().isoformat(),
        "machine": machine(),
        "cpu_hours": float(f"{sum(times[:4]) / 3600:.2g}"),
    }
    data = round_floats(provenance | dict(data))
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / file, _json(data) + "\n", durable=False)
    if page is not None:
        document = page(data)
        document.write(folder)
        print(document.text())


def command() -> str:
    """This process's shell line: `python -m MODULE ARGUMENTS`, paths cut to their names, without --out."""
    main = sys.modules["__main__"].__spec__
    name = main.name.removesuffix(".__main__") if main else Path(sys.argv[0]).name
    words = iter(sys.argv[1:])
    line = []
    for word in words:
        if word in ("--out", "-o"):
            next(words, None)
        elif not word.startswith("--out="):
            option, equal, value = word.rpartition("=")
            line.append(f"{option}{equal}{Path(value).name or value}")
    return shlex.join(["python", "-m", name, *line])


def commit() -> str:
    """The checkout's commit, with "+" if files outside docs differ from it; empty outside git."""

    def git(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(["git", "-C", str(CHECKOUT), *words], capture_output=True, text=True)

    name = git("rev-parse", "--short=7", "HEAD").stdout.strip()
    changed = name and git("status", "--porcelain", "--", ".", ":!docs").stdout
    return f"{name}+" if changed else name


def round_floats(value: Any) -> Any:
    """A tree with its floats rounded to six digits: the others are noise and take half of a file."""
    if isinstance(value, Mapping):
        return {key: round_floats(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [round_floats(part) for part in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def group_rows(rows: Sequence[Row], *keys: str) -> dict[tuple[Any, ...], list[Row]]:
    """Rows by their values of some keys, in the order of the first of each."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return groups


def mean_cell(values: Sequence[float | None], form: str = ".3g", factor: float = 1.0) -> str:
    """A cell of a table: a mean and the known ends of its interval, each times a factor."""
    mean, *ends = (math.nan if value is None else factor * value for value in values)
    ends_text = ", ".join(f"{end:{form}}" for end in ends if not math.isnan(end))
    return f"{mean:{form}} [{ends_text}]" if ends_text else f"{mean:{form}}"


def percent(values: Sequence[float | None] | None) -> str | None:
    """As `mean_cell`, of shares in percent."""
    return None if values is None else mean_cell(values, ".0%")


def markdown(rows: Sequence[Row]) -> str:
    """A table in Markdown; its columns are the keys of all rows, without those of nested mappings."""
    nested = {name for row in rows for name, value in row.items() if isinstance(value, Mapping)}
    names = [name for name in dict.fromkeys(name for row in rows for name in row) if name not in nested]
    lines = [names, ["---"] * len(names), *([_cell(row.get(name)) for name in names] for row in rows)]
    return "\n".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in lines)


def _cell(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _json(value: Any, depth: int = 2) -> str:
    """JSON with a line for each key and for each row of a list under it: short, and easy to compare."""
    if depth and isinstance(value, dict) and value:
        lines = (f"{json.dumps(k)}: {_json(v, depth - 1)}" for k, v in value.items())
        return "{\n" + ",\n".join(lines) + "\n}"
    if depth and isinstance(value, list) and any(isinstance(item, dict | list) for item in value):
        return "[\n" + ",\n".join(_json(item, 0) for item in value) + "\n]"
    return json.dumps(value, separators=(",", ":"))


def front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the Pareto front of points (cost, error), cheapest first."""
    best: list[int] = []
    least = math.inf
    for k in sorted(range(len(points)), key=lambda k: points[k]):
        if points[k][1] < least:
            best.append(k)
            least = points[k][1]
    return best


def chart(*draws: Callable[[Axes], None], heights: Sequence[float] = (), width: float = 480) -> str:
    """Axes that functions draw, each `width` points wide, as one SVG: two in a line, or below one another.

    `heights`: of the axes [points], then below one another; none: 330 each.
    """
    across = 1 if heights else min(2, len(draws))
    lines = -(-len(draws) // across)
    heights = heights or [330.0] * lines

    def draw(figure: Figure) -> None:
        places = figure.subplots(lines, across, squeeze=False, height_ratios=heights).flat
        for place in places:
            place.set_axis_off()
        for place, fill in zip(figure.axes, draws, strict=False):
            place.set_axis_on()
            fill(place)

    return svg(width * across, sum(heights), draw)


def intervals(title: str, unit: str, rows: Mapping[str, Sequence[float]]) -> str:
    """A chart of means, each with the ends of its interval if it has them, a line for each name."""
    return interval_charts((title, unit, rows))


def interval_charts(*parts: tuple[str, str, Mapping[str, Sequence[float]]]) -> str:
    """Charts as of `intervals`, one below the other."""
    draws = [partial(_draw_intervals, title=title, unit=unit, rows=rows) for title, unit, rows in parts]
    return chart(*draws, heights=[70.0 + 19 * len(rows) for _, _, rows in parts], width=960)


def _draw_intervals(axes: Axes, title: str, unit: str, rows: Mapping[str, Sequence[float]]) -> None:
    """Means and the ends of their intervals, a line for each name, which states them."""
    places = np.arange(len(rows))
    for place, (mean, *ends) in zip(places, rows.values(), strict=True):
        if ends:
            axes.plot(ends, [place, place], color="C0", linewidth=2)
        axes.scatter(mean, place, 26, "C0")
    axes.axvline(0, color="#c9ced6", linewidth=0.8, zorder=0)
    axes.set(title=title, xlabel=unit, ylim=(len(rows) - 0.4, -0.6))
    axes.set_yticks(places, [f"{name}   {mean_cell(row, '.4g')}" for name, row in rows.items()])
    axes.grid(visible=False, axis="y")


def scatter(axes: Axes, groups: Mapping[str, Sequence[Row]], x: str, y: str, label: str = "") -> None:
    """Points of rows by group, with the Pareto front of x and y, of which less is better.

    Rows with a true `default` are ringed. `label`: text with the row's keys in braces, of points on the front
    that have room.
    """
    points = {(row[x], row[y]): row for rows in groups.values() for row in rows}
    frontier = [[*points][k] for k in front([*points])]
    axes.plot(*zip(*frontier, strict=True), "--", color="#9aa3ad", linewidth=1)
    for name, rows in groups.items():
        (line,) = axes.plot([row[x] for row in rows], [row[y] for row in rows], " ", marker="o", label=name)
        for row in rows:
            if row.get("default"):
                axes.plot(row[x], row[y], "o", markersize=11, fillstyle="none", color=line.get_color())
    positions: list[np.ndarray[Any, Any]] = []
    for place in sorted(frontier, key=lambda place: not points[place].get("default")) if label else ():
        position = axes.transLimits.transform(axes.transScale.transform(place))
        if all((abs(position - other) > (0.3, 0.05)).any() for other in positions):
            text = label.format_map(points[place])
            axes.annotate(text, place, (5, 4), textcoords="offset points", fontsize=7)
            positions.append(position)


def set_log(axes: Axes, names: str = "xy") -> None:
    """Logarithmic axes whose ticks are plain numbers."""
    from matplotlib import ticker

    for name in names:
        getattr(axes, f"set_{name}scale")("log")
        axis = getattr(axes, f"{name}axis")
        low, high = axis.get_data_interval()
        is_narrow = math.log10(high / low) < 1.7
        axis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5) if is_narrow else (1,), numticks=6))
        axis.set_minor_locator(ticker.NullLocator())
        axis.set_major_formatter("{x:.4g}")


def legend(axes: Axes) -> None:
    """A legend below the axes, of as many columns as its names leave room for."""
    longest = max((len(name) for name in axes.get_legend_handles_labels()[1]), default=1)
    columns = max(1, min(3, 70 // (6 + longest)))
    axes.legend(loc="upper left", bbox_to_anchor=(0, -0.16), ncols=columns, borderaxespad=0)
