"""Charts as SVG, and pages that hold them and need nothing from elsewhere: curves, marks, values."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.output import write as results

_COLOURS = ("#1f6feb", "#c2352b", "#2b7a4b", "#8a6d00", "#a04f9c", "#00798c", "#3b3f46", "#b8562b", "#6b8e23")
_WIDE, _TALL, _LEFT, _RIGHT, _TOP, _LINE = 480, 350, 56, 16, 34, 15
_PER_LINE = 3
_STYLE = (
    "body{font:15px/1.45 system-ui,sans-serif;color:#22262b;margin:1rem auto;max-width:1200px;padding:0 1rem}"
    "h1{font-size:1.4rem}h2{font-size:1.1rem;margin:1.6rem 0 .4rem}"
    ".charts{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,420px),1fr));gap:.5rem}"
    "svg{width:100%;max-width:640px;height:auto;display:block}.wide{overflow-x:auto}"
    "table{border-collapse:collapse;font-size:12px;margin:.6rem 0}td,th{padding:2px 8px;text-align:left;"
    "border-bottom:1px solid #e6e8eb;vertical-align:top}code{background:#f3f4f6;padding:1px 4px;"
    "overflow-wrap:anywhere}"
)


@dataclass(frozen=True)
class Curve:
    """One series."""

    name: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    labels: tuple[str, ...] = ()
    """Said of the points on pointing; empty: a line goes through them."""
    ringed: tuple[int, ...] = ()
    """Points to be looked at, as defaults: ringed, and labelled in the picture."""
    ends: tuple[tuple[float, float], ...] = ()
    """Interval of every y; empty: none."""
    named: bool = True
    """Whether ringed points are labelled in the picture; not where many of them lie together."""


@dataclass(frozen=True)
class Panel:
    """One chart."""

    title: str
    x: str
    y: str
    curves: tuple[Curve, ...]
    log_x: bool = False
    log_y: bool = False
    front: bool = False
    """Whether a line joins the points that none beats in both x and y (less is better)."""


def write(
    panels: Sequence[Panel],
    out: Path,
    title: str,
    rows: Sequence[Mapping[str, Any]] = (),
    found: Mapping[str, Any] | None = None,
) -> None:
    """Writes `chart.svg` and `index.html` into the folder `out`.

    Args:
        panels: the charts.
        out: made if need be.
        title: of the page.
        rows: what was measured, as the page's table; columns are the keys of all rows.
        found: its `command` and `machine`, if any, stand under the title.
    """
    results.keep(out, "chart.svg", drawing(panels))
    write_page(out, title, [credit(found or {}), charts(panels), table(rows) if rows else ""])


def write_page(out: Path, title: str, parts: Sequence[str]) -> None:
    """Writes `index.html`, which needs nothing from elsewhere, of parts (HTML) into the folder `out`."""
    results.keep(out, "index.html", page(title, "\n".join(parts)))


def page(title: str, body: str) -> str:
    """A whole page round `body` (HTML)."""
    name = html.escape(title)
    return (
        f'<!doctype html>\n<html lang="en"><meta charset="utf-8"><meta name="viewport" '
        f'content="width=device-width,initial-scale=1"><title>{name}</title><style>{_STYLE}</style>\n'
        f"<h1>{name}</h1>\n{body}\n</html>\n"
    )


def credit(found: Mapping[str, Any]) -> str:
    """Command and machine of a measurement, as HTML; what isn't known is left out."""
    parts = []
    if "command" in found:
        parts.append(f"<p><code>{html.escape(str(found['command']))}</code></p>")
    if "machine" in found:
        said = ", ".join(f"{key} {value}" for key, value in found["machine"].items())
        parts.append(f"<p>{html.escape(said)}</p>")
    return "\n".join(parts)


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows as an HTML table, wide ones scroll by themselves."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    head = "".join(f"<th>{html.escape(name)}</th>" for name in names)
    body = "\n".join(
        "<tr>" + "".join(f"<td>{html.escape(_shown(row.get(name)))}</td>" for name in names) + "</tr>"
        for row in rows
    )
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table></div>\n'


def charts(panels: Sequence[Panel]) -> str:
    """The panels for a page: as many beside one another as its width holds."""
    colours = _colours(panels)
    pictures = "\n".join(_alone(panel, colours) for panel in panels)
    return f'<div class="charts">\n{pictures}\n</div>\n'


def drawing(panels: Sequence[Panel]) -> str:
    """All panels as one SVG, two a line."""
    across = min(2, len(panels))
    colours = _colours(panels)
    lines = [panels[k : k + across] for k in range(0, len(panels), across)]
    tops, y = [], 0
    for line in lines:
        tops.append(y)
        y += max(_height(panel) for panel in line)
    parts = [_open(across * _WIDE, y)]
    for line, top in zip(lines, tops, strict=True):
        for k, panel in enumerate(line):
            parts.append(f'<g transform="translate({k * _WIDE},{top})">')
            parts += _panel(panel, colours)
            parts.append("</g>")
    return "\n".join([*parts, "</svg>"]) + "\n"


