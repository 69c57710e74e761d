"""Motion in a video: decodes, downsamples, masks and tracks frames, and removes camera motion and pulsation.

`learn predict`, `bench score`, `bench check` and `bench live` all use it.
"""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from synth.errors import UserError, as_positive
from synth.flow import mask_detection
from synth.flow.confidence import add_deviation
from synth.flow.estimator import Flags, Map, Rgb
from synth.flow.mask_selection import Proposal
from synth.flow.stereo.track import Moved
from synth.recording_flow.camera_motion import CameraTracker, Course, Similarity, describe_course
from synth.recording_flow.finding import Finding, first_fault
from synth.recording_flow.foreground import ForegroundSearch
from synth.recording_flow.frame_faults import VideoFaults, find_bars, find_fault, is_inside_out
from synth.recording_flow.frame_motion import FrameMotion, TrackingSummary
from synth.recording_flow.harmonic_fit import Span
from synth.recording_flow.local_flow import LocalFlow
from synth.recording_flow.pulse import PulseSearch, SurfaceMotion, find_pulse, in_cells
from synth.recording_flow.shared_motion import SharedMotion, find_path
from synth.system.stopwatch import Stopwatch
from synth.video.mask_files import MASKS
from synth.video.read import Picture

A = TypeVar("A", bound=np.generic)
Size = tuple[int, int]  # height, width [px]

_SEARCHED = 12  # the first frames, and then one in this many, are searched for foreground
LEAST_COLUMNS = 320  # least width with `shrink` 0: the grids of the networks are no finer


@dataclass(frozen=True)
class RecordingFlowSettings:
    """Settings for tracking a video."""

    backend: str = "tvl1"
    """Flow estimator."""
    shrink: int = 0
    """Factor by which pictures are downsampled for flow; 0: the largest that leaves `LEAST_COLUMNS`."""
    rate_hz: float | None = 10.0
    """Largest number of frames tracked per second; None: all."""
    pulse: bool = True
    """Whether pulsation of the tissue by heart and breath is estimated and removed."""
    masks: str = "auto"
    """Which instruments and highlights are masked, one of `MASKS`."""

    def __post_init__(self) -> None:
        """Raises UserError for an invalid rate or factor of downsampling."""
        if self.rate_hz is not None:
            as_positive("rate_hz (None: every frame)", self.rate_hz)
        if self.shrink not in range(65):
            raise UserError(f"shrink {self.shrink}: a whole number from 0 to 64")


def everywhere(size: Size) -> Flags:
    """Tissue mask (H, W) that covers the whole picture."""
    return np.ones(size, bool)


@dataclass(frozen=True)
class Footage:
    """A video to be tracked."""

    pictures: Iterable[Picture]  # all frames in order
    name: str  # for messages
    tissue: Callable[[Size], Flags] = everywhere  # (H, W) tissue mask of the rest frame
    # (H, W) instrument mask of a frame, None: empty; if the function is None, instruments are detected.
    tool: Callable[[int, Size], Flags | None] | None = None
    rest_frame: int = 0
    only: Container[int] | None = None  # numbers of the frames to track, with the rest frame; None: all


class DepthSource(Protocol):
    """A right camera or a depth camera."""

    scale_mm_per_px: float  # of the original pixels of the video

    def follow(self, frame: FrameMotion, video: VideoFlow) -> Moved | None:
        """Motion in three dimensions of a trusted frame, the rest frame first; None: picture missing."""
        ...

    def depth_mm(self) -> Map | None:
        """Depth (h, w) along the optical axis in the last frame, NaN where unknown; None: unknown."""
        ...


class Pace(Protocol):
    """Times at which the frames of a stream arrive."""

    def start(self, time_s: float) -> None:
        """Starts the clock when the rest frame, at this time of the video, has been processed."""
        ...

    def is_due(self, index: int, time_s: float) -> bool:
        """Waits until a frame arrives and returns whether it is processed."""
        ...

    def spare_s(self, time_s: float) -> float:
        """Time until a frame arrives [s]."""
        ...


@dataclass(frozen=True)
class _Steadied(Picture):
    """A downsampled frame without the camera motion found on its surroundings."""

    camera: Similarity | None = None


