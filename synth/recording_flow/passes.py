"""Motion in a video, in stages: decode, register camera, mask, flow, stereo, detrend.

A stage takes a frame and returns it with its own part filled in. Heart and breath, and the motion of a camera
that sees tissue only, are known when the whole video has been tracked: a second pass subtracts them.

    for one in passes(footage, settings):  # one pass, or two: the last one counts
        for frame in one.frames():
            ...

`learn predict`, `bench score`, `bench check` and `bench live` all do this.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future
from dataclasses import replace
from itertools import chain
from typing import Protocol

import numpy as np

from synth.errors import UserError
from synth.flow.estimator import Flags
from synth.recording_flow.decode import Decoder, Footage, RecordingFlowSettings
from synth.recording_flow.detrend import Detrend, GatherMotion
from synth.recording_flow.finding import Finding, first_fault
from synth.recording_flow.flow import LocalFlow, with_flow
from synth.recording_flow.frame_motion import FrameMotion, TrackingSummary
from synth.recording_flow.harmonic_fit import Span
from synth.recording_flow.inspection import Inspection
from synth.recording_flow.mask import Mask
from synth.recording_flow.pulse import PulseEstimate, PulseSearch
from synth.recording_flow.register_camera import RegisterCamera, RegisterOnTissue
from synth.recording_flow.stereo import open_stereo
from synth.system.stopwatch import Stopwatch
from synth.video.read import Picture


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


class Stage(Protocol):
    """One step from a frame's picture to its motion."""

    def process(self, frame: FrameMotion) -> FrameMotion:
        """The frame with this stage's part filled in."""
        ...


