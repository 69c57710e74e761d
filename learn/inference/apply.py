"""Forces of a video from its motion, and the tissue's stiffness from a press of known force."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from learn.data.grid import GridView
from learn.inference.force_estimator import ForceEstimator, FrameForce
from learn.inference.predict import Predictor, force_size, load_model, net_force
from learn.inference.video_motion import Motion, SecondCamera, motions, read_options, read_single
from learn.uncertainty.conformal import LEVELS
from synth.arguments import checked
from synth.arrays import Array, Floats, Map, Mask
from synth.errors import UserError
from synth.flow.estimator import Estimator
from synth.flow.recording.decode import RecordingFlowSettings
from synth.flow.recording.finding import Finding, first_fault, judge_young, problems
from synth.job.types import MembraneState
from synth.video.read_video import FPS


@checked
def predict(
    source: str | Path | Array,
    model: Predictor | str | Path,
    *,
    scale_mm_per_px: float | Literal["unknown"] | None = None,
    young_kpa: float | None = None,
    membrane: MembraneState = "unknown",
    tissue: str | Path | Array | None = None,
    masks: str | Path | Array = "auto",
    pulse: bool = True,
    flow: str | Estimator = "tvl1",
    shrink: int = 0,
    rate_hz: float | None = 10.0,
    fps: float = FPS,
    rest_frame: int = 0,
    right: str | Path | Array | None = None,
    calibration: str | Path | None = None,
    mm_per_unit: float = 1.0,
    input: str | None = None,
) -> dict[str, Any]:
    """Forces of one video by a network, as `learn predict` estimates them, by the names of its NAME.npz.

    Args:
        source: frames (T, H, W, 3) uint8, a video, a folder of PNGs, a sequence or an .npz of flow.
        model: from `load_model`, its folder or the name of a pretrained one.
        scale_mm_per_px: of a video; unknown: forces are right up to a factor; None: two cameras measure it.
        young_kpa: of the tissue; None: the data's, else forces are those of tissue of 1 kPa.
        membrane: state of the membrane (pia), for a model with that input.
        tissue: mask (H, W) of the rest frame, or a picture of it; None: found by motion.
        masks: auto or none; or instrument masks: (T, H, W), (H, W) or a folder.
        pulse: whether heartbeat and breathing are subtracted from a video's motion.
        flow: estimator of a video's flow.
        shrink: factor by which a video is downsampled before flow; 0: to 320 columns.
        rate_hz: most frames per second that are used; None: all.
        fps: frames per second of an array or a folder of PNGs.
        rest_frame: number of the video's frame in which the tissue is unloaded; earlier ones are left out.
        right: video, PNGs or frames of a right camera: as many as the left's, each of the same moment.
        calibration: of the two cameras, by OpenCV (K1, D1, K2, D2, R, T), Kalibr or others.
        mm_per_unit: millimetres in one unit of the calibration's T.
        input: displacement read from a sequence, as of `learn predict`.

    Raises:
        UserError: an argument of another type, shape or range, or a source of several videos.
    """
    source = Path(source) if isinstance(source, str) else source
    settings = RecordingFlowSettings(flow, shrink, rate_hz, pulse)
    second = SecondCamera.of(right, calibration, mm_per_unit)
    options = read_options(scale_mm_per_px, tissue, masks, settings, fps, rest_frame, second)
    predictor = model if isinstance(model, Predictor) else load_model(model)
    check_cameras(predictor, second)
    motion = read_single(source, motions(source, predictor.choose_source(input), options))
    return apply(predictor, motion, young_kpa, membrane)


def check_cameras(predictor: Predictor, second: SecondCamera | None) -> None:
    """UserError: a second camera is given, but the model uses one."""
    if second is not None and not predictor.card.settings.arch.depth:
        raise UserError("right: this model uses one camera; `stereo` and `bench estimate` use two")


def apply(
    predictor: Predictor, motion: Motion, young_kpa: float | None = None, membrane: MembraneState = "unknown"
) -> dict[str, Any]:
    """Force of every frame of a video, by `ForceEstimator`.

    `young_kpa` overrides the motion's own, unless the scale is unknown. Returns those of
    `prediction_file.FIELDS` that the video and the model have; mask and centre are the last frame's.
    """
    young = young_kpa if young_kpa is not None else motion.young_kpa
    young = young if motion.scale_known else None
    estimator = ForceEstimator(predictor, motion.tissue, motion.scale_mm_per_px, young, membrane)
    rows, forces = [], list[FrameForce]()
    for frame in motion.frames():
        rows.append((frame.index, math.nan if frame.time_s is None else frame.time_s, frame.trusted))
        forces.append(estimator.estimate(frame))
    findings = problems([*judge_young(young), *motion.findings])
    numbers, times, is_tracked = map(np.array, zip(*rows, strict=True))
    trusted = is_tracked & (not first_fault(findings))
    force = np.where(trusted[:, None], [estimate.force_mn for estimate in forces], np.nan)
    last = forces[-1].map
    centres = to_video_px(np.array([estimate.map.view.centre_px for estimate in forces]), motion)
    out: dict[str, Any] = {
        "density": np.stack([estimate.map.density for estimate in forces]),
        "total_force_mn": np.where(trusted, force_size(force), np.nan),
        "trusted": trusted,
        "mask": last.view.mask,
        "pitch_mm": predictor.grid.pitch_mm,
        "scale_mm_per_px": motion.scale_mm_per_px / motion.shrink,
        "centre_px": centres[-1],
        "young_kpa": last.young_kpa,
        "young_known": last.young_known,
        "frame": numbers,
        "centres_px": centres,
    }
    if np.isfinite(times).any():
        out["time_s"] = times
    if last.force_mn is not None:
        out["force_mn"] = force
    doubt = predictor.card.doubt(motion.recovered_by)
    notes = [*motion.notes, *estimator.notes]
    if motion.scale_known:
        notes += estimator.interval_notes
        out |= _ends(forces, trusted)
        if "low_mn" in out and not doubt:
            out["level"] = np.array(LEVELS)
    return out | {"notes": gather_notes(doubt, findings, notes, trusted)}


def to_video_px(points: Floats, motion: Motion) -> Floats:
    """Points (..., 2) px of a motion in the video's own pixels; coordinates are of pixel centres: a picture
    begins at -0.5."""
    return np.asarray(motion.shrink * (points + 0.5) - 0.5)


def gather_notes(
    doubt: Sequence[str], findings: Sequence[Finding], others: Sequence[str], trusted: Mask
) -> Array:
    """All notes on a prediction, (K,) str: `doubt` of the method, the fault or the warnings among the
    findings, `others`, and the number of frames without a force, which are not `trusted` (T,)."""
    fault = first_fault(findings)
    notes = [*doubt, *([f"nothing can be measured: {fault}"] if fault else [])]
    notes += [finding.message for finding in findings if finding.severity == "warning"]
    notes += others
    if not fault and not trusted.all():
        notes.append(f"{(~trusted).sum()} of {len(trusted)} frames could not be followed: they have no force")
    return np.array(notes, dtype=str)


def _ends(forces: Sequence[FrameForce], trusted: Mask) -> dict[str, Floats]:
    """Ends of the intervals by field, (T,) or (T, 3) mN, NaN where not `trusted` (T,)."""
    if not forces[0].bands:
        return {}
    wide, narrow = ([vars(force.bands[level]) for force in forces] for level in LEVELS)
    names = {"low": "low_mn", "high": "high_mn", "axes_low": "force_low_mn", "axes_high": "force_high_mn"}
    out = {name: [band[end] for band in wide] for end, name in names.items()}
    out |= {f"{end}68_mn": [band[end] for band in narrow] for end in ("low", "high")}
    validity = np.where(trusted, 1.0, np.nan)
    return {name: (np.concatenate(ends).T * validity).T for name, ends in out.items()}


def calibrate(predictor: Predictor, press: Motion) -> float:
    """Young's modulus [kPa] by `stiffness` from one press. Raises UserError if its force is not known."""
    if press.force_mn is None:
        raise UserError(f"{press.name}: needs a known force (force_mn in an .npz)")
    view = GridView(press.tissue, press.scale_mm_per_px, predictor.grid)
    frames = press.frames()
    inputs = [predictor.on_grid(view, frame.flow, frame.confidence, frame.motion) for frame in frames]
    displacement, confidence = (np.stack([*part]) for part in zip(*inputs, strict=True))  # a frame has both
    return stiffness(predictor, displacement, view.mask, press.force_mn, confidence)


def stiffness(
    predictor: Predictor, displacement: Map, mask: Map, force_mn: Floats, confidence: Map | None = None
) -> float:
    """Young's modulus [kPa] by a least-squares fit of the prediction to the known force of a press.

    `force_mn`: (T,) size of the known force; others as of `Predictor.density`. Raises UserError if the
    lengths differ, or force or prediction are zero.
    """
    if len(force_mn) != len(displacement):
        raise UserError(f"calibration press: {len(force_mn)} forces for {len(displacement)} frames")
    young = predictor.card.typical_young_kpa
    density = predictor.density(displacement, mask, young, confidence)
    at_rest = predictor.density(np.zeros_like(displacement[:1]), mask, young, None)
    size = force_size(net_force(density, at_rest, predictor.grid))
    fit = float(size @ force_mn), float(size @ size)
    if not (np.isfinite(fit).all() and min(fit) > 0):
        raise UserError("calibration press: the known force or the model's estimate of it is zero")
    return young * fit[0] / fit[1]
