"""Ways in which what a trained network is shown can be wrong: pure functions from clips to clips."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from learn.data.clips import Clip
from learn.data.grid import Grid

Floats = NDArray[np.float32]


def noisy(clip: Clip, sigma_mm: float, patch_mm: float, grid: Grid, rng: np.random.Generator) -> Clip:
    """Gaussian noise on the displacement of every frame but the rest, `sigma_mm` a component.

    `patch_mm` is the noise's own scale (standard deviation of the blur that makes it); 0 is cell by cell.
    """
    shape = clip.displacement["ideal"].shape
    noise = rng.normal(size=shape).astype(np.float32)
    if patch_mm > 0:
        blur = patch_mm / grid.pitch_mm
        noise = ndimage.gaussian_filter(noise, (0, 0, blur, blur)) * np.float32(2 * np.sqrt(np.pi) * blur)
    noise[0] = 0
    return _shown(clip, clip.displacement["ideal"] + np.float32(sigma_mm) * noise * clip.mask)


def hidden(clip: Clip, sigma_mm: float, share: float, grid: Grid, rng: np.random.Generator) -> Clip:
    """A recovered flow that fails in patches, and a confidence that says where.

    Patches over `share` of the picture carry noise of `sigma_mm` with 1 mm blobs; the confidence there is
    0.1.
    """
    field = ndimage.gaussian_filter(rng.normal(size=clip.mask.shape), 3.0 / grid.pitch_mm)
    lost = field > np.quantile(field, 1 - share)
    torn = noisy(clip, sigma_mm, 1.0, grid, rng).displacement["ideal"]
    moved = np.where(lost, torn, clip.displacement["ideal"]).astype(np.float32)
    confidence = np.broadcast_to(np.where(lost, 0.1, 1.0).astype(np.float32), (clip.frames, *lost.shape))
    return replace(
        clip,
        displacement={"ideal": np.asarray(clip.displacement["ideal"]), "recovered": moved},
        confidence=confidence * clip.mask,
    )


def unsure(clip: Clip) -> Clip:
    """The same without its confidence: 1 everywhere, as where a method gives none."""
    return replace(clip, confidence=np.ones_like(clip.confidence) * clip.mask)


def scaled(clip: Clip, factor: float) -> Clip:
    """As seen through a wrong scale: `factor` times the true mm a pixel makes all lengths that much
    longer."""
    n = clip.mask.shape[0]
    node = (np.arange(n) - (n - 1) / 2) / factor + (n - 1) / 2
    at = np.meshgrid(node, node, indexing="ij")

    def zoomed(values: Floats, order: int) -> Floats:
        return np.asarray(ndimage.map_coordinates(values, at, order=order, mode="constant"), np.float32)

    mask = (zoomed(np.asarray(clip.mask), 1) > 0.5).astype(np.float32)
    moved = np.stack([[zoomed(c, 1) for c in frame] for frame in clip.displacement["ideal"]])
    return _shown(replace(clip, mask=mask), np.float32(factor) * moved * mask)


def both(one: Clip, other: Clip) -> Clip:
    """Two sequences at once, by superposition (exact for small loads), on the tissue they share."""
    mask = np.asarray(one.mask) * np.asarray(other.mask)
    frames = min(one.frames, other.frames)
    ratio = np.float32(other.young_kpa / one.young_kpa)
    moved = (one.displacement["ideal"][:frames] + other.displacement["ideal"][:frames]) * mask
    return replace(
        one,
        mask=mask,
        displacement={"ideal": moved},
        confidence=np.ones((frames, *mask.shape), np.float32),
        density=(one.density[:frames] + other.density[:frames]) * mask,
        force=one.force[:frames] + other.force[:frames] / ratio,
    )


def still(clip: Clip) -> Clip:
    """Nothing moves and nothing is loaded."""
    empty = replace(clip, density=0 * np.asarray(clip.density), force=0 * clip.force)
    return _shown(empty, 0 * np.asarray(clip.displacement["ideal"]))


def mislabelled(clip: Clip, sigma: float, rng: np.random.Generator) -> Clip:
    """A sequence whose every label is off by one factor exp(N(0, sigma)), as a sensor's gain would have
    it."""
    gain = np.float32(np.exp(rng.normal(0, sigma)))
    return replace(clip, density=clip.density * gain, force=clip.force * float(gain))


def _shown(clip: Clip, moved: Floats) -> Clip:
    return replace(clip, displacement={"ideal": moved})
