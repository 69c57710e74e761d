"""A trained model on files: sequence stores, datasets, videos, and arrays of flow from anywhere."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import chain, repeat
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from learn.data.clips import FIELDS, has_depth
from learn.inference.force_reader import ForceReader
from learn.inference.predict import GridView, Predictor
from learn.inference.stiffness import stiffness
from learn.uncertainty.conformal import LEVELS
from learn.uncertainty.intervals import Band
from synth.dataset.store import Dataset, Sequence, open_sequence
from synth.errors import UserError
from synth.flow.stereo.track import Moved
from synth.recording_flow.pulse import Pulse, Search
from synth.recording_flow.video_flow import Footage, Settings, VideoFlow, everywhere
from synth.system import checked_file
from synth.video import read as video
from synth.video.mask_files import MaskFiles
from synth.video.pixel_scale import UNKNOWN_NOTE, StatedScale, take_scale


class Step(NamedTuple):
    """One frame's flow."""

    flow: NDArray[np.float32]
    """(H, W, 2) px from the rest frame, on its pixels."""
    confidence: NDArray[np.float32] | None
    """(H, W) in 0..1, if there is one."""
    frame: int
    """Number in the film."""
    time_s: float = math.nan
    trusted: bool = True
    """Whether the frame could be followed."""
    moved: Moved | None = None
    """In three dimensions, where two eyes saw it."""


@dataclass(frozen=True)
class Motion:
    """Flow of one film, still in pixels, wherever it came from."""

    name: str
    steps: Iterator[Step]
    """The frames in order; once."""
    tissue: NDArray[np.bool_]
    scale_mm_per_px: float
    young_kpa: float | None
    force_mn: NDArray[np.float64] | None = None
    """(T,) size of the true force, where it is known."""
    shrink: int = 1
    """How many times smaller than the film's own pictures those are that flow is on."""
    notes: Callable[[], list[str]] = list
    """What was done to the film that its user should know, once its steps are through."""
    fault: Callable[[], str] = str
    """Why nothing of it is a measurement, once its steps are through; empty if something may be."""
    scale_known: bool = True
    """False: a width was taken for the picture's, so E is of no use, and forces are right up to a factor."""
    again: Callable[[], Motion | None] = lambda: None
    """The same film with the tissue's own motion taken off, if its steps, once through, showed any."""


@dataclass(frozen=True)
class Filmed:
    """What a video doesn't say of itself."""

    scale_mm_per_px: StatedScale | None = None
    tissue: Path | None = None
    """A picture, white where there is tissue; everywhere if not given."""
    settings: Settings = field(default_factory=Settings)
    """How it is followed."""
    tool: MaskFiles | None = None
    """Where the tool is; looked for in the pictures if not given."""


def motions(path: Path, source: str, filmed: Filmed | None = None) -> Iterator[Motion]:
    """What `path` holds: a dataset folder, one NNNNNN.zarr store, an .npz of arrays, or a video.

    An .npz holds `flow` (T, H, W, 2) px, `tissue` (H, W), `scale_mm_per_px`, and if known `young_kpa`,
    `confidence` (T, H, W) and `force_mn` (T,); or, of two eyes, `motion` and `deviation` (T, H, W, 3) mm
    instead of flow and confidence. A video's first frame is its rest frame. Raises UserError for
    anything else, and for a video without a scale.
    """
    if path.suffix.lower() in video.SUFFIXES:
        yield _video(path, filmed or Filmed())
    elif path.suffix == ".npz":
        yield _arrays(path)
    elif path.name.endswith((".zarr", ".zarr.part")):
        yield _stored(open_sequence(path), source)
    else:
        for sequence in Dataset(path):
            yield _stored(sequence, source)


def has_second_eye(path: Path) -> bool:
    """Whether what `motions` reads tells of motion in three dimensions; of a dataset its first sequence."""
    if path.suffix.lower() in video.SUFFIXES:
        return False
    if path.suffix == ".npz":
        return "motion" in checked_file.read_arrays(path)
    stored = path.name.endswith((".zarr", ".zarr.part"))
    first = open_sequence(path) if stored else next(iter(Dataset(path)), None)
    return first is not None and FIELDS["motion"] in first


