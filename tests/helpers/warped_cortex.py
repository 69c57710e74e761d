"""Image pairs and sequences with known flow: warped cortex-like texture with light, tool and sensor noise."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from synth.arrays import Map, Mask, Pixels

_FINE = 2  # texture samples a pixel, so that resampling loses no detail that the sensor resolves


@dataclass(frozen=True)
class Recipe:
    """Changes between the rest frame and the current frame. Lengths in px of the image."""

    size: int = 224  # width and height [px]
    pull: float = 10.0  # largest displacement [px]
    reach: float = 0.14  # radius of the contact's dimple, as a share of the width
    direction: float = 0.6  # direction of the pull in the image [rad]; x right, y down
    tool: float = 22.0  # width of one branch of the forceps [px]; 0: no tool
    highlights: float = 0.06  # share of the image in specular highlights
    illumination: float = 0.10
    """Largest relative change of brightness, with an equal gradient over the image."""
    contrast: float = 1.0  # factor on the texture's contrast
    noise: float = 1.5  # standard deviation of the sensor's noise [grey levels]
    blur: float = 0.0  # Gaussian defocus of the current frame, standard deviation [px]


CLEAN = Recipe(tool=0.0, highlights=0.0, illumination=0.0, noise=0.0)  # nothing but motion


@dataclass(frozen=True)
class Pair:
    """Two images and their ground truth, on the rest frame's pixels unless stated otherwise."""

    rest: Pixels  # (H, W, 3) uint8, without tool
    now: Pixels  # (H, W, 3) uint8
    flow: Map  # (H, W, 2) px, rest to now
    rest_usable: Mask  # (H, W): no highlight in the rest frame
    now_usable: Mask  # (H, W), on the current frame's pixels: neither tool nor highlight
    hidden: Mask  # (H, W): material points under the tool in the current frame, inside the image
    contact: Mask  # (H, W): within the dimple's radius of the contact
    inside: Mask  # (H, W): material points inside the current image


def noise_field(shape: tuple[int, int], period: float, rng: np.random.Generator) -> Map:
    """Smooth noise of zero mean and unit deviation with features about `period` samples apart, (H, W)."""
    white = rng.standard_normal(shape)
    fy = np.fft.fftfreq(shape[0])[:, None]
    fx = np.fft.rfftfreq(shape[1])[None]
    radius = np.hypot(fy, fx) * period
    smooth = np.fft.irfft2(np.fft.rfft2(white) * radius * np.exp(-(radius**2)), shape)
    return np.asarray((smooth - smooth.mean()) / smooth.std(), np.float32)


def cortex(size: int, rng: np.random.Generator) -> Map:
    """Albedo like an exposed cortex: parenchyma, arteries, fine vessels and a vein; (size, size, 3) in 0..1.

    Vessels are the zero lines of smooth noise. They are not anatomical, but the image has the gradients, the
    textureless patches and the aperture problems that matter to flow.
    """
    shape = (size, size)
    unit = size / 448.0

    def line(period: float, width: float) -> Map:
        wave = noise_field(shape, period * unit, rng)
        slope = np.hypot(*np.gradient(wave)) + 1e-3
        return np.asarray(np.exp(-((wave / slope / (width * unit)) ** 2)), np.float32)

    shade = 1.0 + 0.06 * noise_field(shape, 160 * unit, rng) + 0.025 * noise_field(shape, 40 * unit, rng)
    shade = shade + 0.012 * noise_field(shape, 8 * unit, rng)
    colour = np.array([0.80, 0.58, 0.46], np.float32) * shade[..., None]
    patchy = 1 / (1 + np.exp(-3 * noise_field(shape, 120 * unit, rng)))
    for alpha, tint in (
        (0.55 * patchy * line(60, 1.6), (0.72, 0.26, 0.20)),
        (0.75 * line(130, 3.2), (0.66, 0.17, 0.14)),
        (0.85 * line(330, 9.0), (0.36, 0.27, 0.40)),
    ):
        colour = colour + alpha[..., None] * (np.array(tint, np.float32) - colour)
    return np.asarray(cv2.GaussianBlur(np.clip(colour, 0, 1), (0, 0), 0.9), np.float32)


