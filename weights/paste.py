"""Instruments and other objects, shadows and highlights drawn over pictures, with exact masks.

For training of the segmentation by cut and paste (D. Dwibedi et al., "Cut, paste and learn", ICCV 2017): what
they look like matters less than that they are of every shape, colour and sharpness. Polished metal needs more
care: it mirrors dark surroundings and lamps, and at its rims and tip the tissue, into which it fades.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from evidence.flow.scenes import noise_field
from synth.arrays import Floats, Map

Outline = tuple[str, Floats, float]
_WIDE = 0.15  # share of the picture's width beyond which an object is no instrument
_POLISHED = 0.6  # chance that an instrument mirrors
# Share of each colour that steel, gold, black, blue and titanium mirror, and how often they are drawn.
_METALS = np.array([[1, 1, 1], [1, 0.78, 0.4], [0.25, 0.25, 0.27], [0.5, 0.65, 1.1], [1.05, 0.8, 0.95]])
_OFTEN = 0.6, 0.1, 0.1, 0.1, 0.1
_VESSELS = np.array(
    [[45, 65, 120], [95, 50, 100], [120, 40, 45], [125, 130, 140], [185, 165, 160]]
)  # grey levels
_SIDE = 65  # of the map of a mirror's surroundings


@dataclass(frozen=True, eq=False)
class Layer:
    """A picture (H, W, 3) of 0..255 and the share (H, W) of each class at its pixels."""

    picture: Map
    instrument: Map
    shadow: Map
    highlight: Map

    @classmethod
    def of(cls, picture: Map) -> Layer:
        """A picture that shows nothing but tissue."""
        nothing = np.zeros(picture.shape[:2], np.float32)
        return cls(np.asarray(picture, np.float32), nothing, nothing, nothing)


@dataclass(frozen=True, eq=False)
class Mirror:
    """What polished metal shows: surroundings by its slope, and the tissue next to it."""

    metal: Floats  # (3,) share of the light that it mirrors
    surroundings: Map  # (_SIDE, _SIDE, 3) grey levels by the slopes along y and x, each -1 to 1
    fade: float  # share of the surroundings' light that is left far from the tip
    edge: float  # slope from which it mirrors tissue
    blend: float  # range of slopes over which this begins
    near: float  # picture widths from the tip over which all of it mirrors tissue
    reach: float  # how far away this tissue is, in picture widths
    rough: float  # picture widths over which it is smeared


@dataclass(frozen=True, eq=False)
class Sprite:
    """An object to be drawn: its outline at any place, and its surface."""

    outlines: tuple[Outline, ...]  # kind, points (N, 2), width; in picture widths
    colour: Floats  # (3,) grey levels
    texture: Map | None  # (H, W, 3) grey levels that replaces the colour
    round: float  # darkening towards the edges
    shine: float  # grey levels of the bright line along the body
    soft_px: float  # defocus
    shades: tuple[tuple[Floats, float, float], ...]  # of its shadows: offset, blur [picture widths], strength
    mirror: Mirror | None = None  # replaces the colour and the texture
    details: tuple[tuple[Outline, float], ...] = ()  # rings, sleeves and screws, and by how much brighter
    grain: Map | None = None  # (H, W) of mean 1: noise on it and on its shadows, as a path tracer leaves it


def draw_instrument(rng: np.random.Generator, picture: Map, other: Map) -> Sprite:
    """A random rod, tube, forceps, bayonet, spatula, hook or probe that enters from outside."""
    tip, turn = rng.uniform(0.15, 0.85, 2) * [1, 0.75], rng.uniform(0, 2 * np.pi)
    direction = np.array([np.cos(turn), np.sin(turn)])
    side = np.array([-direction[1], direction[0]])
    thickness, end = float(np.exp(rng.uniform(np.log(0.012), np.log(0.13)))), tip + 2.0 * direction
    kind = str(rng.choice(["rod", "rod", "taper", "forceps", "forceps", "bent", "spatula", "jointed"]))
    if kind == "rod":
        parts = [("line", np.stack([tip, end]), thickness)]
    elif kind == "taper":
        parts = [_taper(tip, direction, thickness, rng)]
    elif kind == "forceps":
        spread, tilt, thickness = rng.uniform(0.0, 0.16), rng.uniform(0, 0.25), min(thickness, 0.07)
        parts = []
        for sign in (-1, 1):
            arm = direction * np.cos(sign * tilt) + side * np.sin(sign * tilt)
            parts.append(_taper(tip + sign * spread / 2 * side, arm, thickness, rng))
    elif kind in ("bent", "jointed"):
        knee = tip + rng.uniform(0.08, 0.4) * (direction + rng.uniform(-1, 1) * side)
        t = np.linspace(0, 1, 24)[:, None]
        curve = (
            (1 - t) ** 2 * tip + 2 * t * (1 - t) * knee + t**2 * (knee + rng.uniform(0.1, 0.4) * direction)
        )
        line = np.stack([tip, knee]) if kind == "jointed" else curve
        parts = [
            ("line", line, thickness),
            ("line", np.stack([line[-1], line[-1] + 2 * direction]), thickness),
        ]
    else:
        blade = np.array([tip + rng.uniform(0.05, 0.2) * direction, tip])
        parts = [
            ("line", blade, thickness * rng.uniform(1.2, 2.5)),
            ("line", np.stack([blade[0], end]), thickness),
        ]
    sprite = _finish(parts, rng, picture, other)
    if rng.random() < 0.3:
        sprite = replace(sprite, details=_details(tip, direction, thickness, rng))
    if rng.random() < _POLISHED:
        noise = 1 + rng.uniform(0, 0.3) * rng.standard_normal(picture.shape[:2], np.float32)
        grain = np.asarray(noise, np.float32) if rng.random() < 0.5 else None
        sprite = replace(sprite, mirror=_polish(rng), grain=grain)
    return sprite


def draw_object(rng: np.random.Generator, picture: Map, other: Map) -> Sprite:
    """A random finger, hand, patty, cloth or drop, which is no instrument."""
    middle, turn = rng.uniform(0, 1, 2) * [1, 0.75], rng.uniform(0, 2 * np.pi)
    direction = np.array([np.cos(turn), np.sin(turn)])
    if rng.random() < 0.4:
        parts = [("line", np.stack([middle, middle + 2 * direction]), float(rng.uniform(_WIDE + 0.03, 0.35)))]
    else:
        angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
        size, waves = rng.uniform(0.04, 0.25), rng.normal(0, 0.12, (3, 2))
        radius = 1 + sum(a * np.cos((k + 2) * angle + b) for k, (a, b) in enumerate(waves))
        points = np.stack([radius * np.cos(angle), rng.uniform(0.4, 1) * radius * np.sin(angle)], 1)
        parts = [("area", middle + size * points @ np.stack([direction, [-direction[1], direction[0]]]), 0.0)]
    return _finish(parts, rng, picture, other)


def draw_marking(rng: np.random.Generator, picture: Map, other: Map) -> Sprite:
    """A random line, grid or patch of the tissue that looks like an object but moves with the tissue."""
    kind = rng.choice(["line", "grid", "patch"])
    sprite = (
        draw_object(rng, picture, other) if kind == "patch" else _lines(kind == "grid", rng, picture, other)
    )
    return replace(sprite, shades=()) if rng.random() < 0.7 else sprite


def _lines(grid: bool, rng: np.random.Generator, picture: Map, other: Map) -> Sprite:
    """A random winding line across the picture, or many side by side and perhaps as many across them."""
    turn, thickness = rng.uniform(0, 2 * np.pi), float(np.exp(rng.uniform(np.log(0.006), np.log(0.08))))
    direction, side = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    middle = rng.uniform(0, 1, 2) * [1, 0.75]
    t = np.linspace(-1.5, 1.5, 40)[:, None] if rng.random() < 0.7 else np.linspace(-0.3, 0.2, 20)[:, None]
    bend = rng.normal(0, 0.06) * np.sin(rng.uniform(2, 12) * t + rng.uniform(0, 6))
    gap = rng.uniform(2, 8) * thickness
    steps = gap * np.arange(-min(15, 0.5 / gap), min(15, 0.5 / gap)) if grid else np.zeros(1)
    parts = [("line", middle + t * direction + (bend + step) * side, thickness) for step in steps]
    if grid and rng.random() < 0.5:
        parts += [("line", middle + t * side + (bend + step) * direction, thickness) for step in steps]
    return _finish(parts, rng, picture, other)


def paste(layer: Layer, sprite: Sprite, shift: Floats) -> Layer:
    """A layer with an object moved by `shift` (2,) picture widths, and its shadows."""
    body = _cover(sprite.outlines, shift, layer.instrument.shape)
    picture, shadow = layer.picture, layer.shadow
    width = body.shape[1]
    grain = np.ones_like(body) if sprite.grain is None else sprite.grain
    for offset, blur, strength in sprite.shades:
        shade = _cover(sprite.outlines, shift + offset, body.shape)
        shade = strength * cv2.GaussianBlur(shade, (0, 0), max(0.3, blur * width))
        shade = np.clip(shade * grain, 0, 1)
        picture = picture * (1 - shade[..., None])
        shadow = np.maximum(shadow, shade)
    inner = _inner(body)
    shade = 1 - sprite.round * (1 - inner) ** 2
    line = np.exp(-(((inner - 0.7) / 0.12) ** 2))
    surface = sprite.colour if sprite.texture is None else sprite.texture
    surface = surface * shade[..., None] + sprite.shine * line[..., None]
    if sprite.mirror is not None:
        surface = _reflect(sprite, shift, picture, inner)
    for outline, brighter in sprite.details:
        surface = surface * (1 + brighter * _cover((outline,), shift, body.shape)[..., None])
    surface = surface * grain[..., None]
    soft = body if sprite.soft_px < 0.3 else cv2.GaussianBlur(body, (0, 0), sprite.soft_px)
    picture = picture * (1 - soft[..., None]) + surface * soft[..., None]
    free = 1 - body
    instrument = np.maximum(layer.instrument * free, body)
    return Layer(np.asarray(picture, np.float32), instrument, shadow * free, layer.highlight * free)


def add_highlights(layer: Layer, rng: np.random.Generator) -> Layer:
    """A layer with white spots, as of a wet surface."""
    shape = layer.instrument.shape
    if rng.random() < 0.5:
        period = float(np.exp(rng.uniform(np.log(6), np.log(40))))
        wet = noise_field(shape, period, rng) + noise_field(shape, 70, rng)
        share, edge = np.exp(rng.uniform(np.log(0.0005), np.log(0.06))), np.exp(rng.uniform(np.log(0.08), 0))
        strength = np.clip((wet - np.quantile(wet, 1 - share)) / edge + 0.5, 0, 1)
    else:  # single round ones
        across, centre = np.exp(rng.uniform(0.5, 2.3, (4, 1, 1))), rng.uniform(0, 1, (4, 2, 1, 1))
        offset = np.indices(shape) - centre * np.reshape(shape, (2, 1, 1))
        strength = np.exp(-(offset**2).sum(1) / (2 * across**2))[: rng.integers(1, 5)].max(0)
    strength = strength * (1 - layer.instrument)
    white = rng.uniform(225, 275) * (1 + rng.normal(0, 0.03, 3))
    lit = layer.picture + strength[..., None] * np.maximum(white - layer.picture, 0)
    highlight = np.maximum(layer.highlight, np.clip(2 * strength, 0, 1))
    return Layer(np.asarray(lit, np.float32), layer.instrument, layer.shadow, highlight)


def add_vessels(layer: Layer, rng: np.random.Generator) -> Layer:
    """A layer with thick round vessels of any colour that wind and cross; they are tissue."""
    shape = layer.instrument.shape
    picture, highlight = layer.picture, layer.highlight
    light, lit = rng.normal(size=2), rng.uniform(0, 0.5)
    light /= np.linalg.norm(light)
    hue = _vessel_colour(rng)
    for _ in range(int(rng.integers(1, 4))):
        if rng.random() < 0.3:
            hue = _vessel_colour(rng)
        thickness = float(np.exp(rng.uniform(np.log(0.025), np.log(0.13))))
        cover = _cover((_path(thickness, rng),), np.zeros(2), shape)
        inner = _inner(cover)
        slope = _slopes(inner)
        mottle = 1 + rng.uniform(0, 0.12) * noise_field(shape, float(rng.uniform(5, 60)), rng)
        shade = (1 - lit * np.clip(slope @ light, -1, 1) - rng.uniform(0, 0.4) * (1 - inner) ** 2) * mottle
        # A crest is wet where it faces the lamp: a broken line along it.
        exponent = ((slope - rng.uniform(0, 0.6) * light) ** 2).sum(-1) / rng.uniform(0.05, 0.4) ** 2
        broken = np.clip(0.5 + rng.uniform(0, 2) * noise_field(shape, float(rng.uniform(8, 60)), rng), 0, 1)
        wet = cover * broken * np.exp(-exponent) * rng.uniform(0, 1.2) * (rng.random() < 0.8)
        opaque = rng.uniform(0.6, 1) * cv2.GaussianBlur(cover, (0, 0), float(rng.uniform(0.5, 3)))
        picture = picture + opaque[..., None] * (hue * shade[..., None] - picture)
        picture = picture + np.clip(wet, 0, 1)[..., None] * np.maximum(245 - picture, 0)
        highlight = np.maximum(highlight, np.clip(2 * wet - 0.6, 0, 1))
    return replace(
        layer, picture=np.asarray(picture, np.float32), highlight=np.asarray(highlight, np.float32)
    )


def _vessel_colour(rng: np.random.Generator) -> Floats:
    """Grey levels (3,): a blue, purple, red or steel one, or any."""
    if rng.random() < 0.7:
        return np.asarray(rng.choice(_VESSELS) * rng.uniform(0.6, 1.4) * rng.uniform(0.8, 1.2, 3))
    return rng.uniform(20, 230, 3)


def _path(thickness: float, rng: np.random.Generator) -> Outline:
    """A winding line across the picture; some end in it."""
    turn, t = rng.uniform(0, 2 * np.pi), np.linspace(-1.5 if rng.random() < 0.75 else 0.0, 1.5, 80)[:, None]
    direction = np.array([np.cos(turn), np.sin(turn)])
    waves = [rng.normal(0, 0.07 / k) * np.sin(k * rng.uniform(2, 7) * t + rng.uniform(0, 6)) for k in (1, 2)]
    middle = rng.uniform(0, 1, 2) * [1, 0.75]
    return "line", middle + t * direction + sum(waves) * np.array([-direction[1], direction[0]]), thickness


def _polish(rng: np.random.Generator) -> Mirror:
    """A random metal in random surroundings."""
    metal = _METALS[int(rng.choice(len(_METALS), p=_OFTEN))]
    metal = metal * rng.uniform(0.45, 1.0) * (1 + rng.normal(0, 0.04, 3))
    slopes = np.stack(np.meshgrid(*[np.linspace(-1, 1, _SIDE)] * 2), -1)
    bands = noise_field((_SIDE, _SIDE), float(rng.uniform(10, 60)), rng)[..., None]
    level = np.exp(rng.uniform(np.log(15), np.log(200)))
    around = level * np.clip(1 + rng.uniform(0, 0.7) * bands, 0, 3)
    for _ in range(int(rng.integers(0, 4))):  # lamps
        exponent = ((slopes - rng.uniform(-0.7, 0.7, 2)) ** 2).sum(-1) / np.exp(rng.uniform(-3.3, -1.2)) ** 2
        around = around + rng.uniform(60, 350) * np.exp(-exponent)[..., None]
    around = np.broadcast_to(around, (_SIDE, _SIDE, 3)) * (1 + rng.normal(0, 0.05, 3))
    edge, blend = rng.uniform(0.3, 1.0), rng.uniform(0.05, 0.5)
    near = np.exp(rng.uniform(np.log(0.01), np.log(0.5)))
    reach, rough = rng.uniform(0, 0.15), np.exp(rng.uniform(np.log(0.003), np.log(0.04)))
    surroundings = np.asarray(around, np.float32)
    return Mirror(metal, surroundings, rng.uniform(0.2, 1), edge, blend, near, reach, rough)


def _reflect(sprite: Sprite, shift: Floats, picture: Map, inner: Map) -> Map:
    """What an object's surface (H, W, 3) mirrors in front of a picture."""
    mirror, width = sprite.mirror, inner.shape[1]
    assert mirror is not None
    slope = _slopes(inner)
    columns, rows = (np.ascontiguousarray((part + 1) * (_SIDE // 2)) for part in np.moveaxis(slope, -1, 0))
    around = cv2.remap(mirror.surroundings, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    # Just inside its rim a round body mirrors what is just outside, further in what is far away.
    steep = np.linalg.norm(slope, axis=-1)
    distance = width * mirror.reach * np.clip((1 - steep) / np.maximum(steep - 0.6, 0.15), 0, 2)
    y, x = np.indices(inner.shape, np.float32)
    offset = np.asarray(slope / np.maximum(steep, 1e-3)[..., None] * distance[..., None], np.float32)
    smeared = cv2.GaussianBlur(picture, (0, 0), max(0.5, mirror.rough * width))
    reflection = cv2.remap(
        smeared, x + offset[..., 0], y + offset[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101
    )
    points = sprite.outlines[0][1]
    tip = points[0] + shift
    direction = points[len(points) // 2] + shift - tip
    direction = direction / max(float(np.linalg.norm(direction)), 1e-6)
    along = np.maximum(((np.stack([x, y], -1) / width - tip) @ direction), 0) / mirror.near
    close = np.exp(-along)
    share = np.clip((steep - mirror.edge) / mirror.blend + close, 0, 1)[..., None]
    dim = (mirror.fade + (1 - mirror.fade) * np.exp(-0.2 * along))[..., None]
    return np.asarray(mirror.metal * (share * reflection + (1 - share) * dim * around), np.float32)


def _details(
    tip: Floats, direction: Floats, thickness: float, rng: np.random.Generator
) -> tuple[tuple[Outline, float], ...]:
    """Random rings, a sleeve or a screw on a shaft, and by what share each is brighter."""
    side = np.array([-direction[1], direction[0]]) * thickness
    kind, start, brighter = rng.integers(3), rng.uniform(0.02, 0.5), float(rng.uniform(-0.8, 0.8))
    if kind == 0:
        middles = [tip + (start + thickness * step) * direction for step in _steps(rng)]
        outlines = [("line", np.stack([middle - side, middle + side]), 0.2 * thickness) for middle in middles]
    elif kind == 1:
        outlines = [("line", np.stack([tip + start * direction, tip + 2 * direction]), 1.3 * thickness)]
    else:
        screw = tip + start * direction
        outlines = [("line", np.stack([screw, screw]), thickness * rng.uniform(0.3, 0.7))]
    return tuple((outline, brighter) for outline in outlines)


def _steps(rng: np.random.Generator) -> Floats:
    return np.asarray(rng.uniform(0.3, 1.5) * np.arange(rng.integers(1, 8)))


def _inner(body: Map) -> Map:
    """0 at the rim of a body, 1 at its middle, (H, W)."""
    depth = cv2.distanceTransform((body > 0.5).astype(np.uint8), cv2.DIST_L2, 5)
    if not depth.any():
        return np.asarray(depth, np.float32)
    size = 2 * int(np.ceil(min(float(np.percentile(depth[depth > 0], 95)), 60))) + 1
    most = cv2.GaussianBlur(cv2.dilate(depth, np.ones((size, size), np.uint8)), (0, 0), size / 4)
    return np.asarray(np.clip(depth / np.maximum(most, 1.0), 0, 1), np.float32)


def _slopes(inner: Map) -> Map:
    """Slopes (H, W, 2) along x and y of a round body, 1 outwards at its rim."""
    smooth = cv2.GaussianBlur(inner, (0, 0), 1.0)
    rise = np.stack([cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3) for order in ((1, 0), (0, 1))], -1)
    rise /= np.maximum(np.linalg.norm(rise, axis=-1, keepdims=True), 1e-6)
    return np.asarray(-rise * (1 - inner)[..., None], np.float32)


def _taper(tip: Floats, direction: Floats, thickness: float, rng: np.random.Generator) -> Outline:
    """A body that widens from its tip, then is even."""
    side, long = np.array([-direction[1], direction[0]]) * thickness / 2, rng.uniform(0.05, 0.8)
    sharp, neck, end = rng.uniform(0.1, 0.8), tip + long * direction, tip + 2 * direction
    points = [tip - sharp * side, tip + sharp * side, neck + side, end + side, end - side, neck - side]
    return "area", np.array(points), 0.0


def _finish(parts: list[Outline], rng: np.random.Generator, picture: Map, other: Map) -> Sprite:
    """An object of an outline with a random surface, focus and shadows."""
    kind, texture = rng.random(), None
    colour = rng.uniform(25, 235) * (1 + rng.normal(0, 0.05, 3))
    if kind > 0.9:  # like the picture itself
        colour = rng.choice(picture.reshape(-1, 3)) * rng.uniform(0.7, 1.3)
    elif kind > 0.6:
        colour = rng.uniform(10, 245, 3)
    elif kind > 0.5:
        colour = rng.uniform(3, 30) * np.ones(3)
    if rng.random() < 0.15:
        texture = np.asarray(other, np.float32) * rng.uniform(0.5, 1.2)
    elif rng.random() < 0.3:  # stripes or mottle
        mottle = noise_field(picture.shape[:2], float(rng.uniform(4, 60)), rng)[..., None]
        texture = np.asarray(colour + rng.uniform(3, 30) * mottle, np.float32)
    shades = []
    for _ in range(int(rng.choice([0, 1, 1, 2]))):
        offset = rng.normal(0, 0.07, 2) * rng.choice([0.3, 1, 2])
        shades.append((offset, float(np.exp(rng.uniform(-6, -2.8))), float(rng.uniform(0.15, 0.8))))
    soft = float(rng.choice([0.4, 0.7, 1.2, 2.5], p=[0.4, 0.35, 0.15, 0.1]))
    shine = rng.uniform(-20, 140) * (rng.random() < 0.6)
    surface = np.asarray(colour), texture, rng.uniform(0, 0.7), shine
    return Sprite(tuple(parts), *surface, soft, tuple(shades))


def _cover(outlines: tuple[Outline, ...], shift: Floats, shape: tuple[int, ...]) -> Map:
    """Share (H, W) of each pixel that outlines cover."""
    mask, width = np.zeros(shape[:2], np.uint8), shape[1]
    for kind, points, thickness in outlines:
        places = np.clip(np.rint((points + shift) * width * 16), -(2**15), 2**15).astype(np.int32)
        if kind == "line":
            cv2.polylines(mask, [places], False, 255, max(1, round(thickness * width)), cv2.LINE_AA, 4)
        else:
            cv2.fillPoly(mask, [places], 255, cv2.LINE_AA, 4)
    return np.asarray(mask / np.float32(255), np.float32)
