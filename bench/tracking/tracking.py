"""One pass over a recording: displacement from the rest frame, and every method's force from it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.recording.folder import Recording
from bench.recording.video import Picture
from bench.tracking.flow_process import Flow, Here
from synth.errors import UserError
from synth.flow import mask
from synth.system.stopwatch import Stopwatch

Progress = Callable[[int], None]
"""Told how many frames are done."""

WIDTH_KEPT = 320
"""Columns that `shrink` 0 leaves a picture at least: the networks' grids are no finer."""
_MOST_SNAPSHOTS = 64
_SNAPSHOT_WIDTH = 480


@dataclass(frozen=True)
class Scene:
    """What stays the same over a recording, on the pixels flow is computed on."""

    tissue: NDArray[np.bool_]
    """(H, W)."""
    scale_mm_per_px: float
    young_kpa: float | None


@dataclass(frozen=True)
class Answer:
    """What a method says of one frame."""

    force_mn: NDArray[np.float64]
    """(3,) force on the tissue in camera axes [mN]; a method of magnitudes only puts it into x, rest NaN."""
    density: NDArray[np.float32] | None = None
    """(H, W) size of the force density on the rest frame's pixels [kPa], for the pictures."""

    @property
    def size_mn(self) -> float:
        return float(np.sqrt(np.nansum(self.force_mn**2)))


class Method(Protocol):
    """Displacement to force, frame by frame."""

    def __call__(
        self, flow: NDArray[np.float32], confidence: NDArray[np.float32], scene: Scene, picture: bool
    ) -> Answer:
        """Force of one frame.

        Args:
            flow: (H, W, 2) px from the rest frame.
            confidence: (H, W) in 0..1.
            scene: the recording's constants.
            picture: whether `density` is wanted.
        """
        ...


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


@dataclass
class Followed:
    """Curves over the frames that have a time, from the rest frame on."""

    frame: list[int] = field(default_factory=list)
    """Frame numbers in the recording."""
    time_s: list[float] = field(default_factory=list)
    force_mn: dict[str, list[NDArray[np.float64]]] = field(default_factory=dict)
    """By method: (3,) each."""
    speed: list[float] = field(default_factory=list)
    """Mean speed of the tissue since the frame before [mm/s]; what is lined up with the sensor."""
    confidence: list[float] = field(default_factory=list)
    """Mean confidence of the flow over the tissue."""
    snapshots: list[Snapshot] = field(default_factory=list)
    rest: NDArray[np.uint8] | None = None
    tissue: NDArray[np.bool_] | None = None
    """(h, w), shrunk as the snapshots are."""
    size: tuple[int, int] = (0, 0)
    """Height, width of the recording [px]."""
    notes: list[str] = field(default_factory=list)
    timings: dict[str, dict[str, float] | float] = field(default_factory=dict)


@dataclass(frozen=True)
class Settings:
    """What decides a run of `bench score` besides the recording and the model."""

    backend: str = "tvl1"
    """Flow estimator."""
    shrink: int = 0
    """Flow is computed on pictures this many times smaller; 0: the most that leaves `WIDTH_KEPT` columns."""
    rate_hz: float | None = 10.0
    """At most so many frames a second are looked at; None: all."""


