"""Single figures of a crop, each of which alone may tell a rendering from a photograph."""

from __future__ import annotations

import itertools
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.stats import rankdata

Picture = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Map = npt.NDArray[np.float32]

_BANDS_PX = (0.7, 1.4, 2.8, 5.6, 11.2)
_SLOPES = {"coarse": (1 / 64, 1 / 12), "middle": (1 / 16, 1 / 4), "fine": (1 / 5, 1 / 2)}  # cycles a pixel
_BLOCKS = 8  # a side, of which the smoothest hold noise alone
_SMOOTHEST = 0.3
_RIDGE = 10.0


def describe(rgb: Picture) -> dict[str, float]:
    """Figures of a crop (N, N, 3) sRGB.

    Colour: CIE 1976 Lab's means, spreads and correlation. Tone: what share of red is clipped, its 99th
    percentile, green's first (black level). Noise: of luma and colour differences where they are smoothest
    (Immerkaer, 1996), its correlation between neighbours (demosaicing, codec) and JPEG's grid of 8 px.
    Spectrum: its slope in three ranges, the ratio of the finest to a coarser band, how far channels share
    their detail. Shape: kurtosis and 99th percentile of gradients, skewness and kurtosis of a band, coherence
    of the structure tensor.
    """
    colour = rgb.astype(np.float32)
    lab = cv2.cvtColor(colour / 255, cv2.COLOR_RGB2LAB)
    luma, red, blue = cv2.split(cv2.cvtColor(colour / 255, cv2.COLOR_RGB2YCrCb) * 255)
    found = _colour(lab) | _tone(colour)
    smooth = _smooth(luma)
    found |= {"noise luma": _noise(luma), "noise Cr": _noise(red), "noise Cb": _noise(blue)}
    found["noise neighbours"] = _neighbours(luma, smooth)
    found["grid of 8 px"] = _grid(luma)
    found |= {f"slope {name}": _slope(luma, *ends) for name, ends in _SLOPES.items()}
    detail = colour - cv2.GaussianBlur(colour, (0, 0), 1.5)
    found["detail red-green"] = _correlation(detail[..., 0], detail[..., 1])
    found["detail green-blue"] = _correlation(detail[..., 1], detail[..., 2])
    for name, plane in (("luma", luma), ("Cr", red)):
        bands = [a - b for a, b in itertools.pairwise(cv2.GaussianBlur(plane, (0, 0), s) for s in _BANDS_PX)]
        found[f"sharpness {name}"] = float(np.log(max(bands[0].std(), 1e-3) / max(bands[2].std(), 1e-3)))
        found[f"contrast {name}"] = float(np.log(max(bands[1].std(), 1e-3)))
        if name == "luma":
            found |= {"skewness": _moment(bands[1], 3), "kurtosis": _moment(bands[1], 4)}
    return found | _gradients(luma)


def table(pictures: Picture) -> tuple[list[str], Floats]:
    """Names (C) and figures (N, C) of crops (N, n, n, 3)."""
    rows = [describe(picture) for picture in pictures]
    return list(rows[0]), np.array([list(row.values()) for row in rows])


def auc(score: Floats, label: Ints) -> float:
    """Chance that a crop of label 1 scores above one of label 0; ties count half (Mann and Whitney, 1947)."""
    ones = label == 1
    n, m = int(ones.sum()), int((~ones).sum())
    return float((rankdata(score)[ones].sum() - n * (n + 1) / 2) / (n * m))


def linear(figures: Floats, label: Ints, fold: Ints, near: npt.NDArray[np.bool_]) -> float:
    """Mean held-out AUC of folds, of regularised least squares on all figures (N, C), both labels alike.

    Args:
        figures: (N, C).
        label: (N,) 0 or 1.
        fold: (N,).
        near: (N, N) pairs that mustn't stand on either side.
    """
    found = []
    for k in np.unique(fold):
        inside = fold == k
        taught = ~inside & ~near[inside].any(axis=0)
        if len(np.unique(label[inside])) < 2 or len(np.unique(label[taught])) < 2:
            continue
        middle, spread = figures[taught].mean(axis=0), figures[taught].std(axis=0) + 1e-9
        given, truth = (figures - middle) / spread, 2.0 * label - 1
        weight = np.sqrt(1 / np.bincount(label[taught], minlength=2)[label[taught]] * taught.sum() / 2)
        rows = np.concatenate([given[taught], np.ones((int(taught.sum()), 1))], axis=1) * weight[:, None]
        kept = _RIDGE * np.eye(rows.shape[1])
        kept[-1, -1] = 0
        slopes = np.linalg.solve(rows.T @ rows + kept, rows.T @ (truth[taught] * weight))
        found.append(auc(given[inside] @ slopes[:-1], label[inside]))
    return float(np.mean(found))


