"""Motion of a video, read from sequence stores, datasets, videos or arrays of flow."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np

from learn.data.clips import FIELDS, RECOVERED, check_readable, has_depth
from synth.arrays import Array, Floats, Mask
from synth.dataset.dataset_folder import read_relaxation
from synth.dataset.store import Dataset, Sequence, open_sequence
from synth.errors import UserError, as_positive
from synth.flow.estimator import name_motion
from synth.flow.recording.decode import Footage, RecordingFlowSettings
from synth.flow.recording.finding import Finding, judge_scale
from synth.flow.recording.frame_motion import FrameMotion, Size
from synth.flow.recording.pair_findings import judge_pair
from synth.flow.recording.stereo_motion import RightVideo, measure_video_scale
from synth.flow.recording.video_track import track_video
from synth.flow.stereo.calibration import read_rig
from synth.flow.stereo.rig import StereoRig
from synth.flow.stereo.stereo_track import Motion3D
from synth.job.types import PronyTerms
from synth.system import checked_file
from synth.video import file_numbers
from synth.video import read_video as video
from synth.video.mask_files import MaskFiles, read_choice
from synth.video.pixel_scale import UNKNOWN_NOTE, StatedScale, pixel_mm


@dataclass(frozen=True)
class Motion:
    """Motion of one video."""

    name: str
    frames: Callable[[], Iterator[FrameMotion]]  # in order; may be called again
    tissue: Mask  # (H, W) in the rest frame
    scale_mm_per_px: float
    young_kpa: float | None
    force_mn: Floats | None = None  # (T,) size of the true force, if known
    shrink: int = 1  # factor by which pictures were shrunk before flow
    recovered_by: str = ""  # estimator and version of recovered motion; empty if unknown
    notes: tuple[str, ...] = ()  # on the processing
    findings: tuple[Finding, ...] = ()
    relaxation: PronyTerms = ()  # lost shares of the tissue's stiffness and times [s]; empty: none is known
    scale_known: bool = True  # False: the picture's width was assumed, and forces are right up to a factor


@dataclass(frozen=True)
class SecondCamera:
    """The right camera of a video."""

    pictures: Path | Array  # of the same moments as the left ones, in the same form
    calibration: Path  # of OpenCV (K1, D1, K2, D2, R, T), Kalibr or others
    mm_per_unit: float = 1.0  # of T

    @staticmethod
    def of(
        right: str | Path | Array | None, calibration: str | Path | None, mm_per_unit: float
    ) -> SecondCamera | None:
        """From the arguments of `bench.estimate`; None without both. UserError if only one is given."""
        if right is None and calibration is None:
            return None
        if right is None or calibration is None:
            lacking = "calibration" if calibration is None else "right"
            raise UserError(f"{lacking}: a second camera needs its pictures (right) and its calibration")
        right = Path(right) if isinstance(right, str) else right
        return SecondCamera(right, Path(calibration), as_positive("mm_per_unit", mm_per_unit))


@dataclass(frozen=True)
class VideoOptions:
    """What a video file lacks, and settings of its flow."""

    scale_mm_per_px: StatedScale | None = None
    tissue: Path | Array | None = None  # a picture, white on tissue, or (H, W); None: found
    settings: RecordingFlowSettings = field(default_factory=RecordingFlowSettings)
    tool: MaskFiles | Array | None = None  # instrument masks, (T, H, W) or (H, W); None: detected
    fps: float = video.FPS  # of pictures without times
    rest_frame: int = 0  # number of the frame in which tissue is unloaded; earlier ones are left out
    second: SecondCamera | None = None

    @property
    def given(self) -> tuple[bool, bool]:
        """Whether tissue and instruments are given."""
        return self.tissue is not None, self.tool is not None


def read_options(
    scale_mm_per_px: StatedScale | None,
    tissue: str | Path | Array | None,
    masks: str | Path | Array,
    settings: RecordingFlowSettings,
    fps: float = video.FPS,
    rest_frame: int = 0,
    second: SecondCamera | None = None,
) -> VideoOptions:
    """The options of a video from the arguments of `learn.predict` and `bench.estimate`, and of the commands;
    UserError if one is out of range. The masks' kind replaces that of the settings."""
    as_positive("fps", fps)
    if rest_frame < 0:
        raise UserError(f"rest_frame {rest_frame}: the number of a frame, from 0")
    kind, tool = read_choice(str(masks)) if isinstance(masks, (str, Path)) else ("auto", np.asarray(masks))
    tissue = Path(tissue) if isinstance(tissue, str) else tissue
    return VideoOptions(scale_mm_per_px, tissue, replace(settings, masks=kind), tool, fps, rest_frame, second)


