"""Instruments and other objects, shadows and highlights drawn over pictures, with exact masks.

For training of the segmentation by cut and paste (D. Dwibedi et al., "Cut, paste and learn", ICCV 2017): what
they look like matters less than that they are of every shape, colour and sharpness.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from evidence.flow.scenes import noise_field
from synth.arrays import Floats, Map

Outline = tuple[str, Floats, float]
_WIDE = 0.15  # share of the picture's width beyond which an object is no instrument


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
class Thing:
    """An object to be drawn: its outline at any place, and its surface."""

    outlines: tuple[Outline, ...]  # kind, points (N, 2), width; in picture widths
    colour: Floats  # (3,) grey levels
    texture: Map | None  # (H, W, 3) grey levels that replaces the colour
    round: float  # darkening towards the edges
    shine: float  # grey levels of the bright line along the body
    soft_px: float  # defocus
    shades: tuple[tuple[Floats, float, float], ...]  # of its shadows: offset, blur [picture widths], strength


def draw_instrument(rng: np.random.Generator, picture: Map, other: Map) -> Thing:
    """A random rod, tube, forceps, bayonet, spatula, hook or probe that enters from outside."""
    tip, turn = rng.uniform(0.15, 0.85, 2) * [1, 0.75], rng.uniform(0, 2 * np.pi)
    way = np.array([np.cos(turn), np.sin(turn)])
    side = np.array([-way[1], way[0]])
    wide, end = float(np.exp(rng.uniform(np.log(0.012), np.log(0.13)))), tip + 2.0 * way
    kind = str(rng.choice(["rod", "rod", "taper", "forceps", "forceps", "bent", "spatula", "jointed"]))
    if kind == "rod":
        parts = [("line", np.stack([tip, end]), wide)]
    elif kind == "taper":
        parts = [_taper(tip, way, wide, rng)]
    elif kind == "forceps":
        spread, tilt, wide = rng.uniform(0.0, 0.16), rng.uniform(0, 0.25), min(wide, 0.07)
        parts = []
        for sign in (-1, 1):
            arm = way * np.cos(sign * tilt) + side * np.sin(sign * tilt)
            parts.append(_taper(tip + sign * spread / 2 * side, arm, wide, rng))
    elif kind in ("bent", "jointed"):
        knee = tip + rng.uniform(0.08, 0.4) * (way + rng.uniform(-1, 1) * side)
        t = np.linspace(0, 1, 24)[:, None]
        curve = (1 - t) ** 2 * tip + 2 * t * (1 - t) * knee + t**2 * (knee + rng.uniform(0.1, 0.4) * way)
        line = np.stack([tip, knee]) if kind == "jointed" else curve
        parts = [("line", line, wide), ("line", np.stack([line[-1], line[-1] + 2 * way]), wide)]
    else:
        blade = np.array([tip + rng.uniform(0.05, 0.2) * way, tip])
        parts = [("line", blade, wide * rng.uniform(1.2, 2.5)), ("line", np.stack([blade[0], end]), wide)]
    return _finish(parts, rng, picture, other)


def draw_object(rng: np.random.Generator, picture: Map, other: Map) -> Thing:
    """A random finger, hand, patty, cloth or drop, which is no instrument."""
    middle, turn = rng.uniform(0, 1, 2) * [1, 0.75], rng.uniform(0, 2 * np.pi)
    way = np.array([np.cos(turn), np.sin(turn)])
    if rng.random() < 0.4:
        parts = [("line", np.stack([middle, middle + 2 * way]), float(rng.uniform(_WIDE + 0.03, 0.35)))]
    else:
        angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
        size, waves = rng.uniform(0.04, 0.25), rng.normal(0, 0.12, (3, 2))
        radius = 1 + sum(a * np.cos((k + 2) * angle + b) for k, (a, b) in enumerate(waves))
        points = np.stack([radius * np.cos(angle), rng.uniform(0.4, 1) * radius * np.sin(angle)], 1)
        parts = [("area", middle + size * points @ np.stack([way, [-way[1], way[0]]]), 0.0)]
    return _finish(parts, rng, picture, other)


def draw_marking(rng: np.random.Generator, picture: Map, other: Map) -> Thing:
    """A random line, grid or patch of the tissue that looks like an object but moves with the tissue."""
    kind = rng.choice(["line", "grid", "patch"])
    thing = (
        draw_object(rng, picture, other) if kind == "patch" else _lines(kind == "grid", rng, picture, other)
    )
    return replace(thing, shades=()) if rng.random() < 0.7 else thing


def _lines(grid: bool, rng: np.random.Generator, picture: Map, other: Map) -> Thing:
    """A random winding line across the picture, or many side by side and perhaps as many across them."""
    turn, wide = rng.uniform(0, 2 * np.pi), float(np.exp(rng.uniform(np.log(0.006), np.log(0.08))))
    way, side = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    middle = rng.uniform(0, 1, 2) * [1, 0.75]
    t = np.linspace(-1.5, 1.5, 40)[:, None] if rng.random() < 0.7 else np.linspace(-0.3, 0.2, 20)[:, None]
    bend = rng.normal(0, 0.06) * np.sin(rng.uniform(2, 12) * t + rng.uniform(0, 6))
    gap = rng.uniform(2, 8) * wide
    steps = gap * np.arange(-min(15, 0.5 / gap), min(15, 0.5 / gap)) if grid else np.zeros(1)
    parts = [("line", middle + t * way + (bend + step) * side, wide) for step in steps]
    if grid and rng.random() < 0.5:
        parts += [("line", middle + t * side + (bend + step) * way, wide) for step in steps]
    return _finish(parts, rng, picture, other)


def paste(layer: Layer, thing: Thing, shift: Floats) -> Layer:
    """A layer with an object moved by `shift` (2,) picture widths, and its shadows."""
    body = _cover(thing, shift, layer.instrument.shape)
    picture, shadow = layer.picture, layer.shadow
    width = body.shape[1]
    for offset, blur, strength in thing.shades:
        shade = _cover(thing, shift + offset, body.shape)
        shade = strength * cv2.GaussianBlur(shade, (0, 0), max(0.3, blur * width))
        picture = picture * (1 - shade[..., None])
        shadow = np.maximum(shadow, shade)
    inner = cv2.distanceTransform((body > 0.5).astype(np.uint8), cv2.DIST_L2, 3)
    inner /= max(float(np.percentile(inner[inner > 0], 95)), 1.0) if (inner > 0).any() else 1.0
    shade = 1 - thing.round * np.clip(1 - inner, 0, 1) ** 2
    line = np.exp(-(((inner - 0.7) / 0.12) ** 2))
    surface = thing.colour if thing.texture is None else thing.texture
    surface = surface * shade[..., None] + thing.shine * line[..., None]
    soft = body if thing.soft_px < 0.3 else cv2.GaussianBlur(body, (0, 0), thing.soft_px)
    picture = picture * (1 - soft[..., None]) + surface * soft[..., None]
    free = 1 - body
    found = np.maximum(layer.instrument * free, body)
    return Layer(np.asarray(picture, np.float32), found, shadow * free, layer.highlight * free)


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
        away = np.indices(shape) - centre * np.reshape(shape, (2, 1, 1))
        strength = np.exp(-(away**2).sum(1) / (2 * across**2))[: rng.integers(1, 5)].max(0)
    strength = strength * (1 - layer.instrument)
    white = rng.uniform(225, 275) * (1 + rng.normal(0, 0.03, 3))
    lit = layer.picture + strength[..., None] * np.maximum(white - layer.picture, 0)
    found = np.maximum(layer.highlight, np.clip(2 * strength, 0, 1))
    return Layer(np.asarray(lit, np.float32), layer.instrument, layer.shadow, found)


def _taper(tip: Floats, way: Floats, wide: float, rng: np.random.Generator) -> Outline:
    """A body that widens from its tip, then is even."""
    side, long = np.array([-way[1], way[0]]) * wide / 2, rng.uniform(0.05, 0.8)
    sharp, neck, end = rng.uniform(0.1, 0.8), tip + long * way, tip + 2 * way
    points = [tip - sharp * side, tip + sharp * side, neck + side, end + side, end - side, neck - side]
    return "area", np.array(points), 0.0


def _finish(parts: list[Outline], rng: np.random.Generator, picture: Map, other: Map) -> Thing:
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
        away = rng.normal(0, 0.07, 2) * rng.choice([0.3, 1, 2])
        shades.append((away, float(np.exp(rng.uniform(-6, -2.8))), float(rng.uniform(0.15, 0.8))))
    soft = float(rng.choice([0.4, 0.7, 1.2, 2.5], p=[0.4, 0.35, 0.15, 0.1]))
    shine = rng.uniform(-20, 140) * (rng.random() < 0.6)
    surface = np.asarray(colour), texture, rng.uniform(0, 0.7), shine
    return Thing(tuple(parts), *surface, soft, tuple(shades))


def _cover(thing: Thing, shift: Floats, shape: tuple[int, ...]) -> Map:
    """Share (H, W) of each pixel that an object covers."""
    mask, width = np.zeros(shape[:2], np.uint8), shape[1]
    for kind, points, wide in thing.outlines:
        places = np.clip(np.rint((points + shift) * width * 16), -(2**15), 2**15).astype(np.int32)
        if kind == "line":
            cv2.polylines(mask, [places], False, 255, max(1, round(wide * width)), cv2.LINE_AA, 4)
        else:
            cv2.fillPoly(mask, [places], 255, cv2.LINE_AA, 4)
    return np.asarray(mask / np.float32(255), np.float32)
