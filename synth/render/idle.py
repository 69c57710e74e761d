"""Instruments that touch nothing: tools in wait, rods, fingers, gauze and patties, on closed-form paths.

Sizes are those of tools, fingers and cotton; how often each is in view was chosen by eye.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from synth.arrays import Floats

_MOST, _TRIES = 4, 30
_APART_MM = 9.0  # least distance from the axis of another instrument
_TISSUE_MM, _RIM_MM = 3.0, 7.0  # heights over the opening's middle that tissue and rim stay under
CLOTH = "gauze", "patty"  # kinds that lie on what is below; the others hover
RADII_MM = {"rod": (0.25, 4.0), "bent": (0.25, 3.0), "tube": (0.5, 4.0), "finger": (6.5, 8.5)}
RADII_MM |= {"gauze": (7.0, 20.0), "patty": (4.0, 9.0)}
"""Half the width of what is drawn; of cloth half the length."""
_TOOLS = "forceps", "bayonet", "dissector", "suction", "spatula"
_Vector = tuple[float, float, float]


@dataclass(frozen=True)
class IdleInstrument:
    """An instrument that touches nothing, and its path; mm, world axes."""

    kind: str
    radius_mm: float
    tip_mm: _Vector  # farthest in
    shaft: _Vector  # unit vector from tip to hand; of cloth upwards
    aside: _Vector  # unit vector from its first tine to the second; of cloth along its length
    gap_mm: float  # between two tines
    travel_mm: float = 0.0  # by which it is drawn back along its shaft
    drift_mm: float = 0.0  # amplitude of its motion along `aside`
    period_s: float = 4.0
    phase: float = 0.0  # of its motion when the sequence begins [rad]

    def at(self, seconds: float) -> tuple[Floats, Floats]:
        """Tips (2, 3) mm and shafts (2, 3)."""
        turn = 2 * np.pi * seconds / self.period_s + self.phase
        shaft, aside = np.asarray(self.shaft), np.asarray(self.aside)
        across = self.drift_mm * np.sin(turn) + 0.5 * self.gap_mm * np.array([[-1], [1]])
        retraction = self.travel_mm * (1 - np.cos(turn)) / 2
        return np.asarray(self.tip_mm) + retraction * shaft + across * aside, np.stack([shaft, shaft])


def with_idle(
    idle: Sequence[IdleInstrument], seconds: float, tips: Floats, shafts: Floats
) -> tuple[Floats, Floats]:
    """Tips (2n, 3) mm and shafts (2n, 3) of acting instruments, followed by those of idle ones."""
    poses = [(tips, shafts), *(instrument.at(seconds) for instrument in idle)]
    return np.concatenate([tip for tip, _ in poses]), np.concatenate([shaft for _, shaft in poses])


def draw_idle(
    strength: float, rng: np.random.Generator, opening_mm: float, visible_mm: float, acting: Floats
) -> tuple[IdleInstrument, ...]:
    """Up to four idle instruments, on average twice `strength`, those that don't fit left out.

    `opening_mm` and `visible_mm`: radii of the opening and of the view; `acting`: (n, 2, 3) point of contact
    [mm] and shaft of each acting instrument.
    """
    instruments, lines = list[IdleInstrument](), list(acting)
    for _ in range(rng.binomial(_MOST, 0.5 * strength)):
        for _ in range(_TRIES):
            instrument = _draw(rng, opening_mm, visible_mm)
            if _is_clear(instrument, np.reshape(lines, (-1, 2, 3))):
                instruments.append(instrument)
                if instrument.kind not in CLOTH:  # which lies under other idle instruments
                    lines.append(np.array([instrument.tip_mm, instrument.shaft]))
                break
    return tuple(instruments)


def _draw(rng: np.random.Generator, opening_mm: float, visible_mm: float) -> IdleInstrument:
    """A tool whose hand is outside the view, or cloth near the opening's edge."""
    kind = str(rng.choice([*RADII_MM, *RADII_MM, *_TOOLS]))
    is_cloth, motion = kind in CLOTH, float(rng.random() < 0.6)
    radius, azimuth = rng.uniform(*RADII_MM.get(kind, (2.0, 6.0))), rng.uniform(0, 2 * np.pi)
    distance = min(visible_mm, 1.5 * opening_mm) * rng.uniform() ** 0.5
    elevation, hand_azimuth, height = (
        np.radians(rng.uniform(15, 60)),
        azimuth + rng.normal(0, 0.7),
        rng.uniform(2, 20),
    )
    height = max(_TISSUE_MM + height, _RIM_MM - np.tan(elevation) * (opening_mm - distance))
    height += radius if kind in RADII_MM else 1.5
    if is_cloth:
        distance, elevation = min(visible_mm, opening_mm) + rng.uniform(-0.5, 0.7) * radius, np.pi / 2
        height = motion = 0.0
    tip = float(distance * np.cos(azimuth)), float(distance * np.sin(azimuth)), float(height)
    c, s = float(np.cos(hand_azimuth)), float(np.sin(hand_azimuth))
    shaft = c * float(np.cos(elevation)), s * float(np.cos(elevation)), float(np.sin(elevation))
    path = rng.uniform((0.5, 0, 0, 2, 0), (5, 30 * motion, 3 * motion, 8, 2 * np.pi)).tolist()
    return IdleInstrument(kind, float(radius), tip, shaft, (-s, c, 0.0), *path)


def _is_clear(instrument: IdleInstrument, others: Floats) -> bool:
    """Whether an instrument is apart from others on its path; `others`: (n, 2, 3) points mm and shafts."""
    along = np.linspace(0, 110, 56)[:, None]
    axis_points = np.asarray(instrument.tip_mm) + along * (
        0 if instrument.kind in CLOTH else np.asarray(instrument.shaft)
    )
    lines = (others[:, :1] + along * others[:, 1:]).reshape(-1, 1, 3)
    gap = np.linalg.norm(lines - axis_points, axis=2).min(initial=np.inf)
    return float(gap) >= _APART_MM + instrument.radius_mm + instrument.drift_mm + 0.5 * instrument.gap_mm
