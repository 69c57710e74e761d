"""What polished steel mirrors of its surroundings: the tissue below, a dark theatre with its lamps above.

The lamps that light the scene are points, and the rest of the theatre lights nothing: only steel shows it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from synth.geometry.triangles import Shape, normals

Floats = npt.NDArray[np.float64]

_TISSUE = np.array([0.50, 0.20, 0.13])
_DRAPE = np.array([0.05, 0.10, 0.12])
_CEILING = np.array([0.10, 0.11, 0.12])
_LAMPS = 5


def glow(tool: Shape, eye: Floats, seed: int) -> Floats:
    """Radiance (V, 3) that each vertex of a tool mirrors towards the lens at `eye` (3,) mm."""
    normal = normals(tool)
    towards = eye - tool.vertices
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    facing = np.einsum("nc,nc->n", normal, towards)[:, None]
    mirrored = 2 * facing * normal - towards
    # Nearer to its tip steel sees more of the tissue and less of the room.
    near = 1 / (1 + (np.maximum(tool.vertices[:, 2:], 0) / 18.0) ** 2)
    return np.asarray(0.62 * _surroundings(mirrored, near, np.random.default_rng([seed, 3])))


def _surroundings(direction: Floats, near: Floats, rng: np.random.Generator) -> Floats:
    """Radiance (N, 3) from directions (N, 3)."""
    up = direction[:, 2:]
    below = 1 / (1 + np.exp((up + 0.05) / 0.09))
    high = np.clip(up, 0, 1) ** 0.5
    room = (1 - high) * _DRAPE + high * _CEILING
    lamps = np.zeros_like(up)
    for azimuth, height, size, power in zip(
        rng.uniform(0, 2 * np.pi, _LAMPS),
        rng.uniform(0.25, 0.9, _LAMPS),
        rng.uniform(0.10, 0.28, _LAMPS),
        rng.uniform(0.4, 1.6, _LAMPS),
        strict=True,
    ):
        flat = np.sqrt(1 - height**2)
        middle = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), height])
        lamps += power * np.exp(-np.maximum(1 - direction @ middle, 0) / (0.5 * size**2))[:, None]
    return np.asarray(below * near * _TISSUE + (1 - below) * (room + lamps))