def read_single(source: Path | Array, videos: Iterator[Motion]) -> Motion:
    """The motion of a source that holds one video. UserError if it holds several."""
    motion = next(videos)
    if next(videos, None) is not None:
        raise UserError(f"source: {source} holds several sequences: give one of them")
    return motion


def motions(path: Path | Array, source: str, options: VideoOptions | None = None) -> Iterator[Motion]:
    """Motions in a dataset, a store, an .npz, a video, a folder of PNGs or frames (T, H, W, 3) uint8.

    An .npz holds `flow` (T, H, W, 2) px, `tissue` (H, W), `scale_mm_per_px`, and if known `young_kpa`,
    `confidence` (T, H, W) and `force_mn` (T,); or, for stereo, `motion` and `deviation` (T, H, W, 3) mm
    instead of flow and confidence. Raises UserError for anything else, for a video of one camera without a
    scale, and for a rest frame or a second camera of stored motion.
    """
    if isinstance(path, np.ndarray) or video.is_video(path):
        yield _video(path, options or VideoOptions())
        return
    if options is not None and options.rest_frame:
        raise UserError(f"rest_frame {options.rest_frame}: only of a video; {path} starts at rest")
    if options is not None and options.second is not None:
        raise UserError(f"right: only of a video; {path} holds motion, with a second camera or without")
    if path.suffix == ".npz":
        yield _arrays(path)
    else:
        for sequence in _sequences(path):
            yield _read_stored(sequence, source)


def has_right_camera(path: Path | Array) -> bool:
    """Whether `path` holds motion in three dimensions; of a dataset its first sequence decides."""
    if isinstance(path, np.ndarray) or video.is_video(path):
        return False
    if path.suffix == ".npz":
        return "motion" in checked_file.ArrayFile(path)
    first = next(_sequences(path), None)
    return first is not None and FIELDS["motion"] in first


def _sequences(path: Path) -> Iterator[Sequence]:
    is_sequence = path.name.endswith((".zarr", ".zarr.part"))
    yield from [open_sequence(path)] if is_sequence else Dataset(path)


def _read_stored(sequence: Sequence, source: str) -> Motion:
    check_readable(sequence, [source])
    scale = float(sequence.attrs["scale_mm_per_px"])
    time_s, tissue = map(sequence.read_whole, ("time", "tissue"))

    def frames() -> Iterator[FrameMotion]:
        confidences: Iterator[Any] = repeat(np.ones(tissue.shape, np.float32), sequence.frames)
        if source == "recovered" and "flow_confidence" in sequence:
            confidences = sequence.read_sealed("flow_confidence")
        deviations: Iterator[Any] = repeat(np.zeros((*tissue.shape, 3), np.float32), sequence.frames)
        if source == "motion":
            deviations = sequence.read_sealed("motion_deviation")
        arrays = zip(sequence.read_sealed(FIELDS[source]), confidences, deviations, time_s, strict=True)
        for t, (values, confidence, deviation, seconds) in enumerate(arrays):
            motion = Motion3D(values, deviation) if has_depth(source) else None
            flow = values if motion is None else np.asarray(values[..., :2] / scale, np.float32)
            yield FrameMotion(flow, confidence, motion=motion, index=t, time_s=float(seconds))

    return Motion(
        name=sequence.path.stem,
        frames=frames,
        tissue=tissue.astype(bool),
        scale_mm_per_px=scale,
        young_kpa=sequence.attrs["young_kpa"],
        relaxation=read_relaxation(sequence.path),
        recovered_by=sequence.recovered_by if source in RECOVERED else "",
        force_mn=np.linalg.norm(sequence.read_whole("force"), axis=1) if "force" in sequence else None,
    )


