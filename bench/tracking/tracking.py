"""Motion in a recording, and the forces of all methods."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.methods import force_interval
from bench.methods.force_fusion import Fusion
from bench.methods.force_interval import VideoEstimates
from bench.methods.method_interface import ForceEstimate, Method, MethodContext, Revising
from bench.methods.physics import Physics
from bench.methods.relaxation import relax_estimates
from bench.recording.footage import as_footage
from bench.recording.recording_folder import Recording
from bench.sensor.alignment import align_sensor
from bench.tracking.contact_free import ContactFreeSearch
from synth.arrays import Floats, Map, Mask, Pixels
from synth.errors import UserError
from synth.flow.estimator import name_motion
from synth.flow.recording.decode import RecordingFlowSettings
from synth.flow.recording.find_pulse import SurfaceMotion
from synth.flow.recording.finding import Finding
from synth.flow.recording.flow import LocalFlow
from synth.flow.recording.frame_motion import FrameMotion, RestFrame, TrackingSummary
from synth.flow.recording.harmonic_fit import Span
from synth.flow.recording.right_pictures import PairQuality
from synth.flow.recording.video_track import VideoTrack, track_video
from synth.system.stopwatch import Stopwatch

A = TypeVar("A", bound=np.generic)
Progress = Callable[[int], None]  # called with the number of frames done

_MOST_SNAPSHOTS = 64
_SNAPSHOT_WIDTH = 480  # px, at most


@dataclass(frozen=True)
class Snapshot:
    """A downsampled frame for the report."""

    position: int  # index into the curves
    rgb: Pixels  # (h, w, 3)
    flow: Map  # (h, w, 2) px of the downsampled picture
    density: Map | None  # (h, w) kPa, of the traction
    depth: Map | None = None  # (h, w) mm, motion away from the camera; None: monocular


@dataclass
class TrackedRecording:
    """Curves over the frames that have a time, from the rest frame on, and the results of a recording."""

    frame: list[int] = field(default_factory=list)  # numbers in the recording
    time_s: list[float] = field(default_factory=list)
    force_mn: dict[str, list[Floats]] = field(default_factory=dict)  # by method: (3,) each
    size_mn: dict[str, list[float]] = field(default_factory=dict)  # by method: magnitude
    bounds: dict[str, list[tuple[float, float]]] = field(default_factory=dict)  # by method: low, high
    speed: list[float] = field(default_factory=list)  # mean over the tissue since the previous frame [mm/s]
    confidence: list[float] = field(default_factory=list)  # mean over the tissue
    trusted: list[bool] = field(default_factory=list)  # False: the frame is lost, its forces are not valid
    summary: TrackingSummary = field(default_factory=TrackingSummary)
    repeats: tuple[dict[int, int], dict[int, int]] = field(default_factory=lambda: ({}, {}))  # of VideoFaults
    snapshots: list[Snapshot] = field(default_factory=list)
    pictured: str = ""  # method whose force map the snapshots show
    rest: Pixels | None = None  # (h, w, 3) rest frame, downsampled as the snapshots
    tissue: Mask | None = None  # (h, w), likewise
    size: tuple[int, int] = (0, 0)  # height, width of the recording [px]
    notes: list[str] = field(default_factory=list)
    timings: dict[str, dict[str, float] | float] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)  # on the pictures
    doubt: list[Finding] = field(default_factory=list)  # on the training of the leading method's network
    uncalibrated: set[str] = field(default_factory=set)  # methods whose intervals aren't, for this motion
    decoded: list[tuple[int, float | None]] = field(default_factory=list)  # number, time [s] of every picture
    rest_s: float | None = None  # time of the rest frame
    scale_mm_per_px: float = 1.0  # of the recording's own pixels
    stereo: PairQuality | None = None  # of the right or depth camera; None: none, or not used
    turning: SurfaceMotion | None = None  # motion of the tissue over `sensor.turn_s`, if given
    evidence: VideoEstimates | None = None  # from which the interval of physics is computed; None: unbounded
    unbounded: dict[str, str] = field(default_factory=dict)  # by method: why it has no interval
    stated: tuple[bool, ...] = (False,) * 4  # tissue, instruments, membrane, rest or ex vivo
    pulse: list[dict[str, float]] = field(default_factory=list)  # rate_hz, amplitude_mm of removed rhythms


def track_recording(
    recording: Recording,
    methods: Mapping[str, Method],
    scale_mm_per_px: float,
    settings: RecordingFlowSettings,
    *,
    pictured: str = "",
    flow: LocalFlow | None = None,
    progress: Progress = lambda done: None,
    only: Container[int] | None = None,
    on_frame: Callable[[FrameMotion], None] = lambda frame: None,
) -> TrackedRecording:
    """Tracks the video and applies every method, with a few frames in memory.

    `scale_mm_per_px`: of the original pixels. `pictured`: the method whose force map the snapshots show.
    `flow`: computes the flow, in another process while the methods are applied to the previous frame, and is
    closed by the caller; None: in this process. `progress`: called after every frame; `on_frame`: with every
    tracked frame. `only`: numbers of the frames to track, with the rest frame; None: all. UserError for an
    unreadable video, no frame with a time, a rest frame beyond the end, and masks of another size.
    """
    watch, about = Stopwatch(), recording.meta
    settings = replace(settings, pulse=settings.pulse and about.pulse.remove)
    footage, free_s = replace(as_footage(recording, scale_mm_per_px), only=only), about.pulse.free_s
    with track_video(
        footage, settings, free_s, flow=flow, watch=watch, progress=progress, compare_cameras=True
    ) as track:
        video = track.video
        mm_per_px = scale_mm_per_px * video.rest.shrink
        tissue = about.young_kpa, about.membrane, about.poisson, about.young_uncertainty, about.may_pulsate
        backend = name_motion(settings.backend)
        stiffness = about.membrane_mn_per_mm
        law = about.alpha, stiffness, about.relaxation
        scene = MethodContext(video.rest.tissue, mm_per_px, *tissue, backend, *law)
        forces = _Forces(methods, pictured, watch, video.rest, scene)
        turning = SurfaceMotion(video.rest.tissue)
        search = ContactFreeSearch(video.rest.tissue, mm_per_px)
        for frame in track.frames():
            on_frame(frame)
            if frame.time_s is not None:
                forces.add(frame, frame.time_s)
                search.add(frame, frame.time_s)
                if (span := about.sensor.turn_s) and frame.trusted and span[0] <= frame.time_s <= span[1]:
                    turning.add(frame.time_s, frame.flow, frame.confidence)
    if not forces.out.time_s:
        raise UserError(f"{recording.folder}: no frame has a time; give frames.csv, or fps in meta.yaml")
    absent_s = search.find()
    forces.finish(recording, absent_s)
    out = forces.out
    out.stereo = None if track.pair is None else track.pair.quality
    out.turning = turning if turning.time_s else None
    out.scale_mm_per_px = scale_mm_per_px
    _describe(out, track, recording, methods, pictured)
    if absent_s:
        spans = ", ".join(f"{a:.2f}–{b:.2f}" for a, b in absent_s)
        out.notes.append(f"no contact is assumed in {spans} s, where no instrument is over the tissue")
    out.timings |= watch.report()
    return out


def _describe(
    out: TrackedRecording,
    track: VideoTrack,
    recording: Recording,
    methods: Mapping[str, Method],
    pictured: str,
) -> None:
    """Adds summary, findings and notes after the last frame."""
    video = track.video
    decoder = video.decoder
    out.summary, out.size, out.notes = video.summary, video.rest.size, track.notes
    out.findings, out.decoded, out.rest_s = [*video.findings], decoder.decoded, video.rest.time_s
    out.repeats, mm_per_px = decoder.faults.repeats(), out.scale_mm_per_px * video.rest.shrink
    if recording.masks:
        out.notes.append(recording.describe_tool(len(out.decoded)))
    doubt = {name: getattr(method, "doubt", ()) for name, method in methods.items()}
    out.uncalibrated = {name for name in methods if doubt[name]}
    out.doubt = [Finding("warning", pictured, note) for note in doubt.get(pictured, ())]
    for name, method in methods.items():
        reason = out.unbounded.get(name)
        warnings = [*getattr(method, "warnings", ()), *([reason] if reason else [])]
        notes = [*(() if name == pictured else doubt[name]), *getattr(method, "notes", ())]
        if name == pictured:
            out.findings += [Finding("warning", name, warning) for warning in warnings]
            warnings = []
        out.notes += [f"{name}: {note}" for note in [*notes, *warnings]]
    if video.peak_bytes:
        out.timings["flow_peak_rss_mb"] = round(video.peak_bytes / 1e6, 1)
    if out.stereo is not None:
        out.notes.append(out.stereo.describe())
    if (pulse := track.removed) is not None:
        out.notes.append(pulse.describe(mm_per_px))
        out.pulse = [
            {"rate_hz": rhythm.rate_hz, "amplitude_mm": mm_per_px * size}
            for rhythm, size in zip(pulse.rhythms, pulse.amplitudes_px, strict=True)
        ]


class _Forces:
    """Applies every method to every frame."""

    def __init__(
        self,
        methods: Mapping[str, Method],
        pictured: str,
        watch: Stopwatch,
        rest: RestFrame,
        scene: MethodContext,
    ) -> None:
        """Starts with the rest frame and the constants of the recording."""
        self.methods, self.pictured, self.watch, self.scene = methods, pictured, watch, scene
        self.out = TrackedRecording(pictured=pictured, rest=_shrink(rest.rgb))
        self.out.tissue = _shrink(scene.tissue.astype(np.uint8) * 255) > 127
        self.estimates: list[dict[str, ForceEstimate]] = []
        self.last: Map | None = None
        self.motion_mm: list[float] = []  # mean length of the flow over the tissue
        self.stride, self.cameras = 1, 1

    def add(self, frame: FrameMotion, time_s: float) -> None:
        """Adds the forces of a frame at its time [s]."""
        out, scene, inside = self.out, self.scene, self.scene.tissue
        position = len(out.time_s)
        is_snapshot = position % self.stride == 0
        self.cameras = 1 if frame.motion is None else 2
        estimates: dict[str, ForceEstimate] = {}
        for name, method in self.methods.items():
            if not isinstance(method, Fusion):
                with self.watch.stage(name):
                    estimates[name] = method(frame, scene, is_snapshot and name == self.pictured)
        density = estimates[self.pictured].density if self.pictured in estimates else None
        self.estimates.append({name: replace(estimate, density=None) for name, estimate in estimates.items()})
        speed = 0.0
        if self.last is not None and out.time_s:
            lengths = np.linalg.norm(frame.flow - self.last, axis=-1)[inside]
            speed = float(lengths.mean()) * scene.scale_mm_per_px / (time_s - out.time_s[-1])
        self.motion_mm.append(force_interval.find_motion(frame.flow, scene))
        out.confidence.append(float(frame.confidence[inside].mean()))
        out.trusted.append(frame.trusted)
        out.speed.append(speed)
        self.last = frame.flow
        out.frame.append(frame.index)
        out.time_s.append(time_s)
        if is_snapshot:
            self._snap(position, frame, density)

    def finish(self, recording: Recording, absent_s: Sequence[Span]) -> None:
        """Computes results that need all frames; `absent_s`: contact-free spans besides those stated [s]."""
        about = recording.meta
        rate, offset_s = about.sync.rate, about.sync.offset_s
        sensor_s = [(rate * a + offset_s, rate * b + offset_s) for a, b in about.sensor.free_s]
        stated = [*about.pulse.free_s, *(sensor_s if about.sync.method != "correlate" else [])]
        times, trusted = np.array(self.out.time_s), np.array(self.out.trusted, bool)

        def mask_spans(spans: Sequence[Span]) -> Mask:
            inside = np.any([(times >= a) & (times <= b) for a, b in spans], axis=0)  # False without spans
            return np.asarray(trusted & inside)

        contact_free = mask_spans([*stated, *absent_s])
        for name, method in self.methods.items():
            if isinstance(method, Revising):
                with self.watch.stage(name):
                    for frame, estimate in zip(self.estimates, method.revise(contact_free), strict=True):
                        frame[name] = estimate
        shares_left = self._relax(times, trusted)
        if self.pictured in shares_left:
            self._relax_maps(shares_left[self.pictured])
        tracked = [self.estimates[k] for k in np.flatnonzero(trusted)]
        known_mn = np.where(mask_spans(stated), 0.0, np.nan)
        if about.press_s is not None and about.young_kpa is not None:
            press_mn = align_sensor(recording, times, np.where(trusted, self.out.speed, np.nan), None).size_mn
            known_mn = (
                known_mn if press_mn is None else np.where(mask_spans([about.press_s]), press_mn, known_mn)
            )
        for name, method in self.methods.items():
            if isinstance(method, Fusion):
                with self.watch.stage(name):
                    fused = method.fuse(tracked, self.scene, self.cameras, known_mn[trusted])
                for frame, estimate in zip(tracked, fused, strict=True):
                    frame[name] = estimate
                for frame in self.estimates:
                    frame.setdefault(name, frame[method.parts[0]])
        self.out.stated = _find_stated(recording, self.scene)
        for name, method in self.methods.items():
            if isinstance(method, Physics) and tracked:
                self._bound(name, tracked, np.array(self.motion_mm)[trusted])
        for name in self.methods:
            self.out.force_mn[name] = [frame[name].force_mn for frame in self.estimates]
            self.out.size_mn[name] = [frame[name].size_mn for frame in self.estimates]
            self.out.bounds[name] = [(frame[name].low_mn, frame[name].high_mn) for frame in self.estimates]

    def _relax(self, times: Floats, trusted: Mask) -> dict[str, Floats]:
        """Relaxes the forces of methods for elastic tissue, where relaxation is stated; the shares (T,) of
        each method's forces that are left."""
        shares = dict[str, Floats]()
        for name, method in self.methods.items() if self.scene.relaxation else ():
            if isinstance(method, Physics):
                shares[name] = method.share_left
            elif getattr(method, "is_elastic", False):
                estimates = [frame[name] for frame in self.estimates]
                relaxed, shares[name] = relax_estimates(estimates, times, trusted, self.scene.relaxation)
                for frame, estimate in zip(self.estimates, relaxed, strict=True):
                    frame[name] = estimate
        return shares

    def _relax_maps(self, share_left: Floats) -> None:
        """Scales the force maps of frames (T,), which were computed as elastic."""
        self.out.snapshots = [
            snapshot
            if snapshot.density is None
            else replace(snapshot, density=np.float32(share_left[snapshot.position]) * snapshot.density)
            for snapshot in self.out.snapshots
        ]

    def _bound(self, name: str, tracked: Sequence[dict[str, ForceEstimate]], moved_mm: Floats) -> None:
        """Gives physics, of this name, its calibrated interval in the tracked frames."""
        estimates = [frame[name] for frame in tracked]
        share, out = float(np.mean(self.out.stated)), self.out
        video = force_interval.gather(estimates, moved_mm, self.cameras, share)
        common = self.scene.young_uncertainty, self.scene.recovered_by
        bounded, out.unbounded[name] = force_interval.bound(estimates, video, *common)
        out.evidence = None if any(np.isnan(estimate.low_mn) for estimate in estimates) else video
        for frame, estimate in zip(tracked, bounded, strict=True):
            frame[name] = estimate

    def _snap(self, position: int, frame: FrameMotion, density: Map | None) -> None:
        """Adds a snapshot; when the list is full, every other one is removed and the stride doubles."""
        density_map = None if density is None else _shrink(density)
        flow = _shrink(frame.flow) * np.float32(_ratio(frame.rgb.shape[1]))
        motion = frame.motion
        depth = None if motion is None else _shrink(np.ascontiguousarray(motion.motion[..., 2]))
        self.out.snapshots.append(Snapshot(position, _shrink(frame.rgb), flow, density_map, depth))
        if len(self.out.snapshots) >= _MOST_SNAPSHOTS:
            self.out.snapshots = self.out.snapshots[::2]
            self.stride *= 2


