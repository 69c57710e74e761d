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
    environment.filters["number"] = format_number
    return environment.get_template(name)


def render_report(result: Result, title: str = "") -> str:
    """The page as text; `title`: its heading, by default with the recording's name."""
    main = result.methods[result.main]
    figures = {"force": charts.draw_force(result), "methods": charts.draw_force(result, others=True)}
    if np.isfinite(main.force_mn).any(axis=0).all():
        figures["components"] = charts.draw_components(result)
    panels, flow_px, force_kpa = pictures(result)
    columns, mae = _columns(result), main.scores.get("mae_mn", math.nan)
    lower_errors = {n: m for n, m in result.methods.items() if m.scores.get("mae_mn", math.inf) < mae}
    in_hindsight = [n for n, m in lower_errors.items() if m.gain and m.gain.source == "hindsight"]
    better = [n for n in lower_errors if n not in in_hindsight]
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
        masks=None if (mask_picture := picture_masks(result.tracked)) is None else _jpeg(mask_picture),
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
            table.add_row(escape(name), format_number(float(sizes.max()) if len(sizes) else None))
        return table
    columns = {key: metric for key, metric in _columns(result).items() if key in _NARROW}
    table = open_table(title, *(escape(metric.column) for metric in columns.values()), label="method")
    for name, method in methods.items():
        table.add_row(
            escape(name), *(format_number(method.scores[key], m.cell_unit) for key, m in columns.items())
        )
    return table


def _columns(result: Result) -> dict[str, Metric]:
    """The columns in which at least one method has a number."""
    score_tables = [method.scores for method in result.methods.values()]
    return {
        key: metric
        for key, metric in METRICS.items()
        if metric.column and any(math.isfinite(scores.get(key, math.nan)) for scores in score_tables)
    }


def format_number(value: float | None, unit: str = "") -> str:
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
    selection = select_frames(result)
    tracked = result.tracked
    if not selection or tracked.rest is None or tracked.tissue is None:
        return [], 0.0, 0.0
    lengths = [np.linalg.norm(snapshot.flow, axis=-1)[tracked.tissue] for _, snapshot in selection]
    flow_px = max(float(np.percentile(np.concatenate(lengths), 99.5)), 0.5)
    maps = [snapshot.density for _, snapshot in selection if snapshot.density is not None]
    force_kpa = max([float(np.percentile(m[tracked.tissue], 99.8)) for m in maps], default=0.0)
    tissue = tracked.tissue.astype(np.float32)
    grey = np.repeat(tracked.rest.mean(axis=2, keepdims=True), 3, axis=2).astype(np.uint8)
    panels = list[dict[str, str | None]]()
    for caption, snapshot in selection:
        flow_picture = picture.overlay(grey, picture.flow_colours(snapshot.flow, flow_px), 0.65 * tissue)
        flow_picture = picture.arrows(flow_picture, snapshot.flow, tracked.tissue, 1.0)
        force_map = depth = None
        if snapshot.density is not None:
            weight = tissue * np.clip(0.15 + snapshot.density / max(force_kpa, 1e-12), 0, 0.9)
            dark = (0.6 * grey).astype(np.uint8)
            force_map = _jpeg(picture.overlay(dark, picture.heat(snapshot.density, force_kpa), weight))
        if snapshot.depth is not None:
            depth = _jpeg(_depth_colours(grey, snapshot.depth, _largest_depth(tracked), tissue))
        views = {"flow": _jpeg(flow_picture), "force": force_map, "depth": depth}
        panels.append({"caption": caption, "frame": _jpeg(snapshot.rgb), **views})
    return panels, flow_px, force_kpa


def _largest_depth(tracked: TrackedRecording) -> float:
    """Motion in depth [mm] at full colour; 0 without a right or depth camera."""
    depths = [np.abs(snapshot.depth) for snapshot in tracked.snapshots if snapshot.depth is not None]
    return max(float(np.percentile(np.stack(depths), 99.8)), 1e-3) if depths else 0.0


def _depth_colours(grey: Pixels, depth: Map, largest: float, tissue: Map) -> Pixels:
    """Motion in depth, (h, w, 3): blue away from the camera, red towards it."""
    share = np.clip(depth / largest, -1, 1)[..., None]
    colours = np.where(share > 0, np.array([31, 111, 235]), np.array([194, 53, 43])).astype(np.uint8)
    return picture.overlay(grey, colours, 0.85 * np.abs(share[..., 0]) * tissue)


def select_frames(result: Result) -> list[tuple[str, Snapshot]]:
    """The snapshots nearest the largest forces of separate contacts, and those with the largest errors."""
    snapshots = [snapshot for snapshot in result.tracked.snapshots if not result.lost[snapshot.position]]
    if not snapshots:
        return []
    positions = np.array([snapshot.position for snapshot in snapshots])
    predicted = result.methods[result.main].size_mn[positions]
    reference = predicted if result.sensor_mn is None else result.sensor_mn[positions]
    height = np.where(np.isfinite(reference), reference, 0.0)
    peaks: list[int] = []
    separation = max(2, len(snapshots) // (2 * _PEAKS))
    for k in np.argsort(-height, kind="stable"):
        if len(peaks) == _PEAKS or height[k] < 0.1 * height.max():
            break
        if all(abs(int(k) - other) >= separation for other in peaks):
            peaks.append(int(k))
    frames = [(_caption(result, snapshots[k]), snapshots[k]) for k in sorted(peaks)]
    if result.sensor_mn is not None:
        error = np.nan_to_num(np.abs(predicted - reference), nan=-1.0)
        for k in np.argsort(-error, kind="stable")[:_WORST]:
            if int(k) not in peaks and error[k] >= 0:
                frames.append(("Large error: " + _caption(result, snapshots[k]), snapshots[k]))
    return frames


def _caption(result: Result, snapshot: Snapshot) -> str:
    k = snapshot.position
    predicted = format_number(result.methods[result.main].size_mn[k])
    caption = f"{result.time_s[k]:.2f} s, predicted {predicted} {'mN' if result.absolute else 'mN per kPa'}"
    if result.sensor_mn is not None and math.isfinite(result.sensor_mn[k]):
        caption += f", sensor {format_number(result.sensor_mn[k])} mN"
    return caption


def _flat(tree: dict[str, Any], before: str = "") -> list[tuple[str, str]]:
    """Keys, with those of the dictionaries around them, and values as text."""
    rows: list[tuple[str, str]] = []
    for key, value in tree.items():
        name = f"{before}{key}"
        rows += _flat(value, f"{name}.") if isinstance(value, dict) else [(name, html.unescape(str(value)))]
    return rows


def _jpeg(rgb: Pixels) -> str:
    success, data = cv2.imencode(".jpg", np.ascontiguousarray(rgb[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 85])
    assert success
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii")
