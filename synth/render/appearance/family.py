"""Appearance of one sequence (colours, wetness, rim), and the named families that it is drawn from."""

from __future__ import annotations

from dataclasses import dataclass

from synth.render.appearance.light import Lighting
from synth.render.camera.camera_sensor import CameraSensor

Colour = tuple[float, float, float]
Ends = tuple[float, float]


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
    scenery: tuple[str, ...]  # parts of `render.scenery` that are shown
    rim_seed: int
    light: Lighting
    sensor: CameraSensor


@dataclass(frozen=True, kw_only=True)
class Ranges:
    """Middle colours (linear RGB) and ranges of the quantities in `Appearance`, in drawing order.

    Defaults are those of healthy cortex. Chosen by eye on intra-operative photographs;
    `evidence.appearance` compares renderings with one.
    """

    gyrus_albedo: Colour = (0.93, 0.735, 0.49)
    perfused_albedo: Colour = (0.945, 0.57, 0.375)
    vein_crest_albedo: Colour = (0.24, 0.2, 0.27)
    vein_side_albedo: Colour = (0.23, 0.07, 0.085)
    arterial_absorption: Ends = (1.1, 1.5)
    subpial_absorbance_per_mm: Ends = (1.4, 2.2)
    pial_absorbance: Ends = (0.3, 0.9)
    sulcus_shading: Ends = (0.3, 0.6)
    grain: Ends = (0.008, 0.02)
    fluid_smoothing_mm: Ends = (0.035, 0.06)
    bump: Ends = (0.8, 1.3)
    roughness: Ends = (0.018, 0.026)
    dry_roughness: Ends = (0.2, 0.28)
    blood: Ends = (0.25, 0.75)
    dura_albedo: Colour = (0.9, 0.7, 0.6)
    surroundings_albedo: Colour = (0.40, 0.10, 0.065)


FAMILIES: dict[str, Ranges] = {
    "healthy": Ranges(),
    "hyperaemic": Ranges(
        gyrus_albedo=(0.88, 0.52, 0.35),
        perfused_albedo=(0.80, 0.37, 0.26),
        vein_crest_albedo=(0.3, 0.2, 0.29),
        vein_side_albedo=(0.16, 0.03, 0.035),
        arterial_absorption=(1.3, 1.8),
        subpial_absorbance_per_mm=(2.2, 3.2),
        pial_absorbance=(1.2, 2.2),
        blood=(0.5, 0.95),
        dura_albedo=(0.82, 0.5, 0.42),
        surroundings_albedo=(0.42, 0.07, 0.045),
    ),
    "pale": Ranges(
        gyrus_albedo=(0.92, 0.84, 0.67),
        perfused_albedo=(0.89, 0.74, 0.58),
        vein_crest_albedo=(0.42, 0.38, 0.48),
        vein_side_albedo=(0.25, 0.09, 0.1),
        arterial_absorption=(0.7, 1.0),
        subpial_absorbance_per_mm=(0.6, 1.2),
        pial_absorbance=(0.1, 0.4),
        sulcus_shading=(0.2, 0.4),
        fluid_smoothing_mm=(0.04, 0.07),
        bump=(0.7, 1.1),
        blood=(0.1, 0.45),
        dura_albedo=(0.88, 0.7, 0.62),
        surroundings_albedo=(0.5, 0.13, 0.09),
    ),
    "oedematous": Ranges(
        gyrus_albedo=(0.93, 0.80, 0.57),
        perfused_albedo=(0.89, 0.66, 0.48),
        vein_crest_albedo=(0.42, 0.35, 0.44),
        vein_side_albedo=(0.25, 0.09, 0.09),
        arterial_absorption=(0.8, 1.1),
        subpial_absorbance_per_mm=(0.9, 1.5),
        pial_absorbance=(0.3, 0.7),
        sulcus_shading=(0.1, 0.25),
        fluid_smoothing_mm=(0.07, 0.12),
        bump=(0.4, 0.8),
        blood=(0.2, 0.6),
        dura_albedo=(0.87, 0.64, 0.55),
        surroundings_albedo=(0.42, 0.09, 0.06),
    ),
    "calf": Ranges(
        gyrus_albedo=(0.81, 0.64, 0.50),
        perfused_albedo=(0.73, 0.48, 0.38),
        vein_crest_albedo=(0.24, 0.12, 0.13),
        vein_side_albedo=(0.14, 0.035, 0.03),
        arterial_absorption=(0.6, 1.0),
        subpial_absorbance_per_mm=(0.4, 0.9),
        pial_absorbance=(0.3, 0.8),
        sulcus_shading=(0.4, 0.7),
        fluid_smoothing_mm=(0.03, 0.05),
        bump=(1.0, 1.7),
        blood=(0.0, 0.04),
        dura_albedo=(0.66, 0.54, 0.44),
        surroundings_albedo=(0.5, 0.36, 0.27),
    ),
}
