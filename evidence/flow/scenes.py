"""Videos and pairs with motion in closed form, on pictures not made by this project's renderer.

Photographs included in scikit-image, drawn phantoms and a drawn cortex are warped by an analytic field;
tools, lamps, highlights, endoscopes, compression and camera faults are drawn over them. Nothing is shared
with `synth.render`. Photographs of the half `tuning` also train the networks of recovered motion (`weights`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
from scipy.ndimage import map_coordinates, spline_filter
from skimage import data as photographs  # type: ignore[import-not-found, unused-ignore]

from synth.arrays import Array, Floats, Map, Mask, Pixels

_FINE = 2  # samples of the source a pixel
_RIM = 9  # px: masks are dilated by this square, so that soft rims and shadow edges are left out
_MARGIN = 24  # px of the source beyond the image, which motion may bring into view
_PHOTOGRAPHS = (
    "astronaut", "brick", "camera", "cell", "chelsea", "coffee", "coins", "grass", "gravel",
    "hubble_deep_field", "immunohistochemistry", "moon", "retina", "rocket",
)  # fmt: skip
_DRAWN = ("dots", "speckle", "white", "grey", "dark", "tubes")
_TOOLS = {
    "steel": (0.55, 0.57, 0.60),
    "gold": (0.80, 0.62, 0.25),
    "black": (0.06, 0.06, 0.07),
    "blue": (0.10, 0.25, 0.70),
    "white plastic": (0.92, 0.92, 0.90),
    "gloved finger": (0.86, 0.80, 0.66),
}
_MOTIONS = ("pull", "press", "press from behind", "shift", "twist")
_LAMPS = {"white": (1.0, 1.0, 1.0), "warm": (1.1, 0.9, 0.62), "cold": (0.8, 0.95, 1.15)}
_FAULTS = ("doubled", "dropped", "black", "defocus", "covered", "jump")
HALVES = ("tuning", "reporting")
"""Even scenes and even photographs (in alphabetical order) are tuned on, odd ones are reported."""


@dataclass(frozen=True)
class Recipe:
    """One video or pair; the defaults are those of pairs: a pull under a tool on a drawn cortex."""

    index: int = 0
    surface: str = "drawn cortex"
    tool: str = "steel"  # its colour; empty: none
    tool_at_rest: bool = False  # whether the tool is in the rest frame, next to the contact
    motion: str = "pull"
    peak_px: float = 10.0  # largest displacement: of a pair, and of a video 192 px wide
    lamp: str = "white"
    glare: float = 0.06  # share of the image in highlights
    scope: bool = False  # whether the image is round, as an endoscope's
    mono: bool = False
    quality: int = 0  # of JPEG; 0: not compressed
    noise: float = 1.5  # grey levels
    faults: tuple[str, ...] = ()
    reach: float = 0.14  # radius of the moved part as a share of the width; 0: drawn at random
    slope: float = 0.95  # largest gradient of the motion, which is scaled down to it
    tool_width: float = 0.1  # as a share of the image's
    contrast: float = 1.0  # factor on the surface's contrast
    illumination: float = 0.1  # largest relative change of brightness, with an equal gradient over the image
    bulge: float = 0.0  # relative brightening at the contact


CLEAN = Recipe(tool="", glare=0.0, illumination=0.0, noise=0.0)  # nothing but motion


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame and its ground truth."""

    rgb: Pixels
    flow: Map  # (H, W, 2) px from the rest frame, on its pixels
    visible: Mask  # (H, W) on the rest frame's pixels: unobstructed tissue in both images
    free: Mask  # (H, W) on this frame's pixels: tissue away from tool and highlights
    tool: Mask  # (H, W) on this frame's pixels
    glare: Mask  # (H, W) likewise: highlights
    amplitude: float  # share of the full motion
    fault: str


