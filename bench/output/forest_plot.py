"""Means with their intervals, row by row, as a small picture."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

from bench.bootstrap import Interval

_ROW, _LEFT, _WIDTH, _TOP, _BELOW = 24, 270, 780, 40, 46
_COLOURS = ("#1f6feb", "#c2352b", "#2b7a4b")


@dataclass(frozen=True)
class Row:
    """One line of the chart."""

    name: str
    value: float
    interval: Interval
    """NaN ends draw no bar."""
    group: int = 0
    """Which colour."""


def draw(rows: Sequence[Row], title: str, unit: str) -> str:
    """The picture as SVG."""
    height = _TOP + _ROW * len(rows) + _BELOW
    left = max(_LEFT, 20 + round(6.4 * max((len(row.name) for row in rows), default=0)))
    ends = [v for row in rows for v in (row.value, *row.interval) if math.isfinite(v)] or [1.0]
    low, high = min(0.0, *ends), max(ends)
    step = _step((high - low) or 1.0)
    low, high = step * math.floor(low / step), step * math.ceil(high / step + 1e-9)

    def at(value: float) -> float:
        return round(left + (_WIDTH - left - 24) * (value - low) / (high - low), 1)

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}" '
        f'style="max-width:{_WIDTH}px;width:100%" font-family="sans-serif" font-size="12" fill="#22262b">',
        f'<rect width="{_WIDTH}" height="{height}" fill="#fff"/>',
        _text(10, 22, title, 'font-size="15"'),
        _text(left, height - 10, unit),
    ]
    for k in range(round((high - low) / step) + 1):
        x = at(low + k * step)
        parts.append(f'<path d="M{x} {_TOP}V{height - _BELOW}" stroke="#e4e7eb"/>')
        parts.append(_text(x, height - _BELOW + 16, f"{low + k * step:.4g}", 'text-anchor="middle"'))
    for k, row in enumerate(rows):
        y, colour = _TOP + _ROW * k + _ROW // 2, _COLOURS[row.group % len(_COLOURS)]
        parts.append(_text(10, y + 4, row.name))
        said = f"{row.name}: {row.value:.4g}"
        bar = ""
        if all(math.isfinite(end) for end in row.interval):
            said += f" [{row.interval[0]:.4g}, {row.interval[1]:.4g}]"
            low_x, high_x = (at(end) for end in row.interval)
            bar = f'<path d="M{low_x} {y}H{high_x}" stroke="{colour}" stroke-width="2"/>'
        if math.isfinite(row.value):
            bar += f'<circle cx="{at(row.value)}" cy="{y}" r="5" fill="{colour}"/>'
        parts.append(f"<g><title>{html.escape(said)}</title>{bar}</g>")
    return "\n".join([*parts, "</svg>"])


def _step(span: float) -> float:
    """A round step that divides the span into four to nine."""
    base = 10.0 ** math.floor(math.log10(span / 4))
    return next(m * base for m in (1, 2, 5, 10) if span / (m * base) <= 9)


def _text(x: float, y: float, text: str, how: str = "") -> str:
    return f'<text x="{x}" y="{y}" {how}>{html.escape(text)}</text>'
