"""What a surface shows of light that no lamp stands for: an emitter that is seen and never sampled.

Mitsuba's own area light would be sampled by nobody either (its weight was nothing), but its sampling would
still be compiled, and with it the mesh's number of faces: a kernel for every scene.
"""

from __future__ import annotations

import functools
from typing import Any


@functools.cache
def register_glow(variant: str) -> None:
    """Makes `sulcus_glow`, with a texture `radiance`, known to one compiled variant."""
    import drjit as dr
    import mitsuba as mi

    class Glow(mi.Emitter):
        """Radiance of a texture towards the side that normals point to."""

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