def _video(source: Path | Array, options: VideoOptions) -> Motion:
    path = source if isinstance(source, Path) else Path("frames")
    is_measured = options.scale_mm_per_px is None
    if is_measured and options.second is None:
        raise UserError(f"{path}: a video needs its scale (scale_mm_per_px, --scale): mm/px, or unknown")
    if isinstance(source, np.ndarray):
        _check_frames(str(path), source)
    scale_known = options.scale_mm_per_px != "unknown"
    tissue: Callable[[Size], Mask] | None = None
    if isinstance(options.tissue, Path):
        tissue = partial(video.read_mask, options.tissue)
    elif options.tissue is not None:
        tissue = partial(_mask, "tissue", options.tissue, 0)
    notes: list[str] = [] if scale_known else [UNKNOWN_NOTE]
    is_file = isinstance(source, Path) and not source.is_dir()
    if isinstance(source, Path) and not is_file and options.fps == video.FPS:
        notes.append(f"the pictures have no times: {options.fps:g} per second are assumed")
    tool: Callable[[int, Size], Mask | None] | None = None
    if isinstance(options.tool, MaskFiles):
        count = video.count_frames(path) if is_file else None
        tool = options.tool.of_frames(range(count or 0), notes).read
    elif options.tool is not None:
        tool = partial(_mask, "masks", options.tool)
    footage = Footage(
        partial(_pictures, source, options.fps),
        str(path),
        tissue,
        tool,
        options.rest_frame,
        depth=None if options.second is None else _right(source, options, options.second, notes),
    )
    track = track_video(footage, options.settings, compare_cameras=footage.depth is not None)
    rest, findings = track.video.rest, [*track.video.findings]
    stated = options.scale_mm_per_px if footage.depth is None else footage.depth.mm_per_px
    assert stated is not None
    scale = pixel_mm(stated, rest.size[1])
    if track.pair is not None and (quality := track.pair.quality) is not None:
        notes.append(quality.describe())
        findings += judge_pair(quality, None if is_measured else scale)
        scale = quality.mm_per_px if is_measured else scale
    removed = [] if track.removed is None else [track.removed.describe(scale * rest.shrink)]
    missing = [finding.message for finding in findings if finding.severity == "missing"]
    return Motion(
        name=path.stem,
        frames=lambda: (replace(frame, time_s=frame.time_s or 0.0) for frame in track.frames()),
        tissue=rest.tissue,
        scale_mm_per_px=scale * rest.shrink,
        young_kpa=None,
        recovered_by=name_motion(options.settings.backend),
        shrink=rest.shrink,
        notes=(*notes, *track.notes, *removed, *missing),
        findings=(*judge_scale(scale, rest.size[1]), *findings),
        scale_known=scale_known,
    )


def _right(source: Path | Array, options: VideoOptions, second: SecondCamera, notes: list[str]) -> RightVideo:
    """The right camera of a video; `notes` receives how its pictures are counted, and a measured scale.

    UserError: the video's scale is stated to be unknown, or what is given is no video.
    """
    scale = options.scale_mm_per_px
    if scale == "unknown":
        raise UserError("right: two cameras measure the scale: leave it out, or state it in mm/px")
    if isinstance(second.pictures, np.ndarray):
        _check_frames("right", second.pictures)
    elif not video.is_video(second.pictures):
        raise UserError(f"right: {second.pictures} is neither a video nor a folder of PNGs")
    frame_of = file_numbers.match_numbers(_numbers(second.pictures), _numbers(source), "right", notes)

    def read() -> Iterator[video.Picture]:
        for picture in _pictures(second.pictures, options.fps):
            yield replace(picture, index=frame_of.get(picture.index, picture.index))

    def read_rig_of(size: Size) -> StereoRig:
        return read_rig(second.calibration, size[::-1], second.mm_per_unit)

    if scale is None:
        frames = _pictures(source, options.fps), read()
        scale = measure_video_scale(*frames, options.rest_frame, read_rig_of)
        notes.append(f"scale about {scale:.3g} mm/px in the middle of the picture, by both cameras")
    return RightVideo(read, read_rig_of, scale)


