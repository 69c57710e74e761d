"""A photograph of cortex at the scale of a job's pictures: usable region, compression, statistics."""

from __future__ import annotations

import io
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from PIL import Image, JpegImagePlugin

from synth.arrays import Floats, Mask, Pixels
from synth.errors import UserError
from synth.flow.segmentation import segment
from synth.job.schema import RenderSection
from synth.render.camera.video_link import transmit
from synth.system import checked_file

_SMALLEST_PX, _LEAST_MM2 = 160, 60.0  # of a picture's sides, and of cortex
_INVISIBLE_DB = 46.0  # PSNR above which a loss is smaller than rounding a noisy picture to 8 bits
_BITRATES = (0.25, 0.5, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 11.0, 16.0, 22.0, 32.0)  # Mbit/s at 640 x 480
_SAMPLING = ("4:4:4", "4:2:2", "4:2:0")
_BANDS_PX = ((0.7, 1.4), (2.8, 5.6))
_BLOCK, _SMOOTHEST = 16, 0.2  # px; noise is measured where such blocks are smoothest
_OFF, _FITS = 0.3, 5  # of the logarithm of red light, beyond which a pixel is no plain tissue; rounds
_GROWN_PX = 2, 4  # around highlights, for colour and for sharpness
_CLIPPED = 240.0  # grey levels: two channels above it have no texture left
_ABOVE = 45.0  # grey levels of a highlight above the local median
_SHRINK = 4  # factor of downsampling for the local median
_STEEL = 0.3  # probability of an instrument from which a pixel is left out: tissue left out costs little
_OUTLINE_PX = 240  # longer side of the downsampled picture in which the cortex is segmented
_MIDDLE = 0.6  # squared radius of the initial ellipse of cortex, in half sides of the picture
_BLACK, _BLOODY = 60, 0.42  # grey levels; ratio of green to red (sRGB)
_VESSEL_MM = 3.0  # widest vessel: larger red areas are pooled blood
_INSET_PX = 5  # px of the downsampled picture, kernel by which the outline is eroded
_LAPLACIAN = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)


class Compression(NamedTuple):
    """The compression of a picture file."""

    tables: list[list[int]]  # JPEG's quantisation of luma and chroma, 64 steps each; empty: not a JPEG
    chroma: str
    finer: float  # resolution of the file relative to the measurement's

    @classmethod
    def of_file(cls, data: bytes, finer: float) -> Compression:
        """The compression stated in the header of a file."""
        with Image.open(io.BytesIO(data)) as image:
            tables = [list(table) for table in getattr(image, "quantization", {}).values()]
            return cls(tables[:2], _SAMPLING[max(0, JpegImagePlugin.get_sampling(image))], finer)

    def apply(self, rgb: Pixels) -> Pixels:
        """A picture (H, W, 3) compressed alike at the file's resolution, and resampled back."""
        if not self.tables:
            return rgb
        buffer = io.BytesIO()
        size = [round(side * self.finer) for side in rgb.shape[1::-1]]
        enlarged = cv2.resize(rgb, size, interpolation=cv2.INTER_CUBIC)
        sampling = _SAMPLING.index(self.chroma)
        Image.fromarray(enlarged).save(buffer, "JPEG", qtables=self.tables, subsampling=sampling)
        decoded = np.asarray(Image.open(buffer).convert("RGB"))
        return np.asarray(cv2.resize(decoded, rgb.shape[1::-1], interpolation=cv2.INTER_AREA), np.uint8)

    def bitrate_mbps(self, rgb: Pixels) -> float | None:
        """The least bitrate tried, for 640 x 480, at which H.264 loses no more; None: invisible loss."""
        psnr_db = cv2.PSNR(rgb, self.apply(rgb))
        if psnr_db > _INVISIBLE_DB:
            return None
        noise = np.random.default_rng(0).normal(0, 2, (5, *rgb.shape))
        video = np.clip(rgb + noise, 0, 255).astype(np.uint8)
        for rate in _BITRATES:
            decoded = transmit(video, 25.0, rate * rgb[..., 0].size / (640 * 480), self.chroma)
            if cv2.PSNR(video, decoded) >= psnr_db:
                break
        return rate


