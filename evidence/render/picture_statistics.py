"""Statistics of an image of cortex that distinguish a rendering from a photograph and affect optical flow."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.stats import wasserstein_distance

Picture = npt.NDArray[np.uint8]

# A highlight is lighter than its surroundings by this much, and nearly white.
_BRIGHTER_L = 12.0
_WHITE_L = 88.0


def statistics(rgb: Picture) -> dict[str, float]:
    """Statistics of one crop (N, N, 3) sRGB.

    Lab means and standard deviations (CIE 1976, D65), the slope of the radial power spectrum of L from 1/64
    to 1/4 cycles a pixel (natural scenes: about -2; D. J. Field 1987), the kurtosis of its horizontal and
    vertical gradients, the share of highlight pixels, the median and 90th percentile of the areas of
    connected highlights [px], and the median elongation (ratio of axes) of those over 4 px; else 1.
    """
    lab = _lab(rgb)
    found: dict[str, float] = {}
    for k, name in enumerate("Lab"):
        found[f"{name} mean"] = float(lab[..., k].mean())
        found[f"{name} sd"] = float(lab[..., k].std())
    found["spectrum slope"] = _slope(lab[..., 0])
    found["gradient kurtosis"] = _kurtosis(lab[..., 0])
    found |= _highlights(lab[..., 0])
    return found


def distances(rgb: Picture, pooled: Picture) -> dict[str, float]:
    """Earth mover's distance, in Lab, of a crop's histograms from those of pixels (M, 3)."""
    found = {}
    for k, name in enumerate("Lab"):
        ours, theirs = (_lab(picture)[..., k].ravel() for picture in (rgb[::2, ::2], pooled[None]))
        found[f"{name} histogram"] = float(wasserstein_distance(ours, theirs))
    return found


def pool(crops: list[Picture], count: int = 4000) -> Picture:
    """Pixels (count, 3) at equal distances over crops."""
    pixels = np.concatenate([crop.reshape(-1, 3) for crop in crops])
    return pixels[np.linspace(0, len(pixels) - 1, count).astype(np.int64)]


def spread(crops: list[Picture], pooled: Picture) -> dict[str, tuple[float, float, float]]:
    """Smallest, median and largest of each statistic over crops; histograms against those of `pooled`."""
    rows = [statistics(crop) | distances(crop, pooled) for crop in crops]
    return {
        name: tuple(float(f([row[name] for row in rows])) for f in (np.min, np.median, np.max))  # type: ignore[misc]
        for name in rows[0]
    }


def tiles(rgb: Picture, inside: npt.NDArray[np.bool_], side: int, step: int) -> list[Picture]:
    """Square crops of `side` px wholly inside a mask, every `step` px."""
    return [rgb[y : y + side, x : x + side] for x, y in corners(inside, side, step)]


def corners(inside: npt.NDArray[np.bool_], side: int, step: int) -> list[tuple[int, int]]:
    """Upper left corners (x, y) of the crops of `tiles`."""
    summed = cv2.integral(inside.astype(np.uint8))
    covered = summed[side:, side:] - summed[:-side, side:] - summed[side:, :-side] + summed[:-side, :-side]
    return [(int(x * step), int(y * step)) for y, x in np.argwhere(covered[::step, ::step] == side * side)]


def _lab(rgb: Picture) -> npt.NDArray[np.float32]:
    return np.asarray(cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB), np.float32)


def _slope(light: npt.NDArray[np.float32]) -> float:
    side = light.shape[0]
    window = np.hanning(side)[:, None] * np.hanning(side)[None]
    power = np.abs(np.fft.fft2((light - light.mean()) * window)) ** 2
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.fftfreq(side)[None])
    edges = np.geomspace(1 / 64, 1 / 4, 13)
    bins = np.digitize(frequency.ravel(), edges)
    mean = np.array([power.ravel()[bins == k].mean() for k in range(1, len(edges))])
    return float(np.polyfit(np.log(np.sqrt(edges[1:] * edges[:-1])), np.log(mean), 1)[0])


def _kurtosis(light: npt.NDArray[np.float32]) -> float:
    slopes = np.concatenate([np.diff(light, axis=0).ravel(), np.diff(light, axis=1).ravel()]).astype(float)
    slopes -= slopes.mean()
    return float((slopes**4).mean() / (slopes**2).mean() ** 2)


def _highlights(light: npt.NDArray[np.float32]) -> dict[str, float]:
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


def _elongation(label: npt.NDArray[np.int32], chosen: npt.NDArray[np.int64]) -> float:
    """Median ratio of axes of the ellipses with the second moments of the chosen labels' pixels."""
    found = [1.0]
    for k in chosen:
        away = np.argwhere(label == k).astype(float)
        # The second moment of a square pixel is 1/12.
        spread = np.linalg.eigvalsh(np.cov(away.T, bias=True) + np.eye(2) / 12)
        found.append(float(np.sqrt(spread[1] / spread[0])))
    return float(np.median(found[1:] or found))