def _find_stated(recording: Recording, scene: MethodContext) -> tuple[bool, ...]:
    """Whether a recording states tissue, instruments, membrane, and rest or that it is ex vivo."""
    rests = recording.meta.sensor.free_s or recording.meta.pulse.free_s or not scene.living
    return recording.tissue is not None, bool(recording.masks), scene.membrane != "unknown", bool(rests)


def _ratio(width: int) -> float:
    return min(1.0, _SNAPSHOT_WIDTH / width)


def _shrink(array: NDArray[A]) -> NDArray[A]:
    """Downsamples an array (H, W[, C]) to the width of a snapshot."""
    ratio = _ratio(array.shape[1])
    if ratio == 1.0:
        return array
    return np.asarray(cv2.resize(array, None, fx=ratio, fy=ratio, interpolation=cv2.INTER_AREA), array.dtype)


def picture_masks(tracked: TrackedRecording) -> Pixels | None:
    """The rest frame (h, w, 3), tinted red by the share of frames in which a pixel is masked and yellow where
    the rest frame is masked, with the outline of the tissue in green; None if there is nothing to show."""
    summary, rest, tissue = tracked.summary, tracked.rest, tracked.tissue
    if rest is None or tissue is None or summary.masked_count is None:
        return None
    if summary.rest_masked is None and not summary.masked_count.any() and tissue.all():
        return None
    masked_share = _shrink(summary.masked_count / max(summary.frames, 1))[..., None]
    tinted = rest * (1 - 0.7 * masked_share) + 0.7 * masked_share * np.array([230, 40, 30])
    if summary.rest_masked is not None:
        rest_mask = _shrink(summary.rest_masked.astype(np.float32))[..., None]
        tinted = tinted * (1 - 0.5 * rest_mask) + 0.5 * rest_mask * np.array([240, 200, 30])
    picture = np.asarray(np.clip(tinted, 0, 255), np.uint8)
    inside = (tissue & ~tissue.all()).astype(np.uint8)  # tissue that fills the picture has no outline
    edges = cv2.findContours(inside, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
    return np.asarray(cv2.drawContours(picture, edges, -1, (60, 230, 90), 1), np.uint8)