@dataclass(frozen=True, eq=False)
class Pair:
    """Two images and their ground truth, on the rest frame's pixels unless stated otherwise."""

    rest: Pixels  # (H, W, 3) uint8, without tool
    now: Pixels  # (H, W, 3) uint8
    flow: Map  # (H, W, 2) px, rest to now
    rest_usable: Mask  # (H, W): no highlight in the rest frame
    now_usable: Mask  # (H, W), on the current frame's pixels: neither tool nor highlight
    hidden: Mask  # (H, W): material points under the tool in the current frame, inside the image
    contact: Mask  # (H, W): where the motion exceeds 70% of its peak
    inside: Mask  # (H, W): material points inside the current image

    @classmethod
    def of(cls, rest: Frame, now: Frame) -> Pair:
        """Two frames of a video."""
        tool, in_view = dilate(now.tool, 3), inside(now.flow)
        length = np.linalg.norm(now.flow, axis=-1)
        return cls(
            rest=rest.rgb,
            now=now.rgb,
            flow=now.flow,
            rest_usable=~rest.glare,
            now_usable=~(tool | now.glare),
            hidden=(warp_to_rest(tool, now.flow) > 0.5) & in_view,
            contact=(length > 0.7 * length.max()) & in_view,
            inside=in_view,
        )


def pairs(recipe: Recipe, count: int, seed: int, size: int = 224) -> Iterator[Pair]:
    """`count` independent pairs of `size` px with different surfaces and directions of the motion."""
    for rng in (np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(count)):
        stage = Stage(replace(recipe, peak_px=recipe.peak_px * 192 / size), size, rng)
        yield Pair.of(stage.shoot(0.0, "", rng), stage.shoot(1.0, "", rng))


def recipes(half: str, count: int, first: int = 0) -> list[Recipe]:
    """`count` videos of a half (one of `HALVES`) after the `first` ones; each depends on its number alone."""
    side = HALVES.index(half)
    surfaces = [*(f"drawn {name}" for name in _DRAWN), *_PHOTOGRAPHS[side::2]]
    return [_recipe(2 * k + side, surfaces) for k in range(first, first + count)]