def _stored(sequence: Sequence, source: str) -> Motion:
    if source not in FIELDS:
        raise UserError(f"unknown input {source!r}: {', '.join(FIELDS)}")
    if FIELDS[source] not in sequence:
        what = "motion of two eyes" if has_depth(source) else f"{source} flow"
        raise UserError(f"{sequence.path}: holds no {what} (field {FIELDS[source]})")
    scale, young = (sequence.attrs.get(name) for name in ("scale_mm_per_px", "young_kpa"))
    if scale is None or young is None:
        raise UserError(f"{sequence.path}: lacks the attribute young_kpa or scale_mm_per_px")
    sure = source == "recovered" and "flow_confidence" in sequence
    given = sequence.read_sealed("flow_confidence") if sure else repeat(None, sequence.frames)
    time_s, tissue, force = (sequence.read_whole(name) for name in ("time", "tissue", "force"))
    nothing = repeat(None, sequence.frames)
    spread = sequence.read_sealed("motion_deviation") if source == "motion" else nothing
    frames = zip(sequence.read_sealed(FIELDS[source]), given, spread, time_s, strict=True)

    def steps() -> Iterator[Step]:
        for t, (seen, confidence, deviation, at) in enumerate(frames):
            if has_depth(source):
                moved = Moved(seen, np.zeros_like(seen) if deviation is None else deviation)
                yield Step(np.asarray(seen[..., :2] / scale, np.float32), None, t, float(at), moved=moved)
            else:
                yield Step(seen, confidence, t, float(at))

    return Motion(
        name=sequence.path.stem,
        steps=steps(),
        tissue=tissue.astype(bool),
        scale_mm_per_px=float(scale),
        young_kpa=float(young),
        force_mn=np.linalg.norm(force, axis=1),
    )


def _video(path: Path, filmed: Filmed, pulse: Pulse | None = None, search: Search | None = None) -> Motion:
    if filmed.scale_mm_per_px is None:
        raise UserError(
            f"{path}: a video doesn't say how large it shows things; give --scale in mm a pixel, or unknown"
        )
    scale_known = filmed.scale_mm_per_px != "unknown"
    drawn = filmed.tissue
    tissue = everywhere if drawn is None else partial(video.read_mask, drawn)
    tool = filmed.tool.read if filmed.tool else None
    footage = Footage(video.read_video(path, video.FPS), str(path), tissue, tool)
    following = VideoFlow(footage, filmed.settings, pulse=pulse, search=search)
    steps = (
        Step(
            step.found.flow,
            step.found.confidence,
            step.picture.index,
            step.picture.time_s or 0.0,
            step.found.trusted,
        )
        for step in following.steps()
    )
    rest = next(steps)
    mm_per_px = take_scale(filmed.scale_mm_per_px, following.size[1]) * following.shrink

    def again() -> Motion | None:
        found = following.find_pulse()
        return None if found is None else _video(path, filmed, found, following.search)

    def notes() -> list[str]:
        said = following.notes if scale_known else [UNKNOWN_NOTE, *following.notes]
        return said if pulse is None else [*said, pulse.describe(mm_per_px)]

    return Motion(
        name=path.stem,
        steps=chain([rest], steps),
        tissue=following.tissue,
        scale_mm_per_px=mm_per_px,
        young_kpa=None,
        shrink=following.shrink,
        notes=notes,
        fault=lambda: following.fault,
        scale_known=scale_known,
        again=again,
    )


def _arrays(path: Path) -> Motion:
    found = checked_file.read_arrays(path)
    told = {"motion", "deviation"} if "motion" in found else {"flow"}
    missing = (told | {"tissue", "scale_mm_per_px"}) - found.keys()
    if missing:
        raise UserError(f"{path}: lacks {', '.join(sorted(missing))}")
    tissue = found["tissue"].astype(bool)
    if tissue.ndim != 2:
        raise UserError(f"{path}: tissue is {tissue.shape}, expected (H, W)")
    space = [found[name].astype(np.float32) for name in ("motion", "deviation")] if len(told) == 2 else []
    if any(one.ndim != 4 or one.shape != (len(space[0]), *tissue.shape, 3) for one in space):
        h, w = tissue.shape
        raise UserError(f"{path}: motion and deviation must be (T, {h}, {w}, 3) like the tissue")
    scale = _positive(path, found, "scale_mm_per_px")
    flow = space[0][..., :2] / scale if space else found["flow"].astype(np.float32)
    if flow.ndim != 4 or flow.shape[1:] != (*tissue.shape, 2) or not len(flow):
        h, w = tissue.shape
        raise UserError(f"{path}: flow is {flow.shape}, expected (T, {h}, {w}, 2) like the tissue")
    confidence = found.get("confidence")
    if confidence is not None and confidence.shape != flow.shape[:3]:
        raise UserError(f"{path}: confidence is {confidence.shape}, expected {flow.shape[:3]}")
    force = found.get("force_mn")
    if force is not None and force.shape != (len(flow),):
        raise UserError(f"{path}: force_mn is {force.shape}, expected ({len(flow)},)")
    return Motion(
        name=path.stem,
        steps=(
            Step(
                f,
                None if confidence is None else confidence[t].astype(np.float32),
                t,
                moved=Moved(space[0][t], space[1][t]) if space else None,
            )
            for t, f in enumerate(flow)
        ),
        tissue=tissue,
        scale_mm_per_px=scale,
        young_kpa=_positive(path, found, "young_kpa") if "young_kpa" in found else None,
        force_mn=None if force is None else force.astype(np.float64),
    )


