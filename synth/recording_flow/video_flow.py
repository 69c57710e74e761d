"""Video to displacement: decode, shrink, mask, track.

The one loop of `learn predict`, `bench score` and `bench live`. Displacement is that of the tissue from the
rest frame, on the rest frame's pixels.
"""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from synth.errors import UserError
from synth.flow import mask
from synth.flow.mask_choice import ChoosingTracker, Proposal
from synth.flow.track import Tracker
from synth.recording_flow.pulse import Pulse, Search, Span, Surface, carried_over, find_pulse
from synth.recording_flow.quality import find_fault
from synth.system.stopwatch import Stopwatch
from synth.video.mask_files import MASKS
from synth.video.read import Picture

Rgb = NDArray[np.uint8]
Flags = NDArray[np.bool_]
Size = tuple[int, int]
"""Height, width [px]."""

WIDTH_KEPT = 320
"""Columns that `shrink` 0 leaves a picture at least: the networks' grids are no finer."""


_MUCH = 0.2
"""Share of the tissue masked, or of the frames lost, that is worth a look."""


@dataclass(frozen=True)
class Settings:
    """How a video is followed."""

    backend: str = "tvl1"
    """Flow estimator."""
    shrink: int = 0
    """Flow is computed on pictures this many times smaller; 0: the most that leaves `WIDTH_KEPT` columns."""
    rate_hz: float | None = 10.0
    """At most so many frames a second are looked at; None: all."""
    pulse: bool = True
    """Whether the tissue's own periodic motion is looked for, and taken off."""
    masks: str = "auto"
    """What of tools and highlights is masked, one of `MASKS`."""


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


@dataclass(frozen=True, eq=False)
class Found:
    """The flow of one frame."""

    flow: NDArray[np.float32]
    """(h, w, 2) px from the rest frame."""
    confidence: NDArray[np.float32]
    """(h, w) in 0..1."""
    trusted: bool = True
    """Whether the frame could be followed."""
    lost: str = ""
    """Why not; empty if it could."""
    regained: bool = False
    """It could, but only from nothing or with other masks."""
    is_rest: bool = False
    """It is the rest frame itself."""
    blocked: Flags | None = None
    """(h, w) what was masked in the picture; None: nothing."""
    rest_blocked: Flags | None = None
    """(h, w) what was masked in the rest frame for it; None: nothing."""
    cpu_s: float = 0.0
    wall_s: float = 0.0
    peak_bytes: int = 0
    """Memory of the process that computed it, if it was another."""


@dataclass(eq=False)
class Account:
    """What masks and trust came to over a video, without its rest frame."""

    frames: int = 0
    lost: int = 0
    regained: int = 0
    masked: float = 0.0
    """Sum over frames of the share of tissue that was masked."""
    where: NDArray[np.float32] | None = None
    """(h, w) in how many frames a pixel of the picture was masked."""
    rest_blocked: Flags | None = None
    """(h, w) what of the rest frame was masked at last."""

    def add(self, found: Found, tissue: Flags) -> None:
        """Counts a frame; the rest frame starts it anew."""
        if found.is_rest:
            self.frames, self.where = 0, np.zeros(tissue.shape, np.float32)
            return
        assert self.where is not None
        self.frames += 1
        self.lost += not found.trusted
        self.regained += found.regained
        self.rest_blocked = found.rest_blocked
        if found.blocked is not None:
            self.masked += np.count_nonzero(found.blocked & tissue) / np.count_nonzero(tissue)
            self.where += found.blocked

    @property
    def shares(self) -> dict[str, float]:
        """Shares of the tissue masked, and of the frames lost and regained."""
        n = max(self.frames, 1)
        return {"masked": self.masked / n, "lost": self.lost / n, "regained": self.regained / n}

    @property
    def is_odd(self) -> bool:
        """Whether somebody should look at it."""
        return self.shares["masked"] > _MUCH or self.shares["lost"] > _MUCH

    def describe(self) -> str:
        """A line for a person."""
        said = f"{100 * self.shares['masked']:.2g}% of the tissue is masked on average; "
        lost = f"{self.lost} of {self.frames} frames looked at could not be followed"
        return said + lost + (f", {self.regained} only at a second try" if self.regained else "")


