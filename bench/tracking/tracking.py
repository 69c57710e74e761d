"""One pass over a recording: displacement from the rest frame, and every method's force from it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.methods.protocol import InSpace, Method, Scene
from bench.recording.folder import Recording
from bench.recording.meta import Span
from bench.recording.second_eye import OwnMotion, SecondEye, Sight
from synth.errors import UserError
from synth.flow.stereo.track import Moved
from synth.recording_flow.pulse import Surface, carried_over
from synth.recording_flow.video_flow import Account, FlowHere, Footage, Settings, Step, VideoFlow
from synth.system.stopwatch import Stopwatch

A = TypeVar("A", bound=np.generic)
Progress = Callable[[int], None]
"""Told how many frames are done."""

_MOST_SNAPSHOTS = 64
_SNAPSHOT_WIDTH = 480


@dataclass(frozen=True)
class Snapshot:
    """A frame kept for the report, shrunk."""

    position: int
    """Index into the curves."""
    rgb: NDArray[np.uint8]
    flow: NDArray[np.float32]
    """(h, w, 2), in pixels of the shrunken picture."""
    density: NDArray[np.float32] | None
    """(h, w) kPa."""
    depth: NDArray[np.float32] | None = None
    """(h, w) mm, motion along the view, away from the camera; None without a second eye."""


@dataclass
class Tracked:
    """Curves over the frames that have a time, from the rest frame on."""

    frame: list[int] = field(default_factory=list)
    """Frame numbers in the recording."""
    time_s: list[float] = field(default_factory=list)
    force_mn: dict[str, list[NDArray[np.float64]]] = field(default_factory=dict)
    """By method: (3,) each."""
    bounds: dict[str, list[tuple[float, float, float]]] = field(default_factory=dict)
    """By method: `low_mn`, `high_mn` and `distance` of each `Answer`."""
    speed: list[float] = field(default_factory=list)
    """Mean speed of the tissue since the frame before [mm/s]; what is lined up with the sensor."""
    confidence: list[float] = field(default_factory=list)
    """Mean confidence of the flow over the tissue."""
    trusted: list[bool] = field(default_factory=list)
    """Whether the frame could be followed; what was said of one that couldn't is no answer."""
    account: Account = field(default_factory=Account)
    """What was masked, lost and regained."""
    snapshots: list[Snapshot] = field(default_factory=list)
    rest: NDArray[np.uint8] | None = None
    tissue: NDArray[np.bool_] | None = None
    """(h, w), shrunk as the snapshots are."""
    size: tuple[int, int] = (0, 0)
    """Height, width of the recording [px]."""
    notes: list[str] = field(default_factory=list)
    timings: dict[str, dict[str, float] | float] = field(default_factory=dict)
    fault: str = ""
    """Why nothing of the video is a measurement; empty if something may be."""
    sight: Sight | None = None
    """What the second eye or the depth camera is good for; None: there is none, or it was not used."""
    turning: Surface | None = None
    """How the tissue moved over `sensor.turn_s`; None without that span."""
    pulse: list[dict[str, float]] = field(default_factory=list)
    """rate_hz and amplitude_mm of each rhythm of the tissue's own that was taken off."""


def track_recording(
    recording: Recording,
    methods: Mapping[str, Method],
    scale_mm_per_px: float,
    settings: Settings,
    *,
    pictured: str | None = None,
    flow: FlowHere | None = None,
    progress: Progress = lambda done: None,
) -> Tracked:
    """Follows the video and asks every method, holding a few frames at a time.

    Args:
        recording: the opened recording.
        methods: by name.
        scale_mm_per_px: of the recording's own pixels.
        settings: of this run.
        pictured: the method whose force map goes into the snapshots.
        flow: where it is computed, closed by the caller; None: here. Elsewhere, it is on its way while the
            methods answer for the frame before.
        progress: told after every frame.

    Raises:
        UserError: unreadable video, no frame with a time, rest frame beyond the end, masks of another size.
    """
    watch = Stopwatch()
    once = partial(_track, recording, methods, scale_mm_per_px, settings, pictured, flow, progress, watch)
    out, found = once(None)
    if found is not None:
        # Contacts are answered for on the tissue as it would lie still: all over again, with that taken off.
        out, _ = once(found)
    # Of both times through, for whoever asks what an answer costs.
    out.timings |= watch.report()
    return out


