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
        back = self.travel_mm * (1 - np.cos(turn)) / 2
        return np.asarray(self.tip_mm) + back * shaft + across * aside, np.stack([shaft, shaft])


def with_idle(
    idle: Sequence[IdleInstrument], seconds: float, tips: Floats, shafts: Floats
) -> tuple[Floats, Floats]:
    """Tips (2n, 3) mm and shafts (2n, 3) of acting instruments, followed by those of idle ones."""
    poses = [(tips, shafts), *(one.at(seconds) for one in idle)]
    return np.concatenate([one for one, _ in poses]), np.concatenate([other for _, other in poses])


def draw_idle(
    strength: float, rng: np.random.Generator, opening_mm: float, visible_mm: float, acting: Floats
) -> tuple[IdleInstrument, ...]:
    """Up to four idle instruments, on average twice `strength`, those that don't fit left out.

    `opening_mm` and `visible_mm`: radii of the opening and of the view; `acting`: (n, 2, 3) point of contact
    [mm] and shaft of each acting instrument.
    """
    found, lines = list[IdleInstrument](), list(acting)
    for _ in range(rng.binomial(_MOST, 0.5 * strength)):
        for _ in range(_TRIES):
            one = _drawn(rng, opening_mm, visible_mm)
            if _clear(one, np.reshape(lines, (-1, 2, 3))):
                found.append(one)
                if one.kind not in CLOTH:  # which lies under other idle instruments
                    lines.append(np.array([one.tip_mm, one.shaft]))
                break
    return tuple(found)


def _drawn(rng: np.random.Generator, opening_mm: float, visible_mm: float) -> IdleInstrument:
    """A tool whose hand is outside the view, or cloth near the opening's edge."""
    kind = str(rng.choice([*RADII_MM, *RADII_MM, *_TOOLS]))
    cloth, moves = kind in CLOTH, float(rng.random() < 0.6)
    radius, around = rng.uniform(*RADII_MM.get(kind, (2.0, 6.0))), rng.uniform(0, 2 * np.pi)
    away = min(visible_mm, 1.5 * opening_mm) * rng.uniform() ** 0.5
    lean, hand, high = np.radians(rng.uniform(15, 60)), around + rng.normal(0, 0.7), rng.uniform(2, 20)
    high = max(_TISSUE_MM + high, _RIM_MM - np.tan(lean) * (opening_mm - away))
    high += radius if kind in RADII_MM else 1.5
    if cloth:
        away, lean = min(visible_mm, opening_mm) + rng.uniform(-0.5, 0.7) * radius, np.pi / 2
        high = moves = 0.0
    tip = float(away * np.cos(around)), float(away * np.sin(around)), float(high)
    c, s = float(np.cos(hand)), float(np.sin(hand))
    shaft = c * float(np.cos(lean)), s * float(np.cos(lean)), float(np.sin(lean))
    path = rng.uniform((0.5, 0, 0, 2, 0), (5, 30 * moves, 3 * moves, 8, 2 * np.pi)).tolist()
    return IdleInstrument(kind, float(radius), tip, shaft, (-s, c, 0.0), *path)


def _clear(one: IdleInstrument, others: Floats) -> bool:
    """Whether an instrument is apart from others on its path; `others`: (n, 2, 3) points mm and shafts."""
    along = np.linspace(0, 110, 56)[:, None]
    own = np.asarray(one.tip_mm) + along * (0 if one.kind in CLOTH else np.asarray(one.shaft))
    lines = (others[:, :1] + along * others[:, 1:]).reshape(-1, 1, 3)
    apart = np.linalg.norm(lines - own, axis=2).min(initial=np.inf)
    return float(apart) >= _APART_MM + one.radius_mm + one.drift_mm + 0.5 * one.gap_mm
