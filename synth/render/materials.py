"""Bodies, their materials, and lamps, independent of the program that renders them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

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
class Metal:
    """A body whose reflections are given rather than rendered."""

    tint: Floats
    """(V, 3) diffuse reflectance at vertices."""
    glow: Floats
    """(V, 3) mirrored radiance at vertices."""


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