def _numbers(source: Path | Array) -> Collection[int]:
    """Numbers of a video's frames, by which those of two cameras are matched."""
    if isinstance(source, np.ndarray):
        return range(len(source))
    if source.is_dir():
        return file_numbers.number_files(file_numbers.find_stills(source)).keys()
    return range(video.count_frames(source) or 0)


def _check_frames(label: str, frames: Array) -> None:
    """UserError unless frames are (T, H, W, 3) uint8."""
    if frames.dtype != np.uint8 or frames.ndim != 4 or frames.shape[3] != 3:
        raise UserError(f"{label}: {frames.dtype} {frames.shape}, expected uint8 (T, H, W, 3)")


def _pictures(source: Path | Array, fps: float) -> Iterator[video.Picture]:
    if isinstance(source, Path):
        return video.read_frames(source, fps)
    return (video.Picture(t, t / fps, np.ascontiguousarray(rgb)) for t, rgb in enumerate(source))


def _mask(label: str, masks: Array, index: int, size: Size) -> Mask:
    """The mask of a frame, (H, W), from one for all or from (T, H, W)."""
    if masks.shape[-2:] != size or masks.ndim not in (2, 3) or (masks.ndim == 3 and index >= len(masks)):
        raise UserError(f"{label}: {masks.shape}, but frame {index} of the video is {size}")
    return np.asarray((masks if masks.ndim == 2 else masks[index]) != 0)


def _arrays(path: Path) -> Motion:
    arrays = checked_file.read_arrays(path)
    names = ("motion", "deviation") if "motion" in arrays else ("flow",)
    if missing := {*names, "tissue", "scale_mm_per_px"} - arrays.keys():
        raise UserError(f"{path}: needs {', '.join(sorted(missing))}")
    tissue, count = arrays["tissue"].astype(bool), arrays[names[0]].shape[:1]
    if not count or not count[0]:
        raise UserError(f"{path}: {names[0]} holds no frames")
    if tissue.ndim != 2:
        raise UserError(f"{path}: tissue is {tissue.shape}, expected (H, W)")
    shapes = {name: (*count, *tissue.shape, len(names) + 1) for name in names}
    shapes |= {"confidence": (*count, *tissue.shape), "force_mn": count}
    for name, shape in shapes.items():
        if name in arrays and arrays[name].shape != shape:
            raise UserError(f"{path}: {name} is {arrays[name].shape}, expected {shape} like the tissue")
    scale, force = _positive(path, arrays, "scale_mm_per_px"), arrays.get("force_mn")

    def frames() -> Iterator[FrameMotion]:
        confidence = arrays.get("confidence", np.broadcast_to(np.float32(1), (*count, *tissue.shape)))
        for t in range(count[0]):
            first, *rest = (arrays[name][t].astype(np.float32) for name in names)
            motion = Motion3D(first, rest[0]) if rest else None
            flow = first[..., :2] / scale if rest else first
            yield FrameMotion(flow, confidence[t].astype(np.float32), motion=motion, index=t)

    return Motion(
        name=path.stem,
        frames=frames,
        tissue=tissue,
        scale_mm_per_px=scale,
        young_kpa=_positive(path, arrays, "young_kpa") if "young_kpa" in arrays else None,
        force_mn=None if force is None else force.astype(np.float64),
    )


def _positive(path: Path, arrays: dict[str, Array], name: str) -> float:
    """The number under a name. UserError unless it is one and positive."""
    return as_positive(
        f"{path}: {name}", arrays[name].item() if arrays[name].size == 1 else arrays[name].shape
    )
