"""Findings on a video or its metadata, for reports; errors and warnings are reported first."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Severity = Literal["ok", "missing", "warning", "error"]
"""`missing`: an optional part is absent; `warning`: usable, should be checked; `error`: no valid numbers."""

# Ranges chosen by hand; outside the second no number is reported.
_USUAL_KPA, _POSSIBLE_KPA = (0.05, 100.0), (0.01, 300.0)  # values of brain in Pa or MPa lie outside both
_USUAL_MM, _POSSIBLE_MM = (8.0, 200.0), (3.0, 300.0)  # width of the field of view of a microscope


@dataclass(frozen=True)
class Finding:
    """One finding."""

    severity: Severity
    cause: str  # part of the recording: pictures, camera, tissue, scale, stiffness, sensor, clocks, ...
    message: str


def judge_young(young_kpa: float | None, phantom: bool = False) -> list[Finding]:
    """Findings on a Young's modulus [kPa], None if unknown; no errors for a phantom."""
    if young_kpa is None or _USUAL_KPA[0] <= young_kpa <= _USUAL_KPA[1]:
        return []
    possible = phantom or _POSSIBLE_KPA[0] <= young_kpa <= _POSSIBLE_KPA[1]
    unit = "Pa" if young_kpa > 1 else "MPa"
    message = f"E = {young_kpa:g} kPa is implausible for tissue: is the value in {unit}?"
    return [Finding("warning" if possible else "error", "stiffness", message)]


def judge_scale(mm_per_px: float, width_px: int) -> list[Finding]:
    """Findings on a scale: a picture of implausible width for a microscope's field of view."""
    width_mm = mm_per_px * width_px
    if not width_mm or _USUAL_MM[0] <= width_mm <= _USUAL_MM[1]:
        return []
    possible = _POSSIBLE_MM[0] <= width_mm <= _POSSIBLE_MM[1]
    message = f"at {mm_per_px:.4g} mm/px the picture would be {width_mm:.3g} mm wide: is the scale in mm/px?"
    return [Finding("warning" if possible else "error", "scale", message)]


def by_severity(findings: Iterable[Finding]) -> list[Finding]:
    """Errors, then warnings, then the others in their order."""
    return sorted(findings, key=lambda finding: {"error": 0, "warning": 1}.get(finding.severity, 2))


def problems(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Errors, then warnings."""
    return tuple(finding for finding in by_severity(findings) if finding.severity in ("error", "warning"))


def first_fault(findings: Iterable[Finding]) -> str:
    """Message of the first error; empty if there is none."""
    return next((finding.message for finding in findings if finding.severity == "error"), "")
