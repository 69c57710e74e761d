"""Findings on a video or its metadata, for reports.

A `VideoPass` collects those on pictures, and the check of a recording those on the consistency of its files.
They are reported first. If one is `bad`, no number is reported.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

_USUAL_KPA, _POSSIBLE_KPA = (0.05, 100.0), (0.01, 300.0)  # values of brain in Pa or MPa lie outside both
_USUAL_MM, _POSSIBLE_MM = (8.0, 200.0), (3.0, 300.0)  # width of the field of view of a microscope


@dataclass(frozen=True)
class Finding:
    """One finding."""

    state: str  # ok, odd (usable, to be checked), lack (optional part is missing) or bad (no valid numbers)
    what: str  # part of the recording
    message: str


def judge_young(young_kpa: float | None, phantom: bool = False) -> list[Finding]:
    """Checks that a Young's modulus [kPa], None if unknown, is plausible; for a phantom it is never `bad`."""
    if young_kpa is None or _USUAL_KPA[0] <= young_kpa <= _USUAL_KPA[1]:
        return []
    possible = phantom or _POSSIBLE_KPA[0] <= young_kpa <= _POSSIBLE_KPA[1]
    unit = "Pa" if young_kpa > 1 else "MPa"
    message = f"E = {young_kpa:g} kPa is implausible for tissue: is the value in {unit}?"
    return [Finding("odd" if possible else "bad", "stiffness", message)]


def judge_scale(mm_per_px: float, width_px: int) -> list[Finding]:
    """Checks that a scale gives a picture the plausible width of a microscope's field of view."""
    wide_mm = mm_per_px * width_px
    if not wide_mm or _USUAL_MM[0] <= wide_mm <= _USUAL_MM[1]:
        return []
    possible = _POSSIBLE_MM[0] <= wide_mm <= _POSSIBLE_MM[1]
    message = f"at {mm_per_px:.4g} mm/px the picture would be {wide_mm:.3g} mm wide: is the scale in mm/px?"
    return [Finding("odd" if possible else "bad", "scale", message)]


def worth_saying(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Findings that are bad, then those that are odd."""
    return tuple(one for state in ("bad", "odd") for one in findings if one.state == state)


def first_fault(findings: Iterable[Finding]) -> str:
    """Message of the first bad finding; empty if there is none."""
    return next((one.message for one in findings if one.state == "bad"), "")
