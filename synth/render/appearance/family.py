"""The named appearance families."""

from __future__ import annotations

from typing import NamedTuple

from synth.job.schema import Family

Colour = tuple[float, float, float]


class Ranges(NamedTuple):
    """What a family means: middle colours, linear RGB, and ranges of what `look.Look` documents."""

    crown: Colour
    flush: Colour
    vein: Colour
    wine: Colour
    arterial: tuple[float, float]
    capillary: tuple[float, float]
    blush: tuple[float, float]
    shade: tuple[float, float]
    film_mm: tuple[float, float]
    bump: tuple[float, float]
    blood: tuple[float, float]
    dura: Colour
    beyond: Colour


FAMILIES: dict[Family, Ranges] = {
    "healthy": Ranges(
        crown=(0.95, 0.79, 0.49),
        flush=(0.93, 0.57, 0.38),
        vein=(0.34, 0.24, 0.3),
        wine=(0.2, 0.045, 0.045),
        arterial=(1.1, 1.5),
        capillary=(1.4, 2.2),
        blush=(0.3, 0.9),
        shade=(0.3, 0.6),
        film_mm=(0.035, 0.06),
        bump=(0.8, 1.3),
        blood=(0.25, 0.75),
        dura=(0.86, 0.6, 0.5),
        beyond=(0.46, 0.07, 0.04),
    ),
    "hyperaemic": Ranges(
        crown=(0.88, 0.52, 0.35),
        flush=(0.80, 0.37, 0.26),
        vein=(0.3, 0.2, 0.29),
        wine=(0.16, 0.03, 0.035),
        arterial=(1.3, 1.8),
        capillary=(2.2, 3.2),
        blush=(1.2, 2.2),
        shade=(0.3, 0.6),
        film_mm=(0.035, 0.06),
        bump=(0.8, 1.3),
        blood=(0.5, 0.95),
        dura=(0.82, 0.5, 0.42),
        beyond=(0.46, 0.06, 0.04),
    ),
    "pale": Ranges(
        crown=(0.92, 0.84, 0.67),
        flush=(0.89, 0.74, 0.58),
        vein=(0.42, 0.38, 0.48),
        wine=(0.25, 0.09, 0.1),
        arterial=(0.7, 1.0),
        capillary=(0.6, 1.2),
        blush=(0.1, 0.4),
        shade=(0.2, 0.4),
        film_mm=(0.04, 0.07),
        bump=(0.7, 1.1),
        blood=(0.1, 0.45),
        dura=(0.88, 0.7, 0.62),
        beyond=(0.5, 0.13, 0.09),
    ),
    "oedematous": Ranges(
        crown=(0.93, 0.80, 0.57),
        flush=(0.89, 0.66, 0.48),
        vein=(0.42, 0.35, 0.44),
        wine=(0.25, 0.09, 0.09),
        arterial=(0.8, 1.1),
        capillary=(0.9, 1.5),
        blush=(0.3, 0.7),
        shade=(0.1, 0.25),
        film_mm=(0.07, 0.12),
        bump=(0.4, 0.8),
        blood=(0.2, 0.6),
        dura=(0.87, 0.64, 0.55),
        beyond=(0.46, 0.08, 0.05),
    ),
    "calf": Ranges(
        crown=(0.81, 0.64, 0.50),
        flush=(0.73, 0.48, 0.38),
        vein=(0.24, 0.12, 0.13),
        wine=(0.14, 0.035, 0.03),
        arterial=(0.6, 1.0),
        capillary=(0.4, 0.9),
        blush=(0.3, 0.8),
        shade=(0.4, 0.7),
        film_mm=(0.03, 0.05),
        bump=(1.0, 1.7),
        blood=(0.0, 0.04),
        dura=(0.66, 0.54, 0.44),
        beyond=(0.5, 0.36, 0.27),
    ),
}
