"""`bench stability flow`: one thing made worse at a time, until flow breaks; does it say so?"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any

import cv2
import numpy as np
import torch
import typer

from bench.output import charts, machine, result_page
from evidence.flow.measure import epe
from evidence.flow.scenes import CLEAN, Flags, Floats, Pair, Recipe, pairs
from evidence.measuring import measuring
from synth.flow import confidence
from synth.flow.estimator import Estimator, create
from synth.flow.track import Tracker

_COUNTS = ("lost", "flagged", "hits")
_BROKEN = 1.0  # px: a pixel off by more is lost; so is a frame whose mean is


@dataclass(frozen=True)
class Point:
    """One setting of one trouble; lengths in px."""

    trouble: str
    value: float
    estimator: str
    epe: float
    """Mean over what is seen."""
    p95: float
    lost: float
    """Share of seen pixels off by more than 1 px."""
    flagged: float
    """Share of seen pixels whose confidence says that they are lost."""
    hits: float
    """Share of the seen pixels that are lost and flagged."""
    shown_lost: float
    """`lost`, `flagged` and `hits` again, of the pixels that glare and tool leave free in both pictures: what
    is masked is always flagged, right or wrong."""
    shown_flagged: float
    shown_hits: float
    frame_lost: float
    """Share of frames whose mean error exceeds 1 px."""
    frame_flagged: float
    """Share of frames that the tracker did not trust."""
    frame_hits: float
    """Share of frames that are both."""
    finite: bool


@measuring(
    "--out runs/flow --methods tvl1,dis",
    out=...,
    said="Folder for stability.json, chart.svg, index.html.",
    file="stability.json",
    page=lambda found, out: result_page.write(drawn(found), out),
)
def stability(
    count: Annotated[int, typer.Option(min=1, help="Pairs a point.")] = 2,
    size: Annotated[int, typer.Option(min=64, help="Width and height of the pictures [px].")] = 224,
    seed: Annotated[int, typer.Option(min=0, help="Root of every draw; 8 was tuned on.")] = 2615,
    methods: Annotated[str, typer.Option(help="Comma-separated estimators.")] = "tvl1,opencv-tvl1,dis",
) -> dict[str, Any]:
    """Flow: where each estimator breaks, and whether it flags that it did."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    estimators = {name: create(name) for name in methods.split(",")}
    points: list[Point] = []
    for trouble, value, made, spoil in _troubles(size, count, seed):
        for name, estimator in estimators.items():
            points.append(_point(trouble, value, name, estimator, made, spoil))
        typer.echo(f"{trouble} {value:g}", err=True)
    return {
        "machine": machine.describe() | {"torch": torch.__version__, "opencv": cv2.__version__},
        "identical_frames_largest_px": {name: _identical(e, size, seed) for name, e in estimators.items()},
        "extreme_sizes": {name: _extremes(e) for name, e in estimators.items()},
        "flag": {name: _flag([p for p in points if p.estimator == name]) for name in estimators},
        "points": [asdict(point) for point in points],
    }


Spoil = Callable[[Pair], tuple[Flags, Flags, Floats | None]]
"""A pair's rest mask, now mask and initial flow, as the estimator is given them."""


def _plain(pair: Pair) -> tuple[Flags, Flags, Floats | None]:
    return pair.rest_usable, pair.now_usable, None


def _troubles(size: int, count: int, seed: int) -> Iterator[tuple[str, float, list[Pair], Spoil]]:
    base = Recipe(size=size)
    series: dict[str, tuple[str, Sequence[float]]] = {
        "displacement [px]": ("pull", (0.05, 0.5, 2, 5, 10, 20, 30, 40, 60)),
        "contrast": ("contrast", (0.05, 0.1, 0.2, 0.5, 1)),
        "noise [grey levels]": ("noise", (0, 2, 5, 10, 20)),
        "highlights [share]": ("highlights", (0.0, 0.05, 0.12, 0.25)),
        "tool width [px]": ("tool", (14, 30, 60, 100)),
        "illumination": ("illumination", (-0.4, -0.2, 0, 0.2, 0.4)),
        "blur [px]": ("blur", (0, 1, 2, 4)),
    }
    for trouble, (field, values) in series.items():
        for value in values:
            yield trouble, value, list(pairs(_with(base, field, value), count, seed)), _plain
    made = list(pairs(base, count, seed))
    for value in (0.0, 2.0, 5.0, 10.0, 20.0, 40.0):
        yield "wrong start [px]", value, made, _wrong_start(value)
    for value in (-6.0, -3.0, -1.0, 0.0, 3.0, 6.0, 12.0):
        yield "masks grown [px]", value, made, _grown(int(value))
    blank = [replace(pair, now=np.full_like(pair.now, 128)) for pair in made]
    yield "blank frame", 1.0, blank, _plain


def _with(recipe: Recipe, field: str, value: float) -> Recipe:
    changes: dict[str, Any] = {field: value}
    return replace(recipe, **changes)


def _wrong_start(by_px: float) -> Spoil:
    return lambda pair: (
        pair.rest_usable,
        pair.now_usable,
        (pair.flow + by_px / np.sqrt(2)).astype(np.float32),
    )