def passes(
    footage: Footage,
    settings: RecordingFlowSettings,
    free_s: Sequence[Span] = (),
    *,
    flow: LocalFlow | None = None,
    watch: Stopwatch | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> Iterator[VideoPass]:
    """The passes over a video; a second one follows if the first found pulsation or camera motion in it.

    The caller takes all `frames` of a pass before the next one.

    Args:
        footage: the video.
        settings: of the tracking.
        free_s: spans known to be without contact [s].
        flow: computes the flow and is closed by the caller; None: in this process.
        watch: collects the time spent; None: a new one.
        progress: called after every decoded picture of a pass with their number.

    Raises:
        UserError: unreadable video, no tissue, masks or frames of another size, no such estimator.
    """
    flow, watch = flow or LocalFlow(), watch or Stopwatch()
    first = VideoPass(footage, settings, None, flow=flow, watch=watch, progress=progress)
    yield first
    found = first.search(free_s)
    if found is not None and (found.pulse or found.camera):
        yield VideoPass(footage, settings, found, flow=flow, watch=watch, progress=progress)


class VideoPass:
    """One pass over a video. What it found over the whole video is valid after the last frame."""

    def __init__(
        self,
        footage: Footage,
        settings: RecordingFlowSettings,
        known: PulseSearch | None = None,
        *,
        flow: LocalFlow | None = None,
        pace: Pace | None = None,
        watch: Stopwatch | None = None,
        progress: Callable[[int], None] = lambda done: None,
    ) -> None:
        """Decodes the rest frame and starts all stages with it.

        Args:
            footage: the video.
            settings: of the tracking.
            known: pulsation and camera motion from a first pass, removed from every frame.
            flow: computes the flow and is closed by the caller; None: in this process.
            pace: of a stream; None: every frame is processed. Flow runs once before the stream starts, so
                that compilation does not add to the latency.
            watch: collects the time spent; None: a new one.
            progress: called after every decoded picture with their number.

        Raises:
            UserError: as `passes`.
        """
        self.watch = watch or Stopwatch()
        self.decoder = Decoder(footage, settings, self.watch, progress)
        self.rest, self.known = self.decoder.rest, known
        self.peak_bytes = 0  # memory of the flow process
        self._backend, self._flow, self._pace = settings.backend, flow or LocalFlow(), pace
        rest, mm_per_px, source = self.rest, footage.mm_per_px * self.rest.shrink, footage.depth
        self._mask = Mask(rest, settings.masks, footage.tool)
        self._first = self._mask.process(replace(self.decoder.first, is_rest=True))
        path = None if known is None else known.camera
        self._register = None if rest.fault else RegisterCamera(rest, _masked(self._first), path)
        self.stereo = open_stereo(source, rest, settings.masks, footage.name) if source else None
        self._inspection = Inspection(rest, self.stereo, foreground=pace is None and not rest.fault)
        self._gather = GatherMotion(rest, mm_per_px) if settings.pulse and known is None else None
        self._on_tissue: RegisterOnTissue | None = None
        if self._fills_picture and self._gather is None and known is None:
            self._on_tissue = RegisterOnTissue(rest)
        pulse = None if known is None else known.pulse
        self._detrend = None if pulse is None else Detrend(pulse, mm_per_px)
        after: dict[str, Stage | None] = {
            "camera": self._on_tissue,
            "stereo": self.stereo,
            "mask": self._inspection,
            "pulse": self._detrend or self._gather,
        }
        self._after = {name: stage for name, stage in after.items() if stage is not None}

    @property
    def summary(self) -> TrackingSummary:
        """Masks and lost frames so far."""
        return self._inspection.summary

    @property
    def removed(self) -> PulseEstimate | None:
        """Pulsation that this pass subtracts from every frame; None: none."""
        return self._detrend.pulse if self._detrend else None

    @property
    def _fills_picture(self) -> bool:
        """Whether tissue fills the picture, so that no surroundings show the camera's motion."""
        return self._register is not None and self._register.is_blind

    def frames(self) -> Iterator[FrameMotion]:
        """Yields the motion of tracked frames, the rest frame first, with a few frames in memory.

        If flow runs in another process, it computes the next frame while the caller processes this one.
        """
        try:
            yield from self._frames()
        except BrokenExecutor:
            raise UserError("the flow process ended unexpectedly: is it out of memory?") from None

    def _frames(self) -> Iterator[FrameMotion]:
        yield self._finish(self._begin())
        if self._pace is not None:
            self._pace.start(self.rest.time_s or 0.0)
        waiting: deque[tuple[FrameMotion, Future[FrameMotion]]] = deque()
        for picture in self.decoder.frames():
            time_s = picture.time_s or 0.0
            while waiting and self._is_ready(waiting[0][1], time_s):
                yield self._finish(self._with_flow(*waiting.popleft()))
            if self._pace is not None and not self._pace.is_due(picture.index, time_s):
                continue
            if self._register is None:
                yield self._finish(self.decoder.process(picture))
                continue
            frame = self._prepare(picture, self._register)
            assert frame.proposal is not None
            waiting.append((frame, self._flow.submit(frame.rgb, frame.proposal)))
            if len(waiting) > self._flow.ahead:
                yield self._finish(self._with_flow(*waiting.popleft()))
        for one in waiting:
            yield self._finish(self._with_flow(*one))

    def _begin(self) -> FrameMotion:
        """Starts the flow; returns the rest frame, with confidence where it shows tissue."""
        first, proposal = self._first, self._first.proposal
        assert proposal is not None
        if self.rest.fault:
            return first
        self._flow.begin(self._backend, first.rgb, proposal, self.rest.tissue)
        if self._pace is not None:
            self._flow.submit(first.rgb, proposal).result()
        return replace(first, confidence=(self.rest.tissue & ~proposal.known).astype(np.float32))

    def _prepare(self, picture: Picture, register: RegisterCamera) -> FrameMotion:
        """A frame after the stages before flow."""
        began = time.perf_counter()
        frame = self.decoder.process(picture)
        with self.watch.stage("camera"):
            frame = register.process(frame)
        with self.watch.stage("mask"):
            frame = self._mask.process(frame)
        return replace(frame, masking_s=time.perf_counter() - began)

    def _is_ready(self, flow: Future[FrameMotion], time_s: float) -> bool:
        """Waits for a flow until a frame of this time arrives; returns whether the flow is ready."""
        try:
            flow.result(0.0 if self._pace is None else self._pace.spare_s(time_s))
        except TimeoutError:
            return False
        return True

    def _with_flow(self, frame: FrameMotion, flow: Future[FrameMotion]) -> FrameMotion:
        found = with_flow(frame, flow.result())
        self.watch.add("flow", found.cpu_s, found.wall_s)
        self.peak_bytes = max(self.peak_bytes, found.peak_bytes)
        return found

    def _finish(self, frame: FrameMotion) -> FrameMotion:
        """A frame after the stages after flow."""
        for name, stage in self._after.items():
            with self.watch.stage(name):
                frame = stage.process(frame)
        return frame

    def search(self, free_s: Sequence[Span] = ()) -> PulseSearch | None:
        """What a second pass is to remove, searched after the last frame; None: this pass did not gather it.

        `free_s`: spans known to be without contact [s].
        """
        if self._gather is not None:
            with self.watch.stage("pulse"):
                self.known = self._gather.search(free_s, self._fills_picture)
        return None if self._gather is None else self.known

    @property
    def findings(self) -> list[Finding]:
        """Findings on the video."""
        fault = ""
        if self.rest.fault:
            fault = f"the rest frame is {self.rest.fault}"
        elif self.summary.frames and not self.decoder.faults.changes:
            fault = "the picture never changes"
        bad = [Finding("error", "pictures", fault)] if fault else []
        pictures = [] if fault else self.decoder.faults.findings()
        found = [*bad, *self.rest.findings, *self._inspection.findings, *pictures]
        moved = [one.describe() for one in (self._register, self._on_tissue) if one is not None]
        return found + [Finding("warning", "camera", text) for text in chain(*moved)]

    @property
    def notes(self) -> list[str]:
        """Sentences on the processing for reports, after the search for pulsation."""
        shrink, decoder = self.rest.shrink, self.decoder
        shrunk = [f"pictures are downsampled {shrink} times for flow"] if shrink > 1 else []
        count = len(decoder.decoded)
        left = [f"left out: {n} of {count} frames {why}" for why, n in decoder.left_out.items()]
        missed = "" if self.known is None or first_fault(self.findings) else self.known.describe()
        return shrunk + left + ([missed] if missed else [])


def _masked(frame: FrameMotion) -> Flags:
    """(h, w) what is or may be masked in a frame."""
    assert frame.proposal is not None
    return frame.proposal.either | frame.proposal.known