def _colour(lab: Map) -> dict[str, float]:
    found: dict[str, float] = {}
    for k, name in enumerate("Lab"):
        found |= {f"{name} mean": float(lab[..., k].mean()), f"{name} sd": float(lab[..., k].std())}
    found["chroma"] = float(np.hypot(lab[..., 1], lab[..., 2]).mean())
    found["correlation a-b"] = _correlation(lab[..., 1], lab[..., 2])
    return found


def _tone(colour: Map) -> dict[str, float]:
    return {
        "red clipped": float((colour[..., 0] >= 253).mean()),
        "red p99": float(np.quantile(colour[..., 0], 0.99)),
        "green p1": float(np.quantile(colour[..., 1], 0.01)),
    }


def _blocks(plane: Map) -> Map:
    return np.asarray(cv2.resize(plane, (_BLOCKS, _BLOCKS), interpolation=cv2.INTER_AREA), np.float32)


def _noise(plane: Map) -> float:
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    block = _blocks(np.abs(cv2.filter2D(plane, -1, kernel)))
    return float(np.sqrt(np.pi / 2) / 6 * np.quantile(block, _SMOOTHEST))


def _smooth(luma: Map) -> npt.NDArray[np.bool_]:
    block = _blocks(np.abs(luma - cv2.GaussianBlur(luma, (0, 0), 1.5)))
    smooth = (block <= np.quantile(block, _SMOOTHEST)).astype(np.uint8)
    return np.asarray(cv2.resize(smooth, luma.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0)


def _neighbours(luma: Map, smooth: npt.NDArray[np.bool_]) -> float:
    detail = luma - cv2.GaussianBlur(luma, (0, 0), 1.5)
    both = smooth[:, 1:] & smooth[:, :-1]
    return float((detail[:, 1:] * detail[:, :-1])[both].mean() / max((detail**2)[smooth].mean(), 1e-6))


def _grid(luma: Map) -> float:
    step = np.abs(np.diff(luma, axis=1)).mean(axis=0)
    return float(max(step[k::8].mean() for k in range(8)) / max(step.mean(), 1e-6))


def _slope(luma: Map, low: float, high: float) -> float:
    side = luma.shape[0]
    window = np.hanning(side)[:, None] * np.hanning(side)[None]
    power = np.abs(np.fft.fft2((luma - luma.mean()) * window)) ** 2
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.fftfreq(side)[None])
    edges = np.geomspace(low, high, 9)
    bins = np.digitize(frequency.ravel(), edges)
    mean = np.array([power.ravel()[bins == k].mean() for k in range(1, len(edges))])
    middles = np.log(np.sqrt(edges[1:] * edges[:-1]))
    return float(np.polyfit(middles, np.log(np.maximum(mean, 1e-9)), 1)[0])


def _gradients(luma: Map) -> dict[str, float]:
    steps = np.concatenate([np.diff(luma, axis=axis).ravel() for axis in (0, 1)]).astype(float)
    across, down = (cv2.Sobel(cv2.GaussianBlur(luma, (0, 0), 1), cv2.CV_32F, *d) for d in ((1, 0), (0, 1)))
    xx, xy, yy = (cv2.GaussianBlur(v, (0, 0), 4) for v in (across**2, across * down, down**2))
    return {
        "gradient kurtosis": _moment(steps, 4),
        "gradient p99": float(np.quantile(np.abs(steps), 0.99)),
        "coherence": float((np.hypot(xx - yy, 2 * xy) / (xx + yy + 1e-3)).mean()),
    }


def _moment(values: npt.NDArray[np.floating[Any]], order: int) -> float:
    away = values - values.mean()
    return float((away**order).mean() / max((away**2).mean(), 1e-9) ** (order / 2))


def _correlation(one: Map, other: Map) -> float:
    a, b = one - one.mean(), other - other.mean()
    return float((a * b).mean() / max(float(np.sqrt((a**2).mean() * (b**2).mean())), 1e-9))
