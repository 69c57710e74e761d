"""The report's charts as plotly figures in plain JSON-ready dicts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.scoring import metrics
from bench.scoring.result import Result
from bench.sensor.clock_sync import Offset

Figure = dict[str, Any]

SENSOR, MAIN, BAND, RED = "#3b3f46", "#1f6feb", "rgba(31,111,235,0.15)", "#c2352b"
INTERVAL = "rgba(43,122,75,0.15)"
OTHERS = ("#8a6d00", "#2b7a4b", "#a04f9c", "#b8562b", "#5b6b7a", "#00798c", "#7a5195", "#6b8e23", "#a61c3c")


def draw_force(result: Result) -> Figure:
    """Force over time: the sensor, the main method with its band of uncertainty, the sizes of flow, the rest
    on demand. Lost frames are gaps, shaded. Without a known E all curves are brought to one height."""
    time, curves = _list(result.time_s), scale_curves(result)
    main = curves.methods[result.main]
    data: list[Figure] = []
    bound = result.methods[result.main]
    if result.absolute and bound.low_mn is not None and bound.high_mn is not None:
        data += _band(time, bound.low_mn, bound.high_mn, f"{bound.interval['level']:.0%} interval", INTERVAL)
    spread = 1.96 * result.relative_uncertainty
    if spread > 0:
        low, high = main * (1 - min(spread, 1.0)), main * (1 + spread)
        data += _band(time, low, high, f"±{100 * spread:.0f}% scale, stiffness", BAND)
    if curves.sensor is not None:
        data.append(_line(time, curves.sensor, "sensor", SENSOR, width=2.5))
    data.append(_line(time, main, result.main, MAIN, width=2.5))
    rest = [name for name in result.methods if name != result.main]
    for k, name in enumerate(rest):
        data.append(
            _line(
                time,
                curves.methods[name],
                name,
                OTHERS[k % len(OTHERS)],
                width=1.5,
                visible=True if result.methods[name].gain else "legendonly",
            )
        )
    figure = _figure(data, "time [s]", curves.axis, legend=True)
    figure["layout"]["shapes"] = [_shade(result.time_s, run) for run in _spans(result.lost)]
    return figure


def _band(
    time: Sequence[float | None], low: NDArray[np.float64], high: NDArray[np.float64], name: str, colour: str
) -> list[Figure]:
    """The space between two curves (T,). A filled band knows no gaps: one for each run of frames."""
    data: list[Figure] = []
    for number, (first, last) in enumerate(_spans(np.isfinite(low) & np.isfinite(high))):
        part = slice(first, last + 1)
        data += [
            _line(time[part], low[part], "", "rgba(0,0,0,0)", showlegend=False, hoverinfo="skip"),
            _line(
                time[part], high[part], name, "rgba(0,0,0,0)",
                fill="tonexty", fillcolor=colour, hoverinfo="skip", showlegend=number == 0, legendgroup=name,
            ),
        ]  # fmt: skip
    return data


@dataclass(frozen=True)
class Curves:
    """What the chart of forces shows."""

    sensor: NDArray[np.float64] | None
    methods: dict[str, NDArray[np.float64]]
    """(T,) each."""
    axis: str


def scale_curves(result: Result) -> Curves:
    """Forces as they stand; without a known E brought to what can be compared.

    With a separate press to newtons, by its gain. Without, the sensor to its largest value and each method
    to the sensor by the one gain that fits best; without a sensor each method to its own largest value.
    """
    sizes = {name: method.size_mn for name, method in result.methods.items()}
    if result.absolute:
        return Curves(result.sensor_mn, sizes, "force [mN]")
    gains = {name: method.calibrated.get("gain", math.nan) for name, method in result.methods.items()}
    if math.isfinite(gains[result.main]):
        return Curves(
            result.sensor_mn, {n: gains[n] * s for n, s in sizes.items()}, "force [mN], gain of the press"
        )
    if result.sensor_mn is None:
        return Curves(None, {n: s / _largest(s) for n, s in sizes.items()}, "force / largest")
    top, kept = _largest(result.sensor_mn), result.scored
    brought = {n: metrics.gain(result.sensor_mn, s, kept) * s / top for n, s in sizes.items()}
    return Curves(result.sensor_mn / top, brought, "force / largest")


def _largest(values: NDArray[np.float64]) -> float:
    """1 where there is none above zero."""
    return float(np.nanmax(values, initial=0.0)) or 1.0


def _spans(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last index of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _shade(time_s: NDArray[np.float64], span: tuple[int, int]) -> Figure:
    """From the last frame that was followed to the next one that was."""
    left, right = time_s[max(span[0] - 1, 0)], time_s[min(span[1] + 1, len(time_s) - 1)]
    return {
        "type": "rect", "xref": "x", "yref": "paper", "x0": float(left), "x1": float(right), "y0": 0, "y1": 1,
        "fillcolor": "rgba(194,53,43,0.10)", "line": {"width": 0}, "layer": "below",
    }  # fmt: skip


def draw_components(result: Result) -> Figure:
    """The main method's force along the camera's axes over time, and the sensor's where it has them."""
    time, force = _list(result.time_s), result.methods[result.main].force_mn
    sensor = result.sensor_axes_mn if result.methods[result.main].components else None
    data: list[Figure] = []
    for k, axis in enumerate(("x, right", "y, down", "z, away")):
        if sensor is not None:
            data.append(_line(time, sensor[:, k], f"{axis}: sensor", OTHERS[k], width=1, dash="dot"))
        data.append(_line(time, force[:, k], axis, OTHERS[k], width=2))
    unit = "force [mN]" if result.absolute else "force [mN a kPa]"
    return _figure(data, "time [s]", unit, legend=True)


