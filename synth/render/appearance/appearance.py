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
    gyrus_albedo: Colour  # of the crowns of gyri
    perfused_albedo: Colour  # of parenchyma where more blood shines through
    vein_crest_albedo: Colour  # of a thick vein along its crest, where its wall scatters blue light
    vein_side_albedo: Colour  # of a thick vein at its sides
    arterial_absorption: float  # of blood in arteries, in multiples of `texture.Artery.absorption_per_mm`
    subpial_absorbance_per_mm: float  # optical depth (natural, green) of vessels below the pia [1/mm]
    pial_absorbance: float  # optical depth (natural, green) of blood in the pia, most of it over sulci
    sulcus_shading: float  # optical depth of the sulci, as a multiple of `texture.Sulcus`'s
    grain: float  # contrast of the parenchyma's finest mottling, as a share of its albedo
    fluid_smoothing_mm: float  # standard deviation of the wet film's smoothing [mm]
    bump: float  # height of the microstructure under the film, as a multiple of `texture.Film.swell_mm`
    roughness: float  # GGX alpha of the wet coat
    dry_roughness: float  # GGX alpha where the film is thin
    fluid_index: float  # refractive index of the film: 1.33 is water
    blood: float  # on the rim, from none (0) to soaked (1)
    dura_albedo: Colour
    surroundings_albedo: Colour  # outside the dura: muscle, or the bone of a specimen
    cottonoid: bool  # whether a cotton patty lies on the rim
    scenery: tuple[str, ...]  # shown parts of the job's `render.scenery`
    rim_seed: int
    light: Lighting
    sensor: CameraSensor
