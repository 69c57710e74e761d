"""What is found wrong with a film or with what is stated of it, for whoever reads one.

A `VideoFlow` gathers what its pictures show, a recording's check what its files say of one another; all of it
is said first, and where something is `bad` no number is given.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

_USUAL_KPA, _POSSIBLE_KPA = (0.05, 100.0), (0.01, 300.0)  # brain in Pa or MPa lies beyond what is possible
_USUAL_MM, _POSSIBLE_MM = (8.0, 200.0), (3.0, 300.0)  # that a picture through a microscope is wide


@dataclass(frozen=True)
class Finding:
    """One line."""

    state: str
    """`ok`, `odd` (usable, but look at it), `lack` (optional, not there) or `bad` (no number can stand)."""
    what: str
    """Which part of the recording."""
    message: str
    """What was found."""


def judge_young(young_kpa: float | None, phantom: bool = False) -> list[Finding]:
    """Whether a Young's modulus [kPa] is one of tissue; of a phantom none is impossible. None: unknown."""
    if young_kpa is None or _USUAL_KPA[0] <= young_kpa <= _USUAL_KPA[1]:
        return []
    possible = phantom or _POSSIBLE_KPA[0] <= young_kpa <= _POSSIBLE_KPA[1]
    unit = "Pa" if young_kpa > 1 else "MPa"
    said = f"E = {young_kpa:g} kPa is no tissue's: was {unit} meant?"
    return [Finding("odd" if possible else "bad", "stiffness", said)]


def judge_scale(mm_per_px: float, width_px: int) -> list[Finding]:
    """Whether a scale makes a picture as wide as a microscope's may be."""
    wide_mm = mm_per_px * width_px
    if not wide_mm or _USUAL_MM[0] <= wide_mm <= _USUAL_MM[1]:
        return []
    possible = _POSSIBLE_MM[0] <= wide_mm <= _POSSIBLE_MM[1]
    said = f"at {mm_per_px:.4g} mm/px the picture would be {wide_mm:.3g} mm wide: is the scale in mm/px?"
    return [Finding("odd" if possible else "bad", "scale", said)]


def worth_saying(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Those that are wrong or odd, the worst first."""
    return tuple(one for state in ("bad", "odd") for one in findings if one.state == state)


def first_fault(findings: Iterable[Finding]) -> str:
    """Why no number can stand; empty if one may."""
    return next((one.message for one in findings if one.state == "bad"), "")
