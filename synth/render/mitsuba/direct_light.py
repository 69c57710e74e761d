"""Direct light of lamps, separated by the two sources of noise: objects out of focus, and shadows.

Lamps are small: directions sampled from a surface's scattering hardly ever hit one, so a path samples one
lamp. Sample points on pixel, lens and lamps are (0, 2)-sequences in Morton order of the pixels, shuffled for
every seed: not only a pixel's four paths, but the sixteen of four neighbours, are spread over the whole lens.
A. G. M. Ahmed, P. Wonka, "Screen-space blue-noise diffusion of Monte Carlo sampling error via hierarchical
ordering of pixels", 2020; B. Burley, "Practical hash-based Owen scrambling", 2020.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from synth.arrays import Map

_BLURRED_PX = 0.75  # least radius of the circle of confusion of steel that is separated
_AT_ONCE = 256  # paths per pixel: more would exceed indices of 32 bits
_HALVES = ((16, 0x0000FFFF), (8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555))


class Light(NamedTuple):
    """Direct light of a picture, as means over each pixel's paths."""

    radiance: Map  # (3, H, W)
    foreground: Map  # (3, H, W) its part from steel nearer than the focus and out of focus
    cover: Map  # (H, W) share of the paths that end on such steel
    blocked: Map  # (3, H, W) radiance that shadows take from the other paths
    shade: Map  # (H, W) irradiance that shadows take from them
    irradiance: Map  # (H, W) their irradiance without shadows, of the lamps that they sampled
    radius: Map  # (H, W) px: cover times the radius of the circle of confusion
    steel: Map  # (H, W) share of the paths that end on other steel


def trace(scene: Any, lens: Any, size: tuple[int, int], steel: str, spp: int, seed: int) -> Light:
    """Light of a compiled scene in a `sulcus_lens` over a picture of a size (width, height) px.

    `steel`: id of the mesh that is separated where it is out of focus; it may be missing.
    """
    import drjit as dr
    import mitsuba as mi

    width, height = size
    # Numbers as data: a literal in the code would compile the kernel anew.
    seeds = [dr.opaque(mi.UInt32, int(word)) for word in np.random.SeedSequence(seed).generate_state(9)]
    # A path's index has its number within the pixel in its lowest bits; then all bits are reversed.
    shift = dr.opaque(mi.UInt32, int(np.ceil(np.log2(spp))))
    shapes = [mi.ShapePtr(shape) for shape in scene.shapes() if shape.id() == steel]
    number = dr.opaque(
        mi.UInt32, int(np.array(dr.reinterpret_array(mi.UInt32, shapes[0]))[0]) if shapes else 0
    )
    sums = [dr.zeros(mi.Float, width * height) for _ in range(14)]
    for start in range(0, spp, _AT_ONCE):
        count = min(spp - start, _AT_ONCE)
        first, paths = (dr.opaque(mi.UInt32, integer) for integer in (start, count))
        path = dr.arange(mi.UInt32, width * height * count)
        pixel = path // paths
        x, y = pixel % width, pixel // width
        index = dr.brev(((_spread(x) | (_spread(y) << 1)) << shift) | (first + path - pixel * paths))
        subpixel, aperture, window = (_pair(index, seeds[3 * n : 3 * n + 3]) for n in range(3))
        place = mi.Point2f((x + subpixel.x) / width, (y + subpixel.y) / height)
        ray, _ = lens.sample_ray_differential(0.0, 0.0, place, aperture)
        si = scene.ray_intersect(ray, mi.RayFlags.All, True)
        hit = si.is_valid()
        lamp, weight = scene.sample_emitter_direction(si, window, False, hit)
        scattered = weight * si.bsdf(ray).eval(mi.BSDFContext(), si, si.to_local(lamp.d), hit)
        # Lamps are small, so shadow rays of neighbours are as coherent as the paths: 8% of the whole trace.
        shadow = hit & scene.ray_test(si.spawn_ray_to(lamp.p), True, hit)
        # Light of a face too thin for single precision, as meshes of one's own may have, is undefined.
        emitted, scattered = (
            dr.select(dr.isfinite(light), light, 0) for light in (si.emitter(scene).eval(si), scattered)
        )
        radiance = emitted + dr.select(shadow, 0, scattered)
        depth = dr.dot(si.p - lens.centre, lens.rows[2])
        blur = lens.v["fx"] * lens.v["aperture"] * (dr.rcp(depth) - dr.rcp(lens.v["focus"]))
        steel = hit & (dr.reinterpret_array(mi.UInt32, si.shape) == number)
        in_foreground = steel & (blur > _BLURRED_PX)
        parts = [(hit, (*radiance,)), (in_foreground, (*radiance, mi.Float(1)))]
        parts += [
            (shadow & ~in_foreground, (*scattered, weight.y)),
            (hit & ~in_foreground, (weight.y,)),
            (in_foreground, (blur,)),
        ]
        parts += [(steel & ~in_foreground, (mi.Float(1),))]
        for total, (mask, value) in zip(sums, [(w, v) for w, vs in parts for v in vs], strict=True):
            dr.scatter_add(total, value, pixel, mask)
        dr.eval(sums)
    means = np.stack([np.array(total) for total in sums]).reshape(-1, height, width) * np.float32(1 / spp)
    return Light(means[:3], means[3:6], means[6], means[7:10], *means[10:])


def _pair(index: Any, seeds: list[Any]) -> Any:
    """Points of a shuffled (0, 2)-sequence in the unit square, from indices with their bits reversed."""
    import mitsuba as mi

    index = index + seeds[0]
    for factor in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6):  # S. Laine, T. Karras, 2011
        index = index ^ (index * factor)
    second = index
    for step, mask in _HALVES:  # Pascal's triangle modulo 2: Sobol's second dimension
        second = second ^ ((second & mask) << step)
    x, y = ((word ^ seed) >> 8 for word, seed in zip((index, second), seeds[1:], strict=True))
    return mi.Point2f(mi.Float(x), mi.Float(y)) * 2.0**-24


def _spread(x: Any) -> Any:
    """The lower sixteen bits of a number, with a zero between any two."""
    for step, mask in _HALVES[1:]:
        x = (x | (x << step)) & mask
    return x
