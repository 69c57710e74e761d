"""One pass over a video, in stages: decode, register camera, mask, flow, stereo.

A stage takes a frame and returns it with its own part filled in. A stream is one pass, a recording one or, if
tissue fills the picture and the camera moves, two (`synth.flow.recording.video_track`).
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from typing import Protocol

import numpy as np

from synth.errors import UserError
from synth.flow.recording.camera_path import CameraPath
from synth.flow.recording.decode import Decoder, Footage, RecordingFlowSettings
from synth.flow.recording.detrend import GatherMotion
from synth.flow.recording.find_pulse import PulseSearch
from synth.flow.recording.finding import Finding
from synth.flow.recording.flow import LocalFlow, with_flow
from synth.flow.recording.foreground import ForegroundSearch
from synth.flow.recording.frame_motion import FrameMotion, TrackingSummary
from synth.flow.recording.harmonic_fit import Span
from synth.flow.recording.mask import MaskFrame
from synth.flow.recording.register_camera import RegisterCamera, RegisterOnTissue
from synth.flow.recording.stereo_motion import DepthCamera, RightCamera, RightVideo
from synth.system.stopwatch import Stopwatch
from synth.video.read_video import Picture

_SEARCHED = 12, 3  # the first frames, and then one in so many, are searched for foreground


class Pace(Protocol):
    """Times at which the frames of a stream arrive."""

    def start(self, time_s: float) -> None:
        """Starts the clock when the rest frame, at this time of the video, has been processed."""

    def is_due(self, index: int, time_s: float) -> bool:
        """Waits until a frame arrives and returns whether it is processed."""

    def spare_s(self, time_s: float) -> float:
        """Time until a frame arrives [s]."""

    def wait_s(self) -> float:
        """Time [s] for which results are waited for before the next picture is asked for: 0 of a file, which
        gives its pictures before they arrive."""


class Stage(Protocol):
    """One step from a frame's picture to its motion."""

    def process(self, frame: FrameMotion) -> FrameMotion:
        """The frame with this stage's part filled in."""


