"""Whether flow fails on rendered tissue as it does on a photograph that moves the same way.

A rendered pair gives the motion; a photograph of a cortex is warped by that very motion. The photograph stays
where it is: figures alone are kept.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer

from bench.output.charts import Chart, Row
from bench.output.result_page import Page, Section
from evidence.flow import rendered
from evidence.flow.measure import epe
from evidence.flow.scenes import CLEAN, Flags, Floats, Pair, Rgb, Stage, noise_field
from evidence.measuring import measuring
from evidence.render.realism import OUTLINE, outlined, scaled_photograph
from synth.errors import UserError
from synth.flow.estimator import Estimator, create

_LOST_PX = 1.0
_NONE_LOST = 1e-3  # share: where neither loses more there is no ratio to speak of
_NOISE = 1.5  # grey levels, added to both warped pictures
_SOFT_PX = 0.7  # and both are blurred by this first: their own noise would move with the tissue
PAIRS = {
    "rendered, as it is": "photograph, warped, as many highlights",
    "rendered frame, warped": "photograph, warped",
}
"""What is compared with what."""
_FIGURES = ("mean_px", "p95_px", "lost")


@measuring("cortex.jpg", file="look.json")
def look(
    photo: Annotated[Path, typer.Argument(help="A photograph of an exposed cortex; nothing of it is kept.")],
    outline: Annotated[
        str, typer.Option(help="Polygon of the cortex in it, as shares: x,y x,y x,y ...")
    ] = OUTLINE,
    width_mm: Annotated[float, typer.Option(help="What the photograph's width spans in the field.")] = 110.0,
    count: Annotated[int, typer.Option(min=2, help="Pairs a source.")] = 12,
    size: Annotated[int, typer.Option(min=96, help="Side of the crops [px].")] = 256,
    peak: Annotated[float, typer.Option(help="Largest motion [px].")] = 7.0,
    seed: Annotated[int, typer.Option(help="Of the rendered job.")] = 4211,
    out: Path | None = None,
) -> dict[str, Any]:
    """Flow's error on rendered cortex and on a photograph warped by the same motion."""
    estimator = create("tvl1")
    figures: dict[str, list[list[float]]] = {name: [] for pair in PAIRS.items() for name in pair}
    shares, scales = [], []
    for k, wet in enumerate(rendered.pairs(rendered.Wet(peak_px=peak), count, seed)):
        crop = _window(wet.tissue, wet.pair.flow, size)
        own = _cropped(wet.pair, crop)
        scales.append(wet.mm_per_px)
        image = scaled_photograph(photo, width_mm / wet.mm_per_px)
        rng = np.random.default_rng([seed, k])
        there = _somewhere(outlined(outline, image.shape[:2]), size, rng)
        shares.append(float(own.glare.mean()))
        for name, pair in _sources(own, image[there], shares[-1], rng):
            figures[name].append(_figures(estimator, pair))
    return {
        "seed": seed,
        "size_px": size,
        "peak_px": peak,
        "lost_px": _LOST_PX,
        "mm_per_px": round(float(np.mean(scales)), 4),
        "glare_share": round(float(np.mean(shares)), 4),
        "rows": [_row(name, np.asarray(found)) for name, found in figures.items()],
        "ratios": [_ratio(ours, theirs, figures) for ours, theirs in PAIRS.items()],
    }


def _sources(own: Pair, photo: Rgb, share: float, rng: np.random.Generator) -> Iterator[tuple[str, Pair]]:
    """The pair as rendered, and pictures warped by its motion."""
    (whole, wet_photo), (frame, dry_photo) = PAIRS.items()
    yield whole, own
    yield wet_photo, _warped(photo, own.flow, share, rng)
    yield frame, _warped(own.rest, own.flow, 0.0, rng)
    yield dry_photo, _warped(photo, own.flow, 0.0, rng)


def _warped(picture: Rgb, flow: Floats, share: float, rng: np.random.Generator) -> Pair:
    """A picture and the same moved by `flow`; a share of both is under highlights that stay."""
    size = len(picture)
    recipe = replace(CLEAN, size=size, highlights=share, noise=_NOISE)
    soft = cv2.GaussianBlur(picture.astype(np.float32) / 255, (0, 0), _SOFT_PX)
    wet = noise_field((size, size), 8, rng) + 1.2 * noise_field((size, size), 70, rng)
    stage = Stage(recipe, np.asarray(soft, np.float32), wet, noise_field((size, size), 40, rng), flow)
    return stage.pair(1.0, rng)


def _figures(estimator: Estimator, pair: Pair) -> list[float]:
    """Mean and 95th percentile of the endpoint error [px], and the share that is lost."""
    flow, _ = estimator.flow(pair.rest, pair.now, pair.rest_usable, pair.now_usable, None)
    error = epe(flow, pair.flow)[pair.inside & ~pair.hidden]
    return [float(error.mean()), float(np.percentile(error, 95)), float((error > _LOST_PX).mean())]


