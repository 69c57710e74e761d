"""`bench.estimate` and `bench estimate`: the force in a video by physics, without a recording folder."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import TypeAdapter, ValidationError

from bench.methods import force_interval
from bench.methods.method_interface import ForceEstimate, MethodContext
from bench.methods.physics import GRID, Physics
from bench.tracking.contact_free import ContactFreeSearch
from learn.data.clips import UNKNOWN_YOUNG_KPA
from learn.inference.apply import gather_notes, to_video_px
from learn.inference.video_motion import (
    Motion,
    SecondCamera,
    has_right_camera,
    motions,
    read_options,
    read_single,
)
from learn.uncertainty.intervals import LEVEL
from synth.arguments import checked
from synth.arrays import Array, Floats, Ints, Mask
from synth.errors import UserError, as_positive
from synth.flow.estimator import Estimator
from synth.flow.recording.decode import RecordingFlowSettings
from synth.flow.recording.finding import first_fault, judge_young, problems
from synth.flow.recording.harmonic_fit import Span
from synth.job.types import MembraneState, PronyTerms
from synth.video.read_video import FPS


@checked
def estimate(
    source: str | Path | Array,
    *,
    scale_mm_per_px: float | Literal["unknown"] | None = None,
    young_kpa: float | None = None,
    young_uncertainty: float = 0.0,
    membrane: MembraneState = "unknown",
    membrane_mn_per_mm: tuple[float, float] | None = None,
    relaxation: Sequence[tuple[float, float]] | None = None,
    living: bool = True,
    free_s: Sequence[Span] = (),
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
    """Forces of one video by physics, which needs no training, by the names of `bench estimate`'s NAME.npz.

    Args:
        source: frames (T, H, W, 3) uint8, a video, a folder of PNGs, a sequence or an .npz of flow.
        scale_mm_per_px: of a video; unknown: forces are right up to a factor; None: two cameras measure it.
        young_kpa: of the tissue; None: the data's, else forces are those of tissue of 1 kPa.
        young_uncertainty: its relative standard deviation, which widens the interval.
        membrane: state of the membrane (pia).
        membrane_mn_per_mm: range of its stiffness, thickness times Young's modulus; None: unknown.
        relaxation: lost shares of the tissue's stiffness and their times [s], as of a job; `young_kpa`, and a
            membrane's stiffness, are then instantaneous. None: the data's, else elastic, as if empty.
        living: whether heart and breath may move the tissue; False: ex vivo, or a phantom.
        free_s: begin and end [s] of spans of the video without contact, which show what else moves the
            tissue; empty: they are looked for.
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
        input: displacement read from a sequence: recovered or ideal, with two cameras motion or motion-ideal.

    Returns:
        Arrays by name, as of `learn.predict`: `total_force_mn` (T,) the size of the force [mN] and its 90%
        interval `low_mn`, `high_mn`, `force_mn` (T, 3) the force in camera axes, and others.

    Raises:
        UserError: an argument of another type, shape or range, or a source of several videos.
    """
    source = Path(source) if isinstance(source, str) else source
    settings = RecordingFlowSettings(flow, shrink, rate_hz, pulse)
    second = SecondCamera.of(right, calibration, mm_per_unit)
    options = read_options(scale_mm_per_px, tissue, masks, settings, fps, rest_frame, second)
    motion = read_single(source, motions(source, choose_input(source, input), options))
    statements = young_kpa, membrane, membrane_mn_per_mm, living, options.given
    return apply_physics(
        motion, *statements, young_uncertainty=young_uncertainty, free_s=free_s, relaxation=relaxation
    )


def choose_input(source: Path | Array, requested: str | None) -> str:
    """The displacement to read from stored sequences: the given one, else the recovered one, of two cameras
    where there are."""
    return requested or ("motion" if has_right_camera(source) else "recovered")


@dataclass(frozen=True, eq=False)
class PhysicsTrack:
    """What physics was given of T frames, and its estimates."""

    index: Ints  # (T,) numbers in the video
    time_s: Floats  # (T,), NaN without a clock
    trusted: Mask  # (T,)
    moved_mm: Floats  # (T,) mean length of the flow over the tissue
    cameras: int
    estimates: list[ForceEstimate]


def apply_physics(
    motion: Motion,
    young_kpa: float | None = None,
    membrane: MembraneState = "unknown",
    membrane_mn_per_mm: tuple[float, float] | None = None,
    living: bool = True,
    given: tuple[bool, bool] = (False, False),
    *,
    young_uncertainty: float = 0.0,
    free_s: Sequence[Span] = (),
    relaxation: Sequence[tuple[float, float]] | None = None,
) -> dict[str, Any]:
    """Force of every frame of a video by `Physics`, with its calibrated interval.

    `young_kpa` to `living`, `young_uncertainty` to `relaxation`: as of `estimate`; `given`: as of
    `VideoOptions`. Returns those of `learn.inference.prediction_file.FIELDS` that there are. Raises UserError
    for an invalid modulus, stiffness or relaxation, a span without frames, and relaxation without a clock.
    """
    young = motion.young_kpa if young_kpa is None else as_positive("young_kpa", young_kpa)
    young = young if motion.scale_known else None
    if not 0 <= young_uncertainty < 1:
        raise UserError(f"young_uncertainty {young_uncertainty}: a relative standard deviation, from 0 to 1")
    if young_uncertainty and young is None:
        raise UserError("young_uncertainty: needs young_kpa and the video's scale")
    scale, recovered_by, stiffness = motion.scale_mm_per_px, motion.recovered_by, membrane_mn_per_mm
    if stiffness is not None:
        low, high = (as_positive("membrane_mn_per_mm", end) for end in stiffness)
        stiffness = min(low, high), max(low, high)
    extra: dict[str, Any] = {"living": living, "recovered_by": recovered_by, "membrane_mn_per_mm": stiffness}
    extra["relaxation"] = motion.relaxation if relaxation is None else _check_relaxation(relaxation)
    scene, physics = MethodContext(motion.tissue, scale, young, membrane, **extra), Physics()
    track = _follow(motion, scene, physics, free_s)
    findings = problems([*judge_young(young), *motion.findings])
    trusted = track.trusted & (not first_fault(findings))
    bounds_mn, warnings = np.full((len(trusted), 2), np.nan), list(physics.warnings)
    if trusted.any():
        estimates = [track.estimates[k] for k in np.flatnonzero(trusted)]
        stated = float(np.mean([*given, membrane != "unknown", not living or bool(free_s)]))
        video = force_interval.gather(estimates, track.moved_mm[trusted], track.cameras, stated)
        estimates, reason = force_interval.bound(estimates, video, young_uncertainty, recovered_by)
        bounds_mn[trusted] = [(force.low_mn, force.high_mn) for force in estimates]
        warnings += [reason] if reason else []
    centres = to_video_px(physics.centres_px, motion)
    out: dict[str, Any] = {
        "density": physics.map_forces()[:, None],
        "total_force_mn": np.where(trusted, [force.size_mn for force in track.estimates], np.nan),
        "force_mn": np.where(trusted[:, None], [force.force_mn for force in track.estimates], np.nan),
        "trusted": trusted,
        "mask": physics.view.mask,
        "pitch_mm": GRID.pitch_mm,
        "scale_mm_per_px": scale / motion.shrink,
        "centre_px": centres[-1],
        "centres_px": centres,
        "young_kpa": UNKNOWN_YOUNG_KPA if young is None else young,
        "young_known": young is not None,
        "frame": track.index,
    }
    if np.isfinite(track.time_s).any():
        out["time_s"] = track.time_s
    if np.isfinite(bounds_mn).any():
        out |= {"low_mn": bounds_mn[:, 0], "high_mn": bounds_mn[:, 1], "level": np.array([LEVEL])}
    notes = gather_notes((), findings, [*motion.notes, *physics.notes, *warnings], trusted)
    return out | {"notes": notes}


def _check_relaxation(terms: Sequence[tuple[float, float]]) -> PronyTerms:
    """The terms; UserError if they are none."""
    try:
        return TypeAdapter(PronyTerms).validate_python(tuple(terms))
    except (ValidationError, TypeError):
        form = "one or two pairs of a lost share, above 0 and below 1 together, and its time in s"
        raise UserError(f"relaxation {terms}: give {form}") from None


def _follow(motion: Motion, scene: MethodContext, physics: Physics, free_s: Sequence[Span]) -> PhysicsTrack:
    """Applies physics to every frame, and again to all once spans without contact are known."""
    search, cameras = ContactFreeSearch(motion.tissue, scene.scale_mm_per_px), 1
    rows = list[tuple[int, float, bool, float]]()
    for frame in motion.frames():
        physics(frame, scene, False)
        search.add(frame, frame.time_s or 0.0)
        time_s = math.nan if frame.time_s is None else frame.time_s
        rows.append((frame.index, time_s, frame.trusted, force_interval.find_motion(frame.flow, scene)))
        cameras = 1 if frame.motion is None else 2
    if scene.relaxation and not np.isfinite([time_s for _, time_s, *_ in rows]).all():
        raise UserError("relaxation: the times of the frames are not known")
    index, times, trusted, moved_mm = map(np.array, zip(*rows, strict=True))
    for start, end in free_s:
        if not (trusted & (times >= start) & (times <= end)).any():
            raise UserError(f"free_s: no frame of the video was followed between {start:g} and {end:g} s")
    # False without spans.
    inside = np.any([(times >= start) & (times <= end) for start, end in free_s or search.find()], axis=0)
    estimates = physics.revise(np.asarray(trusted & inside))
    return PhysicsTrack(index, times, trusted, moved_mm, cameras, estimates)
