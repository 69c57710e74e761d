"""Video to displacement: decode, shrink, mask, track.

The one loop of `learn predict`, `bench score` and `bench live`. Displacement is that of the tissue from the
rest frame, on the rest frame's pixels.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from learn.inference.video import Picture
from synth.errors import UserError
from synth.flow import mask
from synth.flow.track import Tracker
from synth.system.stopwatch import Stopwatch

Rgb = NDArray[np.uint8]
Flags = NDArray[np.bool_]
Size = tuple[int, int]
"""Height, width [px]."""

FPS = 25.0
"""Taken where a video states no times."""
WIDTH_KEPT = 320
"""Columns that `shrink` 0 leaves a picture at least: the networks' grids are no finer."""


@dataclass(frozen=True)
class Settings:
    """How a video is followed."""

    backend: str = "tvl1"
    """Flow estimator."""
    shrink: int = 0
    """Flow is computed on pictures this many times smaller; 0: the most that leaves `WIDTH_KEPT` columns."""
    rate_hz: float | None = 10.0
    """At most so many frames a second are looked at; None: all."""

    def shrink_of(self, width: int) -> int:
        """By how much pictures `width` columns wide are shrunk."""
        return self.shrink or max(1, width // WIDTH_KEPT)


def everywhere(size: Size) -> Flags:
    """(H, W) True: all of the picture is tissue."""
    return np.ones(size, bool)


@dataclass(frozen=True)
class Footage:
    """What is followed."""

    pictures: Callable[[], Iterator[Picture]]
    """Its frames in order, from the first on."""
    name: str
    """For messages."""
    tissue: Callable[[Size], Flags] = everywhere
    """(H, W) where there is tissue in the rest frame."""
    tool: Callable[[int, Size], Flags | None] | None = None
    """(H, W) where the tool is in a frame, None for nowhere; if not given it is found in the pictures."""
    fps: float | None = None
    """Frames a second where a frame has no time of its own; None: such frames are left out."""
    rest_frame: int = 0


@dataclass(frozen=True, eq=False)
class Found:
    """The flow of one frame."""

    flow: NDArray[np.float32]
    """(H, W, 2) px from the rest frame."""
    confidence: NDArray[np.float32]
    """(H, W) in 0..1."""
    trusted: bool
    """Whether the frame could be followed."""
    cpu_s: float = 0.0
    wall_s: float = 0.0
    peak_bytes: int = 0
    """Memory of the other process; 0 without one."""


class Flow(Protocol):
    """Where flow is computed: frames in order, each from the rest frame."""

    ahead: int
    """How many frames may be asked before the first is waited for."""

    def begin(self, backend: str, rest: Rgb, blocked: Flags, tissue: Flags) -> None:
        """The rest frame; arguments and errors as `Tracker`."""

    def ask(self, rgb: Rgb, blocked: Flags) -> Callable[[], Found]:
        """Gives a frame, (H, W, 3) and (H, W); what comes back waits for its flow, errors as `Tracker`."""
        ...


class FlowHere:
    """Flow in this process, at once."""

    ahead = 0

    def begin(self, backend: str, rest: Rgb, blocked: Flags, tissue: Flags) -> None:
        """See `Flow`."""
        self.tracker = Tracker(backend, rest, blocked, tissue)

    def ask(self, rgb: Rgb, blocked: Flags) -> Callable[[], Found]:
        """See `Flow`."""
        cpu, wall = time.process_time(), time.perf_counter()
        flow, confidence = self.tracker.step(rgb, blocked)
        spent = time.process_time() - cpu, time.perf_counter() - wall
        found = Found(flow, confidence, self.tracker.trusted, *spent)
        return lambda: found


@dataclass(frozen=True, eq=False)
class Step:
    """One frame that was followed."""

    index: int
    """Position among the decoded frames."""
    time_s: float | None
    """On the video's clock [s]; None only for a rest frame without a time."""
    rgb: Rgb
    """(h, w, 3), as small as the flow was computed."""
    found: Found
    masking_s: float
    """Time that shrinking and masking took [s]."""


class VideoFlow:
    """Follows one video, once; what it learns on the way stands in its attributes."""

    def __init__(
        self,
        footage: Footage,
        settings: Settings,
        flow: Flow | None = None,
        is_due: Callable[[Picture, float], bool] = lambda picture, time_s: True,
    ) -> None:
        """Nothing is decoded yet.

        Args:
            footage: what is followed.
            settings: how.
            flow: where flow is computed, closed by the caller; None: here.
            is_due: whether a frame after the rest frame, at its time [s], is to be worked on.
        """
        self.footage, self.settings, self.watch = footage, settings, Stopwatch()
        self.tissue: Flags | None = None
        """(h, w), shrunk as the pictures are; None before the rest frame."""
        self.shrink = settings.shrink
        self.size: Size = (0, 0)
        """Of the video's own pictures."""
        self.seen = 0
        """Frames decoded."""
        self.peak_bytes = 0
        self._flow, self._is_due = flow or FlowHere(), is_due
        self._left_out = {"before the rest frame": 0, "without a time": 0,
                          "whose time stands still or runs back": 0}  # fmt: skip
        rate_hz = settings.rate_hz
        self._period_s = 0.0 if rate_hz is None else 1 / rate_hz
        self._beyond = f"beyond {rate_hz or 0:g} a second"
        self._left_out[self._beyond] = 0
        self._due_s, self._last_s = -math.inf, -math.inf

    @property
    def notes(self) -> list[str]:
        """What was done to the video that its user should know; complete when all frames are through."""
        shrunk = [f"flow is computed on pictures {self.shrink} times smaller"] if self.shrink > 1 else []
        left_out = self._left_out.items()
        return shrunk + [f"{n} of {self.seen} frames {kind} left out" for kind, n in left_out if n]

    def steps(self, progress: Callable[[int], None] = lambda done: None) -> Iterator[Step]:
        """The frames that are followed, the rest frame first, holding a few at a time.

        With flow elsewhere, the caller has its turn while the flow of the next frame is on its way.

        Args:
            progress: told after every decoded frame how many there were.

        Raises:
            UserError: unreadable video, no tissue, masks or frames of another size, no such estimator.
        """
        pictures = self.footage.pictures()
        under_way: deque[tuple[Picture, float | None, Callable[[], Found], float]] = deque()
        while True:
            with self.watch.stage("decode"):
                picture = next(pictures, None)
            if picture is None:
                break
            self.seen += 1
            time_s = picture.time_s
            if time_s is None and self.footage.fps is not None:
                time_s = picture.index / self.footage.fps
            if not self._is_wanted(picture, time_s):
                pass
            elif self.tissue is None:
                yield self._start(picture, time_s)
            else:
                small, blocked, masking_s = self._prepare(picture)
                under_way.append((small, time_s, self._flow.ask(small.rgb, blocked), masking_s))
                if len(under_way) > self._flow.ahead:
                    yield self._answered(*under_way.popleft())
            progress(self.seen)
        for waiting in under_way:
            yield self._answered(*waiting)

    def tissue_of(self, size: Size) -> Flags:
        """(h, w) where tissue is followed in a video of that size, shrunk as the pictures are."""
        shrink = self.settings.shrink_of(size[1])
        tissue = shrink_picture(self.footage.tissue(size).astype(np.uint8) * 255, shrink) > 127
        if not tissue.any():
            raise UserError(f"{self.footage.name}: the picture of the tissue marks no tissue")
        return np.asarray(tissue)

    def _is_wanted(self, picture: Picture, time_s: float | None) -> bool:
        """Whether a frame is looked at; what isn't is counted."""
        reason = None
        if picture.index < self.footage.rest_frame:
            reason = "before the rest frame"
        elif time_s is None:
            reason = "without a time"
        elif time_s <= self._last_s:
            reason = "whose time stands still or runs back"
        # A fifth of the period early is in time.
        elif time_s < self._due_s - 0.2 * self._period_s:
            reason = self._beyond
        if reason is not None:
            self._left_out[reason] += 1
            return reason == "without a time" and picture.index == self.footage.rest_frame
        assert time_s is not None
        first = self._due_s == -math.inf
        self._due_s = (time_s if first else max(self._due_s, time_s - 0.2 * self._period_s)) + self._period_s
        self._last_s = time_s
        return self.tissue is None or self._is_due(picture, time_s)

    def _start(self, picture: Picture, time_s: float | None) -> Step:
        """The rest frame: nothing has moved."""
        self.size = (picture.rgb.shape[0], picture.rgb.shape[1])
        self.shrink = self.settings.shrink_of(self.size[1])
        tissue = self.tissue_of(self.size)
        small, blocked, masking_s = self._prepare(picture)
        self._flow.begin(self.settings.backend, small.rgb, blocked, tissue)
        self.tissue = tissue
        still = np.zeros((*tissue.shape, 2), np.float32)
        found = Found(still, (tissue & ~blocked).astype(np.float32), trusted=True)
        return Step(small.index, time_s, small.rgb, found, masking_s)

    def _prepare(self, picture: Picture) -> tuple[Picture, Flags, float]:
        """A frame shrunk, what of it is no tissue (h, w), and the time that took [s]."""
        height, width = picture.rgb.shape[:2]
        if (height, width) != self.size:
            raise UserError(f"frame {picture.index}: {width} x {height}, the rest frame is another size")
        began = time.perf_counter()
        with self.watch.stage("mask"):
            rgb = shrink_picture(picture.rgb, self.shrink)
            blocked = mask.glare(rgb)
            if self.footage.tool is None:
                blocked |= mask.tool(rgb)
            elif (tool := self.footage.tool(picture.index, self.size)) is not None:
                blocked |= shrink_picture(tool.astype(np.uint8) * 255, self.shrink) > 0
        return Picture(picture.index, picture.time_s, rgb), blocked, time.perf_counter() - began

    def _answered(
        self, small: Picture, time_s: float | None, answer: Callable[[], Found], masking_s: float
    ) -> Step:
        found = answer()
        self.watch.add("flow", found.cpu_s, found.wall_s)
        self.peak_bytes = max(self.peak_bytes, found.peak_bytes)
        return Step(small.index, time_s, small.rgb, found, masking_s)


def shrink_picture(picture: NDArray[np.uint8], shrink: int) -> NDArray[np.uint8]:
    """A picture or mask `shrink` times smaller, (H, W[, C]) uint8; what doesn't fill a pixel is cut off."""
    if shrink == 1:
        return picture
    size = (max(1, picture.shape[1] // shrink), max(1, picture.shape[0] // shrink))
    # Cut to a multiple, so that a pixel of the small picture is exactly shrink x shrink of the large one.
    cut = picture[: size[1] * shrink, : size[0] * shrink]
    return np.asarray(cv2.resize(cut, size, interpolation=cv2.INTER_AREA), np.uint8)
