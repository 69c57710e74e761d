"""Tissue as a volume that light wanders through, for Mitsuba: a reference, far dearer than a blur.

The boundary lets light pass unbent, so that lamps reach every scattering event, and mirrors the share of it
that water would. Single-scattering albedo from the colour seen: M. J.-Y. Chiang et al., "Practical and
controllable subsurface scattering for production path tracing", 2016.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

Map = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]

_TEXELS = 512
_DEEP_MM = 4.0
_PER_MM = 4.0  # events a light path meets in a millimetre, about: reduced scattering of cortex
_MIRRORED = 0.02  # water, seen from above


def boundary(normal: dict[str, Any], roughness: float) -> dict[str, Any]:
    """BSDF of the surface: a thin mirror over nothing."""
    coat = {
        "type": "roughconductor",
        "material": "none",
        "distribution": "ggx",
        "alpha": max(roughness, 0.02),
    }
    bent = {"type": "normalmap", "normalmap": normal, "coat": coat}
    return {"type": "mask", "opacity": _MIRRORED, "nested": {"type": "twosided", "bent": bent}}


def medium(mi: Any, albedo: Map, vertices: Floats) -> dict[str, Any]:
    """What lies under a surface whose maps span the square that its vertices (V, 3) mm do."""
    small = cv2.resize(albedo, (_TEXELS, _TEXELS), interpolation=cv2.INTER_AREA)
    single = 1 - np.exp(-5.09406 * small + 2.61188 * small**2 - 4.31805 * small**3)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    low[2] -= _DEEP_MM
    size = high - low
    place = mi.ScalarTransform4f().translate(low.tolist()).scale(size.tolist())
    grid = np.repeat(single[None], 2, axis=0).astype(np.float32)
    return {
        "type": "heterogeneous",
        "albedo": {"type": "gridvolume", "grid": mi.VolumeGrid(grid), "to_world": place, "raw": True},
        "sigma_t": {
            "type": "gridvolume",
            "grid": mi.VolumeGrid(np.ones((2, 2, 2, 1), np.float32)),
            "to_world": place,
            "raw": True,
        },
        "scale": _PER_MM,
    }
