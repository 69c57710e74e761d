"""Findings on the right or depth camera: its pictures, timing, calibration, noise and scale."""

from __future__ import annotations

import numpy as np

from synth.flow.recording.finding import Finding
from synth.flow.recording.right_pictures import PairQuality

# Chosen by hand between the corrupted and the clean recordings of docs/results/scoring/stability.
_FROZEN = 3  # frames
_BEHIND_PX = 1.0  # disparity of tissue minus that of the tool, which hides tissue and so is nearer than it
_OFF_ROWS_PX, _OTHER_ROWS_PX = 0.5, 2.0  # of reduced frames: an outdated calibration, one of another pair
_SOFT = 0.7  # least share of fine detail over that of the left camera; clean: at least 0.9
_NOISY_MM = 0.16  # depth motion from which force is no better than monocular
# Logarithm of the stated scale over the stereo scale: from the first they contradict each other, from the
# second the error of force is too large for any result.
_OTHER_SCALE, _ANOTHER_SCALE = 0.1, 0.3
_UNITS_MM = {"metres": 1000.0, "centimetres": 10.0, "micrometres": 0.001}


def judge_pair(stereo: PairQuality, stated_mm_per_px: float | None) -> list[Finding]:
    """All findings on a pair; `stated_mm_per_px`: of the video's own pixels, None if not stated."""
    return [*judge_pairing(stereo), *judge_quality(stereo), *judge_pair_scale(stereo, stated_mm_per_px)]


def judge_pairing(stereo: PairQuality) -> list[Finding]:
    """Findings on right pictures that are copies, frozen, swapped with the left ones, late or early."""
    if stereo.copied:
        fault = "shows the left camera's own pictures"
    elif stereo.frozen >= _FROZEN:
        fault = f"is frozen in {stereo.frozen} frames in which the left camera's picture changes"
    elif stereo.tool_behind_px > _BEHIND_PX:
        fault = "shows the tool behind the tissue: left and right are swapped, or both mirrored"
    elif stereo.lag_s:
        fault = f"is about {abs(stereo.lag_s):.2g} s {'late' if stereo.lag_s > 0 else 'early'}"
        if stereo.lag_from_s is not None:
            fault += f", from {stereo.lag_from_s:.3g} s"
            fault += ": or are pictures of the left one missing there?" if stereo.lag_s > 0 else ""
    else:
        return []
    return [Finding("error", "stereo", f"the right camera {fault}")]


def judge_quality(stereo: PairQuality) -> list[Finding]:
    """Findings on the right camera's calibration, motion and focus, and on the noise of depth motion."""
    if stereo.epipolar_px > _OTHER_ROWS_PX:
        rows = f"rows of left and right picture are {stereo.epipolar_px:.2g} px off"
        return [Finding("error", "stereo", f"{rows}: is the calibration of this camera pair?")]
    poor = stereo.epipolar_px > _OFF_ROWS_PX or not stereo.noise_mm < _NOISY_MM
    findings = [Finding("warning" if poor else "ok", "stereo", stereo.describe())]
    findings += [Finding("warning", "camera", f"right camera: {text}") for text in stereo.motion]
    if stereo.last_rows_px > max(_OFF_ROWS_PX, 2 * stereo.epipolar_px):
        message = f"rows of left and right picture are {stereo.last_rows_px:.2g} px off at the end, but"
        message += f" {stereo.epipolar_px:.2g} px in the rest frame: was the right camera bumped?"
        findings.append(Finding("error", "stereo", message))
    if stereo.sharpness < _SOFT:
        softness = f"has {100 * stereo.sharpness:.0f}% of the left camera's fine detail: is it out of focus?"
        findings.append(Finding("warning", "stereo", f"the right camera {softness}"))
    return findings


def judge_pair_scale(stereo: PairQuality, stated: float | None) -> list[Finding]:
    """Findings on a stated scale [mm/px] that differs from that of the right or depth camera."""
    if not stated or (log_ratio := abs(np.log(stereo.mm_per_px / stated))) <= _OTHER_SCALE:
        return []
    message = f"{stated:.4g} mm/px is stated, but stereo gives {stereo.mm_per_px:.4g}"
    for unit, factor in _UNITS_MM.items():
        if abs(np.log(factor * stereo.mm_per_px / stated)) < _ANOTHER_SCALE:
            message += f": if its calibration is in {unit}, multiply mm_per_unit by {factor:g}"
    return [Finding("error" if log_ratio > _ANOTHER_SCALE else "warning", "scale", message)]
