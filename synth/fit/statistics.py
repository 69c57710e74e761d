"""What a picture of cortex looks like, in figures that each answer to one parameter of the job.

All are of usable pixels only, at a known scale (mm a pixel), so that a photograph and a rendered frame of
another cortex can be compared.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.ndimage import percentile_filter

Picture = npt.NDArray[np.uint8]
Map = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

_SURROUND_MM = 5.0  # a vessel is darker than the bright part of what lies so far around it
_DARK = 0.35  # log green below its surround: a vessel
_DARK_RED = 0.4  # log red below its surround: a vein, for arteries let red through
_VEIN_MM = 0.45  # veins narrower than this have no crest to speak of
_BLUE, _BLUE_MM = (
    0.27,
    0.8,
)  # blue over red along a vein's crest, which no artery has; from there to its sides
_TISSUE_MM = 0.5  # the colour of tissue is taken over so much of it
_WHITE, _ABOVE = 200.0, 30.0  # grey levels of a highlight's smallest channel, and above its surround
_BANDS_PX = (0.7, 1.4, 2.8, 5.6, 11.2)
_BLOCK = 16  # px; noise is measured where such blocks are smoothest
_SMOOTHEST = 0.2
_LEAST = 400  # px of anything that a figure is taken from


@dataclass(frozen=True)
class View:
    """A picture with what is known of it."""

    rgb: Picture
    """(H, W, 3) sRGB."""
    usable: Mask
    """(H, W) tissue, without instruments."""
    mm_per_px: float
    corner2: Map
    """(H, W) squared distance from the optical axis, 1 in the corners of the whole photograph."""

    @classmethod
    def whole(cls, rgb: Picture, usable: Mask, mm_per_px: float) -> View:
        """A picture that nothing was cut from."""
        height, width = rgb.shape[:2]
        y, x = np.mgrid[:height, :width].astype(np.float32)
        centre = np.array([(height - 1) / 2, (width - 1) / 2])
        distance2 = (y - centre[0]) ** 2 + (x - centre[1]) ** 2
        return cls(rgb, usable, mm_per_px, np.asarray(distance2 / (centre**2).sum(), np.float32))


@dataclass(frozen=True)
class Parts:
    """Which usable pixels are what, (H, W) each."""

    tissue: Mask
    artery: Mask
    vein: Mask
    """Wide dark vessels; among them may be arteries."""
    highlight: Mask


def measure(view: View) -> dict[str, float]:
    """Figures of one picture; those that it says nothing of are NaN.

    Colours of crown, flush, vein and wine (linear sRGB), darkness of wide arteries (log) and of the usual
    against those, their length on an area (1/mm), the veins' share, mottling of tissue by what lies deep, its
    large shadows, highlights' share, area (mm2) and elongation, light lost in the corners, noise (grey
    levels), sharpness (ratio of two bands), and contrast in octaves of scale (log).
    """
    linear = decode(view.rgb)
    parts, surround = find_parts(view, linear)
    base = _smooth(linear, parts.tissue, _TISSUE_MM / view.mm_per_px)
    lost = _vignette(base, parts.tissue, view.corner2)
    flat = np.asarray(1 - lost * np.minimum(view.corner2, 1), np.float32)[..., None]
    found = {"vignette": lost}
    found |= _tissue(base / flat, parts.tissue)
    found |= _veins(linear / flat, _blue(parts.vein, linear, view.mm_per_px), view.mm_per_px)
    found["vein share"] = float(parts.vein.sum() / max(view.usable.sum(), 1))
    found |= _arteries(linear, surround, parts, view.mm_per_px)
    found |= _highlights(parts.highlight, view)
    found |= _texture(view, parts, linear, base)
    return found


def decode(rgb: Picture) -> Map:
    """Linear light (H, W, 3), 0 to 1, of sRGB (IEC 61966-2-1)."""
    encoded = np.arange(256) / 255
    table = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    return np.asarray(table.astype(np.float32)[rgb])


def find_parts(view: View, linear: Map) -> tuple[Parts, Map]:
    """Vessels, highlights and the tissue between, and the surround's linear light (H, W, 3)."""
    highlight = highlights(view.rgb) & view.usable
    spread = cv2.dilate(highlight.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    clear = view.usable & ~spread
    surround = _surround(linear, clear, view.mm_per_px)
    fine = cv2.GaussianBlur(linear, (0, 0), 0.8)
    darker = np.log(np.maximum(surround, 1e-3) / np.maximum(fine, 1e-3))
    dark_red = (darker[..., 0] > _DARK_RED) & clear
    vein = _opened(dark_red, 0.5 * _VEIN_MM / view.mm_per_px)
    near_vein = cv2.dilate(vein.astype(np.uint8), _disc(0.3 / view.mm_per_px)) > 0
    vessel = (darker[..., 1] > _DARK) & clear
    # Wide red places without an edge of their own are blood in the pia.
    pool = (
        cv2.dilate(_opened(vessel, 0.7 / view.mm_per_px).astype(np.uint8), _disc(0.15 / view.mm_per_px)) > 0
    )
    artery = _without_specks(vessel & ~near_vein & ~pool, view.mm_per_px)
    grown = cv2.dilate((vessel | vein).astype(np.uint8), _disc(0.12 / view.mm_per_px)) > 0
    return Parts(clear & ~grown & ~near_vein, artery, vein, highlight), surround


def _blue(dark: Mask, linear: Map, mm_per_px: float) -> Mask:
    """Of wide dark vessels the veins, which scatter blue along their crest; wide arteries don't."""
    near = _smooth(linear, dark, 0.35 / mm_per_px)
    crest = dark & (near[..., 2] > _BLUE * np.maximum(near[..., 0], 1e-3))
    core = _opened(crest, 0.25 * _VEIN_MM / mm_per_px)
    near_core = cv2.dilate(core.astype(np.uint8), _disc(_BLUE_MM / mm_per_px)) > 0
    return np.asarray(dark & near_core)


def highlights(rgb: Picture) -> Mask:
    """(H, W): near white, and whiter than what lies around."""
    whiteness = rgb.min(axis=2)
    small = cv2.resize(whiteness, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    window = max(3, (max(small.shape) // 8) | 1)
    around = cv2.resize(cv2.medianBlur(small, min(window, 255)), whiteness.shape[::-1])
    return np.asarray((whiteness > _WHITE) & (whiteness > around.astype(np.float32) + _ABOVE))


def _surround(linear: Map, clear: Mask, mm_per_px: float) -> Map:
    """The bright part of each place's neighbourhood, without highlights."""
    step = max(1, round(0.25 / mm_per_px))
    height, width = clear.shape
    small = (max(8, width // step), max(8, height // step))
    weight = cv2.resize(clear.astype(np.float32), small, interpolation=cv2.INTER_AREA)
    value = cv2.resize(linear * clear[..., None], small, interpolation=cv2.INTER_AREA)
    value = np.where(weight[..., None] > 0.3, value / np.maximum(weight, 1e-3)[..., None], 0)
    window = max(3, round(_SURROUND_MM / (mm_per_px * step)) | 1)
    bright = [percentile_filter(value[..., k], 80, size=window, mode="nearest") for k in range(3)]
    bright = [cv2.GaussianBlur(np.asarray(one, np.float32), (0, 0), window / 6) for one in bright]
    return np.asarray(cv2.resize(np.stack(bright, axis=-1), (width, height)), np.float32)


def _smooth(linear: Map, where: Mask, sigma: float) -> Map:
    """Mean of the neighbourhood's pixels that are in a mask."""
    weight = cv2.GaussianBlur(where.astype(np.float32), (0, 0), sigma)
    return np.asarray(
        cv2.GaussianBlur(linear * where[..., None], (0, 0), sigma) / np.maximum(weight, 1e-3)[..., None]
    )


def _vignette(base: Map, tissue: Mask, corner2: Map) -> float:
    """Share of light lost in the corners: leaves red, which blood hardly darkens, flattest on a log scale.

    Lamps light one side more than the other: a slope over the picture is no vignette.
    """
    step = max(4, min(tissue.shape) // 30)
    rows, columns = np.nonzero(tissue[::step, ::step])
    if len(rows) < 40:
        return np.nan
    at = np.ix_(np.arange(0, tissue.shape[0], step), np.arange(0, tissue.shape[1], step))
    red = np.log(np.maximum(base[..., 0][at][rows, columns], 1e-4)).astype(np.float64)
    away = np.minimum(corner2[at][rows, columns], 1)
    plane = np.stack([np.ones(len(rows)), rows / len(rows), columns / len(rows)], axis=1)
    basis, _ = np.linalg.qr(plane)
    tried = np.linspace(-0.3, 0.95, 126)
    left = []
    for share in tried:
        flat = red - np.log(1 - share * away)
        rest = flat - basis @ (basis.T @ flat)
        left.append(np.abs(rest).mean())
    return float(tried[int(np.argmin(left))])


def _tissue(base: Map, tissue: Mask) -> dict[str, float]:
    """Colour where most and least green is left, and how far red goes down in the large."""
    names = [f"{part} {channel}" for part in ("crown", "flush") for channel in "rgb"]
    pixels = base[tissue][::5]
    if len(pixels) < _LEAST:
        return dict.fromkeys([*names, "shade"], np.nan)
    ratio = pixels[:, 1] / np.maximum(pixels[:, 0], 1e-3)
    low, high = np.quantile(ratio, (0.3, 0.7))
    values = [*pixels[ratio >= high].mean(axis=0), *pixels[ratio <= low].mean(axis=0)]
    top, bottom = np.quantile(pixels[:, 0], (0.9, 0.1))
    found = dict(zip(names, map(float, values), strict=True))
    return found | {"shade": float(np.log(top / max(bottom, 1e-4)))}


def _veins(linear: Map, vein: Mask, mm_per_px: float) -> dict[str, float]:
    """Mean colour of thick veins in their inner and outer half."""
    names = [f"{part} {channel}" for part in ("vein", "wine") for channel in "rgb"]
    if vein.sum() < _LEAST:
        return dict.fromkeys(names, np.nan)
    depth = cv2.distanceTransform(vein.astype(np.uint8), cv2.DIST_L2, 5)
    widest = cv2.dilate(depth, _disc(0.8 / mm_per_px))
    crest, side = vein & (depth > 0.6 * widest), vein & (depth > 0.1 * widest) & (depth <= 0.4 * widest)
    values = [*np.median(linear[crest], axis=0), *np.median(linear[side], axis=0)]
    return dict(zip(names, map(float, values), strict=True))


def _arteries(linear: Map, surround: Map, parts: Parts, mm_per_px: float) -> dict[str, float]:
    """How dark arteries are in green, the wide ones and the usual against those, and length on an area."""
    artery = parts.artery.astype(np.uint8)
    area = (parts.tissue | parts.artery | parts.vein).sum() * mm_per_px**2
    line = cv2.ximgproc.thinning(artery * 255) > 0
    if line.sum() < 50 or area < 4:
        return dict.fromkeys(("arterial", "fineness", "density"), np.nan)
    dark = np.log(np.maximum(surround[..., 1], 1e-3) / np.maximum(linear[..., 1], 1e-3))
    usual, most = np.maximum(np.quantile(dark[line], (0.5, 0.9)), 0.05)
    # A line through pixels is 1.1 times as long as their number, over all directions.
    length = 1.1 * line.sum() * mm_per_px
    return {"arterial": float(most), "fineness": float(usual / most), "density": float(length / area)}


def _highlights(highlight: Mask, view: View) -> dict[str, float]:
    """Share of the tissue, and of those spots of more than two pixels the median area and elongation."""
    share = float(highlight.sum() / max(view.usable.sum(), 1))
    count, label, stats, _ = cv2.connectedComponentsWithStats(highlight.astype(np.uint8), connectivity=8)
    big = [k for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] > 2]
    if len(big) < 3:
        return {"highlight share": share, "highlight area": np.nan, "highlight elongation": np.nan}
    longest = []
    for k in big:
        x, y, w, h = stats[k, :4]
        moments = cv2.moments((label[y : y + h, x : x + w] == k).astype(np.uint8), binaryImage=True)
        n = moments["m00"]
        a, b, c = moments["mu20"] / n + 1 / 12, moments["mu11"] / n, moments["mu02"] / n + 1 / 12
        root = np.hypot((a - c) / 2, b)
        longest.append(np.sqrt(((a + c) / 2 + root) / max((a + c) / 2 - root, 1 / 24)))
    area = float(np.median(stats[big, cv2.CC_STAT_AREA])) * view.mm_per_px**2
    return {
        "highlight share": share,
        "highlight area": area,
        "highlight elongation": float(np.median(longest)),
    }


def _texture(view: View, parts: Parts, linear: Map, base: Map) -> dict[str, float]:
    """Noise, sharpness, contrast by scale, and the mottling that deep vessels give tissue."""
    grey = cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    noise = _noise(grey, parts.tissue)
    everything = cv2.erode((view.usable & ~parts.highlight).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    levels = [cv2.GaussianBlur(grey, (0, 0), s) for s in _BANDS_PX]
    found = {"noise": noise}
    energy = []
    for k, (fine, coarse) in enumerate(itertools.pairwise(levels)):
        # White noise of unit variance leaves this much in the band.
        left = _band_gain(_BANDS_PX[k], _BANDS_PX[k + 1])
        inside = (fine - coarse)[everything]
        energy.append(max(float(inside.var()) - left * noise**2, 0.01) if len(inside) else np.nan)
        found[f"contrast {k}"] = float(0.5 * np.log(energy[-1]))
    found["sharpness"] = float(np.sqrt(energy[0] / energy[2]))
    inner = cv2.erode(parts.tissue.astype(np.uint8), _disc(0.15 / view.mm_per_px)) > 0
    local = np.log(np.maximum(_smooth(linear, parts.tissue, 0.12 / view.mm_per_px)[..., 1], 1e-3))
    wide = np.log(np.maximum(_smooth(linear, parts.tissue, 0.8 / view.mm_per_px)[..., 1], 1e-3))
    mottle = (local - wide)[inner]
    found["mottle"] = float(np.subtract(*np.quantile(mottle, (0.9, 0.1)))) if len(mottle) > _LEAST else np.nan
    return found


def _band_gain(fine: float, coarse: float) -> float:
    """Variance that unit white noise has in a difference of Gaussians."""
    area = 1 / (4 * np.pi)
    return float(area * (1 / fine**2 + 1 / coarse**2 - 4 / (fine**2 + coarse**2)))


def _noise(grey: Map, tissue: Mask) -> float:
    """Standard deviation of the noise in the smoothest blocks of tissue (Immerkaer's operator, 1996)."""
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    residual = np.abs(cv2.filter2D(grey, -1, kernel))
    small = (grey.shape[1] // _BLOCK, grey.shape[0] // _BLOCK)
    rows, columns = small[1] * _BLOCK, small[0] * _BLOCK
    block = cv2.resize(residual[:rows, :columns], small, interpolation=cv2.INTER_AREA)
    full = cv2.resize(tissue[:rows, :columns].astype(np.float32), small, interpolation=cv2.INTER_AREA) > 0.95
    if full.sum() < 5:
        return np.nan
    return float(np.sqrt(np.pi / 2) / 6 * np.quantile(block[full], _SMOOTHEST))


def _without_specks(vessel: Mask, mm_per_px: float) -> Mask:
    """Vessels are longer than half a millimetre."""
    _, label, stats, _ = cv2.connectedComponentsWithStats(vessel.astype(np.uint8), connectivity=8)
    long = np.hypot(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT]) * mm_per_px > 0.5
    long[0] = False
    return np.asarray(long[label])


def _opened(mask: Mask, radius: float) -> Mask:
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, _disc(radius)) > 0)


def _disc(radius: float) -> npt.NDArray[np.uint8]:
    side = 2 * max(1, round(radius)) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)
