"""Results of a measurement: data as JSON with their provenance, and a page with charts.

A study (`evidence.study`) measures, and draws a `Page` from its data alone.
"""

from __future__ import annotations

import datetime
import itertools
import json
import math
import os
import shlex
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from synth.dataset.folder import write_whole
from synth.publish.svg import svg
from synth.system.packages import machine

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CHECKOUT = Path(__file__).resolve().parents[1]
RESULTS = CHECKOUT / "docs/results"

_COLOURS = ("#1f6feb", "#c2352b", "#2b7a4b", "#8a6d00", "#a04f9c", "#00798c", "#3b3f46", "#b8562b", "#6b8e23")
_WIDTH, _PANEL, _NAME, _ROW = 960, 310, 15, 19
"""Width of a chart; heights of a panel, of a legend's line below it, of a row of intervals [points]."""
_PICTURES = ("chart.svg", "intervals.svg")


@dataclass(frozen=True)
class Curve:
    """One series."""

    name: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    labels: tuple[str, ...] = ()  # of the points; empty: a line joins them
    ringed: tuple[int, ...] = ()  # indices of points to emphasise, as defaults
    ends: tuple[tuple[float, float], ...] = ()  # interval of every y; empty: none
    named: bool = True  # whether the legend lists the labels of ringed points


@dataclass(frozen=True)
class Panel:
    """One chart of curves."""

    title: str
    x: str
    y: str
    curves: tuple[Curve, ...]
    log_x: bool = False
    log_y: bool = False
    front: bool = False  # whether a line joins the Pareto front of x and y (less is better)


@dataclass(frozen=True)
class Row:
    """A mean and its interval."""

    name: str
    value: float
    interval: tuple[float, float] = (math.nan, math.nan)  # NaN: no bar
    group: int = 0  # selects the colour


@dataclass(frozen=True)
class Chart:
    """One chart of intervals: a line a row."""

    title: str
    unit: str
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Section:
    """A heading, paragraphs and a table; any of them may be empty."""

    heading: str
    rows: Sequence[Mapping[str, Any]] = ()
    words: Sequence[str] = ()  # paragraphs; one that begins with "- " is an item of a list


@dataclass(frozen=True)
class Page:
    """Words, charts and tables."""

    title: str
    found: Mapping[str, Any]  # the data: command, commit and machine are listed if they are in it
    charts: Sequence[Chart | Panel] = ()  # intervals and curves, one image for each kind
    sections: Sequence[Section] = ()
    words: Sequence[str] = ()  # paragraphs at the top; may hold Markdown's `code` and *emphasis*

    def text(self) -> str:
        """The page in Markdown: verdict first, provenance last."""
        made = [f"{key} {self.found[key]}" for key in ("commit", "seed") if key in self.found]
        made += [f"{key} {value}" for key, value in self.found.get("machine", {}).items()]
        parts = [f"# {self.title}", *self.words]
        pictures = _PICTURES[: len({type(one) for one in self.charts})]
        parts += [f"![{self.title}]({picture})" for picture in pictures]
        for section in self.sections:
            parts += [f"## {section.heading}"] if section.heading else []
            parts += [*section.words, *([markdown(section.rows)] if section.rows else [])]
        parts += [f"Made by {', '.join(made)}:"] if made else []
        parts += [f"    {self.found['command']}"] if "command" in self.found else []
        return "\n\n".join(parts) + "\n"

    def write(self, folder: Path) -> None:
        """Writes README.md and the charts."""
        panels = [one for one in self.charts if isinstance(one, Panel)]
        rows = [one for one in self.charts if isinstance(one, Chart)]
        drawn = ([curves(panels)] if panels else []) + ([intervals(rows)] if rows else [])
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in [("README.md", self.text()), *zip(_PICTURES, drawn, strict=False)]:
            write_whole(folder / name, text, durable=False)