def _recipe(index: int, surfaces: list[str]) -> Recipe:
    rng = np.random.default_rng([1804, index])
    number = index // 2
    draws = rng.random(8)
    return Recipe(
        index=index,
        # In turn, so that few videos contain all surfaces and tools; 3 and 7 are coprime.
        surface=surfaces[number % len(surfaces)],
        tool=["", *_TOOLS][(3 * number + number // 7) % 7],
        tool_at_rest=bool(draws[0] < 0.25),
        motion=_MOTIONS[(2 * number + number // 5) % 5],
        peak_px=float(np.exp(rng.uniform(np.log(1.5), np.log(10)))),
        lamp=list(_LAMPS)[int(rng.choice(3, p=[0.6, 0.25, 0.15]))],
        glare=float(rng.uniform(0.01, 0.08)) if draws[1] < 0.35 else 0.0,
        scope=bool(draws[2] < 0.2),
        mono=bool(draws[3] < 0.2),
        quality=int(rng.choice([0, 95, 75, 40])),
        noise=float(rng.choice([0.5, 1.5, 4.0])),
        faults=tuple(name for name in _FAULTS if rng.random() < 0.22),
        reach=0.0,
        slope=0.5,
        tool_width=0.09,
        illumination=0.0,
        bulge=0.08,
    )


def _surface(name: str, size: int, rng: np.random.Generator) -> Map:
    """Cubic-spline coefficients (3, N, N) of a low-pass filtered image, `_FINE` samples a pixel, of
    (size + 2 margins) px a side."""
    fine = _FINE * (size + 2 * _MARGIN)
    picture = _draw_phantom(name[6:], fine, rng) if name.startswith("drawn ") else _photograph(name, fine)
    picture = cv2.GaussianBlur(picture, (0, 0), 0.55 * _FINE)
    return np.stack([spline_filter(picture[..., c], 3, np.float32, "mirror") for c in range(3)])


@cache
def photographs_of(half: str, side: int) -> list[Map]:
    """Photographs (side, side, 3) float32 of 0..255 of a half."""
    return [255 * _photograph(name, side) for name in _PHOTOGRAPHS[HALVES.index(half) :: 2]]


def _photograph(name: str, fine: int) -> Map:
    picture = np.asarray(getattr(photographs, name)())
    picture = np.repeat(picture[..., None], 3, -1) if picture.ndim == 2 else picture[..., :3]
    side = min(picture.shape[:2])
    top, left = (picture.shape[0] - side) // 2, (picture.shape[1] - side) // 2
    square = picture[top : top + side, left : left + side].astype(np.float32)
    square = square / (255 if picture.dtype == np.uint8 else max(float(square.max()), 1.0))
    interpolation = cv2.INTER_AREA if side > fine else cv2.INTER_CUBIC
    return np.asarray(
        np.clip(cv2.resize(square, (fine, fine), interpolation=interpolation), 0, 1), np.float32
    )


def _draw_phantom(name: str, fine: int, rng: np.random.Generator) -> Map:
    """Image of a phantom, (fine, fine, 3) in 0..1."""
    shape = (fine, fine)
    paper = 1 + 0.02 * noise_field(shape, 60, rng)
    if name == "cortex":
        return cortex(fine, rng, fine / _FINE - 2 * _MARGIN)
    if name == "dots":  # dark dots on a light silicone membrane, or white ones on a dark one
        light, ink = ((0.82, 0.80, 0.74), 0.10) if rng.random() < 0.5 else ((0.14, 0.13, 0.13), 0.95)
        return _blend(
            np.array(light) * paper[..., None], _draw_dots(fine, rng, 16 * _FINE / 2, 3.0 * _FINE), ink
        )
    if name == "speckle":
        grains = (noise_field(shape, 3.2 * _FINE, rng) > 0.1).astype(np.float32)
        grains = cv2.GaussianBlur(grains, (0, 0), 0.4 * _FINE)
        return np.repeat((0.12 + 0.72 * grains)[..., None], 3, -1)
    if name == "tubes":  # red and blue tubes below a pink gel
        wave = noise_field(shape, 60 * _FINE, rng)
        line = np.exp(-((wave / (np.hypot(*np.gradient(wave)) + 1e-3) / (2.5 * _FINE)) ** 2))[..., None]
        fine_noise = 0.02 * noise_field(shape, 6 * _FINE, rng)[..., None]
        gel = np.array([0.85, 0.62, 0.58]) * paper[..., None]
        hue = np.where(noise_field(shape, 150 * _FINE, rng)[..., None] > 0, (0.6, 0.1, 0.1), (0.2, 0.2, 0.5))
        return np.asarray(np.clip(gel + 0.8 * line * (hue - gel) + fine_noise, 0, 1), np.float32)
    level = {"white": 0.93, "grey": 0.5, "dark": 0.13}[name]
    grain = 0.25 * min(level, 1 - level) + 0.02
    noise = noise_field(shape, 5 * _FINE, rng) + noise_field(shape, 24 * _FINE, rng)
    body = level * paper + 0.5 * grain * noise
    picture = np.repeat(body[..., None], 3, -1) * np.array([1.0, 0.99, 0.97])
    marks = _draw_dots(fine, rng, 22 * _FINE, 1.5 * _FINE)
    return _blend(picture, 0.7 * marks, 0.25 if level > 0.4 else 0.45)


def _draw_dots(fine: int, rng: np.random.Generator, spacing: float, radius: float) -> Map:
    """Coverage in 0..1 by discs on a jittered grid, (fine, fine)."""
    cover = np.zeros((fine, fine), np.uint8)
    line = np.arange(0, fine, spacing)
    for corner in np.stack(np.meshgrid(line, line), -1).reshape(-1, 2):
        centre = 16 * (corner + rng.uniform(-0.3, 0.3, 2) * spacing)
        cv2.circle(cover, tuple(centre.astype(int).tolist()), int(16 * radius), 255, -1, cv2.LINE_AA, 4)
    return np.asarray(cover / 255, np.float32)


def _blend(picture: Array, cover: Map, ink: float) -> Map:
    return np.asarray(np.clip(picture + cover[..., None] * (ink - picture), 0, 1), np.float32)


@dataclass(frozen=True, eq=False)
class Field:
    """A motion in closed form whose largest displacement is 1 px."""

    motion: str
    centre: Floats  # (2,) px
    radius: float  # px
    direction: Floats  # (2,) unit vector

    @classmethod
    def draw(cls, motion: str, size: int, rng: np.random.Generator, reach: float = 0.0) -> Field:
        """A random field of a kind, near the centre of the image; `reach`: see `Recipe`."""
        centre = size * np.array([rng.uniform(0.38, 0.62), rng.uniform(0.38, 0.62)])
        radius, turn = size * rng.uniform(0.16, 0.26), rng.uniform(0, 2 * np.pi)
        return cls(motion, centre, reach * size or radius, np.array([np.cos(turn), np.sin(turn)]))

    def at(self, place: Map) -> Map:
        """Displacement (..., 2) px at places (..., 2) px."""
        offset = place - self.centre
        square = (offset**2).sum(-1, keepdims=True) / self.radius**2
        if self.motion == "shift":
            return np.asarray(np.broadcast_to(self.direction, place.shape), np.float32)
        if self.motion == "pull":  # as under a point load on a half-space, level within the contact
            return np.asarray(self.direction * np.exp(-square / 16) / np.sqrt(1 + square), np.float32)
        # r exp(-r²/2R²) is largest at R, where it is R exp(-1/2).
        radial = offset / self.radius * np.exp(0.5 - 0.5 * square)
        if self.motion == "twist":
            return np.asarray(np.stack([-radial[..., 1], radial[..., 0]], -1), np.float32)
        return np.asarray(radial if self.motion == "press from behind" else -radial, np.float32)


def video(recipe: Recipe, size: int = 192, frames: int = 16) -> Iterator[Frame]:
    """Frames of a recipe, the rest frame first."""
    rng = np.random.default_rng([1805, recipe.index])
    stage = Stage(recipe, size, rng)
    for amplitude, fault in _plan(recipe, frames, rng):
        yield stage.shoot(amplitude, fault, rng)


def _plan(recipe: Recipe, frames: int, rng: np.random.Generator) -> list[tuple[float, str]]:
    """Amplitude and fault of each frame: a press and a weaker one, at rest before and between them."""
    t = np.linspace(0, 1, frames)
    curve = np.where(t < 0.55, np.sin(np.pi * t / 0.55) ** 2, 0.7 * np.sin(np.pi * (t - 0.55) / 0.45) ** 2)
    plan = [(a, "") for a in curve.tolist()]
    places = rng.permutation(np.arange(2, frames))[: len(recipe.faults)]
    for place, name in zip(places.tolist(), recipe.faults, strict=False):
        if name == "dropped":
            plan[place:-1] = plan[place + 1 :]
            plan[-1] = (float(curve[-1]), "")
        else:
            plan[place] = (plan[place - (name == "doubled")][0], name)
    return plan


class Stage:
    """The constant part of a video."""

    def __init__(self, recipe: Recipe, size: int, rng: np.random.Generator) -> None:
        self.recipe, self.size, shape = recipe, size, (size, size)
        self.skin = _surface(recipe.surface, size, rng)
        self.field = Field.draw(recipe.motion, size, rng, recipe.reach)
        if recipe.contrast != 1:
            mean = self.skin.mean((1, 2), keepdims=True)
            self.skin = mean + recipe.contrast * (self.skin - mean)
        slopes = np.gradient(self.field.at(pixels(size, size)), axis=(0, 1))
        steepest = max(1e-6, *(float(np.abs(slope).max()) for slope in slopes))
        self.peak_px = min(recipe.peak_px, recipe.slope / steepest) * size / 192
        # High values of `wet` are highlights; `drift` is their change with the surface's tilt.
        self.wet = noise_field(shape, size / 14, rng) + noise_field(shape, size / 4, rng)
        self.drift, self.angle = noise_field(shape, size / 5, rng), rng.uniform(0, 2 * np.pi)
        blank = np.zeros((*shape, 3), np.float32)
        glare, tool = self._shine(blank, 0.0)[1], self._tool(blank, 0.0, blank[..., :2])[1]
        self.rest_blocked = dilate(glare | tool, _RIM)

    def shoot(self, amplitude: float, fault: str, rng: np.random.Generator) -> Frame:
        """One frame."""
        size, recipe, lamp = self.size, self.recipe, np.array(_LAMPS[self.recipe.lamp])
        grid = pixels(size, size)
        jump = np.array([18.0, -11.0]) * size / 192 if fault == "jump" else np.zeros(2)

        def displace(points: Map) -> Map:
            return np.asarray(amplitude * self.peak_px * self.field.at(points) + jump, np.float32)

        source = grid
        # s = y - u(s): a contraction, as |grad u| < 1; float32 is too coarse to come closer than 1e-4 px.
        iterations, tolerance = (40, 0.0) if recipe.slope <= 0.5 else (400, 1e-4)
        for _ in range(iterations):
            previous, source = source, grid - displace(source)
            if np.abs(source - previous).max() <= tolerance:
                break
        flow = displace(grid)
        coordinates = [(source[..., k] + _MARGIN + 0.5) * _FINE - 0.5 for k in (1, 0)]
        skin = [map_coordinates(c, coordinates, order=3, mode="mirror", prefilter=False) for c in self.skin]
        bulge = 1 + recipe.bulge * amplitude * np.exp(
            -((grid - self.field.centre) ** 2).sum(-1) / (0.3 * size) ** 2
        )
        picture, glare = self._shine(np.stack(skin, -1) * bulge[..., None] * lamp, amplitude)
        if recipe.illumination:
            ramp = np.linspace(-1, 1, size, dtype=np.float32)
            change = recipe.illumination * amplitude
            light = 1 + change * (ramp + 0.5 * ramp[:, None])[..., None]
            picture = np.asarray(picture * light, np.float32)
        picture, tool = self._tool(picture, amplitude, flow)
        scope, cover = np.ones((size, size), bool), np.zeros((size, size), bool)
        if recipe.scope:
            scope = np.linalg.norm(grid - size / 2, axis=-1) < 0.48 * size
            picture = np.where(scope[..., None], picture, 0.01)
        if fault == "covered":
            cover[:, : int(0.9 * size)] = True
            picture = np.where(cover[..., None], (0.7, 0.68, 0.66), picture)
        if fault == "black":
            picture = np.zeros_like(picture)
        if fault == "defocus":
            picture = cv2.GaussianBlur(picture, (0, 0), 0.03 * size)
        picture = picture.mean(-1, keepdims=True) if recipe.mono else picture
        rgb = add_noise(255 * np.asarray(picture, np.float32), recipe.noise, rng)
        rgb = jpeg(np.repeat(rgb, 3 // rgb.shape[-1], -1), recipe.quality)
        free = scope & ~dilate(glare | tool, _RIM) & ~cover
        visible = (warp_to_rest(free, flow) > 0.99) & scope & ~self.rest_blocked
        return Frame(rgb, flow, visible, free, tool, glare, amplitude, fault)

    def _shine(self, picture: Map, amplitude: float) -> tuple[Map, Mask]:
        """The image with highlights, which stay with the light, and their mask."""
        if self.recipe.glare <= 0:
            return picture, np.zeros(picture.shape[:2], bool)
        level = np.quantile(self.wet, 1 - self.recipe.glare)
        now = self.wet + 0.3 * amplitude * self.drift
        strength = np.clip((now - level) / 0.2 + 0.5, 0, 1)[..., None]
        lit = picture + strength * (1.08 * np.array(_LAMPS[self.recipe.lamp]) - picture)
        return np.asarray(lit, np.float32), strength[..., 0] > 0.1

    def _tool(self, picture: Map, amplitude: float, flow: Map) -> tuple[Map, Mask]:
        """The image with a shaft from the border to the moving contact, and its mask; retracted at rest."""
        recipe, size = self.recipe, self.size
        mask = np.zeros((size, size), np.uint8)
        if not recipe.tool or (recipe.motion == "press from behind" and not recipe.tool_at_rest):
            return picture, mask.astype(bool)
        shaft = np.array([np.cos(self.angle), np.sin(self.angle)])
        centre, is_touching = self.field.centre, amplitude > 0.02
        row, column = np.clip(centre[::-1].round().astype(int), 0, size - 1)
        distance = 0.0 if is_touching else (0.12 if recipe.tool_at_rest else 1.2) * size
        if recipe.motion == "press from behind":
            distance = 0.15 * size  # stays in one place next to the contact
        tip = centre + (flow[row, column] if is_touching else 0) + distance * shaft
        finger = recipe.tool == "gloved finger"
        width = size * (0.22 if finger else recipe.tool_width)
        end = tip + 2 * size * shaft
        if finger:
            points = [tuple((16 * p).round().astype(int).tolist()) for p in (tip, end)]
            cv2.line(mask, points[0], points[1], 1, round(width), cv2.LINE_8, 4)
        else:
            side = np.array([-shaft[1], shaft[0]])
            neck, half = tip + width * shaft, 0.5 * width * side
            outline = [tip - 0.24 * half, tip + 0.24 * half, neck + half, end + half, end - half, neck - half]
            cv2.fillConvexPoly(mask, np.round(16 * np.array(outline)).astype(np.int32), 1, cv2.LINE_8, 4)
        from_tip = pixels(size, size) - tip.astype(np.float64)
        across = (from_tip @ np.array([-shaft[1], shaft[0]])) / (width / 2)
        along = from_tip @ shaft
        shade = 1 - 0.45 * np.clip(np.abs(across), 0, 1) ** 2
        if recipe.tool in ("steel", "gold", "black"):
            shade = shade + 0.35 * np.exp(-(((across - 0.3) / 0.12) ** 2))
        if recipe.tool in ("steel", "blue"):
            shade = shade * np.where((along / size * 10) % 3 < 0.3, 0.6, 1.0)
        colour = shade[..., None] * np.array(_TOOLS[recipe.tool]) * np.array(_LAMPS[recipe.lamp])
        soft = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 0.7)[..., None]
        shadow = 1 - 0.25 * cv2.GaussianBlur(np.roll(mask, 4, 0).astype(np.float32), (0, 0), 3)[..., None]
        lit = picture * shadow * (1 - soft) + soft * colour
        return np.asarray(lit, np.float32), mask.astype(bool)


def noise_field(shape: tuple[int, int], period: float, rng: np.random.Generator) -> Map:
    """Smooth noise of zero mean and unit deviation with features about `period` samples apart, (H, W)."""
    white = rng.standard_normal(shape)
    fy = np.fft.fftfreq(shape[0])[:, None]
    fx = np.fft.rfftfreq(shape[1])[None]
    radius = np.hypot(fy, fx) * period
    smooth = np.fft.irfft2(np.fft.rfft2(white) * radius * np.exp(-(radius**2)), shape)
    return np.asarray((smooth - smooth.mean()) / smooth.std(), np.float32)


def cortex(size: int, rng: np.random.Generator, across: float = 0) -> Map:
    """Albedo like an exposed cortex: parenchyma, arteries, fine vessels and a vein; (size, size, 3) in 0..1.

    `across`: pixels of an image that shows this at two samples a pixel, which sets the scale; 0: `size` / 2.

    Vessels are the zero lines of smooth noise. They are not anatomical, but the image has the gradients, the
    textureless patches and the aperture problems that matter to flow.
    """
    shape = (size, size)
    unit = (across or size / 2) / 224

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


def pixels(height: int, width: int) -> Map:
    """Coordinates (x, y) of pixel centres, (H, W, 2)."""
    return np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(np.float32)


def inverse(flow: Map) -> Map:
    """Position x in the rest frame of each pixel y, x + u(x) = y, by fixed-point iteration. (H, W, 2) px."""
    grid = source = pixels(*flow.shape[:2])
    for _ in range(60):
        previous = source
        source = grid - np.stack([sample(flow[..., c], source, order=1) for c in range(2)], -1)
        if np.abs(source - previous).max() < 1e-3:
            break
    return source


def inside(flow: Map) -> Mask:
    """Pixels (H, W) of the rest frame that stay in the image under a flow (H, W, 2) px."""
    points = pixels(*flow.shape[:2]) + flow
    return np.asarray(np.all((points >= 0) & (points <= np.array(flow.shape[1::-1]) - 1), axis=-1))


def warp_to_rest(mask: Mask, flow: Map) -> Map:
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
    coordinates = (points + 0.5) * _FINE - 0.5
    return np.stack([sample(picture[..., c], coordinates) for c in range(3)], -1)


def sample(field: Map, points: Map, order: int = 3) -> Map:
    """Field (H, W) at points (x, y), (..., 2), by cubic splines.

    OpenCV's remap rounds to 1/32 px and its bicubic kernel displaces a ramp by up to 0.05 px: too much for a
    ground truth.
    """
    return np.asarray(
        map_coordinates(field, (points[..., 1], points[..., 0]), order=order, mode="mirror"), np.float32
    )


def jpeg(rgb: Pixels, quality: int) -> Pixels:
    """The image after JPEG compression; quality 0: unchanged."""
    if not quality:
        return rgb
    _, encoded = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.ascontiguousarray(np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR), np.uint8)[..., ::-1])
