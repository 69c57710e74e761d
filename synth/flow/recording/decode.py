"""The first stage of a video: its frames from the rest frame on, those to be tracked, downsampled."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from synth.arrays import Mask
from synth.errors import UserError, as_positive
from synth.flow.estimator import Estimator
from synth.flow.recording.finding import Finding
from synth.flow.recording.frame_motion import FrameMotion, RestFrame, Size
from synth.flow.recording.picture_faults import VideoFaults, find_bars, find_fault, is_inside_out
from synth.flow.recording.stereo_motion import DepthVideo, RightVideo
from synth.system.stopwatch import Stopwatch
from synth.video.mask_files import MASKS
from synth.video.read_video import Picture, shrink_mask, shrink_picture

DAMAGED = "damaged in the video's file"
LEAST_COLUMNS = 320  # least width with `shrink` 0: the grids of the networks are no finer
LIVE_COLUMNS = 160  # the same for streams: a network's grid has 64 to 128 cells


@dataclass(frozen=True)
class RecordingFlowSettings:
    """Settings for tracking a video."""

    backend: str | Estimator = "tvl1"
    """Flow estimator, or its name."""
    shrink: int = 0
    """Factor by which pictures are downsampled for flow; 0: the largest that leaves `least_columns`."""
    rate_hz: float | None = 10.0
    """Largest number of frames tracked per second; None: all."""
    pulse: bool = True
    """Whether pulsation of the tissue by heart and breath is estimated and removed."""
    masks: str = "auto"
    """Which instruments and highlights are masked, one of `MASKS`."""
    least_columns: int = LEAST_COLUMNS
    """Least width of the downsampled pictures with `shrink` 0 [px]."""

    def __post_init__(self) -> None:
        """Raises UserError for an invalid rate, factor of downsampling or kind of masks."""
        if self.rate_hz is not None:
            as_positive("rate_hz (None: every frame)", self.rate_hz)
        if self.shrink not in range(65):
            raise UserError(f"shrink {self.shrink}: a whole number from 0 to 64")
        if self.masks not in MASKS:
            raise UserError(f"masks: no kind {self.masks!r}; there are {', '.join(MASKS)}")


@dataclass(frozen=True)
class Footage:
    """A video to be tracked."""

    pictures: Callable[[], Iterable[Picture]]  # all frames in order, the same in every pass
    name: str  # for messages
    # (H, W) tissue mask of the rest frame; None: `track_video` finds it, one pass takes the whole picture.
    tissue: Callable[[Size], Mask] | None = None
    # (H, W) instrument mask of a frame, None: empty; if the function is None, instruments are detected.
    tool: Callable[[int, Size], Mask | None] | None = None
    rest_frame: int = 0
    only: Container[int] | None = None  # numbers of the frames to track, with the rest frame; None: all
    depth: RightVideo | DepthVideo | None = None  # right camera or depth camera, if any
    findings: tuple[Finding, ...] = ()  # on the tissue mask, if it was found
    may_pulsate: bool = True  # False: no heart or breath moves the tissue, none is searched
    # (H, W) where an instrument is expected in a frame, if instruments are detected; None: unknown.
    expected: Callable[[int, Size], Mask | None] | None = None
    # Any size: tissue in the rest frame that looks like an instrument; None: `track_video` looks for it.
    lookalikes: Mask | None = None


class Decoder:
    """Decodes a video once."""

    def __init__(
        self,
        footage: Footage,
        settings: RecordingFlowSettings,
        watch: Stopwatch,
        progress: Callable[[int], None],
    ) -> None:
        """Decodes the video up to its rest frame; arguments as for `VideoPass`.

        Raises UserError: unreadable video, no rest frame in it, or a tissue mask without tissue.
        """
        self._footage, self._watch, self._progress = footage, watch, progress
        self._rate_hz = settings.rate_hz
        self._period_s = 0.0 if settings.rate_hz is None else 1 / settings.rate_hz
        self._due_s = self._last_s = -math.inf  # of the next frame at the given rate; of the last one
        self.decoded: list[tuple[int, float | None]] = []  # number and time [s] of every picture so far
        self.left_out = Counter[str]()  # number of frames that are not tracked, by reason
        self._pictures = self._decode()
        rest = self._find_rest()
        self.rest = self._describe_rest(rest, settings.shrink, settings.least_columns)
        self.faults = VideoFaults(rest.rgb, self.rest.rgb, self.rest.tissue)
        self.first = self.process(rest)

    def frames(self) -> Iterator[Picture]:
        """Decodes the pictures after the rest frame and yields those to be tracked."""
        for picture in self._pictures:
            if picture.time_s is not None:
                self.faults.add_decoded(picture.index, picture.time_s, picture.rgb, picture.damaged)
            if reason := self._leave_out(picture):
                self.left_out[reason] += 1
            else:
                yield picture

    def process(self, picture: Picture) -> FrameMotion:
        """The downsampled frame, still without motion. UserError: its size is not the rest frame's."""
        height, width = picture.rgb.shape[:2]
        if (height, width) != self.rest.size:
            rest_size = f"{self.rest.size[1]} x {self.rest.size[0]}"
            raise UserError(
                f"frame {picture.index} is {width} x {height} px, but the rest frame is {rest_size}"
            )
        rgb = shrink_picture(picture.rgb, self.rest.shrink)
        if picture.time_s is not None:
            self.faults.add_tracked(picture.time_s, picture.rgb, rgb)
        size, trusted = self.rest.tissue.shape, not self.rest.fault
        no_motion = np.zeros((*size, 2), np.float32), np.zeros(size, np.float32)
        return FrameMotion(*no_motion, trusted, index=picture.index, time_s=picture.time_s, rgb=rgb)

    def _decode(self) -> Iterator[Picture]:
        pictures = iter(self._footage.pictures())
        while True:
            with self._watch.stage("decode"):
                picture = next(pictures, None)
            if picture is None:
                return
            self.decoded.append((picture.index, picture.time_s))
            yield picture
            self._progress(len(self.decoded))

    def _find_rest(self) -> Picture:
        """The first frame to be tracked; the stated rest frame may lack a time."""
        for picture in self._pictures:
            if not (reason := self._leave_out(picture)):
                return picture
            self.left_out[reason] += 1
            if picture.time_s is None and picture.index == self._footage.rest_frame:
                return picture
        if self.left_out[DAMAGED]:
            raise UserError(f"{self._footage.name}: every picture from the rest frame on is damaged")
        if self.left_out["without a time"]:
            raise UserError(f"{self._footage.name}: no frame from the rest frame on has a time")
        rest = self._footage.rest_frame
        raise UserError(f"{self._footage.name}: rest_frame {rest}, but {len(self.decoded)} frames")

    def _leave_out(self, picture: Picture) -> str:
        """Why a picture is not tracked; empty if it is, which sets when the next one is due."""
        time_s = picture.time_s
        if picture.index < self._footage.rest_frame:
            return "before the rest frame"
        if time_s is None:
            return "without a time"
        if picture.damaged:
            return DAMAGED
        if self._footage.only is not None and picture.index not in self._footage.only:
            return "outside the selection"
        if time_s <= self._last_s:
            return "whose time does not increase"
        # A frame may be early by a fifth of the period.
        early_s = 0.2 * self._period_s
        if time_s < self._due_s - early_s:
            return f"beyond {self._rate_hz:g} per second"
        due_s = time_s if self._due_s == -math.inf else max(self._due_s, time_s - early_s)
        self._due_s, self._last_s = due_s + self._period_s, time_s
        return ""

    def _describe_rest(self, picture: Picture, shrink: int, least_columns: int) -> RestFrame:
        size = (picture.rgb.shape[0], picture.rgb.shape[1])
        shrink = shrink or max(1, size[1] // least_columns)
        read_tissue, bars = self._footage.tissue, find_bars(picture.rgb)
        tissue = np.ones(size, bool) if read_tissue is None else read_tissue(size)
        findings = [*self._footage.findings]
        if read_tissue is not None and not findings and is_inside_out(tissue):
            inverted = "tissue.png marks the border of the picture but not its middle: is it inverted?"
            findings.append(Finding("warning", "tissue", inverted))
        if bars.any() and (self._footage.findings or (tissue & bars).any()):  # found tissue has none of them
            share = f"{100 * bars.mean():.0f}% of the picture are black bars, removed from the tissue mask"
            findings.append(Finding("warning", "pictures", share))
        tissue = shrink_mask(tissue & ~bars, shrink, 127)
        if not tissue.any():
            raise UserError(f"{self._footage.name}: the tissue mask marks no tissue")
        rgb = shrink_picture(picture.rgb, shrink)
        return RestFrame(rgb, tissue, size, shrink, picture.time_s, find_fault(rgb, tissue), tuple(findings))