def pull_field(recipe: Recipe) -> Map:
    """Displacement of a surface pulled at its centre, (H, W, 2) px at the rest frame's pixels.

    Outside the contact it decreases as under a point load on an elastic half-space (1/r, Boussinesq), inside
    it is level; it contracts towards the contact and vanishes at the rim.
    """
    y, x = np.mgrid[: recipe.size, : recipe.size].astype(np.float64)
    centre = 0.5 * (recipe.size - 1) + 0.06 * recipe.size * np.array([-1.0, 0.5])
    dx, dy = x - centre[0], y - centre[1]
    radius = np.hypot(dx, dy)
    dimple = recipe.reach * recipe.size
    rim = np.clip((0.5 * recipe.size - np.hypot(x - x.mean(), y - y.mean())) / (0.2 * recipe.size), 0, 1)
    hold = rim**2 * (3 - 2 * rim)
    pull = hold / np.sqrt(1 + (radius / dimple) ** 2)
    pinch = -0.25 * hold * np.exp(-((radius / (1.3 * dimple)) ** 2)) / dimple
    u = pull * np.cos(recipe.direction) + pinch * dx
    v = pull * np.sin(recipe.direction) + pinch * dy
    return np.asarray(np.stack([u, v], -1) * (recipe.pull / np.hypot(u, v).max()), np.float32)


def pixels(height: int, width: int) -> Map:
    """Coordinates (x, y) of pixel centres, (H, W, 2)."""
    return np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(np.float32)


def inverse(flow: Map) -> Map:
    """Position x in the rest frame of each pixel y, x + u(x) = y, by fixed-point iteration. (H, W, 2) px."""
    grid = source = pixels(*flow.shape[:2])
    for _ in range(60):
        before = source
        source = grid - np.stack([sample(flow[..., c], source, order=1) for c in range(2)], -1)
        if np.abs(source - before).max() < 1e-3:
            break
    return source


def inside(flow: Map) -> Mask:
    """Pixels (H, W) of the rest frame that stay in the image under a flow (H, W, 2) px."""
    points = pixels(*flow.shape[:2]) + flow
    return np.asarray(np.all((points >= 0) & (points <= np.array(flow.shape[1::-1]) - 1), axis=-1))


def at_rest(mask: Mask, flow: Map) -> Map:
    """A mask (H, W) of the current frame on the rest frame's pixels, 0..1, by a flow (H, W, 2) px."""
    points = pixels(*mask.shape) + flow
    return np.asarray(cv2.remap(mask.astype(np.float32), points[..., 0], points[..., 1], cv2.INTER_LINEAR))


def dilate(mask: Mask, side: int) -> Mask:
    """A mask (H, W) dilated by a square of `side` px."""
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def add_noise(picture: Map, noise: float, rng: np.random.Generator) -> Pixels:
    """A picture of 0..255 with Gaussian noise of a standard deviation [grey levels]."""
    return np.clip(np.round(picture + rng.normal(0, noise, picture.shape)), 0, 255).astype(np.uint8)


def resample(picture: Map, points: Map) -> Map:
    """A picture (2H, 2W, 3), two samples a pixel, at places (..., 2) px by cubic splines: (..., 3)."""
    samples = (points + 0.5) * _FINE - 0.5
    return np.stack([sample(picture[..., c], samples) for c in range(3)], -1)


def sample(field: Map, points: Map, order: int = 3) -> Map:
    """Field (H, W) at points (x, y), (..., 2), by cubic splines.

    OpenCV's remap rounds to 1/32 px and its bicubic kernel displaces a ramp by up to 0.05 px: too much for a
    ground truth.
    """
    return np.asarray(
        map_coordinates(field, (points[..., 1], points[..., 0]), order=order, mode="mirror"), np.float32
    )