def follow(
    recording: Recording,
    methods: Mapping[str, Method],
    scale_mm_per_px: float,
    settings: Settings,
    *,
    pictured: str | None = None,
    flow: Flow | None = None,
    progress: Progress = lambda done: None,
) -> Followed:
    """Decodes, tracks and asks every method, holding a few frames at a time.

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
    walker = _Walker(recording, methods, scale_mm_per_px, settings, pictured, flow or Here())
    watch, out = walker.watch, walker.out
    frames = recording.frames()
    seen = 0
    while True:
        with watch.stage("decode"):
            picture = next(frames, None)
        if picture is None:
            break
        seen += 1
        walker.take(picture)
        progress(seen)
    walker.finish()
    if not out.time_s:
        if seen <= recording.meta.rest_frame:
            raise UserError(f"{recording.folder}: rest_frame {recording.meta.rest_frame}, but {seen} frames")
        raise UserError(f"{recording.folder}: no frame has a time; give frames.csv, or fps in meta.yaml")
    out.timings = watch.report()
    if walker.peak_bytes:
        out.timings["flow_peak_rss_mb"] = round(walker.peak_bytes / 1e6, 1)
    if not recording.masks:
        out.notes.append("no masks/: the tool is found in each picture")
    for kind, count in walker.left_out.items():
        if count:
            out.notes.append(f"{count} of {seen} frames {kind} left out")
    return out


class _Walker:
    def __init__(
        self,
        recording: Recording,
        methods: Mapping[str, Method],
        scale: float,
        settings: Settings,
        pictured: str | None,
        flow: Flow,
    ) -> None:
        self.recording, self.methods, self.pictured = recording, methods, pictured
        self.out, self.watch = Followed(force_mn={name: [] for name in methods}), Stopwatch()
        self.backend, self.shrink, self.scale = settings.backend, 0, scale
        rate_hz = settings.rate_hz
        if settings.shrink:
            self._shrink_by(settings.shrink)
        self.left_out = {
            "before the rest frame": 0,
            "without a time": 0,
            "whose time stands still or runs back": 0,
            f"beyond {rate_hz or 0:g} a second": 0,
        }
        self.period = 0.0 if rate_hz is None else 1 / rate_hz
        self.due = -math.inf
        self.flow = flow
        self.asked: tuple[int, float, NDArray[np.uint8]] | None = None
        self.time_s: float | None = None
        self.peak_bytes = 0
        self.scene: Scene | None = None
        self.last: NDArray[np.float32] | None = None
        self.stride = 1

    def take(self, picture: Picture) -> None:
        rest_at, fps = self.recording.meta.rest_frame, self.recording.meta.fps
        time = picture.time_s
        if time is None and fps is not None:
            time = picture.index / fps
        if picture.index < rest_at:
            self.left_out["before the rest frame"] += 1
            return
        if time is None:
            self.left_out["without a time"] += 1
            if picture.index != rest_at:
                return
        elif self.time_s is not None and time <= self.time_s:
            self.left_out["whose time stands still or runs back"] += 1
            return
        if time is not None and not self._is_due(time):
            self.left_out[f"beyond {1 / self.period:g} a second"] += 1
            return
        size = picture.rgb.shape[:2]
        if self.shrink == 0:
            self._shrink_by(max(1, size[1] // WIDTH_KEPT))
        tool = self.recording.tool(picture.index, size)
        rgb, blocked = self._prepare(picture.rgb, tool)
        if self.scene is None:
            still = self._start(rgb, blocked, size)
            if time is not None:
                self._record(picture.index, time, rgb, *still)
        elif size != self.out.size:
            raise UserError(f"frame {picture.index}: {size[1]} x {size[0]}, the rest frame is another size")
        else:
            assert time is not None  # only the rest frame may be without
            before, found = self.asked, self._answer()
            self.flow.ask(rgb, blocked)
            self.asked = (picture.index, time, rgb)
            # The methods' turn, while the flow of this frame is on its way.
            if before is not None and found is not None:
                self._record(*before, *found)
        self.time_s = time if time is not None else self.time_s

    def finish(self) -> None:
        """What the last frame is still owed."""
        found = self._answer()
        if self.asked is not None and found is not None:
            self._record(*self.asked, *found)

    def _answer(self) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
        """Flow and confidence of the frame under way; None if none is."""
        if self.asked is None:
            return None
        found = self.flow.answer()
        self.watch.add("flow", found.cpu_s, found.wall_s)
        self.peak_bytes = max(self.peak_bytes, found.peak_bytes)
        return found.flow, found.confidence

    def _shrink_by(self, shrink: int) -> None:
        self.shrink, self.scale = shrink, self.scale * shrink
        if shrink > 1:
            self.out.notes.append(f"flow is computed on pictures {shrink} times smaller")

    def _is_due(self, time: float) -> bool:
        """Whether a frame is to be looked at; a fifth of the period early is in time."""
        if time < self.due - 0.2 * self.period:
            return False
        self.due = (time if self.due == -math.inf else max(self.due, time - 0.2 * self.period)) + self.period
        return True

    def _prepare(
        self, rgb: NDArray[np.uint8], tool: NDArray[np.bool_] | None
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        with self.watch.stage("mask"):
            rgb = smaller(rgb, self.shrink)
            blocked = mask.glare(rgb)
            if tool is not None:
                blocked |= smaller(tool.astype(np.uint8) * 255, self.shrink) > 0
            elif not self.recording.masks:
                blocked |= mask.tool(rgb)
        return rgb, blocked

    def _start(
        self, rgb: NDArray[np.uint8], blocked: NDArray[np.bool_], size: tuple[int, int]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        whole = self.recording.tissue_mask(size)
        tissue = smaller(whole.astype(np.uint8) * 255, self.shrink) > 127
        if not tissue.any():
            raise UserError(f"{self.recording.tissue}: marks no tissue")
        self.flow.begin(self.backend, rgb, blocked, tissue)
        self.scene = Scene(tissue, self.scale, self.recording.meta.young_kpa)
        self.out.size = size
        self.out.rest, self.out.tissue = _shown(rgb), _shown(tissue.astype(np.uint8) * 255) > 127
        return np.zeros((*tissue.shape, 2), np.float32), (tissue & ~blocked).astype(np.float32)

    def _record(
        self,
        index: int,
        time: float,
        rgb: NDArray[np.uint8],
        flow: NDArray[np.float32],
        confidence: NDArray[np.float32],
    ) -> None:
        assert self.scene is not None
        position, out = len(out_time := self.out.time_s), self.out
        wanted = position % self.stride == 0
        density = None
        for name, method in self.methods.items():
            with self.watch.stage(name):
                answer = method(flow, confidence, self.scene, wanted and name == self.pictured)
            out.force_mn[name].append(answer.force_mn)
            if name == self.pictured:
                density = answer.density
        inside = self.scene.tissue
        out.confidence.append(float(confidence[inside].mean()))
        step = 0.0
        if self.last is not None and out_time:
            moved = np.linalg.norm(flow - self.last, axis=-1)[inside]
            step = float(moved.mean()) * self.scale / (time - out_time[-1])
        out.speed.append(step)
        self.last = flow
        out.frame.append(index)
        out_time.append(time)
        if wanted:
            self._keep(Snapshot(position, _shown(rgb), _shown_flow(flow), _shown_map(density)))

    def _keep(self, snapshot: Snapshot) -> None:
        """Keeps at most so many, evenly: when full, every other one goes and the stride doubles."""
        self.out.snapshots.append(snapshot)
        if len(self.out.snapshots) >= _MOST_SNAPSHOTS:
            self.out.snapshots = self.out.snapshots[::2]
            self.stride *= 2


def smaller(picture: NDArray[np.uint8], shrink: int) -> NDArray[np.uint8]:
    """A picture or mask `shrink` times smaller, (H, W[, C]) uint8; what doesn't fill a pixel is cut off."""
    if shrink == 1:
        return picture
    size = (max(1, picture.shape[1] // shrink), max(1, picture.shape[0] // shrink))
    # Cut to a multiple, so that a pixel of the small picture is exactly shrink x shrink of the large one.
    cut = picture[: size[1] * shrink, : size[0] * shrink]
    return np.asarray(cv2.resize(cut, size, interpolation=cv2.INTER_AREA), np.uint8)


def _ratio(width: int) -> float:
    return min(1.0, _SNAPSHOT_WIDTH / width)


def _resized(array: NDArray[np.generic]) -> NDArray[np.generic]:
    ratio = _ratio(array.shape[1])
    if ratio == 1.0:
        return array
    return np.asarray(cv2.resize(array, None, fx=ratio, fy=ratio, interpolation=cv2.INTER_AREA))


def _shown(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return _resized(rgb).astype(np.uint8)


def _shown_flow(flow: NDArray[np.float32]) -> NDArray[np.float32]:
    return (_ratio(flow.shape[1]) * _resized(flow).astype(np.float32)).astype(np.float32)


def _shown_map(density: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
    return None if density is None else _resized(density).astype(np.float32)