def _row(name: str, found: Floats) -> dict[str, Any]:
    """Means over pairs with their bootstrapped 95% interval, and every pair's mean."""
    row: dict[str, Any] = {"source": name}
    drawn = np.random.default_rng(0).integers(len(found), size=(2000, len(found)))
    for k, figure in enumerate(_FIGURES):
        low, high = np.quantile(found[drawn, k].mean(axis=1), (0.025, 0.975))
        row[figure] = [round(float(value), 4) for value in (found[:, k].mean(), low, high)]
    return row | {"pairs_mean_px": [round(float(value), 3) for value in found[:, 0]]}


def _ratio(ours: str, theirs: str, figures: Mapping[str, list[list[float]]]) -> dict[str, Any]:
    """Rendered over photograph, with the interval over pairs drawn anew together."""
    one, other = np.asarray(figures[ours]), np.asarray(figures[theirs])
    drawn = np.random.default_rng(0).integers(len(one), size=(2000, len(one)))
    row: dict[str, Any] = {"rendered": ours, "photograph": theirs}
    for k, figure in enumerate(_FIGURES):
        ratios = one[drawn, k].mean(axis=1) / np.maximum(other[drawn, k].mean(axis=1), 1e-9)
        middle = one[:, k].mean() / max(other[:, k].mean(), 1e-9)
        if figure == "lost" and max(one[:, k].mean(), other[:, k].mean()) < _NONE_LOST:
            row |= {figure: None, "lost_within_20_percent": None}
            continue
        row[figure] = [round(float(value), 3) for value in (middle, *np.quantile(ratios, (0.025, 0.975)))]
        row[f"{figure}_within_20_percent"] = bool(1 / 1.2 <= middle <= 1.2)
    return row


def _window(tissue: Flags, flow: Floats, size: int) -> tuple[slice, slice]:
    """The square of `size` px on tissue alone that holds the most motion."""
    moved = cv2.boxFilter(np.hypot(flow[..., 0], flow[..., 1]), -1, (size, size), anchor=(0, 0))
    whole = cv2.boxFilter(tissue.astype(np.float32), -1, (size, size), anchor=(0, 0)) > 1 - 1e-6
    whole[tissue.shape[0] - size + 1 :] = whole[:, tissue.shape[1] - size + 1 :] = False
    if not whole.any():
        raise UserError(f"--size: no square of {size} px fits into the rendered opening")
    top, left = np.unravel_index(int(np.argmax(np.where(whole, moved, -1.0))), tissue.shape)
    return slice(int(top), int(top) + size), slice(int(left), int(left) + size)


def _somewhere(inside: Flags, size: int, rng: np.random.Generator) -> tuple[slice, slice]:
    """A random square of `size` px inside the outline."""
    whole = cv2.boxFilter(inside.astype(np.float32), -1, (size, size), anchor=(0, 0)) > 1 - 1e-6
    whole[inside.shape[0] - size + 1 :] = whole[:, inside.shape[1] - size + 1 :] = False
    rows, columns = np.nonzero(whole)
    if not len(rows):
        raise UserError(f"--outline: no square of {size} px fits into it")
    at = int(rng.integers(len(rows)))
    return slice(int(rows[at]), int(rows[at]) + size), slice(int(columns[at]), int(columns[at]) + size)


def _cropped(pair: Pair, crop: tuple[slice, slice]) -> Pair:
    """The same of a part of the picture."""
    return Pair(**{name: np.ascontiguousarray(value[crop]) for name, value in vars(pair).items()})


def drawn(found: Mapping[str, Any]) -> Page:
    """What `look.json` says."""
    said = {"mean_px": "mean error [px]", "p95_px": "95th percentile [px]", "lost": "share lost"}
    charts = [
        Chart(
            said[figure],
            said[figure],
            tuple(
                Row(row["source"], row[figure][0], tuple(row[figure][1:]), k // 2)
                for k, row in enumerate(found["rows"])
            ),
        )
        for figure in _FIGURES
    ]
    cells = [
        {"source": row["source"]}
        | {said[f]: f"{row[f][0]:.3f} [{row[f][1]:.3f}, {row[f][2]:.3f}]" for f in _FIGURES}
        for row in found["rows"]
    ]
    ratios = [
        {"rendered": row["rendered"], "photograph": row["photograph"]}
        | {said[figure]: _said(row, figure) for figure in _FIGURES}
        for row in found["ratios"]
    ]
    words = (
        f"Equal motion of at most {found['peak_px']:g} px on crops of {found['size_px']} px at"
        f" {found['mm_per_px']:g} mm a pixel; lost: more than {found['lost_px']:g} px off. Means over pairs"
        " with bootstrapped 95% intervals."
    )
    sections = [Section("Errors", cells), Section("Rendered over photograph", ratios)]
    return Page("Flow on rendered tissue and on a photograph", found, charts, sections, [words])


def _said(row: Mapping[str, Any], figure: str) -> str:
    """A ratio with its interval, and whether it is as asked."""
    if row[figure] is None:
        return f"none lost in either (under {_NONE_LOST:.1%})"
    middle, low, high = row[figure]
    verdict = "" if row[f"{figure}_within_20_percent"] else ", not within 20%"
    return f"{middle:.2f} [{low:.2f}, {high:.2f}]{verdict}"