class Photograph(NamedTuple):
    """A photograph for the measurement of appearance and camera."""

    rgb: Pixels  # (H, W, 3) sRGB
    usable: Mask  # (H, W) cortex, without instruments
    mm_per_px: float
    compression: Compression

    @property
    def cortex_mm2(self) -> float:
        return float(self.usable.sum()) * self.mm_per_px**2


def read_photograph(path: Path, width_mm: float, mask: Path | None) -> Photograph:
    """The photograph at the scale of a default job's pictures, or at its own if that is coarser.

    `width_mm`: at the cortex; `mask`: white on usable cortex, else it is detected. UserError: unusable.
    """
    rgb = np.ascontiguousarray(np.asarray(checked_file.read_picture(path), np.uint8)[..., ::-1])
    if min(rgb.shape[:2]) < _SMALLEST_PX:
        raise UserError(f"{path}: is smaller than {_SMALLEST_PX} pixels; use a larger picture")
    mm_per_px, render_section = width_mm / rgb.shape[1], RenderSection()
    finer = max(1.0, sum(render_section.field_mm) / 2 / render_section.size[0] / mm_per_px)
    painted_mask = None if mask is None else np.asarray(checked_file.read_picture(mask, 0)) > 127
    usable = find_cortex(rgb, mm_per_px) if painted_mask is None else painted_mask
    if usable.shape != rgb.shape[:2]:
        raise UserError(f"{mask}: has another size than the photograph")
    rgba = np.dstack([rgb, 255 * usable.astype(np.uint8)])
    small = cv2.resize(rgba, None, fx=1 / finer, fy=1 / finer, interpolation=cv2.INTER_AREA)
    compression = Compression.of_file(checked_file.read_bytes(path, checked_file.LARGEST_PICTURE), finer)
    photograph = Photograph(
        np.ascontiguousarray(small[..., :3]), small[..., 3] > 252, mm_per_px * finer, compression
    )
    if photograph.cortex_mm2 < _LEAST_MM2:
        raise UserError(
            f"{path}: {photograph.cortex_mm2:.0f} mm2 of cortex in a width of {width_mm:g} mm, "
            f"{_LEAST_MM2:g} are needed; mark the cortex with --mask, or correct the picture's "
            "width with --width-mm"
        )
    return photograph


def measure(rgb: Pixels, usable: Mask, reach: float = 1.0) -> dict[str, float]:
    """Statistics by which a photograph can be compared with a rendered frame of another cortex.

    `vignette`: logarithmic loss of red light, which blood hardly absorbs, in the corners, less a slope due to
    lamps at one side, of tissue between vessels. `noise`: standard deviation in grey levels where tissue is
    smoothest (J. Immerkaer, 1996). `sharpness`: contrast of the finest octave relative to two octaves
    coarser, without noise. `rgb`: (H, W, 3) sRGB; `usable`: (H, W) tissue; `reach`: width relative to the
    photograph's.
    """
    highlights = find_highlights(rgb).astype(np.uint8)
    tissue, clear = (
        usable & (cv2.dilate(highlights, np.ones((2 * radius + 1,) * 2)) == 0) for radius in _GROWN_PX
    )
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    block = cv2.blur(np.abs(cv2.filter2D(grey, -1, _LAPLACIAN)), (_BLOCK, _BLOCK))
    interior = cv2.erode(tissue.astype(np.uint8), np.ones((_BLOCK, _BLOCK))) > 0
    noise = np.sqrt(np.pi / 2) / 6 * np.quantile(block[interior if interior.any() else tissue], _SMOOTHEST)
    energy = []
    for fine, coarse in _BANDS_PX:
        band = cv2.GaussianBlur(grey, (0, 0), fine) - cv2.GaussianBlur(grey, (0, 0), coarse)
        # White noise of unit variance leaves this much in a difference of Gaussians.
        noise_gain = (1 / fine**2 + 1 / coarse**2 - 4 / (fine**2 + coarse**2)) / (4 * np.pi)
        energy.append(max(float(band[clear].var()) - noise_gain * noise**2, 0.01))
    positions, middle = np.argwhere(tissue), (np.array(tissue.shape) - 1) / 2
    radial = reach**2 * ((positions - middle) ** 2).sum(axis=1) / (middle**2).sum()
    red = rgb[tissue, 0] / np.median(rgb[tissue, 0])
    light = np.log(np.maximum(red**2.2, 0.5))
    slopes = _fit_without_outliers(
        np.column_stack([radial, np.ones(len(positions)), positions / len(positions)]), light
    )
    sharpness = float(np.sqrt(energy[0] / energy[1]))
    return {"noise": float(noise), "sharpness": sharpness, "vignette": -float(slopes[0])}


