"""One thing made worse at a time, until flow breaks; does its confidence flag that?

Run: python -m evidence.flow.stability
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import typer

from evidence import report
from evidence.flow.measure import epe
from evidence.flow.scenes import Floats, Pair, Recipe, pairs
from synth.flow.estimator import Estimator, create
from synth.flow.track import Tracker

_LOST_PX = 1.0  # a frame whose mean is off by more is lost
_TROUBLES: dict[str, tuple[str, tuple[float, ...]]] = {
    "displacement [px]": ("pull", (0.05, 0.5, 2, 5, 10, 20, 30, 40, 60)),
    "contrast": ("contrast", (0.05, 0.1, 0.2, 0.5, 1)),
    "noise [grey levels]": ("noise", (0, 2, 5, 10, 20)),
    "highlights [share]": ("highlights", (0.0, 0.05, 0.12, 0.25)),
    "tool width [px]": ("tool", (14, 30, 60, 100)),
    "illumination": ("illumination", (-0.4, -0.2, 0, 0.2, 0.4)),
    "blur [px]": ("blur", (0, 1, 2, 4)),
}


def main(
    out: Path = report.RESULTS / "flow/stability",
    count: int = 2,
    size: int = 224,
    seed: int = 2615,
    methods: str = "tvl1,opencv-tvl1,dis",
) -> None:
    """`count` pairs a point; seed 8 was tuned on."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    rows = []
    for trouble, value, made in _troubles(size, count, seed):
        for name in methods.split(","):
            points = [_point(create(name), pair, start) for pair, start in made]
            means = {key: float(np.mean([point[key] for point in points])) for key in points[0]}
            rows.append({"trouble": trouble, "value": value, "estimator": name} | means)
    found = {"flags": [_flags(name, rows) for name in methods.split(",")], "points": rows}
    report.save(out, "stability.json", found, page(found))
    report.show(found)


def _troubles(
    size: int, count: int, seed: int
) -> Iterator[tuple[str, float, Sequence[tuple[Pair, Floats | None]]]]:
    """Pairs with what flow starts from."""
    for trouble, (field, values) in _TROUBLES.items():
        for value in values:
            changes: dict[str, Any] = {"size": size, field: value}
            yield trouble, value, [(pair, None) for pair in pairs(Recipe(**changes), count, seed)]
    made = list(pairs(Recipe(size=size), count, seed))
    for value in (0.0, 2.0, 5.0, 10.0, 20.0, 40.0):
        wrong = [(p, np.asarray(p.flow + value / np.sqrt(2), np.float32)) for p in made]
        yield "wrong start [px]", value, wrong
    yield "blank frame", 1.0, [(replace(p, now=np.full_like(p.now, 128)), None) for p in made]


def _point(estimator: Estimator, pair: Pair, start: Floats | None) -> dict[str, float]:
    """Errors [px]; whether the frame is lost, flagged, and both ("hits")."""
    tracker = Tracker(estimator, pair.rest, ~pair.rest_usable, np.ones_like(pair.inside))
    tracker.initial = start
    flow, trust = tracker.step(pair.now, ~pair.now_usable)
    # Judged where the picture shows the point: what is masked is no question of tracking.
    seen = pair.inside & ~pair.hidden & pair.rest_usable
    error = epe(flow, pair.flow)
    frame = bool(error[seen].mean() > _LOST_PX), not tracker.trusted
    return {
        "epe": float(error[seen].mean()),
        "p95": float(np.percentile(error[seen], 95)),
        "frame_lost": float(frame[0]),
        "frame_flagged": float(frame[1]),
        "frame_hits": float(all(frame)),
        "finite": float(np.isfinite(flow).all() and np.isfinite(trust).all()),
    }


def _flags(name: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Precision and recall of an estimator's flags of frames over all troubles."""
    points = [p for p in rows if p["estimator"] == name]
    lost, flagged, hits = (sum(p[f"frame_{key}"] for p in points) for key in ("lost", "flagged", "hits"))
    return {
        "estimator": name,
        "all finite": all(p["finite"] == 1 for p in points),
        "frames: precision": hits / max(flagged, 1e-12),
        "frames: recall": hits / max(lost, 1e-12),
    }


def page(found: Mapping[str, Any]) -> report.Page:
    """Draws `stability.json`: error over each trouble."""
    panels = []
    for trouble in dict.fromkeys(p["trouble"] for p in found["points"]):
        curves = []
        for name in dict.fromkeys(p["estimator"] for p in found["points"]):
            own = [p for p in found["points"] if (p["trouble"], p["estimator"]) == (trouble, name)]
            x, y = tuple(p["value"] for p in own), tuple(max(p["epe"], 1e-3) for p in own)
            curves.append(report.Curve(name, x, y))
        panels.append(report.Panel(trouble, trouble, "EPE mean [px]", tuple(curves), log_y=True))
    words = ["A frame is lost if it is off by more than 1 px in the mean; what is masked is left out."]
    return report.Page(
        "Flow: where it breaks", found, panels, [report.Section("Flags", found["flags"])], words
    )


if __name__ == "__main__":
    typer.run(main)
