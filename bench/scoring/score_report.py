"""`report.html`: a self-contained page of a result; and the table for the terminal."""

from __future__ import annotations

import base64
import html
import math
from typing import Any

import cv2
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, Template, select_autoescape
from rich.markup import escape
from rich.table import Table

from bench.scoring import charts
from bench.scoring.answers import answer
from bench.scoring.force_metrics import METRICS
from bench.scoring.headline import headline
from bench.scoring.result import Result
from bench.scoring.skill import FIGURES, skill_of
from bench.tracking.tracking import Snapshot, TrackedRecording, picture_masks
from learn.evaluation.metrics import Metric
from learn.evaluation.tables import open_table
from synth.arrays import Map, Pixels
from synth.publish import picture

_PEAKS, _WORST = 4, 2

_NARROW = ("mae_mn", "mae_of_peak", "r", "shape_error", "r2", "bias_mn", "false_positive_rate")
"""Columns that fit into the 80 of a terminal, and those of the report's first table."""


def load_template(name: str) -> Template:
    """A page's template in this package: escaped, and strict about names."""
    environment = Environment(
        loader=PackageLoader("bench.scoring", "."),
        autoescape=select_autoescape(default_for_string=True, default=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["shown"] = shown
    return environment.get_template(name)


def render_report(result: Result, title: str = "") -> str:
    """The page as text; `title`: its heading, by default with the recording's name."""
    main = result.methods[result.main]
    figures = {"force": charts.draw_force(result), "methods": charts.draw_force(result, others=True)}
    if np.isfinite(main.force_mn).any(axis=0).all():
        figures["components"] = charts.draw_components(result)
    panels, flow_px, force_kpa = pictures(result)
    columns, mae = _columns(result), main.scores.get("mae_mn", math.nan)
    lower = {n: m for n, m in result.methods.items() if m.scores.get("mae_mn", math.inf) < mae}
    in_hindsight = [n for n, m in lower.items() if m.gain and m.gain.source == "hindsight"]
    better = [n for n in lower if n not in in_hindsight]
    return load_template("report.html.jinja").render(
        title=title or f"Force from video: {result.recording}",
        result=result,
        main=main,
        first={key: metric for key, metric in columns.items() if key in _NARROW},
        more={key: metric for key, metric in columns.items() if key not in _NARROW},
        headline=headline(result),
        answers=answer(result),
        better=better,
        in_hindsight=in_hindsight,
        origin=result.settings.get("networks", {}).get(result.main, {}).get("origin", ""),
        surely=[n for n in better if (w := result.methods[n].worse_by_mn) and w[0] > 0],
        figures=figures,
        depth_mm=_largest_depth(result.tracked),
        panels=panels,
        flow_px=flow_px,
        masks=None if (masked := picture_masks(result.tracked)) is None else _jpeg(masked),
        force_kpa=force_kpa,
        settings=_flat(result.settings),
        skill=skill_of(result),
        skill_figures=FIGURES,
    )


def terminal_table(result: Result) -> Table:
    """The methods' scores for a terminal."""
    title, methods = escape(result.recording), result.methods
    if not methods[result.main].scores:
        table = open_table(title, escape("largest force [mN]"), label="method")
        for name, method in methods.items():
            sizes = method.size_mn[np.isfinite(method.size_mn)]
            table.add_row(escape(name), shown(float(sizes.max()) if len(sizes) else None))
        return table
    columns = {key: metric for key, metric in _columns(result).items() if key in _NARROW}
    table = open_table(title, *(escape(metric.column) for metric in columns.values()), label="method")
    for name, method in methods.items():
        table.add_row(escape(name), *(shown(method.scores[key], m.cell_unit) for key, m in columns.items()))
    return table


def _columns(result: Result) -> dict[str, Metric]:
    """The columns in which at least one method has a number."""
    every = [method.scores for method in result.methods.values()]
    return {
        key: metric
        for key, metric in METRICS.items()
        if metric.column and any(math.isfinite(scores.get(key, math.nan)) for scores in every)
    }


def shown(value: float | None, unit: str = "") -> str:
    """Formats a number: three significant figures, percent and milliseconds converted, a dash for none."""
    if value is None or not math.isfinite(value):
        return "–"
    if unit == "%":
        return f"{100 * value:.1f}%"
    if unit == "ms":
        return f"{1000 * value:+.0f} ms"
    digits = max(0, 2 - math.floor(math.log10(abs(value)))) if value else 0
    text = f"{value:.{min(digits, 3)}f}"
    return f"{text} {unit}" if unit else text


def pictures(result: Result) -> tuple[list[dict[str, str | None]], float, float]:
    """The selected frames, with pictures as data URIs, and flow [px of the panel] and density [kPa] at full
    colour."""
    chosen = select_frames(result)
    done = result.tracked
    if not chosen or done.rest is None or done.tissue is None:
        return [], 0.0, 0.0
    lengths = [np.linalg.norm(snap.flow, axis=-1)[done.tissue] for _, snap in chosen]
    flow_px = max(float(np.percentile(np.concatenate(lengths), 99.5)), 0.5)
    maps = [snap.density for _, snap in chosen if snap.density is not None]
    force_kpa = max([float(np.percentile(m[done.tissue], 99.8)) for m in maps], default=0.0)
    tissue = done.tissue.astype(np.float32)
    grey = np.repeat(done.rest.mean(axis=2, keepdims=True), 3, axis=2).astype(np.uint8)
    panels = list[dict[str, str | None]]()
    for caption, snap in chosen:
        moved = picture.overlay(grey, picture.flow_colours(snap.flow, flow_px), 0.65 * tissue)
        moved = picture.arrows(moved, snap.flow, done.tissue, 1.0)
        force_map = depth = None
        if snap.density is not None:
            weight = tissue * np.clip(0.15 + snap.density / max(force_kpa, 1e-12), 0, 0.9)
            dark = (0.6 * grey).astype(np.uint8)
            force_map = _jpeg(picture.overlay(dark, picture.heat(snap.density, force_kpa), weight))
        if snap.depth is not None:
            depth = _jpeg(_depth_colours(grey, snap.depth, _largest_depth(done), tissue))
        shown_too = {"flow": _jpeg(moved), "force": force_map, "depth": depth}
        panels.append({"caption": caption, "frame": _jpeg(snap.rgb), **shown_too})
    return panels, flow_px, force_kpa


def _largest_depth(done: TrackedRecording) -> float:
    """Motion in depth [mm] at full colour; 0 without a right or depth camera."""
    depths = [np.abs(snap.depth) for snap in done.snapshots if snap.depth is not None]
    return max(float(np.percentile(np.stack(depths), 99.8)), 1e-3) if depths else 0.0


def _depth_colours(grey: Pixels, depth: Map, largest: float, tissue: Map) -> Pixels:
    """Motion in depth, (h, w, 3): blue away from the camera, red towards it."""
    share = np.clip(depth / largest, -1, 1)[..., None]
    colours = np.where(share > 0, np.array([31, 111, 235]), np.array([194, 53, 43])).astype(np.uint8)
    return picture.overlay(grey, colours, 0.85 * np.abs(share[..., 0]) * tissue)


def select_frames(result: Result) -> list[tuple[str, Snapshot]]:
    """The snapshots nearest the largest forces of separate contacts, and those with the largest errors."""
    snaps = [snap for snap in result.tracked.snapshots if not result.lost[snap.position]]
    if not snaps:
        return []
    at = np.array([snap.position for snap in snaps])
    predicted = result.methods[result.main].size_mn[at]
    truth = predicted if result.sensor_mn is None else result.sensor_mn[at]
    height = np.where(np.isfinite(truth), truth, 0.0)
    taken: list[int] = []
    apart = max(2, len(snaps) // (2 * _PEAKS))
    for k in np.argsort(-height, kind="stable"):
        if len(taken) == _PEAKS or height[k] < 0.1 * height.max():
            break
        if all(abs(int(k) - other) >= apart for other in taken):
            taken.append(int(k))
    out = [(_caption(result, snaps[k]), snaps[k]) for k in sorted(taken)]
    if result.sensor_mn is not None:
        error = np.nan_to_num(np.abs(predicted - truth), nan=-1.0)
        for k in np.argsort(-error, kind="stable")[:_WORST]:
            if int(k) not in taken and error[k] >= 0:
                out.append(("Large error: " + _caption(result, snaps[k]), snaps[k]))
    return out


def _caption(result: Result, snap: Snapshot) -> str:
    k = snap.position
    predicted = shown(result.methods[result.main].size_mn[k])
    caption = f"{result.time_s[k]:.2f} s, predicted {predicted} {'mN' if result.absolute else 'mN per kPa'}"
    if result.sensor_mn is not None and math.isfinite(result.sensor_mn[k]):
        caption += f", sensor {shown(result.sensor_mn[k])} mN"
    return caption


def _flat(tree: dict[str, Any], before: str = "") -> list[tuple[str, str]]:
    """Keys, with those of the dictionaries around them, and values as text."""
    rows: list[tuple[str, str]] = []
    for key, value in tree.items():
        name = f"{before}{key}"
        rows += _flat(value, f"{name}.") if isinstance(value, dict) else [(name, html.unescape(str(value)))]
    return rows


def _jpeg(rgb: Pixels) -> str:
    done, data = cv2.imencode(".jpg", np.ascontiguousarray(rgb[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 85])
    assert done
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii")