def _track(
    recording: Recording,
    methods: Mapping[str, Method],
    scale_mm_per_px: float,
    settings: Settings,
    pictured: str | None,
    flow: FlowHere | None,
    progress: Progress,
    watch: Stopwatch,
    own: OwnMotion | None,
) -> tuple[Tracked, OwnMotion | None]:
    """Once through the video; what was tracked, and the tissue's own motion that is still in it."""
    meta = recording.meta
    tool = recording.tool if recording.has_masks else None
    footage = Footage(recording.frames(), str(recording.folder), recording.tissue_mask, tool, meta.rest_frame)
    asked = replace(settings, pulse=settings.pulse and meta.pulse.remove)
    known = (None, None) if own is None else (own.flow, own.search)
    video = VideoFlow(footage, asked, flow, pulse=known[0], search=known[1], watch=watch)
    asking = _Asking(methods, pictured, watch)
    two = bool(recording.right or recording.depths)
    second, space = SecondEye(recording, video, own) if two else None, _InSpace()
    for step in video.steps(progress):
        asking.out.account.add(step.found, video.tissue)
        if asking.scene is None:
            asking.scene = Scene(video.tissue, scale_mm_per_px * video.shrink, meta.young_kpa)
            asking.out.rest = _shrunk(step.picture.rgb)
            asking.out.tissue = _shrunk(video.tissue.astype(np.uint8) * 255) > 127
        moved = None
        if second is not None:
            with watch.stage("second eye"):
                moved = second.move(step)
            if video.surface is not None:
                space.add(step, moved, video.tissue, asking.scene.scale_mm_per_px)
        if step.picture.time_s is not None:
            asking.ask(step, step.picture.time_s, asking.scene, moved)
            if _is_within(meta.sensor.turn_s, step):
                asking.out.turning = asking.out.turning or Surface(video.tissue)
                asking.out.turning.add(step.picture.time_s, step.found.flow, step.found.confidence)
    out = asking.out
    if second is not None:
        out.sight = second.sight
    if not out.time_s:
        if video.seen <= meta.rest_frame:
            raise UserError(f"{recording.folder}: rest_frame {meta.rest_frame}, but {video.seen} frames")
        raise UserError(f"{recording.folder}: no frame has a time; give frames.csv, or fps in meta.yaml")
    found = video.find_pulse(meta.pulse.free_s, space.seen)
    _tell(out, video, recording, methods, own, scale_mm_per_px * video.shrink)
    if found is None or video.search is None:
        return out, None
    deep = None if space.moved is None else carried_over(video.search, space.moved, video.rest_s)
    return out, OwnMotion(found, deep, video.search)


def _tell(
    out: Tracked,
    video: VideoFlow,
    recording: Recording,
    methods: Mapping[str, Method],
    own: OwnMotion | None,
    mm_per_px: float,
) -> None:
    """Says what was done to the video, which is through, and what somebody should know of it."""
    out.fault = video.fault
    if out.fault:
        out.trusted = [False] * len(out.time_s)
    out.size, out.notes = video.size, video.notes
    if out.fault:
        out.notes.append(f"nothing can be measured: {out.fault}")
    out.notes.append(recording.describe_tool(video.seen))
    for name, method in methods.items():
        out.notes += [f"{name}: {note}" for note in getattr(method, "notes", ())]
    if out.account.is_odd:
        out.notes.append(out.account.describe())
    if video.peak_bytes:
        out.timings["flow_peak_rss_mb"] = round(video.peak_bytes / 1e6, 1)
    if out.sight is not None:
        out.notes.append(out.sight.describe())
    if own is not None:
        out.pulse = own.rhythms(mm_per_px)
        out.notes.append(own.describe(mm_per_px))


def _is_within(span: Span | None, step: Step) -> bool:
    """Whether a frame that could be followed lies in a span of video time."""
    time_s = step.picture.time_s
    return span is not None and time_s is not None and span[0] <= time_s <= span[1] and step.found.trusted


class _InSpace:
    """What both eyes saw move, for the tissue's own motion to be looked for in."""

    def __init__(self) -> None:
        self.moved: Surface | None = None
        """[mm], to be taken off; None if there is no frame."""
        self._seen: Surface | None = None
        self._sure: list[float] = []

    def add(self, step: Step, moved: Moved, tissue: NDArray[np.bool_], mm_per_px: float) -> None:
        """A frame; one that can't be followed, or is the rest frame, is left out as `VideoFlow` does."""
        time_s, found = step.picture.time_s, step.found
        if time_s is None or found.is_rest or not found.trusted:
            return
        self.moved = self.moved or Surface(tissue, mm_per_px)
        self._seen = self._seen or Surface(tissue)
        self.moved.add(time_s, moved.motion, found.confidence)
        # The flow itself, not x and y in millimetres, which have the noise of depth in them.
        seen = np.dstack([found.flow, moved.motion[..., 2] / np.float32(mm_per_px)])
        self._seen.add(time_s, seen, found.confidence)
        across, along = (float(np.median(moved.deviation[..., k][tissue])) for k in (0, 2))
        self._sure.append(across / max(along, 1e-9))

    @property
    def seen(self) -> Surface | None:
        """[px], to be looked in. Depth weighs as much less as it is less sure."""
        if self._seen is not None:
            self._seen.weight = (1.0, 1.0, min(1.0, float(np.median(self._sure))))
        return self._seen