@dataclass(frozen=True)
class Asked:
    """The flow of a frame that is on its way."""

    take: Callable[[], Found]
    """Waits for it; errors as `Tracker`."""
    is_there: Callable[[float], bool] = lambda within_s: True
    """Whether it is there, or will be within so many seconds, which it waits for."""

    def __call__(self) -> Found:
        return self.take()


class FlowHere:
    """Where flow is computed: in this process, at once."""

    ahead = 0
    """How many frames may be asked before the first is waited for."""

    def begin(self, backend: str, rest: Rgb, blocked: Flags | Proposal, tissue: Flags) -> None:
        """The rest frame; arguments and errors as `Tracker`, or, of a proposal, as `ChoosingTracker`."""
        self.tracker: Tracker | ChoosingTracker = (
            ChoosingTracker(backend, rest, blocked, tissue)
            if isinstance(blocked, Proposal)
            else Tracker(backend, rest, blocked, tissue)
        )

    def ask(self, rgb: Rgb, blocked: Flags | Proposal) -> Asked:
        """Gives a frame, (h, w, 3) and (h, w); what comes back waits for its flow, errors as `Tracker`."""
        cpu, wall, tracker = time.process_time(), time.perf_counter(), self.tracker
        if isinstance(tracker, ChoosingTracker):
            assert isinstance(blocked, Proposal)
            flow, confidence = tracker.step(rgb, blocked)
            masked, rest_masked, regained = tracker.blocked, tracker.rest_blocked, tracker.regained
        else:
            assert not isinstance(blocked, Proposal)
            resets = tracker.resets
            flow, confidence = tracker.step(rgb, blocked)
            masked, rest_masked = blocked, tracker.tissue & ~tracker.usable
            regained = tracker.trusted and tracker.resets > resets
        found = Found(
            flow,
            confidence,
            tracker.trusted,
            tracker.lost,
            regained,
            blocked=masked if masked.any() else None,
            rest_blocked=rest_masked if rest_masked.any() else None,
            cpu_s=time.process_time() - cpu,
            wall_s=time.perf_counter() - wall,
        )
        return Asked(lambda: found)


@dataclass(frozen=True, eq=False)
class Step:
    """One frame that was followed."""

    picture: Picture
    """(h, w, 3), as small as the flow was computed; only the rest frame may be without a time."""
    found: Found
    masking_s: float
    """Time that shrinking and masking took [s]."""


