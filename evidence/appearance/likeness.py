"""How near a set of crops is to another one: kernel distance, coverage, and lengths of vessels by calibre.

Distances are those of features (`classifier.embed`); lengths are of ridges, as a filter finds them in both
a photograph and a rendering at the same scale, so that their ratio is meaningful, not their size.
"""

import cv2
import numpy as np
from skimage.filters import apply_hysteresis_threshold, sato  # type: ignore[import-not-found, unused-ignore]
from skimage.morphology import (  # type: ignore[import-not-found, unused-ignore]
    remove_small_objects,
    skeletonize,
)

from synth.arrays import Floats, Map, Mask, Pixels

CALIBRES = "below 0.16", "0.16 to 0.31", "above 0.31"
"""Classes of `vessel_lengths`, mm; a pixel of 0.055 mm hardly resolves the first."""
_LIMITS_MM = 0.16, 0.31  # between them
_SCALES_MM = 0.08, 0.11, 0.15, 0.21, 0.3, 0.42, 0.6  # calibres that the filter looks for
_OF_WIDTH = 1.35 / (2 * 3**0.5)  # standard deviation of the filter's Gaussian, as a share of a calibre
_FINER = 3  # samples a pixel along each side
_RIDGE = 0.02, 0.045  # of the filter on the logarithm of green: where a ridge goes on, and where it begins
_LEAST_MM = 0.4  # shorter ridges are left out
_DIAGONAL = 1.12  # mean length of a skeleton's step, as a multiple of a sample
_DARK, _AROUND_MM = 0.45, 0.45  # veins and clefts: fall of the logarithm of green, blurred
_DARKEST, _BRIGHTEST = 8, 235  # grey levels


def kernel_distance(real: Floats, rendered: Floats) -> float:
    """Unbiased square of the maximum mean discrepancy of features (N, d) and (M, d), with a cubic kernel.

    M. Bińkowski et al., "Demystifying MMD GANs", 2018, of this network's features instead of Inception's.
    """

    def kernel(a: Floats, b: Floats) -> Floats:
        return np.asarray((a @ b.T / a.shape[1] + 1) ** 3)

    def within(a: Floats) -> float:
        values, count = kernel(a, a), len(a)
        return float((values.sum() - np.trace(values)) / (count * (count - 1)))

    return within(real) + within(rendered) - 2 * float(kernel(real, rendered).mean())


def find_covered(real: Floats, rendered: Floats, overlaps: Mask, k: int = 5) -> Mask:
    """Which (N,) of features (N, d) have one of (M, d) nearer than their k-th neighbour among themselves.

    `overlaps` (N, N): which of `real` overlap and thus are no neighbours.
    M. F. Naeem et al., "Reliable fidelity and diversity metrics for generative models", 2020.
    """
    distances = np.where(overlaps, np.inf, _distances(real, real))
    return np.asarray(_distances(real, rendered).min(axis=1) < np.sort(distances, axis=1)[:, k - 1])


def vessel_lengths(rgb: Pixels, inside: Mask, mm_per_px: float) -> tuple[Floats, Mask]:
    """Length [mm/mm²] of vessels by calibre (3,), see `CALIBRES`, in a picture (H, W, 3) within a mask.

    Veins, clefts and highlights are left out. Also the mask (3 H, 3 W) of the vessels' centre lines.
    """
    green = np.log(np.maximum(rgb[..., 1].astype(np.float32), _DARKEST) / 255)
    blurred = cv2.GaussianBlur(green, (0, 0), _AROUND_MM / mm_per_px)
    dark = blurred < np.median(blurred[inside]) - _DARK
    bright = rgb.min(axis=-1) > _BRIGHTEST
    excluded = cv2.dilate((dark | bright).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    usable = _refine((inside & ~excluded).astype(np.uint8), cv2.INTER_NEAREST) > 0
    green = _refine(green, cv2.INTER_CUBIC)
    sample = mm_per_px / _FINER
    filtered = np.stack([sato(green, sigmas=[_OF_WIDTH * width / sample]) for width in _SCALES_MM])
    ridge = apply_hysteresis_threshold(filtered[1:].max(axis=0), *_RIDGE) & usable
    line = remove_small_objects(skeletonize(ridge), max_size=int(_LEAST_MM / sample), connectivity=2)
    calibre = np.asarray(_SCALES_MM)[filtered.argmax(axis=0)][line]
    counts = np.bincount(np.digitize(calibre, _LIMITS_MM), minlength=len(CALIBRES))
    return np.asarray(counts * _DIAGONAL * sample / (usable.sum() * sample**2)), line


def _refine(layer: Map, interpolation: int) -> Map:
    return np.asarray(cv2.resize(layer, None, fx=_FINER, fy=_FINER, interpolation=interpolation))


def _distances(a: Floats, b: Floats) -> Floats:
    """Distances (N, M) of features (N, d) and (M, d)."""
    square = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2 * a @ b.T
    return np.asarray(np.sqrt(np.maximum(square, 0)))