class VideoPass:
    """One pass over a video. What it found over the whole video is valid after the last frame."""

    def __init__(
        self,
        footage: Footage,
        settings: RecordingFlowSettings,
        path: CameraPath | None = None,
        *,
        flow: LocalFlow | None = None,
        pace: Pace | None = None,
        watch: Stopwatch | None = None,
        progress: Callable[[int], None] = lambda done: None,
    ) -> None:
        """Decodes the rest frame, with which all stages start.

        `path`: of the camera, found on the tissue in a first pass and removed from the pictures; `flow`:
        computes the flow and is closed by the caller, None: in this process; `pace`: of a stream, None: every
        frame is processed; `watch` collects the time spent; `progress` is called after every decoded picture
        with their number. UserError: unreadable video, no tissue, sizes that differ, no such estimator.
        """
        self.watch, self.summary = watch or Stopwatch(), TrackingSummary()
        self.decoder = Decoder(footage, settings, self.watch, progress)
        self.rest = rest = self.decoder.rest
        self.peak_bytes = 0  # memory of the flow process
        self._backend, self._flow, self._pace = settings.backend, flow or LocalFlow(), pace
        mask_sources = footage.tool, footage.expected, footage.lookalikes
        self._mask = MaskFrame(rest, settings.masks, *mask_sources)
        self._first = self._mask.process(replace(self.decoder.first, is_rest=True))
        self.summary.rest_masked = self._first.hidden if self._first.hidden.any() else None
        self._register = None if rest.fault else RegisterCamera(rest, self._first, path)
        self.stereo: RightCamera | DepthCamera | None = None
        if isinstance(footage.depth, RightVideo):
            self.stereo = RightCamera(footage.depth, rest, settings.masks, footage.name)
        elif footage.depth is not None:
            self.stereo = DepthCamera(footage.depth, rest)
        self._foreground: ForegroundSearch | None = None
        if pace is None and not rest.fault:
            stated, masks = bool(footage.tissue and not footage.findings), footage.tool is not None
            self._foreground = ForegroundSearch(rest.tissue, rest.shrink, is_stated=stated, has_masks=masks)
        self.mm_per_px = 1.0 if footage.depth is None else footage.depth.mm_per_px * rest.shrink
        is_searched, self._may_pulsate = settings.pulse and path is None, footage.may_pulsate
        self._gather = GatherMotion(rest, self.mm_per_px) if is_searched else None
        is_stream = not settings.pulse and path is None
        self._on_tissue = RegisterOnTissue(rest) if self._fills_picture and is_stream else None

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
                yield self._finish(self._receive_flow(*waiting.popleft()))
            if self._pace is not None and not self._pace.is_due(picture.index, time_s):
                continue
            if self._register is None:
                yield self._finish(self.decoder.process(picture))
                continue
            frame = self._prepare(picture, self._register)
            waiting.append((frame, self._flow.submit(frame.rgb, frame.hidden)))
            if len(waiting) > self._flow.ahead or self._is_done(waiting[0][1]):
                yield self._finish(self._receive_flow(*waiting.popleft()))
        for submission in waiting:
            yield self._finish(self._receive_flow(*submission))

    def _begin(self) -> FrameMotion:
        """Starts the flow; returns the rest frame, with confidence where it shows tissue."""
        first = self._first
        if self.rest.fault:
            return first
        self._flow.begin(self._backend, first.rgb, first.hidden, self.rest.tissue)
        if self._pace is not None:  # so that compilation does not add to the stream's latency
            self._flow.submit(first.rgb, first.hidden).result()
        return replace(first, confidence=(self.rest.tissue & ~first.hidden).astype(np.float32))

    def _prepare(self, picture: Picture, register: RegisterCamera) -> FrameMotion:
        """A frame after the stages before flow."""
        start_s = time.perf_counter()
        frame = self._process("camera", register, self.decoder.process(picture))
        frame = self._process("mask", self._mask, frame)
        return replace(frame, masking_s=time.perf_counter() - start_s)

    def _is_ready(self, flow: Future[FrameMotion], time_s: float) -> bool:
        """Waits for a flow until a frame of this time arrives; returns whether the flow is ready."""
        try:
            flow.result(0.0 if self._pace is None else self._pace.spare_s(time_s))
        except TimeoutError:
            return False
        return True

    def _is_done(self, flow: Future[FrameMotion]) -> bool:
        """Whether a flow is ready before the next picture of a stream is expected, until when it waits."""
        if self._pace is None or (wait_s := self._pace.wait_s()) <= 0:
            return False
        with suppress(TimeoutError):
            flow.result(wait_s)
            return True
        return False

    def _receive_flow(self, frame: FrameMotion, flow: Future[FrameMotion]) -> FrameMotion:
        tracked = with_flow(frame, flow.result())
        self.watch.add("flow", tracked.cpu_s, tracked.wall_s)
        self.peak_bytes = max(self.peak_bytes, tracked.peak_bytes)
        return tracked

    def _finish(self, frame: FrameMotion) -> FrameMotion:
        """A frame after the stages after flow."""
        frame = self._process("camera", self._on_tissue, frame)
        frame = self._process("stereo", self.stereo, frame)
        if not frame.is_rest:
            self.summary.add(frame, self.rest.tissue)
        self._search_foreground(frame)
        return self._process("pulse", self._gather, frame)

    def _process(self, name: str, stage: Stage | None, frame: FrameMotion) -> FrameMotion:
        if stage is None:
            return frame
        with self.watch.stage(name):
            return stage.process(frame)

    def _search_foreground(self, frame: FrameMotion) -> None:
        """Searches the first frames, and then each third, for foreground."""
        count = self.summary.frames
        if self._foreground is not None and (count <= _SEARCHED[0] or count % _SEARCHED[1] == 0):
            with self.watch.stage("mask"):
                depth = self.stereo.depth_mm() if self.stereo is not None and frame.trusted else None
                self._foreground.add(frame, depth)

    def search(self, free_s: Sequence[Span] = ()) -> PulseSearch | None:
        """Pulsation of the tissue, and the camera's motion if tissue fills the picture, after the last frame.

        `free_s`: spans known to be without contact [s]. None: the settings request no search, or this pass
        follows one.
        """
        if self._gather is None:
            return None
        with self.watch.stage("pulse"):
            return self._gather.search(free_s, self._fills_picture, self._may_pulsate)

    @property
    def findings(self) -> list[Finding]:
        """Findings on the video."""
        fault = ""
        if self.rest.fault:
            fault = f"the rest frame is {self.rest.fault}"
        elif self.summary.frames and not self.decoder.faults.changes:
            fault = "the picture never changes"
        faults = [Finding("error", "pictures", fault)] if fault else []
        pictures = [] if fault else self.decoder.faults.findings()
        foreground = [] if self._foreground is None else self._foreground.findings
        findings = [*faults, *self.rest.findings, *foreground, *pictures]
        sentences = [stage.describe() for stage in (self._register, self._on_tissue) if stage is not None]
        return findings + [Finding("warning", "camera", text) for text in chain(*sentences)]

    @property
    def notes(self) -> list[str]:
        """Sentences on the processing for reports, after the last frame."""
        shrink, decoder = self.rest.shrink, self.decoder
        shrunk = [f"pictures are downsampled {shrink} times for flow"] if shrink > 1 else []
        count = len(decoder.decoded)
        omissions = [f"left out: {n} of {count} frames {reason}" for reason, n in decoder.left_out.items()]
        return shrunk + omissions