@dataclass(frozen=True)
class Stage:
    """One surface under one light, which yields any frame of a pull."""

    recipe: Recipe
    albedo: Map  # (2H, 2W, 3), in 0..1
    wet: Map  # (H, W) field whose high values are highlights
    drift: Map  # (H, W) change of `wet` as the surface tilts
    field: Map = field(repr=False)  # (H, W, 2) px: displacement at full pull

    @classmethod
    def set(cls, recipe: Recipe, rng: np.random.Generator) -> Stage:
        """Draws the surface and its highlights."""
        albedo = cortex(_FINE * recipe.size, rng)
        mean = albedo.mean(axis=(0, 1))
        albedo = mean + recipe.contrast * (albedo - mean)
        size, unit = (recipe.size, recipe.size), recipe.size / 224
        wet = noise_field(size, 14 * unit, rng) + 1.2 * noise_field(size, 70 * unit, rng)
        return cls(recipe, albedo, wet, noise_field(size, 40 * unit, rng), pull_field(recipe))

    def rest(self, rng: np.random.Generator) -> tuple[Pixels, Mask]:
        """The rest frame and its highlights: (H, W, 3) uint8, (H, W) bool."""
        grid = pixels(self.recipe.size, self.recipe.size)
        picture, glare = self._light(resample(self.albedo, grid), self.wet, 0.0)
        return add_noise(255 * picture, self.recipe.noise, rng), glare

    def against(self, rest: tuple[Pixels, Mask], share: float, rng: np.random.Generator) -> Pair:
        """The rest frame and the frame at `share` of the full pull."""
        recipe = self.recipe
        flow = np.asarray(share * self.field, np.float32)
        source = inverse(flow)
        # Highlights depend on light and slope: they stay nearly in place as the surface moves.
        picture, glare = self._light(
            resample(self.albedo, source), self.wet + 0.5 * share * self.drift, share
        )
        if recipe.blur > 0:
            picture = cv2.GaussianBlur(picture, (0, 0), recipe.blur)
        tool = self._tool(share)
        picture = np.where(tool[..., None], _metal(picture.shape[:2]), picture)
        soft = cv2.GaussianBlur(tool.astype(np.float32), (0, 0), 0.6)[..., None]
        picture = picture + np.where(tool[..., None], 0, soft * (0.1 - picture))
        tool, in_view = dilate(tool, 3), inside(flow)
        length = np.hypot(self.field[..., 0], self.field[..., 1])
        return Pair(
            rest=rest[0],
            now=add_noise(255 * picture, recipe.noise, rng),
            flow=flow,
            rest_usable=~rest[1],
            now_usable=~(tool | glare),
            hidden=(at_rest(tool, flow) > 0.5) & in_view,
            contact=(length > 0.7 * length.max()) & in_view,
            inside=in_view,
        )

    def _light(self, albedo: Map, wet: Map, share: float) -> tuple[Map, Mask]:
        recipe = self.recipe
        ramp = np.linspace(-1, 1, recipe.size, dtype=np.float32)
        change = recipe.illumination * share
        picture = albedo * (1 + change * ramp[None, :, None] + 0.5 * change * ramp[:, None, None])
        if recipe.highlights <= 0:
            return picture, np.zeros(wet.shape, bool)
        level = np.quantile(self.wet, 1 - recipe.highlights)
        strength = np.clip((wet - level) / 0.25 + 0.5, 0, 1)[..., None]
        return np.asarray(picture + strength * (1.05 - picture), np.float32), strength[..., 0] > 0.12

    def _tool(self, share: float) -> Mask:
        """Mask of two branches from the lower right to the contact, which they follow."""
        recipe = self.recipe
        mask = np.zeros((recipe.size, recipe.size), np.uint8)
        if recipe.tool <= 0:
            return mask.astype(bool)
        middle = np.unravel_index(np.argmax(np.hypot(*np.moveaxis(self.field, -1, 0))), mask.shape)
        tip = np.array([middle[1], middle[0]], float) + share * self.field[middle]
        for angle, side in ((0.35, -1), (0.75, 1)):
            normal = np.array([-np.sin(angle), np.cos(angle)])
            axis = np.array([np.cos(angle), np.sin(angle)])
            start = tip + 0.35 * side * recipe.tool * normal
            end = start + 2 * recipe.size * axis
            sharp = 0.5 * recipe.tool * normal
            outline = np.array([start - 0.5 * sharp, start + 0.5 * sharp, end + sharp, end - sharp])
            cv2.fillConvexPoly(mask, np.round(outline * 16).astype(np.int32), 1, shift=4)
        return mask.astype(bool)


def pairs(recipe: Recipe, count: int, seed: int) -> Iterator[Pair]:
    """`count` independent pairs with different surfaces and directions of pull."""
    for rng in (np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(count)):
        variant = replace(recipe, direction=float(rng.uniform(0, 2 * np.pi)))
        stage = Stage.set(variant, rng)
        yield stage.against(stage.rest(rng), 1.0, rng)


def _metal(shape: tuple[int, int]) -> Map:
    """Dull grey steel, (H, W, 3) in 0..1; bright lines along the branches would be easier to detect."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    sheen = 0.32 + 0.12 * np.sin(0.35 * (y - 0.6 * x)) + 0.05 * np.sin(0.11 * (x + y))
    return np.asarray(sheen[..., None] * np.array([0.95, 1.0, 1.05]), np.float32)
