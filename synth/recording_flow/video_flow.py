"""A film's motion: frames are decoded, shrunk, masked and followed from the rest frame, pulse taken off.

The one way of a film, for `learn predict`, `bench score`, `bench check` and `bench live`.
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
Size = tuple[int, int]
"""Height, width [px]."""

_SEARCHED = 12  # frames, and one in so many, that are searched for what is no tissue
LEAST_COLUMNS = 320
"""That `shrink` 0 leaves a picture: the networks' grids are no finer."""


@dataclass(frozen=True)
class RecordingFlowSettings:
    """How a film is followed."""

    backend: str = "tvl1"
    """Flow estimator."""
    shrink: int = 0
    """Flow is computed on pictures so many times smaller; 0: the most that leaves `LEAST_COLUMNS`."""
    rate_hz: float | None = 10.0
    """At most so many frames a second are looked at; None: all."""
    pulse: bool = True
    """Whether the tissue's own periodic motion is looked for, and taken off."""
    masks: str = "auto"
    """What of tools and highlights is masked, one of `MASKS`."""

    def __post_init__(self) -> None:
        """Raises UserError for a rate or a shrinking that can't be."""
        if self.rate_hz is not None:
            as_positive("rate_hz (None: every frame)", self.rate_hz)
        if self.shrink not in range(65):
            raise UserError(f"shrink {self.shrink}: a whole number from 0 to 64")


def everywhere(size: Size) -> Flags:
    """(H, W) True: all of the picture is tissue."""
    return np.ones(size, bool)


@dataclass(frozen=True)
class Footage:
    """What is followed."""

    pictures: Iterable[Picture]
    """Its frames in order, from the first on."""
    name: str
    """For messages."""
    tissue: Callable[[Size], Flags] = everywhere
    """(H, W) where there is tissue in the rest frame."""
    tool: Callable[[int, Size], Flags | None] | None = None
    """(H, W) where the tool is in a frame, None for nowhere; if not given it is found in the pictures."""
    rest_frame: int = 0
    only: Container[int] | None = None
    """Numbers of the frames that are followed, the rest frame's among them; None: all."""


class SecondView(Protocol):
    """A second eye or a depth camera."""

    scale_mm_per_px: float
    """Of the film's own pixels."""

    def follow(self, frame: FrameMotion, video: VideoFlow) -> Moved | None:
        """Motion in space of a frame that could be followed, None if it lacks it; first of the rest frame."""
        ...

    def depth_mm(self) -> Map | None:
        """(h, w) along the view in the frame last followed, NaN where it is not known; None: nowhere."""
        ...


class Pace(Protocol):
    """When the frames of a stream arrive."""

    def start(self, time_s: float) -> None:
        """The rest frame, of that time on the film's clock, has been worked on."""
        ...

    def is_due(self, index: int, time_s: float) -> bool:
        """Whether a frame is worked on: waits until it arrives."""
        ...

    def spare_s(self, time_s: float) -> float:
        """How long it is to a frame's arrival [s]."""
        ...


@dataclass(frozen=True)
class _Steadied(Picture):
    """A frame shrunk, as a camera at rest would have taken it."""

    camera: Similarity | None = None


