"""Charts of the flow room: one plotly figure as HTML, and the same curves as a PNG drawn by OpenCV."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

_COLOURS = ("#1f6feb", "#c2352b", "#2b7a4b", "#8a6d00", "#a04f9c", "#00798c", "#3b3f46")
_WIDTH, _HEIGHT, _LEFT, _BELOW = 560, 360, 62, 46


@dataclass(frozen=True)
class Curve:
    """One series."""

    name: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    labels: tuple[str, ...] = ()
    """Written beside the points; empty: a line through them."""


@dataclass(frozen=True)
class Panel:
    """One chart."""

    title: str
    x: str
    y: str
    curves: tuple[Curve, ...]
    log_x: bool = False
    log_y: bool = False


def write(panels: Sequence[Panel], out: Path, title: str) -> None:
    """`chart.png` and `index.html` (plotly from its CDN: inlined it would be 5 MB) in the folder `out`."""
    from plotly import graph_objects
    from plotly.subplots import make_subplots

    rows = math.ceil(len(panels) / 2)
    across = min(2, len(panels))
    figure = make_subplots(
        rows=rows, cols=across, subplot_titles=[p.title for p in panels], vertical_spacing=0.35 / rows
    )
    named: dict[str, str] = {}
    for k, panel in enumerate(panels):
        row, column = k // 2 + 1, k % 2 + 1
        for curve in panel.curves:
            first = curve.name not in named
            colour = named.setdefault(curve.name, _COLOURS[len(named) % len(_COLOURS)])
            figure.add_trace(
                graph_objects.Scatter(
                    x=curve.x, y=curve.y, name=curve.name, text=curve.labels or None, showlegend=first,
                    mode="markers+text" if curve.labels else "lines+markers", textposition="top center",
                    marker_color=colour,
                ),
                row=row, col=column,
            )  # fmt: skip
        figure.update_xaxes(title=panel.x, type="log" if panel.log_x else "linear", row=row, col=column)
        figure.update_yaxes(title=panel.y, type="log" if panel.log_y else "linear", row=row, col=column)
    figure.update_layout(title=title, template="plotly_white", height=380 * rows + 80)
    figure.write_html(out / "index.html", include_plotlyjs="cdn", full_html=True)
    sheet = [_draw(panel, named) for panel in panels]
    blank = np.full_like(sheet[0], 255)
    lines = [np.hstack([*sheet[k : k + across], *[blank] * (across - len(sheet[k : k + across]))])
             for k in range(0, len(sheet), across)]  # fmt: skip
    cv2.imwrite(str(out / "chart.png"), np.vstack(lines)[..., ::-1])


def _draw(panel: Panel, named: dict[str, str]) -> NDArray[np.uint8]:
    canvas = np.full((_HEIGHT, _WIDTH, 3), 255, np.uint8)
    xs = _axis([v for c in panel.curves for v in c.x], panel.log_x)
    ys = _axis([v for c in panel.curves for v in c.y], panel.log_y)

    def at(x: float, y: float) -> tuple[int, int]:
        across = _LEFT + (_WIDTH - _LEFT - 20) * xs.share(x)
        return round(across), round(_HEIGHT - _BELOW - (_HEIGHT - _BELOW - 40) * ys.share(y))

    for axis, along in ((xs, True), (ys, False)):
        for tick in axis.ticks():
            one, two = (
                (at(tick, ys.low), at(tick, ys.high)) if along else (at(xs.low, tick), at(xs.high, tick))
            )
            cv2.line(canvas, one, two, (230, 232, 235), 1, cv2.LINE_AA)
            place = (one[0] - 12, one[1] + 16) if along else (8, one[1] + 4)
            _text(canvas, f"{tick:.3g}", place, 0.36, "#5b6b7a")
    for k, curve in enumerate(panel.curves):
        colour = _rgb(named[curve.name])
        points = [at(x, y) for x, y in zip(curve.x, curve.y, strict=True) if math.isfinite(y)]
        if not curve.labels and len(points) > 1:
            cv2.polylines(canvas, [np.array(points, np.int32)], False, colour, 2, cv2.LINE_AA)
        for point, label in zip(points, curve.labels or [""] * len(points), strict=False):
            cv2.circle(canvas, point, 4, colour, -1, cv2.LINE_AA)
            _text(canvas, label, (point[0] + 6, point[1] - 5), 0.34, named[curve.name])
        _text(canvas, curve.name, (_WIDTH - 150, 44 + 15 * k), 0.38, named[curve.name])
    _text(canvas, panel.title, (_LEFT, 20), 0.48, "#22262b")
    _text(canvas, panel.x, (_LEFT + 160, _HEIGHT - 8), 0.4, "#22262b")
    _text(canvas, panel.y, (8, 36), 0.38, "#22262b")
    return canvas


@dataclass(frozen=True)
class _Axis:
    low: float
    high: float
    log: bool

    def share(self, value: float) -> float:
        value = min(max(value, self.low), self.high)
        if self.log:
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)

    def ticks(self) -> list[float]:
        if not self.log:
            return [self.low + k * (self.high - self.low) / 5 for k in range(6)]
        decades = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
        fine = [m * 10.0**d for d in decades for m in (1, 2, 5)]
        return [t for t in fine if self.low <= t <= self.high]


def _axis(values: Sequence[float], log: bool) -> _Axis:
    good = [v for v in values if math.isfinite(v) and (v > 0 or not log)] or [1.0]
    if log:
        return _Axis(min(good) / 1.3, max(good) * 1.3, True)
    low, high = min(0.0, *good), max(good)
    return _Axis(low, high + 0.08 * (high - low) + 1e-9, False)


def _text(canvas: NDArray[np.uint8], text: str, at: tuple[int, int], size: float, colour: str) -> None:
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, _rgb(colour), 1, cv2.LINE_AA)


def _rgb(colour: str) -> tuple[int, int, int]:
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)