class _Asking:
    """Every method asked of every frame."""

    def __init__(self, methods: Mapping[str, Method], pictured: str | None, watch: Stopwatch) -> None:
        self.methods, self.pictured, self.watch = methods, pictured, watch
        self.out = Tracked(force_mn={name: [] for name in methods}, bounds={name: [] for name in methods})
        self.scene: Scene | None = None
        self.last: NDArray[np.float32] | None = None
        self.stride = 1

    def ask(self, step: Step, time_s: float, scene: Scene, moved: Moved | None) -> None:
        """Records what the methods say of a frame at its time [s]."""
        flow, confidence, out = step.found.flow, step.found.confidence, self.out
        position = len(out.time_s)
        wanted = position % self.stride == 0
        density = None
        for name, method in self.methods.items():
            with self.watch.stage(name):
                shown = wanted and name == self.pictured
                if moved is not None and isinstance(method, InSpace):
                    answer = method.in_space(flow, confidence, moved, scene, shown)
                else:
                    answer = method(flow, confidence, scene, shown)
            out.force_mn[name].append(answer.force_mn)
            out.bounds[name].append((answer.low_mn, answer.high_mn, answer.distance))
            if name == self.pictured:
                density = answer.density
        inside = scene.tissue
        out.confidence.append(float(confidence[inside].mean()))
        out.trusted.append(step.found.trusted)
        speed = 0.0
        if self.last is not None and out.time_s:
            lengths = np.linalg.norm(flow - self.last, axis=-1)[inside]
            speed = float(lengths.mean()) * scene.scale_mm_per_px / (time_s - out.time_s[-1])
        out.speed.append(speed)
        self.last = flow
        out.frame.append(step.picture.index)
        out.time_s.append(time_s)
        if wanted:
            self._keep(position, step, density, moved)

    def _keep(
        self, position: int, step: Step, density: NDArray[np.float32] | None, moved: Moved | None
    ) -> None:
        """Keeps at most so many, evenly: when full, every other one goes and the stride doubles."""
        small = None if density is None else _shrunk(density)
        flow = _shrunk(step.found.flow) * np.float32(_ratio(step.picture.rgb.shape[1]))
        depth = None if moved is None else _shrunk(np.ascontiguousarray(moved.motion[..., 2]))
        self.out.snapshots.append(Snapshot(position, _shrunk(step.picture.rgb), flow, small, depth))
        if len(self.out.snapshots) >= _MOST_SNAPSHOTS:
            self.out.snapshots = self.out.snapshots[::2]
            self.stride *= 2


def _ratio(width: int) -> float:
    return min(1.0, _SNAPSHOT_WIDTH / width)


def _shrunk(array: NDArray[A]) -> NDArray[A]:
    """As wide as a snapshot at most."""
    ratio = _ratio(array.shape[1])
    if ratio == 1.0:
        return array
    return np.asarray(cv2.resize(array, None, fx=ratio, fy=ratio, interpolation=cv2.INTER_AREA), array.dtype)


def picture_masks(tracked: Tracked) -> NDArray[np.uint8] | None:
    """The rest frame, red where the picture is masked, the more often the redder, and yellow where the rest
    frame itself is; (h, w, 3). None if nothing is."""
    account, rest = tracked.account, tracked.rest
    if rest is None or account.where is None or (account.rest_blocked is None and not account.where.any()):
        return None
    often = _shrunk(account.where / max(account.frames, 1))[..., None]
    shown = rest * (1 - 0.7 * often) + 0.7 * often * np.array([230, 40, 30])
    if account.rest_blocked is not None:
        still = _shrunk(account.rest_blocked.astype(np.float32))[..., None]
        shown = shown * (1 - 0.5 * still) + 0.5 * still * np.array([240, 200, 30])
    return np.asarray(np.clip(shown, 0, 255), np.uint8)
