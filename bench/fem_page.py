"""Charts as one SVG and one small page that needs nothing from elsewhere: curves, values on hover, rows."""

from __future__ import annotations

import html
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from bench.flow_plot import Curve, Panel

_COLOURS = ("#1f6feb", "#c2352b", "#2b7a4b", "#8a6d00", "#a04f9c", "#00798c", "#3b3f46", "#b8562b", "#6b8e23")
_WIDE, _TALL, _LEFT, _RIGHT, _TOP, _BELOW = 560, 330, 58, 150, 34, 44
_STYLE = (
    "body{font:14px system-ui,sans-serif;color:#22262b;margin:2em;max-width:1160px}"
    "table{border-collapse:collapse;font-size:12px;margin-top:1em}td,th{padding:2px 8px;text-align:left;"
    "border-bottom:1px solid #e6e8eb;vertical-align:top}code{background:#f3f4f6;padding:1px 4px}"
)


def write(
    panels: Sequence[Panel], rows: Sequence[dict[str, Any]], found: dict[str, Any], title: str, out: Path
) -> None:
    """Writes `chart.svg` and `index.html` into the folder `out`.

    Args:
        panels: the charts, two a line.
        rows: what was measured, as the page's table; columns are the keys of all rows.
        found: `command` and `machine` stand under the title.
        title: of the page.
    """
    chart = drawing(panels)
    (out / "chart.svg").write_text(chart, "utf-8")
    names = list(dict.fromkeys(name for row in rows for name in row))
    head = "".join(f"<th>{html.escape(name)}</th>" for name in names)
    body = "\n".join(
        "<tr>" + "".join(f"<td>{html.escape(_shown(row.get(name)))}</td>" for name in names) + "</tr>"
        for row in rows
    )
    machine = ", ".join(f"{key} {value}" for key, value in found["machine"].items())
    page = (
        f'<!doctype html>\n<html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{_STYLE}</style>\n<h1>{html.escape(title)}</h1>\n"
        f"<p><code>{html.escape(found['command'])}</code></p><p>{html.escape(machine)}</p>\n"
        f"{chart}<table><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table></html>\n"
    )
    (out / "index.html").write_text(page, "utf-8")


def drawing(panels: Sequence[Panel]) -> str:
    """All panels as one SVG."""
    across = min(2, len(panels))
    lines = math.ceil(len(panels) / across)
    wide, tall = across * _WIDE, lines * _TALL
    names = list(dict.fromkeys(curve.name for panel in panels for curve in panel.curves))
    colours = {name: _COLOURS[k % len(_COLOURS)] for k, name in enumerate(names)}
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide} {tall}" width="{wide}" height="{tall}" '
        'font-family="sans-serif" font-size="11" fill="#22262b">',
        f'<rect width="{wide}" height="{tall}" fill="white"/>',
    ]
    for k, panel in enumerate(panels):
        parts.append(f'<g transform="translate({k % across * _WIDE},{k // across * _TALL})">')
        parts += _panel(panel, colours)
        parts.append("</g>")
    return "\n".join([*parts, "</svg>"]) + "\n"


def _panel(panel: Panel, colours: dict[str, str]) -> Iterator[str]:
    xs = _scale([x for c in panel.curves for x in c.x], panel.log_x)
    ys = _scale([y for c in panel.curves for y in c.y], panel.log_y)
    right, bottom = _WIDE - _RIGHT, _TALL - _BELOW

    def across(x: float) -> float:
        return _LEFT + (right - _LEFT) * _share(x, xs, panel.log_x)

    def down(y: float) -> float:
        return bottom - (bottom - _TOP) * _share(y, ys, panel.log_y)

    middle = (_TOP + bottom) / 2
    yield _text(panel.title, _LEFT, 18, "start", size=13)
    yield _text(panel.x, (_LEFT + right) / 2, _TALL - 8, "middle")
    yield f'<g transform="translate(14,{middle}) rotate(-90)">{_text(panel.y, 0, 0, "middle")}</g>'
    for x in _ticks(xs, panel.log_x):
        yield f'<line x1="{across(x):.1f}" x2="{across(x):.1f}" y1="{_TOP}" y2="{bottom}" stroke="#e6e8eb"/>'
        yield _text(f"{x:.4g}", across(x), bottom + 14, "middle")
    for y in _ticks(ys, panel.log_y):
        yield f'<line x1="{_LEFT}" x2="{right}" y1="{down(y):.1f}" y2="{down(y):.1f}" stroke="#e6e8eb"/>'
        yield _text(f"{y:.4g}", _LEFT - 5, down(y) + 4, "end")
    for k, curve in enumerate(panel.curves):
        colour = colours[curve.name]
        yield _text(curve.name, right + 10, _TOP + 10 + 15 * k, "start", colour)
        yield from _curve(curve, colour, across, down)


def _curve(curve: Curve, colour: str, across: Any, down: Any) -> Iterator[str]:
    places = [(across(x), down(y), x, y) for x, y in zip(curve.x, curve.y, strict=True) if math.isfinite(y)]
    if not curve.labels and len(places) > 1:
        line = " ".join(f"{x:.1f},{y:.1f}" for x, y, *_ in places)
        yield f'<polyline points="{line}" fill="none" stroke="{colour}" stroke-width="1.6"/>'
    for (x, y, value, error), label in zip(places, curve.labels or [""] * len(places), strict=False):
        about = html.escape(f"{curve.name} {label}: {value:.4g}, {error:.4g}")
        yield f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{colour}"><title>{about}</title></circle>'
        if label:
            yield _text(label, x + 6, y - 4, "start", colour, size=10)


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
