"""Content of a scene: what the renderer is given to draw, and builds nothing of itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from synth.arrays import Floats, Indices, Map, Mask
from synth.geometry.triangles import Shape
from synth.render.materials import Body, FinishMaps, Lamp


class Instruments(Protocol):
    """Instruments as one mesh that follows tips and shafts.

    `tips` (2n, 3) mm and `shafts` (2n, 3), unit vectors from tip to hand: two of each for every instrument.
    """

    @property
    def maps(self) -> FinishMaps:
        """Texture of all of them."""

    @property
    def uv(self) -> Map:
        """(V, 2) from 0 to 1: place in the maps."""

    @property
    def owner(self) -> Indices:
        """(F,) number of the instrument that each face belongs to, from 0 on."""

    def pose(self, tips: Floats, shafts: Floats) -> Shape:
        """The mesh in its place; only its vertices depend on it."""

    def glow(self, posed: Shape) -> Floats:
        """Radiance (V, 3) of the surroundings that a mirror in its place shows the camera at rest."""

    def touch(self, posed: Shape, surface: Floats) -> tuple[Floats, Floats]:
        """At a tissue's vertices (V, 3) mm the height (V,) mm of the liquid that climbs to the mesh in its
        place, and the share (V,) of light that scatters to them past it."""


@dataclass(frozen=True)
class SceneContent:
    """What a scene shows, world axes: a tissue, bodies around it, instruments, lamps."""

    tissue: Body
    """At rest. Frames move its vertices; flow, depth and highlights are of it. Its material is `Wet`."""
    lamps: Sequence[Lamp]
    static: Sequence[Body] = ()
    """Bodies that never move and are neither tissue nor instruments, though they hide both."""
    hidden: Mask | None = None
    """(F,) of the tissue's faces those that static bodies hide from every view, and that throw no shadow that
    is seen: left out of the picture, not of labels."""
    instruments: Instruments | None = None
    spot: float = np.inf
    """Radius of the lamps' spot, in widths of the picture: light falls by a third to there."""
