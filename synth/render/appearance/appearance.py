"""Appearance of one sequence: colours, wetness and rim."""

from __future__ import annotations

from dataclasses import dataclass

from synth.render.appearance.family import Colour
from synth.render.appearance.light import Lighting
from synth.render.camera.camera_sensor import CameraSensor


@dataclass(frozen=True)
class Appearance:
    """One sequence's appearance; colours are linear RGB."""

    family: str
    gyrus_albedo: Colour
    """Of the crowns of gyri."""
    perfused_albedo: Colour
    """Of parenchyma where more blood shines through."""
    vein_crest_albedo: Colour
    """Of a thick vein along its crest, where its wall scatters blue."""
    vein_side_albedo: Colour
    """Of a thick vein at its sides."""
    arterial_absorption: float
    """Of the blood in arteries, as a multiple of `texture.Artery.absorption_per_mm`."""
    subpial_absorbance_per_mm: float
    """Optical depth (natural, green) of a millimetre of vessel under the pia [1/mm]."""
    pial_absorbance: float
    """Optical depth (natural, green) of the blood in the pia; over sulci most of it, over crowns little."""
    sulcus_shading: float
    """Optical depth of the sulci, as a multiple of `texture.Sulcus`'s."""
    grain: float
    """Contrast of the parenchyma's finest mottling, as a share of its albedo."""
    film_smoothing_mm: float
    """Standard deviation of what the wet film evens out [mm]."""
    bump: float
    """Height of the microstructure under the film, as a multiple of `texture.Film.swell_mm`."""
    roughness: float
    """GGX alpha of the wet coat."""
    dry_roughness: float
    """GGX alpha where the film is thin."""
    film_index: float
    """Refractive index of the film: 1.33 is water."""
    blood: float
    """How much blood lies on the rim, 0 to 1."""
    dura_albedo: Colour
    surroundings_albedo: Colour
    """Of what lies outside the dura: muscle, or the bone of a specimen."""
    cottonoid: bool
    """Whether a cotton patty lies on the rim."""
    scenery: tuple[str, ...]
    """What else lies about the opening, of what the job allows."""
    rim_seed: int
    light: Lighting
    sensor: CameraSensor
