"""Image statistics of renderings against a photograph, which is not stored."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.stats import kurtosis, wasserstein_distance

from evidence import report, status
from evidence.render.case import case
from evidence.study import Study
from synth.arrays import Indices, Ints, Map, Mask, Pixels
from synth.errors import UserError
from synth.job.schema import Job

# A highlight is lighter than its surroundings by this much, and nearly white.
_BRIGHTER_L = 12.0
_WHITE_L = 88.0
_SIDE, _STEP = 160, 40  # px, of crops
_POOLED = 4000  # pixels of the photograph that histograms are compared with
OUTLINE = (
    "0.2,0.56 0.29,0.31 0.39,0.19 0.52,0.16 0.6,0.29 0.67,0.42 0.71,0.6 0.67,0.73 0.6,0.86 0.47,0.91"
    " 0.37,0.86 0.28,0.76"
)
"""Of the cortex in the photograph of the stored results."""


def statistics(rgb: Pixels) -> dict[str, float]:
    """Statistics of one crop (N, N, 3) sRGB.

    Lab means and standard deviations (CIE 1976, D65), the slope of the radial power spectrum of L from 1/64
    to 1/4 cycles a pixel (natural scenes: about -2; D. J. Field 1987), the kurtosis of its horizontal and
    vertical gradients, the share of highlight pixels, the median and 90th percentile of the areas of
    connected highlights [px], and the median elongation (ratio of axes) of those over 4 px; else 1.
    """
    lab = _lab(rgb)
    found: dict[str, float] = {}
    for name, channel in zip("Lab", np.moveaxis(lab, -1, 0), strict=True):
        found |= {f"{name} mean": float(channel.mean()), f"{name} sd": float(channel.std())}
    slopes = np.concatenate([np.diff(lab[..., 0], axis=axis).ravel() for axis in (0, 1)]).astype(float)
    found["spectrum slope"] = _slope(lab[..., 0])
    found["gradient kurtosis"] = float(kurtosis(slopes, fisher=False))
    return found | _highlights(lab[..., 0])


def distances(rgb: Pixels, pooled: Pixels) -> dict[str, float]:
    """Earth mover's distance, in Lab, of a crop's histograms from those of pixels (M, 3)."""
    ours, theirs = (_lab(picture).reshape(-1, 3).T for picture in (rgb[::2, ::2], pooled[None]))
    pairs = zip("Lab", ours, theirs, strict=True)
    return {f"{name} histogram": float(wasserstein_distance(*both)) for name, *both in pairs}


def spread(crops: list[Pixels], pooled: Pixels) -> dict[str, tuple[float, float, float]]:
    """Smallest, median and largest of each statistic over crops; histograms against those of `pooled`."""
    rows = [statistics(crop) | distances(crop, pooled) for crop in crops]
    return {
        name: tuple(float(f([row[name] for row in rows])) for f in (np.min, np.median, np.max))  # type: ignore[misc]
        for name in rows[0]
    }


def tiles(rgb: Pixels, inside: Mask) -> list[Pixels]:
    """Square crops of 160 px wholly inside a mask, every 40 px."""
    return [rgb[y : y + _SIDE, x : x + _SIDE] for x, y in corners(inside, _SIDE, _STEP)]


def corners(inside: Mask, side: int, step: int) -> list[tuple[int, int]]:
    """Upper left corners (x, y) of square crops of `side` px wholly inside a mask, every `step` px."""
    summed = cv2.integral(inside.astype(np.uint8))
    covered = summed[side:, side:] - summed[:-side, side:] - summed[side:, :-side] + summed[:-side, :-side]
    return [(int(x * step), int(y * step)) for y, x in np.argwhere(covered[::step, ::step] == side * side)]


def _lab(rgb: Pixels) -> Map:
    return np.asarray(cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB), np.float32)


def _slope(light: Map) -> float:
    side = light.shape[0]
    window = np.hanning(side)[:, None] * np.hanning(side)[None]
    power = np.abs(np.fft.fft2((light - light.mean()) * window)) ** 2
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.fftfreq(side)[None])
    edges = np.geomspace(1 / 64, 1 / 4, 13)
    bins = np.digitize(frequency.ravel(), edges)
    mean = np.array([power.ravel()[bins == k].mean() for k in range(1, len(edges))])
    return float(np.polyfit(np.log(np.sqrt(edges[1:] * edges[:-1])), np.log(mean), 1)[0])


def _highlights(light: Map) -> dict[str, float]:
    around = cv2.medianBlur(np.clip(light * 2.55, 0, 255).astype(np.uint8), 31) / 2.55
    bright = ((light > around + _BRIGHTER_L) & (light > _WHITE_L)).astype(np.uint8)
    count, label, stats, _ = cv2.connectedComponentsWithStats(bright, connectivity=8)
    areas: Any = stats[1:, cv2.CC_STAT_AREA] if count > 1 else np.zeros(1)
    return {
        "highlight share": float(bright.mean()),
        "highlight area median": float(np.median(areas)),
        "highlight area p90": float(np.quantile(areas, 0.9)),
        "highlight elongation": _elongation(label, np.flatnonzero(stats[1:, cv2.CC_STAT_AREA] > 4) + 1),
    }


def _elongation(label: Indices, chosen: Ints) -> float:
    """Median ratio of axes of the ellipses with the second moments of the chosen labels' pixels."""
    found = [1.0]
    for k in chosen:
        away = np.argwhere(label == k).astype(float)
        # The second moment of a square pixel is 1/12.
        spread = np.linalg.eigvalsh(np.cov(away.T, bias=True) + np.eye(2) / 12)
        found.append(float(np.sqrt(spread[1] / spread[0])))
    return float(np.median(found[1:] or found))


