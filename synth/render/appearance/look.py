"""Appearance of one sequence: colours, wetness and rim."""

from __future__ import annotations

from dataclasses import dataclass

from synth.render.appearance.family import Colour
from synth.render.appearance.light import Lighting
from synth.render.camera.camera_sensor import CameraSensor


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
    sensor: CameraSensor
