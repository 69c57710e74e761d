"""Appearance of one sequence: colours, wetness, light and sensor, drawn within a named family."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from synth.job import Family

Colour = tuple[float, float, float]


class _Ranges(NamedTuple):
    """What a family means: middle colours and ranges, linear RGB."""

    crown: Colour
    flush: Colour
    vein: Colour
    arterial: tuple[float, float]
    capillary: tuple[float, float]
    blush: tuple[float, float]
    shade: tuple[float, float]
    film_mm: tuple[float, float]
    bump: tuple[float, float]


_FAMILIES: dict[str, _Ranges] = {
    "healthy": _Ranges(
        crown=(0.93, 0.7, 0.38),
        flush=(0.9, 0.55, 0.36),
        vein=(0.185, 0.15, 0.2),
        arterial=(1.1, 1.5),
        capillary=(1.4, 2.2),
        blush=(0.3, 0.9),
        shade=(0.3, 0.6),
        film_mm=(0.035, 0.06),
        bump=(0.8, 1.3),
    ),
    "hyperaemic": _Ranges(
        crown=(0.86, 0.46, 0.29),
        flush=(0.78, 0.32, 0.22),
        vein=(0.14, 0.09, 0.14),
        arterial=(1.3, 1.8),
        capillary=(2.2, 3.2),
        blush=(1.2, 2.2),
        shade=(0.3, 0.6),
        film_mm=(0.035, 0.06),
        bump=(0.8, 1.3),
    ),
    "pale": _Ranges(
        crown=(0.92, 0.8, 0.6),
        flush=(0.88, 0.69, 0.52),
        vein=(0.2, 0.19, 0.26),
        arterial=(0.7, 1.0),
        capillary=(0.6, 1.2),
        blush=(0.1, 0.4),
        shade=(0.2, 0.4),
        film_mm=(0.04, 0.07),
        bump=(0.7, 1.1),
    ),
    "oedematous": _Ranges(
        crown=(0.93, 0.75, 0.5),
        flush=(0.88, 0.61, 0.42),
        vein=(0.19, 0.16, 0.22),
        arterial=(0.8, 1.1),
        capillary=(0.9, 1.5),
        blush=(0.3, 0.7),
        shade=(0.1, 0.25),
        film_mm=(0.07, 0.12),
        bump=(0.4, 0.8),
    ),
    "calf": _Ranges(
        crown=(0.8, 0.6, 0.45),
        flush=(0.72, 0.45, 0.34),
        vein=(0.17, 0.08, 0.085),
        arterial=(0.6, 1.0),
        capillary=(0.4, 0.9),
        blush=(0.3, 0.8),
        shade=(0.4, 0.7),
        film_mm=(0.03, 0.05),
        bump=(1.0, 1.7),
    ),
}


@dataclass(frozen=True)
class Look:
    """One sequence's appearance; colours are linear RGB."""

    family: str
    crown: Colour
    """Reflectance of the gyri's crowns."""
    flush: Colour
    """Reflectance where more blood shines through."""
    vein: Colour
    arterial: float
    """Strength of the arteries' red."""
    capillary: float
    blush: float
    """Blood in the pia, over sulci most."""
    shade: float
    """Darkening of the sulci."""
    grain: float
    """Contrast of the parenchyma's finest mottling."""
    film_mm: float
    """Width of what the wet film evens out."""
    bump: float
    """Strength of the microstructure under the film."""
    roughness: float
    """GGX alpha of the wet coat."""
    coaxial: float
    """Share of the light that comes along the axis; the rest comes from the ring."""
    lamp_tilt_deg: float
    """Angle between the coaxial lamp and the optical axis."""
    lamp_azimuth_deg: float
    kelvin: float
    """Colour temperature of the lamps."""
    balance_kelvin: float
    """What the camera's white balance takes it for."""
    exposure: float
    full_well: float
    contrast: float
    blood: float
    """How much blood lies on the rim."""
    rim_seed: int

    @classmethod
    def draw(cls, family: Family, rng: np.random.Generator) -> Look:
        ranges = _FAMILIES[family]
        kelvin = float(rng.uniform(4200, 5600))
        return cls(
            family=family,
            crown=_near(ranges.crown, rng),
            flush=_near(ranges.flush, rng),
            vein=_near(ranges.vein, rng),
            arterial=float(rng.uniform(*ranges.arterial)),
            capillary=float(rng.uniform(*ranges.capillary)),
            blush=float(rng.uniform(*ranges.blush)),
            shade=float(rng.uniform(*ranges.shade)),
            grain=float(rng.uniform(0.01, 0.025)),
            film_mm=float(rng.uniform(*ranges.film_mm)),
            bump=float(rng.uniform(*ranges.bump)),
            roughness=float(rng.uniform(0.022, 0.038)),
            coaxial=float(rng.uniform(0.55, 0.8)),
            lamp_tilt_deg=float(rng.uniform(3.0, 9.0)),
            lamp_azimuth_deg=float(rng.uniform(0, 360)),
            kelvin=kelvin,
            balance_kelvin=kelvin + float(rng.uniform(-250, 350)),
            exposure=float(rng.uniform(1.0, 1.2)),
            full_well=float(rng.uniform(8_000, 20_000)),
            contrast=float(rng.uniform(0.25, 0.55)),
            blood=float(rng.uniform(0.3, 0.9)),
            rim_seed=int(rng.integers(2**31)),
        )


def _near(colour: Colour, rng: np.random.Generator) -> Colour:
    """A colour a little brighter or darker, redder or bluer."""
    value = np.asarray(colour) * rng.uniform(0.94, 1.05) * rng.uniform(0.96, 1.04, 3)
    r, g, b = np.clip(value, 0.01, 0.95).tolist()
    return r, g, b