def front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Which points (cost, error) no other beats in both, cheapest first."""
    kept: list[int] = []
    least = math.inf
    for k in sorted(range(len(points)), key=lambda k: points[k]):
        if points[k][1] < least:
            kept.append(k)
            least = points[k][1]
    return kept


def _colours(panels: Sequence[Panel]) -> dict[str, str]:
    names = list(dict.fromkeys(curve.name for panel in panels for curve in panel.curves))
    return {name: _COLOURS[k % len(_COLOURS)] for k, name in enumerate(names)}


def _open(wide: float, tall: float) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide:g} {tall:g}" width="{wide:g}" '
        f'height="{tall:g}" font-family="sans-serif" font-size="11" fill="#22262b">'
        f'<rect width="{wide:g}" height="{tall:g}" fill="white"/>'
    )


def _height(panel: Panel) -> int:
    return _TALL + _LINE * math.ceil(len(panel.curves) / _PER_LINE)


def _alone(panel: Panel, colours: Mapping[str, str]) -> str:
    return "\n".join([_open(_WIDE, _height(panel)), *_panel(panel, colours), "</svg>"])


def _panel(panel: Panel, colours: Mapping[str, str]) -> Iterator[str]:
    ends = [end for c in panel.curves for pair in c.ends for end in pair]
    xs = _scale([x for c in panel.curves for x in c.x], panel.log_x)
    ys = _scale([*(y for c in panel.curves for y in c.y), *ends], panel.log_y)
    right, bottom = _WIDE - _RIGHT, _TALL - 46

    def across(x: float) -> float:
        return _LEFT + (right - _LEFT) * _share(x, xs, panel.log_x)

    def down(y: float) -> float:
        return bottom - (bottom - _TOP) * _share(y, ys, panel.log_y)

    yield _text(panel.title, _LEFT, 18, "start", size=13)
    yield _text(panel.x, (_LEFT + right) / 2, bottom + 32, "middle")
    side = f"translate(13,{(_TOP + bottom) / 2}) rotate(-90)"
    yield f'<g transform="{side}">{_text(panel.y, 0, 0, "middle")}</g>'
    for x in _ticks(xs, panel.log_x):
        yield f'<line x1="{across(x):.1f}" x2="{across(x):.1f}" y1="{_TOP}" y2="{bottom}" stroke="#e6e8eb"/>'
        yield _text(f"{x:.4g}", across(x), bottom + 14, "middle")
    for y in _ticks(ys, panel.log_y):
        yield f'<line x1="{_LEFT}" x2="{right}" y1="{down(y):.1f}" y2="{down(y):.1f}" stroke="#e6e8eb"/>'
        yield _text(f"{y:.4g}", _LEFT - 5, down(y) + 4, "end")
    if panel.front:
        points = [p for c in panel.curves for p in zip(c.x, c.y, strict=True) if math.isfinite(p[1])]
        line = " ".join(f"{across(points[k][0]):.1f},{down(points[k][1]):.1f}" for k in front(points))
        yield f'<polyline points="{line}" fill="none" stroke="#9aa3ad" stroke-dasharray="4 3"/>'
    for curve in panel.curves:
        yield from _curve(curve, colours[curve.name], across, down)
    for k, curve in enumerate(panel.curves):
        x = _LEFT + (right - _LEFT) / _PER_LINE * (k % _PER_LINE)
        y = bottom + 50 + _LINE * (k // _PER_LINE)
        yield f'<circle cx="{x + 4:.1f}" cy="{y - 4:.1f}" r="4" fill="{colours[curve.name]}"/>'
        yield _text(curve.name, x + 12, y, "start")


def _curve(
    curve: Curve, colour: str, across: Callable[[float], float], down: Callable[[float], float]
) -> Iterator[str]:
    good = [k for k, y in enumerate(curve.y) if math.isfinite(y)]
    if not curve.labels and len(good) > 1:
        line = " ".join(f"{across(curve.x[k]):.1f},{down(curve.y[k]):.1f}" for k in good)
        yield f'<polyline points="{line}" fill="none" stroke="{colour}" stroke-width="1.6"/>'
    for k in good:
        x, y = across(curve.x[k]), down(curve.y[k])
        label = curve.labels[k] if curve.labels else ""
        about = f"{curve.name} {label}: {curve.x[k]:.4g}, {curve.y[k]:.4g}"
        yield "<g>"
        if curve.ends:
            low, high = curve.ends[k]
            about += f" [{low:.4g}, {high:.4g}]"
            yield f'<path d="M{x:.1f} {down(low):.1f}V{down(high):.1f}" stroke="{colour}" opacity="0.55"/>'
        yield f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{colour}"/>'
        if k in curve.ringed:
            yield f'<circle cx="{x:.1f}" cy="{y:.1f}" r="7" fill="none" stroke="#22262b" stroke-width="1.8"/>'
            if curve.named:
                side = "start" if x < 0.7 * _WIDE else "end"
                yield _text(label, x + (10 if side == "start" else -10), y - 8, side, size=10)
        yield f"<title>{html.escape(about)}</title></g>"


def _text(words: str, x: float, y: float, anchor: str, colour: str = "#22262b", size: int = 11) -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{colour}" font-size="{size}">'
        f"{html.escape(words)}</text>"
    )


def _scale(values: Sequence[float], log: bool) -> tuple[float, float]:
    good = [v for v in values if math.isfinite(v) and (v > 0 or not log)] or [1.0]
    if log:
        return min(good) / 1.3, max(good) * 1.3
    low, high = min(0.0, *good), max(good)
    return low, high + 0.08 * (high - low) + 1e-9


def _share(value: float, ends: tuple[float, float], log: bool) -> float:
    low, high = ends
    value = min(max(value, low), high)
    return math.log(value / low) / math.log(high / low) if log else (value - low) / (high - low)


def _ticks(ends: tuple[float, float], log: bool) -> list[float]:
    low, high = ends
    if not log:
        rough = (high - low) / 5
        size = 10.0 ** math.floor(math.log10(rough))
        step = next(m * size for m in (1, 2, 5, 10) if m * size >= rough)
        return [k * step for k in range(math.ceil(low / step), math.floor(high / step) + 1)]
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    several = (1, 2, 5) if len(decades) <= 4 else (1,)
    return [m * 10.0**d for d in decades for m in several if low <= m * 10.0**d <= high]


def _shown(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)
