"""Finishes of instruments: satin metal, insulation, paint, gloves, cotton; their wear and blood.

All numbers were chosen by eye, also reflectances of steel and titanium, and the roughness of instruments that
are blasted or brushed against glare.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from synth.arrays import Floats
from synth.render.anatomy.layers import Rgb, over, step
from synth.render.appearance.reflection import Reflectance
from synth.render.idle import CLOTH

_METALS: tuple[Rgb, ...] = (0.67, 0.64, 0.60), (0.67, 0.64, 0.60), (0.62, 0.58, 0.54)
_ALPHAS = (0.22, 0.36), (0.16, 0.28), (0.5, 0.9), (0.06, 0.15)  # GGX: satin, brushed, matte, polished
_SHARES = 0.7, 0.3, 0.0, 0.0  # of these among instruments in use
_PLASTIC = np.full(3, 0.04)  # reflectance of coats at right angles, at an index of 1.5
_BLOOD = np.array([0.20, 0.006, 0.005])
_INSULATED = {"forceps": 0.5, "bayonet": 0.6, "suction": 0.2, "spatula": 0.1}
SOLD: tuple[Rgb, ...] = (  # insulation: blue, black, white, green, yellow, grey
    (0.02, 0.08, 0.34), (0.02, 0.02, 0.02), (0.7, 0.7, 0.7), (0.03, 0.24, 0.14), (0.7, 0.5, 0.05), (0.3,) * 3
)  # fmt: skip
_GLOVES: tuple[Rgb, ...] = (0.76, 0.66, 0.48), (0.10, 0.22, 0.52), (0.34, 0.50, 0.40), (0.86, 0.84, 0.78)
_SOFT = {"finger": _GLOVES, **dict.fromkeys(CLOTH, ((0.86, 0.82, 0.76),))}
COATS_MM = 5.0, 7.0, 9.0, 12.0  # from the tip to where coats begin; meshes have rings there


@dataclass(frozen=True)
class Finish:
    """Surface of one instrument; colours are linear RGB."""

    mirror: Rgb  # reflectance of the bare body at right angles
    alpha: float  # its GGX roughness
    scattered: float = 0.0  # light that it scatters diffusely, as a share of what it mirrors
    brushed: float = 0.0  # contrast of its lines along the shaft
    coat: Rgb = (0.0, 0.0, 0.0)  # albedo
    coat_alpha: float = 0.3
    bare_mm: float = np.inf  # length from the tip without coat
    wear: float = 0.0  # 0 new to 1: edges rubbed bare and bright
    blood: float = 0.0  # share that is covered of
    blood_mm: float = 0.0  # the length from the tip, or of cloth from the border


def draw_finish(strength: float, rng: np.random.Generator, kind: str) -> Finish:
    """A finish of an instrument of that kind: of those in use, or with probability `strength` of any."""
    wide, soft, colours = rng.random() < strength, kind in _SOFT, _SOFT.get(kind, SOLD)
    metal, coat = _METALS[rng.integers(len(_METALS))], colours[rng.integers(len(colours))]
    if wide and kind not in CLOTH and rng.random() < 0.7:
        r, g, b = (rng.uniform(0.01, 0.9, 3 if rng.random() < 0.6 else 1) ** 2 * np.ones(3)).tolist()
        coat = r, g, b
    coated = rng.random() < (0.6 if wide else _INSULATED.get(kind, 0.0))
    # From before its tip on: all of it, as paint or composite.
    bare = -1.0 if soft else float(rng.choice((-1.0, *COATS_MM) if wide else COATS_MM)) if coated else np.inf
    body = rng.choice(len(_ALPHAS), p=None if wide else _SHARES)
    ranges = [_ALPHAS[body], (0.06, 0.15), (0.2, 0.5), (0.7, 1.0) if kind in CLOTH else (0.25, 0.45)]
    ranges += [(0, 1), (0.2, 1), (2, 30)] if wide else [(0, 0.35), (0.2, 0.7), (2, 7)]
    alpha, scattered, brushed, coat_alpha, wear, blood, long = rng.uniform(*np.transpose(ranges)).tolist()
    bloody = blood * (rng.random() < 0.6)
    body_only = scattered * (body != 3), brushed * (body == 1)
    return Finish(metal, alpha, *body_only, coat, coat_alpha, bare, wear * (not soft), bloody, long)


def reflectance(finish: Finish, profile: Floats, columns: int, rng: np.random.Generator) -> Reflectance:
    """Reflectance at the vertices (V, 3) mm of a bar in rings of `columns` with its tip at z = 0, or of a
    sheet in x and y if that is 0."""
    # Flat bars have few vertices across.
    wave = max(2.5, 0.8 * float(np.ptp(profile[: 24 * columns, 1]))) if columns else 8.0
    uneven = noise(profile * [1, 1, bool(columns)], wave, rng)
    if columns:
        along, edge = profile[:, 2], _edges(profile, columns)
        lines = np.tile(rng.normal(size=columns), len(profile) // columns)
    else:
        sides = np.abs(profile[:, :2])
        along, edge = (sides.max(axis=0) - sides).min(axis=1), np.zeros(len(profile))
        lines = rng.normal(size=len(profile))
    worn = step((edge + 0.3 * uneven - 1.5 * (1 - finish.wear)) / 0.4) * (finish.wear > 0)
    coat = step((along - finish.bare_mm) / 0.04) * (1 - worn)
    wet = step(1 - along / max(finish.blood_mm, 0.1) + 0.7 * uneven + 2 * finish.blood - 1.4)
    wet = wet * (finish.blood > 0) * step((1.3 * finish.blood_mm - along) / 2)
    alpha = finish.alpha * np.exp(finish.brushed * lines) * (1 - 0.3 * worn)
    alpha = over(over(alpha, np.asarray(finish.coat_alpha), coat), np.asarray(0.12), wet)
    metal, hidden = np.asarray(finish.mirror) * (1 + 0.1 * worn[:, None]), np.maximum(coat, wet)[:, None]
    diffuse = over(finish.scattered * metal, np.asarray(finish.coat), coat[:, None])
    diffuse = diffuse * np.clip(1 + 0.06 * uneven + (0.3 * finish.brushed + 0.05) * lines, 0, 2)[:, None]
    diffuse = np.clip(over(diffuse, _BLOOD, 0.9 * wet[:, None]), 0, 1)
    return Reflectance(diffuse, over(metal, _PLASTIC, hidden), np.clip(alpha, 0.05, 1))


def noise(at: Floats, wave_mm: float, rng: np.random.Generator) -> Floats:
    """Smooth noise (V,) of unit variance at places (V, n) mm."""
    waves = rng.normal(size=(at.shape[1], 16)) * 2 * np.pi / wave_mm
    return np.asarray(np.cos(at @ waves + rng.uniform(0, 2 * np.pi, 16)).sum(axis=1) / np.sqrt(8))


def _edges(profile: Floats, columns: int) -> Floats:
    """By how much (V,) the outline of a bar's rings turns more at a vertex than a circle's."""
    outline = (profile[:, 0] + 1j * profile[:, 1]).reshape(-1, columns)
    side = np.roll(outline, -1, axis=1) - outline
    turn = np.abs(np.angle(side * np.conj(np.roll(side, 1, axis=1)))) * columns / (2 * np.pi)
    return np.asarray(np.clip(turn - 1, 0, 2).ravel())
