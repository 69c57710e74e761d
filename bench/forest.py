"""Means with their intervals, row by row: a page and a picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.bootstrap import Interval

_ROW, _LEFT, _WIDTH, _TOP, _BELOW = 24, 250, 760, 40, 46
_INK, _FAINT, _COLOURS = (34, 38, 43), (228, 231, 235), ((31, 111, 235), (194, 53, 43), (43, 122, 75))


@dataclass(frozen=True)
class Row:
    """One line of the chart."""

    name: str
    value: float
    interval: Interval
    """NaN ends draw no bar."""
    group: int = 0
    """Which colour."""


def write(rows: Sequence[Row], out: Path, title: str, unit: str) -> None:
    """`chart.png` and `index.html`, which stands alone, in the folder `out`."""
    import plotly.graph_objects as go

    out.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(out / "chart.png"), draw(rows, title, unit)[..., ::-1])
    up = [row.interval[1] - row.value for row in rows]
    down = [row.value - row.interval[0] for row in rows]
    figure = go.Figure(
        go.Scatter(
            x=[row.value for row in rows],
            y=[row.name for row in rows],
            mode="markers",
            marker={"size": 9, "color": [f"rgb{_COLOURS[row.group % len(_COLOURS)]}" for row in rows]},
            error_x={"type": "data", "array": up, "arrayminus": down, "symmetric": False},
        )
    )
    figure.update_layout(title=title, template="plotly_white", height=26 * len(rows) + 160)
    figure.update_yaxes(autorange="reversed", automargin=True)
    figure.update_xaxes(title=unit, rangemode="tozero")
    figure.write_html(out / "index.html", include_plotlyjs=True, full_html=True)


def draw(rows: Sequence[Row], title: str, unit: str) -> NDArray[np.uint8]:
    """The picture, (H, W, 3) uint8 sRGB."""
    height = _TOP + _ROW * len(rows) + _BELOW
    canvas = np.full((height, _WIDTH, 3), 255, np.uint8)
    ends = [v for row in rows for v in (row.value, *row.interval) if math.isfinite(v)] or [1.0]
    low, high = min(0.0, *ends), max(ends)
    step = _step((high - low) or 1.0)
    high = step * math.ceil(high / step + 1e-9)
    low = step * math.floor(low / step)

    def at(value: float) -> int:
        return round(_LEFT + (_WIDTH - _LEFT - 24) * (value - low) / (high - low))

    for k in range(round((high - low) / step) + 1):
        tick = low + k * step
        cv2.line(canvas, (at(tick), _TOP), (at(tick), height - _BELOW), _FAINT, 1, cv2.LINE_AA)
        _text(canvas, f"{tick:.4g}", (at(tick) - 10, height - _BELOW + 16), 0.36)
    for k, row in enumerate(rows):
        y, colour = _TOP + _ROW * k + _ROW // 2, _COLOURS[row.group % len(_COLOURS)]
        _text(canvas, row.name, (10, y + 4), 0.4)
        if all(math.isfinite(end) for end in row.interval):
            cv2.line(canvas, (at(row.interval[0]), y), (at(row.interval[1]), y), colour, 2, cv2.LINE_AA)
        if math.isfinite(row.value):
            cv2.circle(canvas, (at(row.value), y), 5, colour, -1, cv2.LINE_AA)
    _text(canvas, title, (10, 22), 0.5)
    _text(canvas, unit, (_LEFT, height - 10), 0.4)
    return canvas


def _step(span: float) -> float:
    """A round step that divides the span into four to nine."""
    base = 10.0 ** math.floor(math.log10(span / 4))
    return next(m * base for m in (1, 2, 5, 10) if span / (m * base) <= 9)


def _text(canvas: NDArray[np.uint8], text: str, at: tuple[int, int], size: float) -> None:
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, _INK, 1, cv2.LINE_AA)