def _fit_without_outliers(terms: Floats, values: Floats) -> Floats:
    """Least-squares coefficients (n,) of terms (N, n), without values (N,) that are off by `_OFF`: vessels
    and clefts, which lie elsewhere in every cortex."""
    inliers = np.ones(len(values), bool)
    for _ in range(_FITS):
        slopes, *_ = np.linalg.lstsq(terms[inliers], values[inliers])
        residuals = values - terms @ slopes
        inliers = np.abs(residuals - np.median(residuals[inliers])) < _OFF
    return np.asarray(slopes)


def find_highlights(rgb: Pixels) -> Mask:
    """Mask (H, W) of the specular highlights of a picture (H, W, 3) sRGB, at its own resolution.

    They are much brighter than the local median in the darkest channel, because they have the colour of the
    lamp and tissue lacks blue. The segmentation of `synth.flow` sees small pictures, too coarse for this.
    """
    darkest, second, _ = np.moveaxis(np.sort(rgb, axis=2), 2, 0)
    height, width = darkest.shape
    size = max(1, width // _SHRINK), max(1, height // _SHRINK)
    small = cv2.resize(darkest, size, interpolation=cv2.INTER_AREA)
    window = max(3, (max(height, width) // (4 * _SHRINK)) | 1)
    median = cv2.resize(cv2.medianBlur(small, window), (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray((darkest > median + _ABOVE) | (second > _CLIPPED))


def find_cortex(rgb: Pixels, mm_per_px: float) -> Mask:
    """Mask (H, W) of the exposed cortex in a picture (H, W, 3) sRGB.

    Pixels that resemble the middle of the picture more than its edge (C. Rother et al., "GrabCut", 2004),
    without those that are black, blue, covered by blood or part of an instrument.
    """
    scale = min(1.0, _OUTLINE_PX / max(rgb.shape))
    small = cv2.medianBlur(cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), 5)
    red, green, blue = np.moveaxis(small.astype(np.float32), 2, 0)
    kernel_px = (max(3, round(_VESSEL_MM / mm_per_px * scale)),) * 2
    bloody = cv2.blur((green < _BLOODY * red).astype(np.float32), kernel_px) > 0.9
    steel = cv2.resize(segment(rgb, rgb).instrument, small.shape[1::-1]) > _STEEL
    y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in small.shape[:2]), indexing="ij")
    label = np.where(x**2 + y**2 < _MIDDLE, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    label[(small.max(axis=2) < _BLACK) | (blue > 1.1 * red) | bloody | steel] = cv2.GC_BGD
    if not (label == cv2.GC_PR_FGD).any():
        return np.zeros(rgb.shape[:2], bool)
    cv2.setRNGSeed(1)  # for the initial colour clusters
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(np.ascontiguousarray(small[..., ::-1]), label, None, *models, 6, cv2.GC_INIT_WITH_MASK)
    foreground = (label == cv2.GC_PR_FGD).astype(np.uint8)
    cortex = cv2.erode(foreground, np.ones((_INSET_PX, _INSET_PX)), borderValue=1)
    return np.asarray(cv2.resize(cortex, rgb.shape[1::-1]) > 0)
