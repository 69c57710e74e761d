"""`bench live`: a video as a stream: decode, mask, flow, force, frame by frame, and what each costs.

The stream is paced by the video's own clock: a frame that arrives while another is still worked on is
dropped, as it would be beside the table. Mask, tracker and model are those that score recordings.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.output import machine
from bench.output import write as results
from bench.recording.video import Picture, from_video
from bench.tracking.tracking import Method, Scene, smaller
from synth.errors import UserError
from synth.flow import mask
from synth.flow.track import Tracker

_FPS = 25.0  # where the video states no times


@dataclass(frozen=True)
class Frame:
    """One frame that was worked on."""

    index: int
    latency_s: float
    """From its arrival to its answer."""
    stages_s: dict[str, float]
    """mask, flow, force: time in each."""
    confidence: float
    """Mean over the tissue that is seen."""
    trusted: bool
    largest_px: float
    force_mn: float | None
    """Magnitude of the total force; None without a model."""


@dataclass
class Watched:
    """A stream's account."""

    frames: list[Frame] = field(default_factory=list)
    dropped: int = 0
    size: tuple[int, int] = (0, 0)
    """Height, width of what is worked on [px]."""

    def summary(self) -> dict[str, float | int]:
        """Latency percentiles [ms], mean time of each stage [ms], dropped and flagged frames."""
        latency = 1e3 * np.array([frame.latency_s for frame in self.frames])
        result: dict[str, float | int] = {"frames": len(self.frames), "dropped": self.dropped}
        result |= {"height": self.size[0], "width": self.size[1]}
        result |= {f"p{q}_ms": float(np.percentile(latency, q)) for q in (50, 95, 99)}
        for stage in self.frames[0].stages_s:
            result[f"{stage}_ms"] = 1e3 * float(np.mean([frame.stages_s[stage] for frame in self.frames]))
        result["untrusted"] = sum(not frame.trusted for frame in self.frames)
        return result


def watch(
    video: Path,
    *,
    backend: str = "tvl1",
    method: Method | None = None,
    scale_mm_per_px: float | None = None,
    young_kpa: float | None = None,
    shrink: int = 1,
    paced: bool = True,
    told: Callable[[Frame], None] = lambda frame: None,
) -> Watched:
    """Follows the video from its first frame on, which is taken as the rest frame.

    Args:
        video: any file that FFmpeg reads.
        backend: flow estimator.
        method: a model that makes force of flow; needs the scale.
        scale_mm_per_px: of the video's own pixels.
        young_kpa: of the tissue, if known.
        shrink: pictures are made this many times smaller first.
        paced: drop what arrives meanwhile; False: work on every frame.
        told: of every frame's answer.

    Raises:
        UserError: unreadable video, fewer than two frames, or a model without a scale.
    """
    if method is not None and scale_mm_per_px is None:
        raise UserError("a model needs --scale (mm a pixel): forces have no meaning without it")
    return run(
        (_smaller(picture, shrink) for picture in from_video(video)),
        backend=backend,
        method=method,
        scale_mm_per_px=(scale_mm_per_px or 1.0) * shrink,
        young_kpa=young_kpa,
        paced=paced,
        told=told,
        name=str(video),
    )


def run(
    pictures: Iterable[Picture],
    *,
    backend: str,
    method: Method | None,
    scale_mm_per_px: float,
    young_kpa: float | None,
    paced: bool,
    told: Callable[[Frame], None],
    name: str,
) -> Watched:
    """As `watch`, on pictures from anywhere."""
    account = Watched()
    tracker: Tracker | None = None
    begin = first_s = 0.0
    for picture in pictures:
        stamp = picture.index / _FPS if picture.time_s is None else picture.time_s
        if tracker is None:
            tissue = np.ones(picture.rgb.shape[:2], bool)
            account.size = picture.rgb.shape[:2]
            tracker = Tracker(backend, picture.rgb, mask.blocked(picture.rgb), tissue)
            scene = Scene(tissue, scale_mm_per_px, young_kpa)
            # The clock starts when the first flow is warm: loading isn't latency.
            tracker.step(picture.rgb, mask.blocked(picture.rgb))
            begin, first_s = time.perf_counter(), stamp
            continue
        arrival = begin + stamp - first_s
        if paced and arrival < time.perf_counter() - _interval(stamp, first_s, picture.index):
            account.dropped += 1
            continue
        if paced:
            time.sleep(max(0.0, arrival - time.perf_counter()))
        frame = _work(picture, tracker, scene, method, arrival if paced else time.perf_counter())
        account.frames.append(frame)
        told(frame)
    if not account.frames:
        raise UserError(f"{name}: fewer than two frames")
    return account


def write(out: Path, summary: dict[str, float | int], **how: str | int | bool) -> None:
    """`live.json`: the summary, how the stream was run, and the machine."""
    out.mkdir(parents=True, exist_ok=True)
    record = {"command": "bench live", **how, "machine": machine.describe(), **summary}
    results.keep(out, "live.json", record)


def _interval(stamp: float, first_s: float, index: int) -> float:
    """Time between frames [s]: a frame older than that has a successor already."""
    return (stamp - first_s) / index if index > 0 and stamp > first_s else 1 / _FPS


def _work(picture: Picture, tracker: Tracker, scene: Scene, method: Method | None, arrival: float) -> Frame:
    start = time.perf_counter()
    blocked = mask.blocked(picture.rgb)
    masked = time.perf_counter()
    flow, confidence = tracker.step(picture.rgb, blocked)
    flowed = time.perf_counter()
    force = None
    if method is not None:
        force = method(flow, confidence, scene, False).size_mn
    end = time.perf_counter()
    seen: NDArray[np.bool_] = confidence > 0
    return Frame(
        index=picture.index,
        latency_s=end - arrival,
        stages_s={"mask": masked - start, "flow": flowed - masked, "force": end - flowed},
        confidence=float(confidence[seen].mean()) if seen.any() else 0.0,
        trusted=tracker.trusted,
        largest_px=float(np.hypot(flow[..., 0], flow[..., 1])[seen].max()) if seen.any() else 0.0,
        force_mn=force,
    )


def _smaller(picture: Picture, shrink: int) -> Picture:
    return Picture(picture.index, picture.time_s, smaller(picture.rgb, shrink))