def draw_correlogram(found: Offset) -> Figure:
    """Correlation of force and motion at every offset that was tried, and the one that was found best."""
    offsets, r = np.array(found.correlogram).T
    figure = _figure(
        [
            _line(_list(offsets), r, "", MAIN, width=2),
            _dots(np.array([found.offset_s]), np.array([found.r]), "best"),
        ],
        "offset added to the sensor's times [s]",
        "correlation",
    )
    figure["data"][1]["marker"] = {"color": RED, "size": 9}
    return figure


def draw_scatter(result: Result) -> Figure:
    """Predicted against sensor, with the line of agreement."""
    assert result.sensor_mn is not None
    x, y = _both(result)
    top = float(max(x.max(initial=0.0), y.max(initial=0.0))) * 1.05 or 1.0
    data = [
        _line([0, top], np.array([0, top]), "equal", SENSOR, width=1, dash="dot", hoverinfo="skip"),
        _dots(x, y, result.main),
    ]
    figure = _figure(data, "sensor [mN]", "predicted [mN]")
    for axis in ("xaxis", "yaxis"):
        figure["layout"][axis]["range"] = [-0.02 * top, top]
    return figure


def draw_bland_altman(result: Result, limits: dict[str, float]) -> Figure:
    """Difference against mean, with bias and limits of agreement.

    Args:
        limits: bias_mn, low_mn, high_mn.
    """
    x, y = _both(result)
    middle, difference = (x + y) / 2, y - x
    left, right = float(middle.min(initial=0.0)), float(middle.max(initial=1.0))
    data = [_dots(middle, difference, result.main)]
    for name, key, colour in (
        ("bias", "bias_mn", MAIN),
        ("95% low", "low_mn", RED),
        ("95% high", "high_mn", RED),
    ):
        level = limits[key]
        if math.isfinite(level):
            data.append(
                _line(
                    [left, right],
                    np.array([level, level]),
                    f"{name} {level:+.3g}",
                    colour,
                    width=1.5,
                    dash="dash",
                )
            )
    return _figure(data, "mean of both [mN]", "predicted − sensor [mN]")


def _both(result: Result) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    assert result.sensor_mn is not None
    predicted = result.methods[result.main].size_mn
    good = result.scored & np.isfinite(result.sensor_mn) & np.isfinite(predicted)
    return result.sensor_mn[good], predicted[good]


def _line(
    x: Sequence[float | None],
    y: NDArray[np.float64],
    name: str,
    colour: str,
    width: float = 0,
    dash: str = "solid",
    **more: Any,
) -> Figure:
    line = {"color": colour, "width": width, "dash": dash}
    return {"type": "scatter", "mode": "lines", "x": x, "y": _list(y), "name": name, "line": line, **more}


def _dots(x: NDArray[np.float64], y: NDArray[np.float64], name: str) -> Figure:
    marker = {"color": MAIN, "size": 5, "opacity": 0.45 if len(x) > 100 else 0.8}
    kind = "scattergl" if len(x) > 4000 else "scatter"
    return {"type": kind, "mode": "markers", "x": _list(x), "y": _list(y), "name": name, "marker": marker}


def _figure(data: list[Figure], x: str, y: str, legend: bool = False) -> Figure:
    axis = {"gridcolor": "#e6e8eb", "zerolinecolor": "#c9ced6", "linecolor": "#c9ced6", "ticks": "outside",
            "tickcolor": "#c9ced6", "automargin": True}  # fmt: skip
    layout = {
        "xaxis": {**axis, "title": {"text": x, "standoff": 6}},
        "yaxis": {**axis, "title": {"text": y, "standoff": 4}, "rangemode": "normal"},
        "margin": {"l": 8, "r": 8, "t": 8, "b": 8},
        "showlegend": legend,
        "legend": {"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0, "font": {"size": 12}},
        "font": {"family": "system-ui, sans-serif", "size": 13, "color": "#22262b"},
        "paper_bgcolor": "white",
        "plot_bgcolor": "white",
        "hovermode": "x unified" if legend else "closest",
    }
    return {"data": data, "layout": layout}


def _list(values: Any) -> list[float | None]:
    """Five figures are more than a chart shows; NaN becomes a gap."""
    return [float(f"{value:.5g}") if math.isfinite(value) else None for value in values]
