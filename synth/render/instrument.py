"""Instruments as meshes that follow tips and shafts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

_AROUND = 20
_ALONG = 96
_LENGTH_MM = 110.0


@dataclass(frozen=True)
class Instrument:
    """Tines in their own axes: the tip at the origin, z towards the hand; all tines one mesh."""

    tines: int
    profile: Floats
    """(T, V, 3) mm, one block a tine."""
    faces: npt.NDArray[np.int32]
    """(F, 3) over all tines."""
    uv: npt.NDArray[np.float32]


def build(tines: int) -> Instrument:
    """Bipolar forceps for two tips, a dissector for one."""
    blocks = [_tine(side) for side in (np.linspace(1, -1, tines) if tines > 1 else [0.0])]
    faces, uv = _skin()
    count = blocks[0].shape[0]
    return Instrument(
        tines=tines,
        profile=np.stack(blocks),
        faces=np.concatenate([faces + count * t for t in range(tines)]).astype(np.int32),
        uv=np.concatenate([uv] * tines).astype(np.float32),
    )


def pose(instrument: Instrument, tips: Floats, shafts: Floats) -> Floats:
    """World vertices (T*V, 3) mm of an instrument.

    Args:
        instrument: the instrument.
        tips: (T, 3) mm, where each tine ends.
        shafts: (T, 3) unit, from tip to hand.
    """
    placed = []
    spread = tips[-1] - tips[0]
    for profile, tip, shaft in zip(instrument.profile, tips, shafts, strict=True):
        z = shaft / np.linalg.norm(shaft)
        # Flat sides of the tines face each other; a single one turns its flat side up.
        side = spread if np.linalg.norm(spread) > 1e-9 else np.cross(z, [0.0, 0.0, 1.0])
        x = side - (side @ z) * z
        if np.linalg.norm(x) < 1e-9:
            x = np.cross(z, [1.0, 0.0, 0.0])
        x /= np.linalg.norm(x)
        placed.append(tip + profile @ np.stack([x, np.cross(z, x), z]))
    return np.concatenate(placed)


def _tine(side: float) -> Floats:
    """One tine (V, 3): a blunt tip that widens into a flat blade, bowed outwards (to -x for side 1)."""
    s = (np.linspace(0, 1, _ALONG) ** 1.6) * _LENGTH_MM
    round_off = np.sqrt(np.clip(1 - (1 - np.minimum(s / 0.45 + 0.01, 1)) ** 2, 0, 1))
    wide = (0.42 + 0.9 * (1 - np.exp(-s / 9.0)) + 1.3 * (1 - np.exp(-s / 45.0))) * round_off
    thick = (0.34 + 0.42 * (1 - np.exp(-s / 8.0)) + 0.3 * (1 - np.exp(-s / 40.0))) * round_off
    bow = -side * 5.5 * (1 - np.exp(-((s / 38.0) ** 1.5)))
    angle = np.linspace(0, 2 * np.pi, _AROUND + 1)
    # A superellipse: flats with rounded edges.
    c, w = np.cos(angle), np.sin(angle)
    x = np.sign(c) * np.abs(c) ** 0.7
    y = np.sign(w) * np.abs(w) ** 0.7
    ring = np.stack(
        [thick[:, None] * x + bow[:, None], wide[:, None] * y, np.repeat(s[:, None], len(x), 1)], -1
    )
    return ring.reshape(-1, 3)


def _skin() -> tuple[npt.NDArray[np.int64], Floats]:
    around = _AROUND + 1
    row, column = np.meshgrid(np.arange(_ALONG - 1), np.arange(_AROUND), indexing="ij")
    a = (row * around + column).ravel()
    b, c, d = a + 1, a + around, a + around + 1
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    v, u = np.meshgrid(np.linspace(0, 1, _ALONG), np.linspace(0, 1, around), indexing="ij")
    return faces, np.stack([u.ravel(), v.ravel()], axis=1)