class VideoFlow:
    """Tracks one video, once; results over the whole video are attributes."""

    def __init__(
        self,
        footage: Footage,
        settings: RecordingFlowSettings,
        flow: LocalFlow | None = None,
        pulse: PulseSearch | None = None,
        depth: DepthSource | None = None,
        pace: Pace | None = None,
        watch: Stopwatch | None = None,
    ) -> None:
        """Decodes nothing yet.

        Args:
            footage: the video.
            settings: of the tracking.
            flow: computes the flow and is closed by the caller; None: in this process.
            pulse: pulsation and camera motion from a first pass, removed from every frame.
            depth: source of motion in three dimensions, if any.
            pace: of a stream; None: every frame is processed. Flow runs once before the stream starts, so
                that compilation does not add to the latency.
            watch: collects the time spent; None: a new one.

        Raises:
            UserError: no such kind of masks.
        """
        if settings.masks not in MASKS:
            raise UserError(f"masks: no kind {settings.masks!r}; there are {', '.join(MASKS)}")
        self.footage, self.settings, self.watch = footage, settings, watch or Stopwatch()
        self.pulse, self.summary = pulse, TrackingSummary()
        self.removed = None if pulse is None else pulse.pulse  # subtracted from the motion of every frame
        self.tissue = np.zeros((0, 0), bool)  # (h, w) on the downsampled pixels; empty before the rest frame
        self.shrink, self.size = settings.shrink, (0, 0)  # factor of downsampling; height, width of the video
        self.rest_s: float | None = None  # time of the rest frame, if known
        self.decoded = self.peak_bytes = 0  # number of frames; memory of the flow process
        self.faults: VideoFaults | None = None  # None before the rest frame
        self._depth, self._findings = depth, list[Finding]()
        self._flow, self._pace = flow or LocalFlow(), pace
        self._camera: CameraTracker | None = None  # from the rest frame on
        self._path = None if pulse is None else pulse.camera
        self._shared: SharedMotion | None = None  # only for a stream whose tissue fills the picture
        self._course: Course = []  # of the camera, found on the tissue
        self._foreground: ForegroundSearch | None = None  # not for a stream
        self._surface: SurfaceMotion | None = None  # only for a search for pulsation
        self._depth_weights: list[float] = []
        self._period_s = 0.0 if settings.rate_hz is None else 1 / settings.rate_hz
        self._due_s = self._last_s = -math.inf
        self._left_out: Counter[str] = Counter()
        self._fault, self._rest_rgb, self._changes = "", np.zeros((0, 0, 3), np.uint8), False

    def frames(self, progress: Callable[[int], None] = lambda done: None) -> Iterator[FrameMotion]:
        """Yields the motion of tracked frames, the rest frame first, with a few frames in memory.

        If flow runs in another process, it computes the next frame while the caller processes this one.

        Args:
            progress: called after every decoded frame with their number.

        Raises:
            UserError: unreadable video, no tissue, masks or frames of another size, no such estimator.
        """
        try:
            yield from self._frames(progress)
        except BrokenExecutor:
            raise UserError("the flow process ended unexpectedly: is it out of memory?") from None

    def _frames(self, progress: Callable[[int], None]) -> Iterator[FrameMotion]:
        pictures = iter(self.footage.pictures)
        waiting: deque[tuple[_Steadied, float, Future[FrameMotion]]] = deque()
        while True:
            with self.watch.stage("decode"):
                picture = next(pictures, None)
            if picture is None:
                break
            self.decoded += 1
            if self.faults is not None and picture.time_s is not None:
                self.faults.add_decoded(picture.index, picture.time_s, picture.rgb)
            while waiting and self._is_ready(waiting[0][2], picture.time_s):
                yield self._finish(*waiting.popleft())
            if self._is_wanted(picture.index, picture.time_s):
                is_rest = self.tissue.size == 0
                if is_rest:
                    self._start(picture)
                small, proposal, masking_s = self._prepare(picture)
                if is_rest:
                    yield self._begin(small, proposal, masking_s)
                    if self._pace is not None:
                        self._pace.start(picture.time_s or 0.0)
                elif self._fault:
                    nothing = FrameMotion.none(self.tissue.shape, trusted=False)
                    self.summary.add(nothing, self.tissue)
                    yield self._with_depth(self._with_picture(nothing, small, masking_s))
                else:
                    waiting.append((small, masking_s, self._flow.submit(small.rgb, proposal)))
                if len(waiting) > self._flow.ahead:
                    yield self._finish(*waiting.popleft())
            progress(self.decoded)
        for one in waiting:
            yield self._finish(*one)

    def find_pulse(self, free_s: Sequence[Span] = ()) -> PulseSearch | None:
        """Estimates pulsation, and camera motion where tissue fills the picture, after the last frame.

        Returns None if there is neither, or if `pulse` is off in the settings.

        Args:
            free_s: spans without contact, if known [s].
        """
        if self._surface is None:
            return None
        if self._depth_weights:
            self._surface.depth_weight = min(1.0, float(np.median(self._depth_weights)))
        rest_s = self.rest_s
        if rest_s is None:
            rest_s = self._surface.time_s[0] if self._surface.time_s else 0.0
        with self.watch.stage("pulse"):
            self.pulse = find_pulse(self._surface, rest_s, free_s)
        if self._camera is not None and self._camera.is_blind:
            with self.watch.stage("camera"):
                self.pulse = replace(self.pulse, camera=find_path(self._surface, self.pulse.pulse))
        return self.pulse if self.pulse.pulse or self.pulse.camera else None

    @property
    def findings(self) -> list[Finding]:
        """Findings on the video, after the last frame."""
        fault = ""
        if self._fault:
            fault = f"the rest frame is {self._fault}"
        elif self.summary.frames and not self._changes:
            fault = "the picture never changes"
        foreground = [] if self._foreground is None else self._foreground.findings
        moved = [] if self._camera is None else self._camera.describe(self.shrink)
        faults = [] if self.faults is None or fault else self.faults.findings()
        course = self._course or ([] if self._shared is None else self._shared.course)
        if course:
            how = "it is estimated on tissue alone, which contacts and pulsation move too"
            moved.append(f"{describe_course(course, self.shrink)}; {how}")
        bad = [Finding("bad", "pictures", fault)] if fault else []
        camera = [Finding("odd", "camera", one) for one in moved]
        return [*bad, *self._findings, *foreground, *faults, *camera]

    @property
    def fault(self) -> str:
        """Reason why no number is valid, after the last frame; empty if there is none."""
        return first_fault(self.findings)

    @property
    def notes(self) -> list[str]:
        """Sentences on the processing for reports, after the last frame and the search for pulsation."""
        missed = "" if self.pulse is None or self.fault else self.pulse.describe()
        shrunk = [f"pictures are downsampled {self.shrink} times for flow"] if self.shrink > 1 else []
        left_out = [f"left out: {n} of {self.decoded} frames {why}" for why, n in self._left_out.items()]
        return shrunk + left_out + ([missed] if missed else [])

    def _is_wanted(self, index: int, time_s: float | None) -> bool:
        """Whether a frame is tracked; others are counted by reason."""
        if index < self.footage.rest_frame:
            reason = "before the rest frame"
        elif time_s is None:
            reason = "without a time"
        elif self.footage.only is not None and index not in self.footage.only:
            reason = "outside the selection"
        elif time_s <= self._last_s:
            reason = "whose time does not increase"
        # A frame may be early by a fifth of the period.
        elif time_s < self._due_s - 0.2 * self._period_s:
            reason = f"beyond {self.settings.rate_hz:g} per second"
        else:
            first = self._due_s == -math.inf
            due_s = time_s if first else max(self._due_s, time_s - 0.2 * self._period_s)
            self._due_s, self._last_s = due_s + self._period_s, time_s
            return self.tissue.size == 0 or self._pace is None or self._pace.is_due(index, time_s)
        self._left_out[reason] += 1
        return time_s is None and index == self.footage.rest_frame

    def _start(self, rest: Picture) -> None:
        """Sets sizes and the tissue mask from the rest frame."""
        self.size = (rest.rgb.shape[0], rest.rgb.shape[1])
        self.shrink = self.settings.shrink or max(1, self.size[1] // LEAST_COLUMNS)
        tissue, bars = self.footage.tissue(self.size), find_bars(rest.rgb)
        if is_inside_out(tissue):
            inverted = "tissue.png marks the border of the picture but not its middle: is it inverted?"
            self._findings.append(Finding("odd", "tissue", inverted))
        if (tissue & bars).any():
            share = f"{100 * bars.mean():.0f}% of the picture are black bars, removed from the tissue mask"
            self._findings.append(Finding("odd", "pictures", share))
        self.tissue = shrink_mask(tissue & ~bars, self.shrink, 127)
        if not self.tissue.any():
            raise UserError(f"{self.footage.name}: the tissue mask marks no tissue")
        self.faults = VideoFaults(rest.rgb, shrink_picture(rest.rgb, self.shrink), self.tissue)
        self.rest_s = rest.time_s
        if self.settings.pulse and self.pulse is None:
            self._surface = SurfaceMotion(self.tissue)

    def _prepare(self, picture: Picture) -> tuple[_Steadied, Proposal, float]:
        """The downsampled frame without camera motion, its mask proposals, and the time spent [s]."""
        height, width = picture.rgb.shape[:2]
        if (height, width) != self.size:
            known = f"{self.size[1]} x {self.size[0]}"
            raise UserError(f"frame {picture.index} is {width} x {height} px, but the rest frame is {known}")
        began = time.perf_counter()
        rgb, view = shrink_picture(picture.rgb, self.shrink), None
        if self.faults is not None and picture.time_s is not None:
            self.faults.add_tracked(picture.time_s, picture.rgb, rgb)
        if self._camera is not None:
            with self.watch.stage("camera"):
                if self._path is None:
                    view = self._camera.find(rgb, picture.time_s)
                elif (view := self._path.at(picture.time_s or 0.0)) is not None:
                    last = self._course[-1][1] if self._course else None
                    self._course.append(
                        (picture.time_s or 0.0, view, view.distance_px(last, self.tissue.shape))
                    )
                rgb = rgb if view is None else view.undo(rgb)
        with self.watch.stage("mask"):
            proposal = self._mask(picture.index, rgb, view)
        return _Steadied(picture.index, picture.time_s, rgb, view), proposal, time.perf_counter() - began

    def _mask(self, index: int, rgb: Rgb, view: Similarity | None) -> Proposal:
        """Mask proposals of a frame."""
        kind, nothing = self.settings.masks, np.zeros(rgb.shape[:2], bool)
        glare = nothing if kind in ("none", "tool") else mask_detection.glare(rgb)
        tool = known = nothing
        if kind not in ("none", "glare"):
            if self.footage.tool is None:
                tool = mask_detection.tool(rgb)
            elif (given := self.footage.tool(index, self.size)) is not None:
                known = shrink_mask(given, self.shrink, 0)
                known = known if view is None else view.undo(known.astype(np.uint8) * 255) > 127
        if view is not None:
            known = known | view.outside(known.shape)
        if kind == "auto":
            return Proposal(glare, tool, known)
        return Proposal(nothing, nothing, glare | tool | known)

    def _begin(self, small: _Steadied, proposal: Proposal, masking_s: float) -> FrameMotion:
        """Starts the flow and returns the rest frame without motion."""
        self._fault, self._rest_rgb = find_fault(small.rgb, self.tissue), small.rgb
        frame = FrameMotion.none(self.tissue.shape, trusted=not self._fault)
        if not self._fault:
            self._flow.begin(self.settings.backend, small.rgb, proposal, self.tissue)
            self._camera = CameraTracker(small.rgb, self.tissue, proposal.either | proposal.known)
            # Shared motion of the tissue may be pulsation; a search for it comes first.
            if self._camera.is_blind and self._surface is None and self._path is None:
                self._shared = SharedMotion(self.tissue)
            if self._pace is not None:
                self._flow.submit(small.rgb, proposal).result()
            frame = replace(frame, confidence=(self.tissue & ~proposal.known).astype(np.float32))
            if self._pace is None:
                self._foreground = ForegroundSearch(self.tissue, self.shrink)
        frame = self._with_picture(replace(frame, is_rest=True), small, masking_s)
        return self._searched(self._with_depth(frame))

    def _is_ready(self, flow: Future[FrameMotion], time_s: float | None) -> bool:
        """Waits for a flow until a frame of this time arrives; returns whether the flow is ready."""
        try:
            flow.result(0.0 if self._pace is None else self._pace.spare_s(time_s or 0.0))
        except TimeoutError:
            return False
        return True

    def _finish(self, small: _Steadied, masking_s: float, flow: Future[FrameMotion]) -> FrameMotion:
        """The motion of a frame after its flow: without camera motion and pulsation, in stereo with depth."""
        frame = self._with_picture(flow.result(), small, masking_s)
        if self._shared is not None and frame.trusted and small.time_s is not None:
            frame = self._without_camera(frame, small.time_s, self._shared)
        if frame.camera is not None:
            frame = replace(frame, confidence=add_deviation(frame.confidence, frame.camera.deviation_px))
        self._changes = self._changes or not np.array_equal(small.rgb, self._rest_rgb)
        if frame.trusted and find_fault(small.rgb, self.tissue):
            frame = replace(frame, trusted=False)
        self.watch.add("flow", frame.cpu_s, frame.wall_s)
        self.peak_bytes = max(self.peak_bytes, frame.peak_bytes)
        frame = self._with_depth(frame)
        self.summary.add(frame, self.tissue)
        return self._without_pulse(self._searched(frame))

    def _without_camera(self, frame: FrameMotion, time_s: float, shared: SharedMotion) -> FrameMotion:
        """Removes the camera motion found on the tissue, after pulsation is subtracted."""
        began, moved = time.process_time(), frame.flow
        if self.removed is not None:
            moved = moved - self.removed.at(time_s)[..., :2]
        view = shared.add(time_s, *in_cells(moved, frame.confidence * self.tissue))
        if view is not None:
            rgb = frame.rgb if self._depth is None else view.undo(frame.rgb)
            frame = replace(frame, flow=view.steady(frame.flow), rgb=rgb, camera=view)
        self.watch.add("camera", time.process_time() - began, 0.0)
        return frame

    def _with_picture(self, frame: FrameMotion, small: _Steadied, masking_s: float) -> FrameMotion:
        frame = replace(frame, index=small.index, time_s=small.time_s, rgb=small.rgb)
        return replace(frame, camera=small.camera, masking_s=masking_s)

    def _with_depth(self, frame: FrameMotion) -> FrameMotion:
        """Adds motion in three dimensions; without it a frame is lost."""
        if self._depth is None:
            return frame
        with self.watch.stage("stereo"):
            moved = self._depth.follow(frame, self) if frame.trusted else None
            if moved is None:
                return replace(frame, trusted=False, motion=Moved.nothing(self.tissue.shape))
            return replace(frame, motion=moved)

    def _searched(self, frame: FrameMotion) -> FrameMotion:
        """Searches the first frames, and then each twelfth, for foreground."""
        count = self.summary.frames
        if self._foreground is not None and (count <= _SEARCHED or count % _SEARCHED == 0):
            with self.watch.stage("mask"):
                depth = self._depth.depth_mm() if self._depth is not None and frame.trusted else None
                self._foreground.add(frame, depth)
        return frame

    def _without_pulse(self, frame: FrameMotion) -> FrameMotion:
        """Subtracts known pulsation, or adds the frame to the search for it."""
        moved, time_s = frame.motion, frame.time_s
        assert time_s is not None
        px_mm = np.float32(1.0 if self._depth is None else self._depth.scale_mm_per_px * self.shrink)
        if self._surface is not None and frame.trusted:
            parts = [frame.flow]
            if moved is not None:
                # The search uses the flow, because lateral motion in mm has the noise of depth.
                parts += [moved.motion[..., 2:] / px_mm, moved.motion[..., :2] / px_mm]
                across, along = (float(np.median(moved.deviation[..., k][self.tissue])) for k in (0, 2))
                self._depth_weights.append(across / max(along, 1e-9))
            self._surface.add(time_s, np.dstack(parts), frame.confidence)
        if self.removed is None:
            return frame
        own = self.removed.at(time_s)
        if moved is not None and frame.trusted:
            moved = replace(moved, motion=moved.motion - own[..., [3, 4, 2]] * px_mm)
        return replace(frame, flow=frame.flow - own[..., :2], motion=moved)


def shrink_picture(picture: NDArray[A], shrink: int) -> NDArray[A]:
    """Downsamples an array (H, W[, C]) by `shrink`; a remainder at the right and bottom is cropped."""
    if shrink == 1:
        return picture
    size = (max(1, picture.shape[1] // shrink), max(1, picture.shape[0] // shrink))
    # Cropped to a multiple, so that a pixel of the small picture is shrink x shrink pixels of the large one.
    cut = picture[: size[1] * shrink, : size[0] * shrink]
    return np.asarray(cv2.resize(cut, size, interpolation=cv2.INTER_AREA), picture.dtype)


def shrink_mask(mask: Flags, shrink: int, above: int) -> Flags:
    """Downsamples a mask (H, W); True where more than `above` / 255 of a pixel is True."""
    return np.asarray(shrink_picture(mask.astype(np.uint8) * 255, shrink) > above)
