"""Checks of the scale and of the tissue's stiffness, to whose product with scale² force is proportional."""

from __future__ import annotations

from bench.recording import pixel_scale
from bench.recording.folder import Recording
from bench.tracking.tracking import TrackedRecording
from synth.errors import UserError
from synth.recording_flow.finding import Finding, judge_scale, judge_young

_NO_YOUNG = (
    "Young's modulus unknown: forces are those of tissue of 1 kPa, so only scores that are independent of a "
    "factor are reported, and those after the gain of a separate press if there is one"
)


def check_stiffness(recording: Recording) -> list[Finding]:
    """Findings on Young's modulus: unknown, or implausible for tissue."""
    meta = recording.meta
    if meta.young_kpa is None:
        return [Finding("missing", "stiffness", _NO_YOUNG)]
    stated = f"E = {meta.young_kpa:g} kPa ± {100 * meta.young_uncertainty:.2g}%"
    wrong = judge_young(meta.young_kpa, meta.tissue == "phantom")
    return wrong or [Finding("ok", "stiffness", stated)]


def check_scale(recording: Recording) -> list[Finding]:
    """Findings on the stated or calibrated scale."""
    try:
        found = pixel_scale.find_scale(recording.meta, recording.folder)
    except UserError as error:
        return [Finding("error", "scale", str(error))]
    message = f"{found.mm_per_px:.4g} mm/px ± {100 * found.uncertainty:.2g}% ({found.source})"
    return [Finding("ok", "scale", message)]


def check_field_of_view(recording: Recording, tracked: TrackedRecording) -> list[Finding]:
    """Findings on the width of the picture in millimetres."""
    return judge_scale(tracked.scale_mm_per_px, tracked.size[1])