def measure(
    photo: Path,
    outline: str = OUTLINE,
    width_mm: float = 110.0,
    frames: int = 12,
    family: str = "healthy",
    seed: int = 11,
) -> dict[str, Any]:
    """Colour, spectrum, gradients and highlights of rendered frames against crops of a photograph.

    `outline`: polygon of the cortex in it, as shares "x,y x,y ..."; `width_mm`: width of the photograph in
    the field; `frames`: number of rendered sequences, one frame each.
    """
    crops, pixel = _rendered(frames, family, seed)
    photograph = scaled_photograph(photo, width_mm / pixel)
    inside = outlined(outline, photograph.shape[:2])
    reference = tiles(photograph, inside)
    pixels = np.concatenate([crop.reshape(-1, 3) for crop in reference])
    pooled = pixels[np.linspace(0, len(pixels) - 1, _POOLED).astype(np.int64)]  # at equal distances
    theirs, ours = spread(reference, pooled), spread(crops, pooled)
    rows = [
        {
            "statistic": name,
            "photograph": [round(v, 4) for v in theirs[name]],
            "rendered": [round(v, 4) for v in ours[name]],
            "median_within_spread": theirs[name][0] <= ours[name][1] <= theirs[name][2],
        }
        for name in theirs
    ]
    return {
        "data": status.data(photo),
        "family": family,
        "seed": seed,
        "crops": {"photograph": len(reference), "rendered": len(crops), "side_px": _SIDE},
        "photograph_width_mm_assumed": width_mm,
        "mm_per_px": pixel,
        "statistics": rows,
    }


def _rendered(frames: int, family: str, seed: int) -> tuple[list[Pixels], float]:
    """Crops of the tissue in frames without an instrument, and the median mm of a pixel."""
    job = Job.model_validate(
        {"seed": seed, "appearance": {"families": [family]}, "fem": {"instrument": "none"}}
    )
    crops, pixels = [], []
    for index in range(frames):
        picture, inside, mm_per_px = bare_picture(job, index)
        crops += tiles(picture, inside)
        pixels.append(mm_per_px)
    return crops, float(np.median(pixels))


def bare_picture(job: Job, index: int) -> tuple[Pixels, Mask, float]:
    """First frame of a sequence, its tissue less a rim of 4 px, and its scale [mm per px]."""
    one = case(job, index)
    rest = one.renderer.rest
    inside = cv2.erode(rest.tissue.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    return one.renderer.render(one.state(), index).rgb, inside, rest.scale_mm_per_px


def outlined(outline: str, shape: tuple[int, ...]) -> Mask:
    """Pixels (H, W) inside a polygon in shares of the image, "x,y x,y ..."."""
    corners = np.array([[float(v) for v in pair.split(",")] for pair in outline.split()])
    inside = np.zeros(shape, np.uint8)
    cv2.fillPoly(inside, [np.rint(corners * np.array(shape[::-1])).astype(np.int32)], 1)
    return inside > 0


def scaled_photograph(photo: Path, width_px: float) -> Pixels:
    """The photograph (H, W, 3) sRGB, `width_px` wide."""
    image = cv2.imread(str(photo), cv2.IMREAD_COLOR)
    if image is None:
        raise UserError(f"{photo}: not an image that can be read")
    scale = width_px / image.shape[1]
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(small[..., ::-1])


def page(found: Mapping[str, Any]) -> report.Page:
    """Statistics of renderings in units of the photograph's spread."""
    rows = []
    for one in found["statistics"]:
        (low, middle, high), rendered = one["photograph"], one["rendered"]
        a, b, c = ((value - middle) / max(high - low, 1e-12) for value in rendered)
        rows.append(report.Row(one["statistic"], b, (a, c)))
    unit = "quantiles of renderings less the photograph's median, over its spread"
    chart = report.Chart("Within half a unit: as crops of the photograph differ", unit, tuple(rows))
    within = sum(one["median_within_spread"] for one in found["statistics"])
    words = [f"**The medians of {within} of {len(rows)} statistics lie within the photograph's spread.**"]
    sections = [report.Section("", found["statistics"])]
    return report.Page("Renderings against a photograph", found, [chart], sections, words)


STUDY = Study(measure, "render/realism/realism.json", page, ("{photo}",))