def save(
    folder: Path, file: str, found: Mapping[str, Any], page: Callable[[Mapping[str, Any]], Page] | None = None
) -> None:
    """Writes data and the page drawn from them into a folder, and prints the page's text.

    Floats are rounded to six digits. `command`, `commit`, `machine` and `cpu_hours` (of this process and its
    children: less than the total where a cache held parts) are put before the data, unless these have them.
    """
    times = os.times()
    made = {
        "command": command(),
        "commit": commit(),
        "date": datetime.date.today().isoformat(),
        "machine": machine(),
        "cpu_hours": float(f"{sum(times[:4]) / 3600:.2g}"),
    }
    found = shortened(made | dict(found))
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / file, _json(found) + "\n", durable=False)
    if page is not None:
        drawn = page(found)
        drawn.write(folder)
        print(drawn.text())


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


def shortened(value: Any) -> Any:
    """A tree with its floats rounded to six digits: the others are noise and take half of a file."""
    if isinstance(value, Mapping):
        return {key: shortened(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [shortened(part) for part in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def bars(values: Mapping[str, float]) -> tuple[Row, ...]:
    """A row for each value, without intervals."""
    return tuple(Row(name, float(value)) for name, value in values.items())


def grouped(rows: Sequence[Mapping[str, Any]], *keys: str) -> dict[tuple[Any, ...], list[Mapping[str, Any]]]:
    """Rows by their values of some keys, in the order of the first of each."""
    found: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        found.setdefault(tuple(row[key] for key in keys), []).append(row)
    return found


def curve(
    name: str,
    rows: Sequence[Mapping[str, Any]],
    x: str,
    y: str,
    label: str = "",
    factors: tuple[float, float] = (1, 1),
) -> Curve:
    """A series of two keys of rows, each times a factor; rows with a true `default` are ringed.

    `label`: text of the points, with the row's keys in braces; empty: a line joins them.
    """
    xs, ys = (tuple(by * row[key] for row in rows) for key, by in zip((x, y), factors, strict=True))
    labels = tuple(label.format_map(row) for row in rows) if label else ()
    return Curve(name, xs, ys, labels, tuple(k for k, row in enumerate(rows) if row.get("default")))


def front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the Pareto front of points (cost, error), cheapest first."""
    best: list[int] = []
    least = math.inf
    for k in sorted(range(len(points)), key=lambda k: points[k]):
        if points[k][1] < least:
            best.append(k)
            least = points[k][1]
    return best


def curves(panels: Sequence[Panel]) -> str:
    """Panels as one SVG, two in a line; a name has one colour in all of them."""
    names = dict.fromkeys(curve.name for panel in panels for curve in panel.curves)
    colours = dict(zip(names, itertools.cycle(_COLOURS), strict=False))
    across = min(2, len(panels))
    lines = [panels[k : k + across] for k in range(0, len(panels), across)]
    heights = [_PANEL + _NAME * max(math.ceil(len(_names(p)) / _across(p)) for p in line) for line in lines]
    draws = [lambda axes, panel=panel: _panel(axes, panel, colours) for panel in panels]
    return _stacked(heights, across, draws)


def intervals(charts: Sequence[Chart]) -> str:
    """Charts as one SVG, one below the other."""
    draws = [lambda axes, chart=chart: _intervals(axes, chart) for chart in charts]
    return _stacked([70 + _ROW * len(chart.rows) for chart in charts], 1, draws, _WIDTH)


def _stacked(heights: list[int], across: int, draws: Sequence[Callable[[Axes], None]], width: int = 0) -> str:
    """Axes in lines of some heights [points], `across` in each, as one SVG."""

    def draw(figure: Figure) -> None:
        places = figure.subplots(len(heights), across, squeeze=False, height_ratios=heights).flat
        for place, one in itertools.zip_longest(places, draws):
            if one is None:
                place.set_axis_off()
            else:
                one(place)

    return svg(width or _WIDTH * across / 2, sum(heights), draw)


def _panel(axes: Axes, panel: Panel, colours: Mapping[str, str]) -> None:
    axes.set(title=panel.title, xlabel=panel.x, ylabel=panel.y)
    if panel.front:
        points = [p for c in panel.curves for p in zip(c.x, c.y, strict=True) if math.isfinite(p[1])]
        axes.plot(*zip(*(points[k] for k in front(points)), strict=True), "--", color="#9aa3ad", linewidth=1)
    for curve in panel.curves:
        _curve(axes, curve, colours[curve.name])
    for axis, log in ((axes.xaxis, panel.log_x), (axes.yaxis, panel.log_y)):
        _scale(axis, log)
    axes.legend(loc="upper left", bbox_to_anchor=(0, -0.16), ncols=_across(panel), borderaxespad=0)


def _names(panel: Panel) -> list[str]:
    """Entries of the legend below a panel."""
    ringed = [c.labels[k] for c in panel.curves if c.named for k in c.ringed]
    return [*(c.name for c in panel.curves), *ringed]


def _across(panel: Panel) -> int:
    """Columns of the legend: as many as fit in 480 points."""
    return max(1, min(3, 70 // (6 + max(len(name) for name in _names(panel)))))


def _curve(axes: Axes, curve: Curve, colour: str) -> None:
    good = [k for k, y in enumerate(curve.y) if math.isfinite(y)]
    x, y = np.array(curve.x)[good], np.array(curve.y)[good]
    axes.plot(x, y, " " if curve.labels else "-", color=colour, marker="o", label=curve.name)
    if curve.ends:
        axes.vlines(x, *np.array(curve.ends)[good].T, color=colour, alpha=0.55)
    ringed = [k for k in good if k in curve.ringed]
    if ringed:
        at = ([values[k] for k in ringed] for values in (curve.x, curve.y))
        name = " / ".join(curve.labels[k] for k in ringed) if curve.named else None
        axes.plot(*at, "o", markersize=11, fillstyle="none", color=colour, markeredgewidth=1.8, label=name)


def _scale(axis: Any, log: bool) -> None:
    from matplotlib import ticker

    if not log:
        if axis.axis_name == "y":
            low, high = axis.get_data_interval()
            low, high = min(low, 0.0), max(high, 0.0)
            pad = 0.05 * (high - low) or 1.0
            axis.axes.set_ylim(low - pad, high + pad)
        axis.set_major_locator(ticker.MaxNLocator(6, steps=[1, 2, 5, 10]))
        return
    getattr(axis.axes, f"set_{axis.axis_name}scale")("log")
    low, high = axis.get_data_interval()
    wide = math.log10(high / low) if low > 0 else 9.0
    axis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5) if wide < 1.7 else (1,), numticks=6))
    axis.set_minor_locator(ticker.NullLocator())
    axis.set_major_formatter("{x:.4g}")


def _intervals(axes: Axes, chart: Chart) -> None:
    rows = chart.rows
    at = np.arange(len(rows))
    low, high = np.array([row.interval for row in rows], float).reshape(-1, 2).T
    colours = [_COLOURS[row.group % len(_COLOURS)] for row in rows]
    axes.hlines(at, low, high, color=colours, linewidth=2)
    axes.scatter(np.array([row.value for row in rows], float), at, 26, colours)
    axes.axvline(0, color="#c9ced6", linewidth=0.8, zorder=0)
    axes.set(title=chart.title, xlabel=chart.unit, ylim=(len(rows) - 0.4, -0.6))
    axes.set_yticks(at, [f"{row.name}   {mean_cell((row.value, *row.interval), '.4g')}" for row in rows])
    axes.grid(visible=False, axis="y")


def mean_cell(values: Sequence[float | None], form: str = ".3g", factor: float = 1.0) -> str:
    """A cell of a table: a mean and the known ends of its interval, each times a factor."""
    mean, *ends = (math.nan if value is None else factor * value for value in values)
    known = ", ".join(f"{end:{form}}" for end in ends if not math.isnan(end))
    return f"{mean:{form}} [{known}]" if known else f"{mean:{form}}"


def percent(values: Sequence[float | None] | None) -> str | None:
    """As `mean_cell`, of shares in percent."""
    return None if values is None else mean_cell(values, ".0%")


def markdown(rows: Sequence[Mapping[str, Any]]) -> str:
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


def _json(what: Any, depth: int = 2) -> str:
    """JSON with a line for each key and for each row of a list under it: short, and easy to compare."""
    if depth and isinstance(what, dict) and what:
        lines = (f"{json.dumps(k)}: {_json(v, depth - 1)}" for k, v in what.items())
        return "{\n" + ",\n".join(lines) + "\n}"
    if depth and isinstance(what, list) and any(isinstance(item, dict | list) for item in what):
        return "[\n" + ",\n".join(_json(item, 0) for item in what) + "\n]"
    return json.dumps(what, separators=(",", ":"))
