"""Finishes of instruments: satin metal, insulation, paint, gloves, cotton; their wear, blood and water.

Reflectances at right angles are about those of iron and chromium, the parts of stainless steel, and of
titanium (P. B. Johnson, R. W. Christy, "Optical constants of transition metals", 1974). All other numbers
were chosen by eye: instruments are blasted, turned or brushed against glare.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from synth.render.anatomy.layers import Rgb
from synth.render.idle import CLOTH

_METALS: tuple[Rgb, ...] = (0.67, 0.64, 0.60), (0.67, 0.64, 0.60), (0.62, 0.58, 0.54)
_ALPHAS = (0.10, 0.17), (0.10, 0.15), (0.5, 0.9), (0.06, 0.15)  # GGX, across: satin, brushed, matte, polished
_STREAKS = 3.2, 4.2, 1.0, 1.0  # of that along it
_SHARES = 0.7, 0.3, 0.0, 0.0  # of these among instruments in use
_INSULATED = {"forceps": 0.5, "bayonet": 0.6, "suction": 0.2}
SOLD: tuple[Rgb, ...] = (  # insulation: blue, black, white, green, yellow, grey
    (0.05, 0.11, 0.29), (0.02, 0.02, 0.02), (0.7, 0.7, 0.7), (0.06, 0.21, 0.14), (0.6, 0.45, 0.12), (0.3,) * 3
)  # fmt: skip
_GLOVES: tuple[Rgb, ...] = (0.76, 0.66, 0.48), (0.10, 0.22, 0.52), (0.34, 0.50, 0.40), (0.86, 0.84, 0.78)
_SOFT = {"finger": _GLOVES, **dict.fromkeys(CLOTH, ((0.86, 0.82, 0.76),))}
_COAT_ALPHAS, _COAT_STREAK = {True: (0.25, 0.45), False: (0.08, 0.11)}, 9.0  # of gloves; of insulation, paint
COATS_MM = 5.0, 7.0, 9.0, 12.0  # from the tip to where coats begin; meshes have rings there


@dataclass(frozen=True)
class Finish:
    """Surface of one instrument; colours are linear RGB."""

    mirror: Rgb  # reflectance of the bare body at right angles
    alpha: float  # its GGX roughness across the shaft
    streak: float = 1.0  # that along the shaft, as a multiple: by turning and brushing around it
    scattered: float = 0.0  # light that it scatters diffusely, as a share of what it mirrors
    brushed: float = 0.0  # contrast of its lines along the shaft
    coat: Rgb = (0.0, 0.0, 0.0)  # albedo
    coat_alpha: float = 0.3  # its GGX roughness across the shaft
    coat_streak: float = 1.0  # that along the shaft, as a multiple: by drawing and handling
    bare_mm: float = np.inf  # length from the tip without coat
    wear: float = 0.0  # 0 new to 1: edges rubbed bare and bright
    blood: float = 0.0  # share that is covered of
    blood_mm: float = 0.0  # the length from the tip, or of cloth from the border
    wet_mm: float = 0.0  # the length from the tip under water


def draw_finish(strength: float, rng: np.random.Generator, kind: str) -> Finish:
    """A finish of an instrument of that kind: of those in use, or with probability `strength` of any."""
    any_finish, is_soft, colours = rng.random() < strength, kind in _SOFT, _SOFT.get(kind, SOLD)
    metal, coat = _METALS[rng.integers(len(_METALS))], colours[rng.integers(len(colours))]
    if any_finish and kind not in CLOTH and rng.random() < 0.7:
        r, g, b = (rng.uniform(0.01, 0.9, 3 if rng.random() < 0.6 else 1) ** 2 * np.ones(3)).tolist()
        coat = r, g, b
    has_coat = rng.random() < (0.6 if any_finish else _INSULATED.get(kind, 0.0))
    # From before its tip on: all of it, as paint or composite.
    bare_mm = (
        -1.0
        if is_soft
        else float(rng.choice((-1.0, *COATS_MM) if any_finish else COATS_MM))
        if has_coat
        else np.inf
    )
    body = rng.choice(len(_ALPHAS), p=None if any_finish else _SHARES)
    ranges = [_ALPHAS[body], (0.06, 0.15), (0.2, 0.5), (0.7, 1.0) if kind in CLOTH else _COAT_ALPHAS[is_soft]]
    ranges += [(0, 1), (0.2, 1), (2, 30)] if any_finish else [(0, 0.15), (0.2, 0.7), (2, 7)]
    alpha, scattered, brushed, coat_alpha, wear, blood, blood_mm = rng.uniform(*np.transpose(ranges)).tolist()
    blood_share = blood * (rng.random() < 0.6)
    body_values = scattered * (body != 3), brushed * (body == 1)
    wet_mm = 0.0 if is_soft else float(rng.choice([1.5, 3.0, 5.0, 8.0]))
    streak = _STREAKS[body]
    return Finish(
        metal, alpha, streak, *body_values, coat, coat_alpha, 1.0 if is_soft else _COAT_STREAK, bare_mm,
        wear * (not is_soft), blood_share, blood_mm, wet_mm,
    )  # fmt: skip
