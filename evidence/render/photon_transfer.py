"""Noise of a camera from its flat and dark frames: the photon transfer method.

J. R. Janesick, "Photon Transfer", 2007: the variance of a linear sensor grows with its mean by 1/gain.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from synth.errors import UserError

Floats = npt.NDArray[np.float64]
Frames = npt.NDArray[np.floating]

_ENDINGS = {".png", ".tif", ".tiff", ".bmp", ".pgm"}


@dataclass(frozen=True)
class Noise:
    """What `job.Sensor` needs to know of a camera."""

    full_well: float
    """Photoelectrons at full scale."""
    read_noise: float
    """[electrons]."""
    gain: float
    """Photoelectrons a grey level."""
    black: float
    """Grey level of darkness."""


def load(folder: Path) -> tuple[Frames, float]:
    """Frames (N, H, W) of a folder of pictures, green of colour ones, and their full scale.

    Raises:
        UserError: fewer than two pictures, or pictures of different size or depth.
    """
    paths = sorted(p for p in folder.glob("*") if p.suffix.lower() in _ENDINGS) if folder.is_dir() else []
    if len(paths) < 2:
        raise UserError(
            f"{folder}: holds {len(paths)} pictures ({', '.join(sorted(_ENDINGS))}); two are needed"
        )
    frames = []
    for path in paths:
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise UserError(f"{path}: not a picture that can be read")
        frames.append(image[..., 1] if image.ndim == 3 else image)
    if len({(frame.shape, frame.dtype) for frame in frames}) > 1:
        raise UserError(f"{folder}: the pictures differ in size or depth")
    return np.stack(frames).astype(np.float64), float(np.iinfo(frames[0].dtype).max)


def fit(flats: Frames, darks: Frames, full_scale: float) -> Noise:
    """Gain, full well and read noise.

    Args:
        flats: (N, H, W) linear grey levels of an even surface, from any exposures, two or more of each.
        darks: (M, H, W) with the lens capped.
        full_scale: largest grey level.

    Raises:
        UserError: the frames are saturated, dark, or too few of a kind to compare.
    """
    if flats.shape[1:] != darks.shape[1:]:
        raise UserError("flat and dark frames differ in size")
    black = float(darks.mean())
    # Differences of two frames keep the noise and lose what is fixed in the picture.
    read = float(np.mean([np.var(a - b) / 2 for a, b in itertools.pairwise(darks)]))
    order = np.argsort(flats.mean(axis=(1, 2)), kind="stable")
    means, variances = [], []
    for a, b in itertools.pairwise(flats[order]):
        level, other = float(a.mean()) - black, float(b.mean()) - black
        if abs(other / max(level, 1e-9) - 1) > 0.02 or max(a.max(), b.max()) >= full_scale:
            continue  # another exposure, or clipped
        means.append(0.5 * (level + other))
        variances.append(float(np.var(a * (other / level) - b) / 2) - read)
    signal, spread = np.array(means), np.array(variances)
    if not len(signal) or signal.max() < 10 * np.sqrt(read + 1 / 12):
        raise UserError("flat frames: no two of one exposure that are neither dark nor saturated")
    slope = float((signal * spread).sum() / (signal**2).sum())  # grey levels an electron
    if not slope > 0:
        raise UserError("flat frames: their noise does not grow with light; are they averaged or compressed?")
    # A step of 1 in grey adds 1/12 of its own to the variance.
    electrons = 1 / slope
    return Noise(
        full_well=(full_scale - black) * electrons,
        read_noise=float(np.sqrt(max(read - 1 / 12, 0.0))) * electrons,
        gain=electrons,
        black=black,
    )