class VideoFlow:
    """Follows one film, once; what it finds out on the way stands in its attributes."""

    def __init__(
        self,
        footage: Footage,
        settings: RecordingFlowSettings,
        flow: LocalFlow | None = None,
        pulse: PulseSearch | None = None,
        second: SecondView | None = None,
        pace: Pace | None = None,
        watch: Stopwatch | None = None,
    ) -> None:
        """Nothing is decoded yet.

        Args:
            footage: what is followed.
            settings: how.
            flow: where flow is computed, closed by the caller; None: in this process.
            pulse: what a first pass found, and the camera's motion; taken off every frame.
            second: what shows motion in space, if there is something.
            pace: of a stream; None: every frame has its turn. Flow runs once before its start, for loading is
                no latency.
            watch: what the time spent is added to; None: one of its own.

        Raises:
            UserError: no such masks.
        """
        if settings.masks not in MASKS:
            raise UserError(f"masks: no kind {settings.masks!r}; there are {', '.join(MASKS)}")
        self.footage, self.settings, self.watch = footage, settings, watch or Stopwatch()
        self.pulse, self.second, self.summary = pulse, second, TrackingSummary()
        self.removed = None if pulse is None else pulse.pulse
        """What is taken off the motion of every frame."""
        self.tissue = np.zeros((0, 0), bool)
        """(h, w), shrunk as the pictures are; empty before the rest frame."""
        self.shrink, self.size = settings.shrink, (0, 0)
        """How many times smaller than `size`, height and width of the film's own pictures, these are."""
        self.rest_s: float | None = None
        """Time of the rest frame, if it has one."""
        self.decoded = self.peak_bytes = 0
        """Frames, and memory of the flow's own process."""
        self.found: list[Finding] = []
        """What was found wrong on the way; see `findings`."""
        self.faults: VideoFaults | None = None
        """What its pictures suffer from; None before the rest frame."""
        self._flow, self._pace = flow or LocalFlow(), pace
        self._camera: CameraTracker | None = None  # from the rest frame on
        self._path = None if pulse is None else pulse.camera
        self._shared: SharedMotion | None = None  # of a stream whose tissue fills the picture
        self._course: Course = []  # the camera's, found on the tissue
        self._foreground: ForegroundSearch | None = None  # not of a stream
        self._surface: SurfaceMotion | None = None  # only where a pulse is to be found
        self._depth_weights: list[float] = []
        self._period_s = 0.0 if settings.rate_hz is None else 1 / settings.rate_hz
        self._due_s = self._last_s = -math.inf
        self._left_out: Counter[str] = Counter()
        self._fault, self._rest_rgb, self._changes = "", np.zeros((0, 0, 3), np.uint8), False

    def frames(self, progress: Callable[[int], None] = lambda done: None) -> Iterator[FrameMotion]:
        """The frames that are followed, the rest frame first, holding a few at a time.

        With flow elsewhere, the caller has its turn while the flow of the next frame is on its way.

        Args:
            progress: told after every decoded frame how many there were.

        Raises:
            UserError: unreadable film, no tissue, masks or frames of another size, no such estimator.
        """
        try:
            yield from self._frames(progress)
        except BrokenExecutor:
            raise UserError("the process that computes the flow ended; out of memory?") from None

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
                self.faults.see(picture.index, picture.time_s, picture.rgb)
            while waiting and self._is_there(waiting[0][2], picture.time_s):
                yield self._finish(*waiting.popleft())
            if self._is_wanted(picture.index, picture.time_s):
                is_rest = self.tissue.size == 0
                if is_rest:
                    self._measure(picture)
                small, proposal, masking_s = self._prepare(picture)
                if is_rest:
                    yield self._begin(small, proposal, masking_s)
                    if self._pace is not None:
                        self._pace.start(picture.time_s or 0.0)
                elif self._fault:
                    nothing = FrameMotion.none(self.tissue.shape, trusted=False)
                    self.summary.add(nothing, self.tissue)
                    yield self._in_space(self._pictured(nothing, small, masking_s))
                else:
                    waiting.append((small, masking_s, self._flow.submit(small.rgb, proposal)))
                if len(waiting) > self._flow.ahead:
                    yield self._finish(*waiting.popleft())
            progress(self.decoded)
        for one in waiting:
            yield self._finish(*one)

    def find_pulse(self, free_s: Sequence[Span] = ()) -> PulseSearch | None:
        """The tissue's own motion, and the camera's where tissue fills the picture; all frames are through.

        None where there is neither, or it is off.

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
        """What is wrong with this film, once it is through."""
        fault = ""
        if self._fault:
            fault = f"the rest frame is {self._fault}"
        elif self.summary.frames and not self._changes:
            fault = "the picture never changes"
        between = [] if self._foreground is None else self._foreground.findings
        moved = [] if self._camera is None else self._camera.describe(self.shrink)
        faults = [] if self.faults is None or fault else self.faults.findings()
        course = self._course or ([] if self._shared is None else self._shared.course)
        if course:
            how = "found on tissue alone, of which a contact or a pulse may move all that shows"
            moved.append(f"{describe_course(course, self.shrink)}; {how}")
        bad = [Finding("bad", "pictures", fault)] if fault else []
        return [*bad, *self.found, *between, *faults, *(Finding("odd", "camera", one) for one in moved)]

    @property
    def fault(self) -> str:
        """Why nothing of this film is a measurement, once it is through; empty if something may be."""
        return first_fault(self.findings)

    @property
    def notes(self) -> list[str]:
        """What was done to the film that its user should know; complete when all frames are through, and
        the pulse looked for."""
        missed = "" if self.pulse is None or self.fault else self.pulse.describe()
        shrunk = [f"flow is computed on pictures {self.shrink} times smaller"] if self.shrink > 1 else []
        left_out = [f"{n} of {self.decoded} frames {why} left out" for why, n in self._left_out.items()]
        return shrunk + left_out + ([missed] if missed else [])

    def _is_wanted(self, index: int, time_s: float | None) -> bool:
        """Whether a frame is looked at; what isn't is counted."""
        if index < self.footage.rest_frame:
            reason = "before the rest frame"
        elif time_s is None:
            reason = "without a time"
        elif self.footage.only is not None and index not in self.footage.only:
            reason = "not looked at"
        elif time_s <= self._last_s:
            reason = "whose time stands still or runs back"
        # A fifth of the period early is in time.
        elif time_s < self._due_s - 0.2 * self._period_s:
            reason = f"beyond {self.settings.rate_hz:g} a second"
        else:
            first = self._due_s == -math.inf
            due_s = time_s if first else max(self._due_s, time_s - 0.2 * self._period_s)
            self._due_s, self._last_s = due_s + self._period_s, time_s
            return self.tissue.size == 0 or self._pace is None or self._pace.is_due(index, time_s)
        self._left_out[reason] += 1
        return time_s is None and index == self.footage.rest_frame

    def _measure(self, rest: Picture) -> None:
        """Sizes and tissue, from the rest frame."""
        self.size = (rest.rgb.shape[0], rest.rgb.shape[1])
        self.shrink = self.settings.shrink or max(1, self.size[1] // LEAST_COLUMNS)
        tissue, bars = self.footage.tissue(self.size), find_bars(rest.rgb)
        if is_inside_out(tissue):
            self._odd("tissue", "tissue.png marks the picture's border and not its middle: is it inverted?")
        if (tissue & bars).any():
            share = f"{100 * bars.mean():.0f}% of the picture are black bars, not taken for tissue"
            self._odd("pictures", share)
        self.tissue = shrink_mask(tissue & ~bars, self.shrink, 127)
        if not self.tissue.any():
            raise UserError(f"{self.footage.name}: the picture of the tissue marks no tissue")
        self.faults = VideoFaults(rest.rgb, shrink_picture(rest.rgb, self.shrink), self.tissue)
        self.rest_s = rest.time_s
        if self.settings.pulse and self.pulse is None:
            self._surface = SurfaceMotion(self.tissue)

    def _prepare(self, picture: Picture) -> tuple[_Steadied, Proposal, float]:
        """A frame shrunk, its camera's motion undone, what of it may be no tissue, and the time [s]."""
        height, width = picture.rgb.shape[:2]
        if (height, width) != self.size:
            raise UserError(f"frame {picture.index}: {width} x {height}, the rest frame is another size")
        began = time.perf_counter()
        rgb, view = shrink_picture(picture.rgb, self.shrink), None
        if self.faults is not None and picture.time_s is not None:
            self.faults.look(picture.time_s, picture.rgb, rgb)
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

    def _odd(self, what: str, said: str) -> None:
        self.found.append(Finding("odd", what, said))

    def _mask(self, index: int, rgb: Rgb, view: Similarity | None) -> Proposal:
        """What of a frame is no tissue, or may be none."""
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
        return (
            Proposal(glare, tool, known)
            if kind == "auto"
            else Proposal(nothing, nothing, glare | tool | known)
        )

    def _begin(self, small: _Steadied, proposal: Proposal, masking_s: float) -> FrameMotion:
        """Starts the flow: nothing has moved."""
        self._fault, self._rest_rgb = find_fault(small.rgb, self.tissue), small.rgb
        frame = FrameMotion.none(self.tissue.shape, trusted=not self._fault)
        if not self._fault:
            self._flow.begin(self.settings.backend, small.rgb, proposal, self.tissue)
            self._camera = CameraTracker(small.rgb, self.tissue, proposal.either | proposal.known)
            # What all tissue shares may be its pulse, which is looked for first.
            if self._camera.is_blind and self._surface is None and self._path is None:
                self._shared = SharedMotion(self.tissue)
            if self._pace is not None:
                self._flow.submit(small.rgb, proposal).result()
            frame = replace(frame, confidence=(self.tissue & ~proposal.known).astype(np.float32))
            if self._pace is None:
                self._foreground = ForegroundSearch(self.tissue, self.shrink)
        return self._looked_at(self._in_space(self._pictured(replace(frame, is_rest=True), small, masking_s)))

    def _is_there(self, flow: Future[FrameMotion], time_s: float | None) -> bool:
        """Whether a flow is there, or will be before a frame of that time arrives, which is waited for."""
        try:
            flow.result(0.0 if self._pace is None else self._pace.spare_s(time_s or 0.0))
        except TimeoutError:
            return False
        return True

    def _finish(self, small: _Steadied, masking_s: float, flow: Future[FrameMotion]) -> FrameMotion:
        """The motion of a frame whose flow was submitted, in space too, and without the pulse."""
        frame = self._pictured(flow.result(), small, masking_s)
        if self._shared is not None and frame.trusted and small.time_s is not None:
            frame = self._without_camera(frame, small.time_s, self._shared)
        if frame.camera is not None:
            frame = replace(frame, confidence=add_deviation(frame.confidence, frame.camera.deviation_px))
        self._changes = self._changes or not np.array_equal(small.rgb, self._rest_rgb)
        if frame.trusted and find_fault(small.rgb, self.tissue):
            frame = replace(frame, trusted=False)
        self.watch.add("flow", frame.cpu_s, frame.wall_s)
        self.peak_bytes = max(self.peak_bytes, frame.peak_bytes)
        frame = self._in_space(frame)
        self.summary.add(frame, self.tissue)
        return self._without_pulse(self._looked_at(frame))

    def _without_camera(self, frame: FrameMotion, time_s: float, shared: SharedMotion) -> FrameMotion:
        """The same as a camera at rest had taken it, by what its tissue shares besides the pulse."""
        began, moved = time.process_time(), frame.flow
        if self.removed is not None:
            moved = moved - self.removed.at(time_s)[..., :2]
        view = shared.add(time_s, *in_cells(moved, frame.confidence * self.tissue))
        if view is not None:
            rgb = frame.rgb if self.second is None else view.undo(frame.rgb)
            frame = replace(frame, flow=view.steady(frame.flow), rgb=rgb, camera=view)
        self.watch.add("camera", time.process_time() - began, 0.0)
        return frame

    def _pictured(self, frame: FrameMotion, small: _Steadied, masking_s: float) -> FrameMotion:
        frame = replace(frame, index=small.index, time_s=small.time_s, rgb=small.rgb)
        return replace(frame, camera=small.camera, masking_s=masking_s)

    def _in_space(self, frame: FrameMotion) -> FrameMotion:
        """The same with what the second eye shows of it; nothing of a frame that was not followed."""
        if self.second is None:
            return frame
        with self.watch.stage("second eye"):
            moved = self.second.follow(frame, self) if frame.trusted else None
            if moved is None:
                return replace(frame, trusted=False, motion=Moved.nothing(self.tissue.shape))
            return replace(frame, motion=moved)

    def _looked_at(self, frame: FrameMotion) -> FrameMotion:
        """The same, which was searched for what is no tissue if it is one of the first, or each twelfth."""
        count = self.summary.frames
        if self._foreground is not None and (count <= _SEARCHED or count % _SEARCHED == 0):
            with self.watch.stage("mask"):
                depth = self.second.depth_mm() if self.second is not None and frame.trusted else None
                self._foreground.add(frame, depth)
        return frame

    def _without_pulse(self, frame: FrameMotion) -> FrameMotion:
        """The same with the pulse taken off; before it is known, the frame is one to find it in."""
        moved, time_s = frame.motion, frame.time_s
        assert time_s is not None
        px_mm = np.float32(1.0 if self.second is None else self.second.scale_mm_per_px * self.shrink)
        if self._surface is not None and frame.trusted:
            parts = [frame.flow]
            if moved is not None:
                # The flow itself is looked in, not x and y in space, which have the noise of depth in them.
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
    """An array (H, W[, C]) `shrink` times smaller; what doesn't fill a pixel is cut off."""
    if shrink == 1:
        return picture
    size = (max(1, picture.shape[1] // shrink), max(1, picture.shape[0] // shrink))
    # Cut to a multiple, so that a pixel of the small picture is exactly shrink x shrink of the large one.
    cut = picture[: size[1] * shrink, : size[0] * shrink]
    return np.asarray(cv2.resize(cut, size, interpolation=cv2.INTER_AREA), picture.dtype)


def shrink_mask(mask: Flags, shrink: int, above: int) -> Flags:
    """The same of a mask (H, W): True where more than `above` of 255 parts of a pixel are."""
    return np.asarray(shrink_picture(mask.astype(np.uint8) * 255, shrink) > above)
