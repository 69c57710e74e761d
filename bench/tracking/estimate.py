"""`bench.estimate` and `bench estimate`: the force in a video by physics, without a recording folder."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Literal

import numpy as np

from bench.methods import force_interval
from bench.methods.method_interface import MethodContext
from bench.methods.physics import GRID, Physics
from bench.tracking.contact_free import ContactFreeSearch
from learn.inference.video_motion import Motion, has_right_camera, motions, read_only, read_options
from learn.uncertainty.intervals import LEVEL
from synth.arguments import checked
from synth.arrays import Array
from synth.errors import as_positive
from synth.flow.estimator import Estimator
from synth.flow.recording.decode import RecordingFlowSettings
from synth.flow.recording.finding import first_fault, judge_young, problems
from synth.job.types import MembraneState
from synth.video.read_video import FPS


@checked
def estimate(
    source: str | Path | Array,
    *,
    scale_mm_per_px: float | Literal["unknown"] | None = None,
    young_kpa: float | None = None,
    membrane: MembraneState = "unknown",
    membrane_mn_per_mm: tuple[float, float] | None = None,
    living: bool = True,
    tissue: str | Path | Array | None = None,
    masks: str | Path | Array = "auto",
    pulse: bool = True,
    flow: str | Estimator = "tvl1",
    shrink: int = 0,
    rate_hz: float | None = 10.0,
    fps: float = FPS,
    input: str | None = None,
) -> dict[str, Any]:
    """Forces of one video by physics, which needs no training, by the names of `bench estimate`'s NAME.npz.

    Args:
        source: frames (T, H, W, 3) uint8 from the rest frame on, a video, a folder of PNGs, a sequence or an
            .npz of flow.
        scale_mm_per_px: of a video, or unknown: forces are then right up to a factor.
        young_kpa: of the tissue; None: the data's, else forces are those of tissue of 1 kPa.
        membrane: state of the membrane (pia).
        membrane_mn_per_mm: range of its stiffness, thickness times Young's modulus; None: unknown.
        living: whether heart and breath may move the tissue; False: ex vivo, or a phantom.
        tissue: mask (H, W) of the rest frame, or a picture of it; None: found by motion.
        masks: auto or none; or instrument masks: (T, H, W), (H, W) or a folder.
        pulse: whether heartbeat and breathing are subtracted from a video's motion.
        flow: estimator of a video's flow.
        shrink: factor by which a video is downsampled before flow; 0: to 320 columns.
        rate_hz: most frames per second that are used; None: all.
        fps: frames per second of an array or a folder of PNGs.
        input: displacement read from a sequence: recovered or ideal, with two cameras motion or motion-ideal.

    Returns:
        Arrays by name, as of `learn.predict`: `total_force_mn` (T,) the size of the force [mN] and its 90%
        interval `low_mn`, `high_mn`, `force_mn` (T, 3) the force in camera axes, and others.

    Raises:
        UserError: an argument of another type, shape or range, or a source of several videos.
    """
    source = Path(source) if isinstance(source, str) else source
    settings = RecordingFlowSettings(flow, shrink, rate_hz, pulse)
    options = read_options(scale_mm_per_px, tissue, masks, settings, fps)
    motion = read_only(source, motions(source, choose_input(source, input), options))
    is_given = tissue is not None, not isinstance(masks, str) or masks not in ("auto", "none")
    return apply_physics(motion, young_kpa, membrane, membrane_mn_per_mm, living, is_given)


def choose_input(source: Path | Array, given: str | None) -> str:
    """The displacement to read from stored sequences: the given one, else the recovered one, of two cameras
    where there are."""
    return given or ("motion" if has_right_camera(source) else "recovered")


def apply_physics(
    motion: Motion,
    young_kpa: float | None = None,
    membrane: MembraneState = "unknown",
    membrane_mn_per_mm: tuple[float, float] | None = None,
    living: bool = True,
    is_given: tuple[bool, bool] = (False, False),
) -> dict[str, Any]:
    """Force of every frame of a video by `Physics`, with its calibrated interval.

    `young_kpa` to `living`: as of `estimate`; `is_given`: whether tissue and instruments are.
    Returns those of `learn.inference.prediction_file.FIELDS` that there are.
    """
    young = motion.young_kpa if young_kpa is None else as_positive("young_kpa", young_kpa)
    young = young if motion.scale_known else None
    scale, by = motion.scale_mm_per_px, motion.recovered_by
    if membrane_mn_per_mm is not None:
        low, high = (as_positive("membrane_mn_per_mm", end) for end in membrane_mn_per_mm)
        membrane_mn_per_mm = min(low, high), max(low, high)
    scene = MethodContext(
        motion.tissue,
        scale,
        young,
        membrane,
        living=living,
        recovered_by=by,
        membrane_mn_per_mm=membrane_mn_per_mm,
    )
    physics, free = Physics(), ContactFreeSearch(motion.tissue, scale)
    rows, moved_mm, cameras = list[tuple[int, float, bool]](), list[float](), 1
    for frame in motion.frames():
        physics(frame, scene, False)
        free.add(frame, frame.time_s or 0.0)
        rows.append((frame.index, math.nan if frame.time_s is None else frame.time_s, frame.trusted))
        lengths = np.linalg.norm(frame.flow[motion.tissue].astype(np.float64), axis=1)
        moved_mm.append(scale * float(lengths.mean()))
        cameras = 1 if frame.motion is None else 2
    numbers, times, followed = map(np.array, zip(*rows, strict=True))
    spans = free.find()
    within = np.any(
        [(times >= start) & (times <= end) for start, end in spans], axis=0
    )  # False without spans
    estimates = physics.revise(np.asarray(followed & within))
    findings = problems([*judge_young(young), *motion.findings])
    fault = first_fault(findings)
    trusted = followed & (not fault)
    warnings = list(physics.warnings)
    ends = np.full((len(rows), 2), np.nan)
    if trusted.any():
        known = [estimates[k] for k in np.flatnonzero(trusted)]
        stated = float(np.mean([*is_given, membrane != "unknown", bool(spans) or not living]))
        video = force_interval.gather(known, np.array(moved_mm)[trusted], cameras, stated)
        known, reason = force_interval.bound(known, video, 0.0, by)
        ends[trusted] = [(one.low_mn, one.high_mn) for one in known]
        warnings += [reason] if reason else []
    out: dict[str, Any] = {
        "density": physics.map_forces()[:, None],
        "total_force_mn": np.where(trusted, [one.size_mn for one in estimates], np.nan),
        "force_mn": np.where(trusted[:, None], [one.force_mn for one in estimates], np.nan),
        "trusted": trusted,
        "mask": physics.view.mask,
        "pitch_mm": GRID.pitch_mm,
        "scale_mm_per_px": scale / motion.shrink,
        # Pixel coordinates are of pixel centres: a picture begins at -0.5.
        "centre_px": motion.shrink * (np.array(physics.view.centre_px) + 0.5) - 0.5,
        "young_kpa": 1.0 if young is None else young,
        "young_known": young is not None,
        "frame": numbers,
    }
    out["centres_px"] = np.tile(out["centre_px"], (len(rows), 1))
    if np.isfinite(times).any():
        out["time_s"] = times
    if np.isfinite(ends).any():
        out |= {"low_mn": ends[:, 0], "high_mn": ends[:, 1], "level": np.array([LEVEL])}
    notes = [finding.message for finding in findings if finding.severity == "warning"]
    notes += [*motion.notes, *physics.notes, *warnings]
    if fault:
        notes.insert(0, f"nothing can be measured: {fault}")
    elif not trusted.all():
        notes.append(f"{(~trusted).sum()} of {len(trusted)} frames could not be followed: they have no force")
    out["notes"] = np.array(notes, dtype=str)
    return out
