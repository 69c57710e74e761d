"""The report's charts, each returned as the text of an SVG element."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.methods.comparison import PHYSICS
from bench.scoring import force_metrics
from bench.scoring.result import Result
from synth.arrays import Floats
from synth.publish.svg import svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SENSOR, _MAIN, _RED, _INTERVAL = "#3b3f46", "#1f6feb", "#c2352b", "#2b7a4b"
_OTHERS = ("#8a6d00", "#2b7a4b", "#a04f9c", "#b8562b", "#5b6b7a", "#00798c", "#7a5195", "#6b8e23", "#a61c3c")
_WIDE, _HIGH = 1150, 300  # points


def draw_force(result: Result, others: bool = False) -> str:
    """Force over time: the sensor, the main method with its uncertainty, and thinner the `others`.

    Lost frames are shaded gaps. The axis covers the sensor, networks and the dotted lengths of flow; without
    the others the main method's interval.
    """
    time_s, (sensor, curves, label) = result.time_s, scale_curves(result)
    main, method = curves[result.main], result.methods[result.main]
    # The interval of physics includes the uncertainty of E; none includes that of scale.
    holds_young = method.low_mn is not None and result.main == PHYSICS
    spread = 1.96 * (2 * result.scale.uncertainty if holds_young else result.relative_uncertainty)

    def draw(axes: Axes) -> None:
        if result.absolute and method.low_mn is not None and method.high_mn is not None:
            level = method.interval.get("level")
            name = f"{level:.0%} interval" if level else "interval, not calibrated for this motion"
            _band(axes, time_s, method.low_mn, method.high_mn, name, _INTERVAL)
        if spread > 0:
            name = f"±{100 * spread:.0f}% scale" + ("" if holds_young else ", stiffness")
            _band(axes, time_s, main * (1 - min(spread, 1.0)), main * (1 + spread), name, _MAIN)
        if sensor is not None:
            axes.plot(time_s, sensor, color=_SENSOR, linewidth=1.8, label="sensor", zorder=4)
        axes.plot(time_s, main, color=_MAIN, linewidth=1.8, label=result.main, zorder=5)
        thin_curves = {name: curve for name, curve in curves.items() if others and name != result.main}
        networks = result.settings.get("networks", {})
        sizes = {name for name in thin_curves if result.methods[name].gain}
        for k, (name, curve) in enumerate(thin_curves.items()):
            # The gain of a length of flow is fitted to a curve that is drawn too: dotted.
            style, colour = ":" if name in sizes else "-", _OTHERS[k % len(_OTHERS)]
            axes.plot(time_s, curve, style, color=colour, linewidth=1.1, label=name)
        ranged_curves = [curve for name, curve in thin_curves.items() if name in sizes or name in networks]
        if not others and result.absolute and method.high_mn is not None:
            ranged_curves.append(method.high_mn)
        values = np.concatenate([main, *ranged_curves, *([] if sensor is None else [sensor])])
        if np.isfinite(values).any():
            low, high = min(np.nanmin(values), 0.0), _largest(values)
            axes.set_ylim(low - 0.04 * (high - low), high + 0.08 * (high - low))
        for left in np.flatnonzero(result.lost[:-1] | result.lost[1:]):
            axes.axvspan(time_s[left], time_s[left + 1], color=_RED, alpha=0.1, linewidth=0)

    return _chart((_WIDE, _HIGH + 40), draw, "time [s]", label, columns=5)


def scale_curves(result: Result) -> tuple[Floats | None, dict[str, Floats], str]:
    """Magnitudes (T,) of the sensor's and each method's force, and the axis label; without E by the gain of a
    separate press, else by each method's best-fitting gain to the sensor, else over each one's largest."""
    sizes = {name: method.size_mn for name, method in result.methods.items()}
    if result.absolute:
        return result.sensor_mn, sizes, "force [mN]"
    gains = {name: method.calibrated.get("gain", math.nan) for name, method in result.methods.items()}
    if math.isfinite(gains[result.main]):
        pressed = {name: gains[name] * size for name, size in sizes.items()}
        return result.sensor_mn, pressed, "force [mN], gain of the press"
    if result.sensor_mn is None:
        return None, {name: size / _largest(size) for name, size in sizes.items()}, "force / largest"
    sensor, top = result.sensor_mn, _largest(result.sensor_mn)
    fitted = {
        name: force_metrics.gain(sensor, size, result.scored) * size / top for name, size in sizes.items()
    }
    return sensor / top, fitted, "force / largest"


def draw_components(result: Result) -> str:
    """The main method's force along the camera's axes over time, and the sensor's where it has them."""
    method = result.methods[result.main]
    sensor = result.sensor_axes_mn if method.components else None

    def draw(axes: Axes) -> None:
        for k, name in enumerate(("x, right", "y, down", "z, away")):
            if sensor is not None:
                axes.plot(result.time_s, sensor[:, k], ":", color=_OTHERS[k], label=f"{name}: sensor")
            axes.plot(result.time_s, method.force_mn[:, k], color=_OTHERS[k], label=name)

    unit = "force [mN]" if result.absolute else "force [mN a kPa]"
    return _chart((_WIDE, _HIGH), draw, "time [s]", unit, columns=6)


def _largest(values: Floats) -> float:
    """The largest value; 1 if none is above zero."""
    return float(np.nanmax(values, initial=0.0)) or 1.0


def _band(axes: Axes, x: Floats, low: Floats, high: Floats, name: str, colour: str) -> None:
    axes.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0, label=name)


def _chart(size: tuple[int, int], draw: Callable[[Axes], None], x: str, y: str, columns: int = 2) -> str:
    """A chart with a label at each axis, and a legend in `columns` above it if anything in it has a name."""

    def draw_all(figure: Figure) -> None:
        axes = figure.subplots()
        draw(axes)
        axes.set(xlabel=x, ylabel=y)
        handles: Any = axes.get_legend_handles_labels()
        if handles[0]:
            axes.legend(*handles, ncols=columns, loc="lower left", bbox_to_anchor=(0, 1))

    return svg(*size, draw_all)
