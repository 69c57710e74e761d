"""Appearance of one sequence: colours, wetness and rim, drawn within a named family."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from synth.job.schema import Family, Job
from synth.render.appearance.family import FAMILIES, Colour
from synth.render.appearance.light import Lighting, balance
from synth.render.camera.camera_sensor import Sensor

_SHOWN = 0.75  # share of the sequences that show a part of `render.scenery`


@dataclass(frozen=True)
class Look:
    """One sequence's appearance; colours are linear RGB."""

    family: str
    crown: Colour
    """Reflectance of the gyri's crowns."""
    flush: Colour
    """Reflectance where more blood shines through."""
    vein: Colour
    """Reflectance of a thick vein along its crest, where its wall scatters blue."""
    wine: Colour
    """Reflectance of a thick vein at its sides."""
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
    dry_roughness: float
    """GGX alpha where the film is thin."""
    film_index: float
    """Refractive index of the film: 1.33 is water."""
    blood: float
    """How much blood lies on the rim, 0 to 1."""
    dura: Colour
    beyond: Colour
    """What lies outside the dura: muscle, or the bone of a specimen."""
    cottonoid: bool
    """Whether a cotton patty lies on the rim."""
    scenery: tuple[str, ...]
    """What else lies about the opening, of what the job allows."""
    rim_seed: int
    light: Lighting
    sensor: Sensor

    @classmethod
    def draw(cls, job: Job, family: Family, rng: np.random.Generator) -> Look:
        """A look of `family` under the job's light, seen by its sensor."""
        lighting = Lighting.draw(job.light, rng)
        glare = lighting.glare
        ranges = FAMILIES[family]
        drawn = cls(
            family=family,
            crown=_near(ranges.crown, rng),
            flush=_near(ranges.flush, rng),
            vein=_near(ranges.vein, rng),
            wine=_near(ranges.wine, rng),
            arterial=float(rng.uniform(*ranges.arterial)),
            capillary=float(rng.uniform(*ranges.capillary)),
            blush=float(rng.uniform(*ranges.blush)),
            shade=float(rng.uniform(*ranges.shade)),
            grain=float(rng.uniform(0.008, 0.02)),
            film_mm=float(rng.uniform(*ranges.film_mm)) + 0.14 * glare**2,
            bump=float(rng.uniform(*ranges.bump)) * (1 + 3 * glare**2),
            roughness=float(rng.uniform(0.012, 0.02)) + 0.12 * glare**2,
            dry_roughness=float(rng.uniform(0.22, 0.34)) * (1 - 0.6 * glare),
            film_index=1.33 + 0.47 * glare**2,
            blood=float(rng.uniform(*(job.appearance.blood or ranges.blood))),
            dura=_near(ranges.dura, rng),
            beyond=_near(ranges.beyond, rng),
            cottonoid=bool(rng.uniform() < job.appearance.cottonoid),
            scenery=(),
            rim_seed=int(rng.integers(2**31)),
            light=lighting,
            sensor=Sensor.draw(job.sensor, balance(lighting.kelvin + rng.uniform(-250, 350)), rng),
        )
        return replace(drawn, scenery=_shown(job.render.scenery, drawn.rim_seed))


def _shown(parts: tuple[str, ...], seed: int) -> tuple[str, ...]:
    """Which of the parts that a job allows one sequence shows; from a seed, so that nothing else changes."""
    seen = np.random.default_rng([seed, 4]).random(len(parts)) < _SHOWN
    return tuple(part for part, shown in zip(parts, seen, strict=True) if shown)


def _near(colour: Colour, rng: np.random.Generator) -> Colour:
    """A colour a little brighter or darker, redder or bluer."""
    value = np.asarray(colour) * rng.uniform(0.94, 1.05) * rng.uniform(0.96, 1.04, 3)
    r, g, b = np.clip(value, 0.01, 0.95).tolist()
    return r, g, b