def _positive(path: Path, found: dict[str, NDArray[Any]], name: str) -> float:
    """The one number under a name. UserError if it is another number of them, or not positive."""
    if found[name].size != 1 or not 0 < found[name].item() < math.inf:
        raise UserError(f"{path}: {name} must be one positive number")
    return float(found[name].item())


def apply(predictor: Predictor, motion: Motion, young_kpa: float | None = None) -> dict[str, Any]:
    """Force of every frame of a film, ready for np.savez; what is done to it is `ForceReader`'s.

    `young_kpa` overrides the film's own, but not where the scale is unknown. Returns fields of
    `prediction_file.FIELDS`, those that the film and the model have. Mask and centre are the last frame's;
    they change only where the tissue is wider than the grid.
    """
    young = young_kpa if young_kpa is not None else motion.young_kpa
    if not motion.scale_known:
        young = None
    reader = ForceReader(predictor, motion.tissue, motion.scale_mm_per_px, young)
    frames, times, forces, maps, trusted = [], [], [], [], []
    bands = []
    for step in motion.steps:
        force, said = reader.read(step.flow, step.confidence, step.moved)
        frames.append(step.frame)
        times.append(step.time_s)
        forces.append(force if step.trusted else np.full(3, np.nan))
        trusted.append(step.trusted)
        maps.append(said)
        if motion.scale_known:
            # What could not be followed shows no world.
            bands.append(reader.bound(force, said, counted=step.trusted))
    still = motion.again()
    if still is not None:
        return apply(predictor, still, young_kpa)
    fault = motion.fault()
    if fault:
        trusted, forces = [False] * len(trusted), [np.full(3, np.nan)] * len(forces)
    total, last = np.array(forces), maps[-1]
    out: dict[str, Any] = {
        "density": np.stack([m.density for m in maps]),
        "total_force_mn": np.where(trusted, np.sqrt(np.nansum(total**2, axis=1)), np.nan),
        "trusted": np.array(trusted),
        "mask": last.view.mask,
        "pitch_mm": predictor.grid.pitch_mm,
        "scale_mm_per_px": motion.scale_mm_per_px / motion.shrink,
        # A picture begins half a pixel before its first pixel, whatever its pixels' size.
        "centre_px": motion.shrink * (np.array(last.view.resample.centre_px) + 0.5) - 0.5,
        "young_kpa": last.young_kpa,
        "young_known": last.young_known,
        "frame": np.array(frames),
        "centres_px": motion.shrink * (np.array([m.view.resample.centre_px for m in maps]) + 0.5) - 0.5,
    }
    if np.isfinite(times).any():
        out["time_s"] = np.array(times)
    if last.force_mn is not None:
        out["force_mn"] = total
    notes = motion.notes() + reader.notes
    if fault:
        notes.append(f"nothing can be measured: {fault}")
    elif not all(trusted):
        notes.append(
            f"{trusted.count(False)} of {len(trusted)} frames could not be followed: they have no force"
        )
    out |= _ends([one for one in bands if one is not None], np.array(trusted))
    out["notes"] = np.array(notes, dtype=str)
    return out


def _ends(bands: list[dict[float, Band]], trusted: NDArray[np.bool_]) -> dict[str, NDArray[np.float64]]:
    """Ends of the intervals by field, (T,) or (T, 3) mN, NaN where `trusted` (T,) is False; none of none."""
    if not bands:
        return {}
    wide, narrow = ([one[level] for one in bands] for level in LEVELS)
    out = {
        "low_mn": np.array([one.low[0] for one in wide]),
        "high_mn": np.array([one.high[0] for one in wide]),
        "low68_mn": np.array([one.low[0] for one in narrow]),
        "high68_mn": np.array([one.high[0] for one in narrow]),
        "force_low_mn": np.array([one.axes_low[0] for one in wide]),
        "force_high_mn": np.array([one.axes_high[0] for one in wide]),
    }
    for values in out.values():
        values[~trusted] = np.nan
    return out


def calibrate(predictor: Predictor, press: Motion) -> float:
    """Young's modulus [kPa] from a film of one press whose force is known. Raises UserError if it isn't."""
    if press.force_mn is None:
        raise UserError(f"{press.name}: holds no force to calibrate on (force_mn in an .npz)")
    view = GridView(press.tissue, press.scale_mm_per_px, predictor.grid)
    told = [predictor.on_grid(view, step.flow, step.confidence, step.moved) for step in press.steps]
    sure = [confidence for _, confidence in told if confidence is not None]
    given = np.stack(sure) if sure else None
    return stiffness(predictor, np.stack([moved for moved, _ in told]), view.mask, press.force_mn, given)
