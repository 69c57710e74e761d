"""An emitter that is visible but never sampled, for light on a surface that is not of a lamp.

Mitsuba's own area light with a sampling weight of 0 is not sampled either, but its sampling would still be
compiled, with the mesh's number of faces in the code, which takes a kernel for every scene.
"""

from __future__ import annotations

import functools
from typing import Any


@functools.cache
def register_glow(variant: str) -> None:
    """Registers the emitter `sulcus_glow`, with a texture `radiance`, in one compiled variant."""
    import drjit as dr
    import mitsuba as mi

    class Glow(mi.Emitter):
        """An emitter of a texture's radiance to the side of the normals."""

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.radiance = props["radiance"]
            self.m_flags = mi.EmitterFlags.Surface | mi.EmitterFlags.SpatiallyVarying

        def eval(self, si: Any, active: Any = True) -> Any:
            return dr.select(mi.Frame3f.cos_theta(si.wi) > 0, self.radiance.eval(si, active), 0)

        def sample_direction(self, it: Any, sample: Any, active: Any = True) -> tuple[Any, Any]:
            return dr.zeros(mi.DirectionSample3f), dr.zeros(mi.Color3f)

        def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return mi.Float(0)

        def eval_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return mi.Color3f(0)

        def bbox(self) -> Any:
            return self.get_shape().bbox()

        def traverse(self, callback: Any) -> None:
            callback.put("radiance", self.radiance, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return "SulcusGlow[]"

    mi.register_emitter("sulcus_glow", Glow)
