"""Two kinds of chart as SVG: curves with marks, and means with their intervals."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.bootstrap import Interval
from synth.publish.svg import svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = ("#1f6feb", "#c2352b", "#2b7a4b", "#8a6d00", "#a04f9c", "#00798c", "#3b3f46", "#b8562b", "#6b8e23")
_WIDTH, _PANEL, _NAME, _ROW = 960, 310, 15, 19
"""Of a picture; height of a panel, of a line of names below it, of a row of intervals [points]."""
_SIDE_BY_SIDE = 3


@dataclass(frozen=True)
class Curve:
    """One series."""

    name: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    labels: tuple[str, ...] = ()
    """What the points are; empty: a line goes through them."""
    ringed: tuple[int, ...] = ()
    """Points to be looked at, as defaults: ringed, and their labels stand among the names."""
    ends: tuple[tuple[float, float], ...] = ()
    """Interval of every y; empty: none."""
    named: bool = True
    """Whether the labels of ringed points are said."""


@dataclass(frozen=True)
class Panel:
    """One chart of curves."""

    title: str
    x: str
    y: str
    curves: tuple[Curve, ...]
    log_x: bool = False
    log_y: bool = False
    front: bool = False
    """Whether a line joins the points that none beats in both x and y (less is better)."""


@dataclass(frozen=True)
class Row:
    """A mean and its interval."""

    name: str
    value: float
    interval: Interval = (math.nan, math.nan)
    """NaN ends draw no bar."""
    group: int = 0
    """Which colour."""


@dataclass(frozen=True)
class Chart:
    """One chart of intervals: a line a row."""

    title: str
    unit: str
    rows: tuple[Row, ...]


def bars(
    values: Mapping[str, float], ends: Mapping[str, tuple[float, float]] | None = None
) -> tuple[Row, ...]:
    """A row a value, with its interval where there is one."""
    known, none = ends or {}, (math.nan, math.nan)
    return tuple(Row(name, float(value), known.get(name, none)) for name, value in values.items())


def curves(panels: Sequence[Panel]) -> str:
    """Panels as one SVG, two a line; a name has one colour in all of them."""
    names = dict.fromkeys(curve.name for panel in panels for curve in panel.curves)
    colours = dict(zip(names, itertools.cycle(_COLOURS), strict=False))
    across = min(2, len(panels))
    lines = [panels[k : k + across] for k in range(0, len(panels), across)]
    heights = [_PANEL + _NAME * max(math.ceil(len(_names(p)) / _across(p)) for p in line) for line in lines]

    def draw(figure: Figure) -> None:
        places = figure.subplots(len(lines), across, squeeze=False, height_ratios=heights).flat
        for place, panel in itertools.zip_longest(places, panels):
            if panel is None:
                place.set_axis_off()
            else:
                _panel(place, panel, colours)

    return svg(_WIDTH * across / 2, sum(heights), draw)


def intervals(charts: Sequence[Chart]) -> str:
    """Charts as one SVG, one below the other; those of the same rows side by side, named once."""
    lines: list[list[Chart]] = []
    for chart in charts:
        names = [row.name for row in chart.rows]
        if lines and len(lines[-1]) < _SIDE_BY_SIDE and names == [row.name for row in lines[-1][0].rows]:
            lines[-1].append(chart)
        else:
            lines.append([chart])
    heights = [70 + _ROW * len(line[0].rows) for line in lines]

    def draw(figure: Figure) -> None:
        parts = figure.subfigures(len(lines), 1, squeeze=False, height_ratios=heights)
        for part, line in zip(parts.flat, lines, strict=True):
            units = {chart.unit for chart in line}
            if len(line) > 1 and len(units) == 1:
                part.supxlabel(units.pop(), fontsize=10)
                line = [replace(chart, unit="") for chart in line]
            places = part.subplots(1, len(line), squeeze=False, sharey=True)
            for place, chart in zip(places.flat, line, strict=True):
                _intervals(place, chart, said=len(line) == 1)

    return svg(_WIDTH, sum(heights), draw)


def front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Which points (cost, error) no other beats in both, cheapest first."""
    kept: list[int] = []
    least = math.inf
    for k in sorted(range(len(points)), key=lambda k: points[k]):
        if points[k][1] < least:
            kept.append(k)
            least = points[k][1]
    return kept


def _panel(axes: Axes, panel: Panel, colours: Mapping[str, str]) -> None:
    axes.set(title=panel.title, xlabel=panel.x, ylabel=panel.y)
    if panel.front:
        points = [p for c in panel.curves for p in zip(c.x, c.y, strict=True) if math.isfinite(p[1])]
        joined = [points[k] for k in front(points)]
        axes.plot(*zip(*joined, strict=True), color="#9aa3ad", linestyle="--", linewidth=1)
    for curve in panel.curves:
        _curve(axes, curve, colours[curve.name])
    for axis, log in ((axes.xaxis, panel.log_x), (axes.yaxis, panel.log_y)):
        _scale(axis, log)
    axes.legend(loc="upper left", bbox_to_anchor=(0, -0.16), ncols=_across(panel), borderaxespad=0)


def _names(panel: Panel) -> list[str]:
    """What stands below a panel."""
    said = [c.labels[k] for c in panel.curves if c.named for k in c.ringed]
    return [*(c.name for c in panel.curves), *said]


def _across(panel: Panel) -> int:
    """How many of its names stand side by side: what 480 points hold."""
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


def _intervals(axes: Axes, chart: Chart, said: bool) -> None:
    """Args: said: whether the figures stand beside the rows."""
    rows = chart.rows
    at = np.arange(len(rows))
    colours = [_COLOURS[row.group % len(_COLOURS)] for row in rows]
    low, high = np.array([row.interval for row in rows], float).reshape(-1, 2).T
    value = np.array([row.value for row in rows], float)
    axes.hlines(at, low, high, color=colours, linewidth=2)
    axes.scatter(value, at, 26, colours)
    axes.axvline(0, color="#c9ced6", linewidth=0.8, zorder=0)
    axes.set(title=chart.title, xlabel=chart.unit, ylim=(len(rows) - 0.4, -0.6))
    axes.set_yticks(at, [row.name for row in rows])
    axes.grid(visible=False, axis="y")
    axes.locator_params(axis="x", nbins=9 if said else 4)
    if said:
        right = axes.secondary_yaxis("right")
        right.set_yticks(at, [_figures(row) for row in rows], fontsize=9)
        right.tick_params(length=0)
        right.spines["right"].set_visible(False)


def _figures(row: Row) -> str:
    if not math.isfinite(row.interval[0]):
        return f"{row.value:.4g}"
    return f"{row.value:.4g} [{row.interval[0]:.4g}, {row.interval[1]:.4g}]"