def _grown(by_px: int) -> Spoil:
    element = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(by_px) + 1,) * 2)
    change = cv2.erode if by_px > 0 else cv2.dilate

    def spoil(pair: Pair) -> tuple[Flags, Flags, Floats | None]:
        grown = [
            change(mask.astype(np.uint8), element).astype(bool)
            for mask in (pair.rest_usable, pair.now_usable)
        ]
        return grown[0], grown[1], None

    return spoil


def _point(
    trouble: str, value: float, name: str, estimator: Estimator, made: Sequence[Pair], spoil: Spoil
) -> Point:
    rows, frames, finite = [], [], True
    for pair in made:
        rest, now, initial = spoil(pair)
        tracker = Tracker(estimator, pair.rest, ~rest, np.ones_like(rest))
        tracker.start(initial)
        flow, trust = tracker.step(pair.now, ~now)
        finite &= bool(np.isfinite(flow).all() and np.isfinite(trust).all())
        error = epe(flow, pair.flow)
        # Judged where the picture shows the point: what is masked is no question of tracking.
        seen = pair.inside & ~pair.hidden & rest
        lost, flagged = error[seen] > _BROKEN, trust[seen] < confidence.DOUBTFUL
        shown = _shown(pair, now)[seen]
        rows.append([error[seen].mean(), np.percentile(error[seen], 95), lost.mean(), flagged.mean(),
                     (lost & flagged).mean(), (lost & shown).mean(), (flagged & shown).mean(),
                     (lost & flagged & shown).mean()])  # fmt: skip
        frames.append([error[seen].mean() > _BROKEN, not tracker.trusted])
    names = ("epe", "p95", "lost", "flagged", "hits", "shown_lost", "shown_flagged", "shown_hits")
    pixel: dict[str, float] = dict(zip(names, np.mean(rows, axis=0).tolist(), strict=True))
    frame = np.asarray(frames)
    return Point(
        trouble=trouble,
        value=value,
        estimator=name,
        frame_lost=float(frame[:, 0].mean()),
        frame_flagged=float(frame[:, 1].mean()),
        frame_hits=float(np.mean(frame[:, 0] & frame[:, 1])),
        finite=finite,
        **pixel,
    )


def _shown(pair: Pair, now_usable: Flags) -> Flags:
    """(H, W): the material point is on a usable pixel of the now frame."""
    y, x = np.mgrid[: now_usable.shape[0], : now_usable.shape[1]].astype(np.float32)
    at = cv2.remap(
        now_usable.astype(np.float32), x + pair.flow[..., 0], y + pair.flow[..., 1], cv2.INTER_LINEAR
    )
    return np.asarray(at > 0.9, bool)


def _flag(points: Sequence[Point]) -> dict[str, float | bool]:
    """Precision and recall of the flags over all troubles."""
    result: dict[str, float | bool] = {"all_finite": all(p.finite for p in points)}
    for what, kind in (("", "pixel"), ("shown_", "shown_pixel"), ("frame_", "frame")):
        lost, flagged, hits = (sum(getattr(p, what + name) for p in points) for name in _COUNTS)
        result[f"{kind}_precision"] = hits / max(flagged, 1e-12)
        result[f"{kind}_recall"] = hits / max(lost, 1e-12)
    return result


def _identical(estimator: Estimator, size: int, seed: int) -> float:
    (pair,) = pairs(replace(CLEAN, size=size), 1, seed)
    flow, _ = estimator.flow(pair.rest, pair.rest, pair.rest_usable, pair.rest_usable)
    return float(np.abs(flow).max())


def _extremes(estimator: Estimator) -> dict[str, bool]:
    """Whether the flow is finite for one pixel, one row, and a picture of 3840 x 2160 px."""
    rng = np.random.default_rng(0)
    result = {}
    for height, width in ((1, 1), (1, 64), (2160, 3840)):
        small = rng.integers(0, 255, (max(1, height // 16), max(1, width // 16), 3), dtype=np.uint8)
        picture = cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
        every = np.ones((height, width), bool)
        flow, trust = estimator.flow(picture, np.roll(picture, 2, axis=1), every, every)
        result[f"{width}x{height}"] = bool(np.isfinite(flow).all() and np.isfinite(trust).all())
    return result


def drawn(found: Mapping[str, Any]) -> result_page.Page:
    """What the data say."""
    tables = [result_page.Section("All points", found["points"])]
    return result_page.Page("Flow: where it breaks", found, panels(found), tables)


def panels(found: Mapping[str, Any]) -> list[charts.Panel]:
    """Charts of `stability.json`: error over each trouble."""
    points, made = [Point(**point) for point in found["points"]], []
    for trouble in dict.fromkeys(point.trouble for point in points):
        curves = []
        for name in dict.fromkeys(point.estimator for point in points):
            own = [p for p in points if p.trouble == trouble and p.estimator == name]
            if len(own) > 1:
                y = tuple(max(p.epe, 1e-3) for p in own)
                curves.append(charts.Curve(name, tuple(p.value for p in own), y))
        if curves:
            made.append(charts.Panel(f"Flow: {trouble}", trouble, "EPE mean [px]", tuple(curves), log_y=True))
    return made
