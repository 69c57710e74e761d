"""Bodies, their materials, and lamps, independent of the program that renders them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from synth.arrays import Floats, Indices, Map
from synth.geometry.triangles import Shape


@dataclass(frozen=True)
class Coat:
    """Texture maps of one body of wet tissue; the first row has the lowest v."""

    albedo: Map
    """(n, n, 3) linear reflectance."""
    normal: Map
    """(n, n, 3) unit normals in the surface's tangent frame."""
    dry: Map
    """(m, m) share of the surface under a film too thin to be smooth."""


@dataclass(frozen=True)
class Wet:
    """A diffuse body under a wet coat."""

    coat: Coat | Callable[[], Coat]
    """Its maps, or what paints them when first rendered."""
    roughness: float
    """GGX alpha of the coat under film."""
    dry_roughness: float
    """GGX alpha where the film is too thin."""
    ambient: Floats
    """(3,) light scattered into shadows from all around, as a white diffuser's radiance."""
    index: float = 1.33
    """Refractive index of the coat."""

    @cached_property
    def maps(self) -> Coat:
        """The coat, painted."""
        return self.coat() if callable(self.coat) else self.coat


@dataclass(frozen=True)
class FinishMaps:
    """Texture maps (h, w) of hard bodies, float32: bare metal, plastic, paint, and what sticks to them."""

    base: Map
    """(h, w, 3) linear reflectance: at right angles of bare metal, else albedo."""
    bare: Map
    """(h, w) share that is bare metal, a conductor; the rest scatters below a dielectric surface."""
    rough: Map
    """(h, w, 2) GGX alpha along u and across it; the first is the larger one."""
    wet: Map
    """(h, w) share under a film of liquid."""
    mirror: Map
    """(h, w, 3) reflectance at right angles for light of the surroundings."""
    normal: Map
    """(h, w, 3) unit normals in the surface's tangent frame."""


def stack_maps(parts: Sequence[tuple[Map, FinishMaps]]) -> tuple[Map, FinishMaps]:
    """One texture for several bodies: uv (V, 2) of each and its maps, to those of all and the maps' stack.

    Maps of other widths than the widest are resampled.
    """
    width = max(maps.bare.shape[1] for _, maps in parts)
    total, start = sum(len(maps.bare) for _, maps in parts), 0
    places = list[Map]()
    layers = dict[str, list[Map]]()
    for uv, maps in parts:
        height = len(maps.bare)
        # Between the centres of a body's outermost texels: its neighbours don't show at its edges.
        v = (start + 0.5 + uv[:, 1] * (height - 1)) / total
        places.append(np.column_stack([(0.5 + uv[:, 0] * (width - 1)) / width, v]).astype(np.float32))
        start += height
        for name, layer in vars(maps).items():
            fits = layer.shape[1] == width
            layers.setdefault(name, []).append(layer if fits else cv2.resize(layer, (width, height)))
    return np.concatenate(places), FinishMaps(**{name: np.concatenate(rows) for name, rows in layers.items()})


def read_map(layer: Map, uv: Map) -> Map:
    """A map (h, w) or (h, w, n) at places uv (V, 2) from 0 to 1, bilinear: (V,) or (V, n)."""
    place = (uv * layer.shape[1::-1] - 0.5).astype(np.float32)[:, None]
    texels = cv2.remap(layer, place, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(texels[:, 0])


@dataclass(frozen=True)
class Metal:
    """A hard body that mirrors its surroundings; u of its body runs along the brushing."""

    maps: FinishMaps
    glow: Floats
    """(V, 3) radiance of the surroundings, but for the lamps, that a mirror at a vertex would show."""


@dataclass(frozen=True)
class Body:
    """A mesh and its material, world axes."""

    vertices: Floats
    """(V, 3) mm."""
    faces: Indices
    """(F, 3), counter-clockwise from outside."""
    uv: Map
    """(V, 2) from 0 to 1: place in the maps."""
    material: Wet | Metal
    film: Floats | None = None
    """(V,) mm: height of a film on the vertices, for the normals."""

    @property
    def shape(self) -> Shape:
        """The mesh alone."""
        return Shape(self.vertices, self.faces)


@dataclass(frozen=True)
class Lamp:
    """A round window that emits light."""

    position: Floats
    """(3,) mm, its middle."""
    target: Floats
    """(3,) mm: point that it faces."""
    radius: float
    """mm."""
    intensity: Floats
    """(3,) radiant intensity towards its target, linear RGB; a white surface square to it at a distance d mm
    has a radiance of intensity / (pi d^2)."""