class VideoFlow:
    """Follows one video, once; what it learns on the way stands in its attributes."""

    def __init__(
        self,
        footage: Footage,
        settings: Settings,
        flow: FlowHere | None = None,
        is_due: Callable[[int, float], bool] = lambda index, time_s: True,
        pulse: Pulse | None = None,
        search: Search | None = None,
        watch: Stopwatch | None = None,
        spare_s: Callable[[float], float] = lambda time_s: 0.0,
    ) -> None:
        """Nothing is decoded yet.

        Args:
            footage: what is followed.
            settings: how.
            flow: where flow is computed, closed by the caller; None: here.
            is_due: whether a frame after the rest frame, at its time [s], is to be worked on.
            pulse: motion of the tissue's own that is taken off the flow of every frame.
            search: what came of looking for that, the first time through.
            watch: what the time spent is added to; None: one of its own.
            spare_s: how long it is to a frame's arrival [s]: answers that are there until then come first.

        Raises:
            UserError: no such masks.
        """
        if settings.masks not in MASKS:
            raise UserError(f"masks: no kind {settings.masks!r}; there are {', '.join(MASKS)}")
        self.footage, self.settings, self.watch = footage, settings, watch or Stopwatch()
        self.tissue = np.zeros((0, 0), bool)
        """(h, w), shrunk as the pictures are; empty before the rest frame."""
        self.shrink, self.size = settings.shrink, (0, 0)
        """How many times smaller than `size`, height and width of the video's own pictures, these are."""
        self.seen = self.peak_bytes = 0
        """Frames decoded, and memory of the flow's own process."""
        self.surface: Surface | None = None
        """How the tissue moved by and large; kept while `settings.pulse` asks for it and none is off."""
        self._flow, self._is_due, self._pulse = flow or FlowHere(), is_due, pulse
        self._spare_s = spare_s
        self._left_out: Counter[str] = Counter()
        self._period_s = 0.0 if settings.rate_hz is None else 1 / settings.rate_hz
        self._due_s = self._last_s = -math.inf
        self._rest_s: float | None = None
        self.search = search
        """What came of looking for a pulse; None before."""
        self._fault, self._rest_rgb = "", np.zeros((0, 0, 3), np.uint8)
        self._followed, self._still = 0, True

    @property
    def fault(self) -> str:
        """Why nothing of this video is a measurement, said once it is through; empty if something may be."""
        if self._fault:
            return f"the rest frame is {self._fault}"
        return "the picture never changes" if self._followed and self._still else ""

    @property
    def notes(self) -> list[str]:
        """What was done to the video that its user should know; complete when all frames are through, and
        the pulse looked for."""
        missed = "" if self.search is None or self.fault else self.search.describe()
        shrunk = [f"flow is computed on pictures {self.shrink} times smaller"] if self.shrink > 1 else []
        left_out = [f"{n} of {self.seen} frames {why} left out" for why, n in self._left_out.items()]
        return shrunk + left_out + ([missed] if missed else [])

    def steps(self, progress: Callable[[int], None] = lambda done: None) -> Iterator[Step]:
        """The frames that are followed, the rest frame first, holding a few at a time.

        With flow elsewhere, the caller has its turn while the flow of the next frame is on its way.

        Args:
            progress: told after every decoded frame how many there were.

        Raises:
            UserError: unreadable video, no tissue, masks or frames of another size, no such estimator.
        """
        pictures = iter(self.footage.pictures)
        under_way: deque[tuple[Picture, float, Asked]] = deque()
        while True:
            with self.watch.stage("decode"):
                picture = next(pictures, None)
            if picture is None:
                break
            self.seen += 1
            while under_way and under_way[0][2].is_there(self._spare_s(picture.time_s or 0.0)):
                yield self._step(*under_way.popleft())
            if self._is_wanted(picture.index, picture.time_s):
                resting = self.tissue.size == 0
                if resting:
                    self._see(picture)
                small, blocked, masking_s = self._prepare(picture)
                if resting:
                    found = self._rest(small.rgb, blocked)
                    yield Step(small, found, masking_s)
                elif self._fault:
                    yield Step(small, self._nothing(), masking_s)
                else:
                    under_way.append((small, masking_s, self._flow.ask(small.rgb, blocked)))
                if len(under_way) > self._flow.ahead:
                    yield self._step(*under_way.popleft())
            progress(self.seen)
        for waiting in under_way:
            yield self._step(*waiting)

    def find_pulse(self, free_s: Sequence[Span] = (), space: Surface | None = None) -> Pulse | None:
        """The flow's part of the tissue's own motion, once all steps are through; None where none is seen or
        was asked for.

        Args:
            free_s: spans without contact, if known [s].
            space: the same frames' motion in space, if there is a second eye: rhythms are looked for there.
        """
        if self.surface is None:
            return None
        with self.watch.stage("pulse"):
            looked, rest_s = self.surface if space is None else space, self.rest_s
            self.search = find_pulse(looked, rest_s, free_s)
            if self.search.pulse is None or space is None:
                return self.search.pulse
            return carried_over(self.search, self.surface, rest_s)

    @property
    def rest_s(self) -> float:
        """Time of the rest frame [s]; if it has none, of the first frame that could be followed."""
        if self._rest_s is not None:
            return self._rest_s
        return self.surface.time_s[0] if self.surface is not None and self.surface.time_s else 0.0

    def _is_wanted(self, index: int, time_s: float | None) -> bool:
        """Whether a frame is looked at; what isn't is counted."""
        if index < self.footage.rest_frame:
            reason = "before the rest frame"
        elif time_s is None:
            reason = "without a time"
        elif time_s <= self._last_s:
            reason = "whose time stands still or runs back"
        # A fifth of the period early is in time.
        elif time_s < self._due_s - 0.2 * self._period_s:
            reason = f"beyond {self.settings.rate_hz:g} a second"
        else:
            first = self._due_s == -math.inf
            due_s = time_s if first else max(self._due_s, time_s - 0.2 * self._period_s)
            self._due_s, self._last_s = due_s + self._period_s, time_s
            return self.tissue.size == 0 or self._is_due(index, time_s)
        self._left_out[reason] += 1
        return time_s is None and index == self.footage.rest_frame

    def _see(self, picture: Picture) -> None:
        """Sizes and tissue, from the rest frame."""
        self.size = (picture.rgb.shape[0], picture.rgb.shape[1])
        self.shrink = self.settings.shrink or max(1, self.size[1] // WIDTH_KEPT)
        self.tissue = shrink_mask(self.footage.tissue(self.size), self.shrink, 127)
        if not self.tissue.any():
            raise UserError(f"{self.footage.name}: the picture of the tissue marks no tissue")
        self._rest_s = picture.time_s
        if self.settings.pulse and self._pulse is None:
            self.surface = Surface(self.tissue)

    def _prepare(self, picture: Picture) -> tuple[Picture, Flags | Proposal, float]:
        """A frame shrunk, what of it is no tissue (h, w), and the time that took [s]."""
        height, width = picture.rgb.shape[:2]
        if (height, width) != self.size:
            raise UserError(f"frame {picture.index}: {width} x {height}, the rest frame is another size")
        began = time.perf_counter()
        with self.watch.stage("mask"):
            rgb = shrink_picture(picture.rgb, self.shrink)
            blocked = self._masks(picture.index, rgb)
        return replace(picture, rgb=rgb), blocked, time.perf_counter() - began

    def _masks(self, index: int, rgb: Rgb) -> Flags | Proposal:
        """What of a frame is no tissue, (h, w), or may be none."""
        kind, nothing = self.settings.masks, np.zeros(rgb.shape[:2], bool)
        glare = nothing if kind in ("none", "tool") else mask.glare(rgb)
        tool = known = nothing
        if kind not in ("none", "glare"):
            if self.footage.tool is None:
                tool = mask.tool(rgb)
            elif (given := self.footage.tool(index, self.size)) is not None:
                known = shrink_mask(given, self.shrink, 0)
        return Proposal(glare, tool, known) if kind == "auto" else glare | tool | known

    def _rest(self, rgb: Rgb, blocked: Flags | Proposal) -> Found:
        """Starts the flow: nothing has moved."""
        self._fault, self._rest_rgb = find_fault(rgb, self.tissue), rgb
        if self._fault:
            return replace(self._nothing(), is_rest=True)
        self._flow.begin(self.settings.backend, rgb, blocked, self.tissue)
        still = np.zeros((*self.tissue.shape, 2), np.float32)
        sure = blocked.known if isinstance(blocked, Proposal) else blocked
        return Found(still, (self.tissue & ~sure).astype(np.float32), is_rest=True)

    def _nothing(self) -> Found:
        """Of a frame in which nothing can be followed."""
        none = np.zeros(self.tissue.shape, np.float32)
        return Found(np.stack([none, none], axis=-1), none, trusted=False)

    def _step(self, small: Picture, masking_s: float, answer: Asked) -> Step:
        found = answer()
        self._followed += 1
        self._still = self._still and np.array_equal(small.rgb, self._rest_rgb)
        if found.trusted and find_fault(small.rgb, self.tissue):
            found = replace(found, trusted=False)
        self.watch.add("flow", found.cpu_s, found.wall_s)
        self.peak_bytes = max(self.peak_bytes, found.peak_bytes)
        if self._pulse is not None and small.time_s is not None:
            found = replace(found, flow=found.flow - self._pulse.at(small.time_s))
        elif self.surface is not None and small.time_s is not None and found.trusted:
            self.surface.add(small.time_s, found.flow, found.confidence)
        return Step(small, found, masking_s)


def shrink_picture(picture: Rgb, shrink: int) -> Rgb:
    """A picture `shrink` times smaller, (H, W[, C]) uint8; what doesn't fill a pixel is cut off."""
    if shrink == 1:
        return picture
    size = (max(1, picture.shape[1] // shrink), max(1, picture.shape[0] // shrink))
    # Cut to a multiple, so that a pixel of the small picture is exactly shrink x shrink of the large one.
    cut = picture[: size[1] * shrink, : size[0] * shrink]
    return np.asarray(cv2.resize(cut, size, interpolation=cv2.INTER_AREA), np.uint8)


def shrink_mask(mask: Flags, shrink: int, above: int) -> Flags:
    """The same of a mask (H, W): True where more than `above` of 255 parts of a pixel are."""
    return np.asarray(shrink_picture(mask.astype(np.uint8) * 255, shrink) > above)
