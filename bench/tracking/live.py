"""`bench live`: a video as a stream: decode, mask, flow, force, frame by frame, and what each costs.

The stream is paced by the video's own clock: a frame that arrives while another is still worked on is
dropped, as it would be beside the table. Mask, tracker and model are those that score recordings.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.methods.protocol import Method, Scene
from synth.errors import UserError
from synth.flow.mask_choice import Proposal
from synth.recording_flow.video_flow import Asked, Flags, FlowHere, Footage, Rgb, Settings, Step, VideoFlow
from synth.system.checked_file import write_whole
from synth.system.packages import machine
from synth.video.pixel_scale import StatedScale, take_scale


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
    """Magnitude of the total force; None without a model, and of a frame that could not be followed."""


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


def watch_video(
    footage: Footage,
    *,
    backend: str = "tvl1",
    method: Method | None = None,
    scale_mm_per_px: StatedScale | None = None,
    young_kpa: float | None = None,
    shrink: int = 1,
    masks: str = "auto",
    paced: bool = True,
    told: Callable[[Frame], None] = lambda frame: None,
    flow: FlowHere | None = None,
) -> Watched:
    """Follows the video from its first frame on, which is taken as the rest frame.

    Args:
        footage: the video.
        backend: flow estimator.
        method: a model that makes force of flow; needs the scale.
        scale_mm_per_px: of the video's own pixels; unknown: forces are right up to a factor, whatever E is.
        young_kpa: of the tissue, if known.
        shrink: pictures are made this many times smaller first.
        masks: as of `Settings`.
        paced: drop what arrives meanwhile; False: work on every frame.
        told: of every frame's answer.
        flow: where it is computed, closed by the caller; None: here. In another process a frame's flow runs
            while the next is masked and the one before is asked for its force.

    Raises:
        UserError: unreadable video, fewer than two frames, or a model without a scale.
    """
    if method is not None and scale_mm_per_px is None:
        raise UserError("a model needs --scale (mm a pixel, or unknown): forces have no meaning without it")
    account, pace = Watched(), _Pace(paced)
    settings = Settings(backend, shrink, rate_hz=None, pulse=False, masks=masks)
    video = VideoFlow(footage, settings, _Warm(flow or FlowHere()), pace.is_due, spare_s=pace.spare_s)
    scene: Scene | None = None
    for step in video.steps():
        if scene is None:
            account.size = video.tissue.shape
            mm_per_px = take_scale(scale_mm_per_px or 1.0, video.size[1]) * video.shrink
            scene = Scene(video.tissue, mm_per_px, None if scale_mm_per_px == "unknown" else young_kpa)
            pace.start(step)
            continue
        began, found, force = time.perf_counter(), step.found, None
        if method is not None and found.trusted:
            force = method(found.flow, found.confidence, scene, False).size_mn
        end = time.perf_counter()
        seen: NDArray[np.bool_] = found.confidence > 0
        frame = Frame(
            index=step.picture.index,
            latency_s=end - pace.arrivals_s.pop(step.picture.index),
            stages_s={"mask": step.masking_s, "flow": found.wall_s, "force": end - began},
            confidence=float(found.confidence[seen].mean()) if seen.any() else 0.0,
            trusted=found.trusted,
            largest_px=float(np.hypot(*found.flow[seen].T).max()) if seen.any() else 0.0,
            force_mn=force,
        )
        account.frames.append(frame)
        told(frame)
    account.dropped = pace.dropped
    if not account.frames:
        raise UserError(f"{footage.name}: fewer than two frames")
    return account


class _Warm(FlowHere):
    """Flow that has run once before the clock starts: loading isn't latency."""

    def __init__(self, flow: FlowHere) -> None:
        self._flow, self.ahead = flow, flow.ahead

    def begin(self, backend: str, rest: Rgb, blocked: Flags | Proposal, tissue: Flags) -> None:
        """See `FlowHere`."""
        self._flow.begin(backend, rest, blocked, tissue)
        self._flow.ask(rest, blocked).take()

    def ask(self, rgb: Rgb, blocked: Flags | Proposal) -> Asked:
        """See `FlowHere`."""
        return self._flow.ask(rgb, blocked)


class _Pace:
    """Lets frames arrive as the video's own clock has them."""

    def __init__(self, paced: bool) -> None:
        self.paced, self.dropped = paced, 0
        self.arrivals_s: dict[int, float] = {}
        """Of frames that are worked on, by index."""

    def start(self, rest: Step) -> None:
        """The clock starts with the rest frame."""
        self.first_s, self.began_s = rest.picture.time_s or 0.0, time.perf_counter()

    def is_due(self, index: int, time_s: float) -> bool:
        """Waits until a frame arrives; False if it has a successor already."""
        since, now = time_s - self.first_s, time.perf_counter()
        arrival_s = self.began_s + since if self.paced else now
        if arrival_s < now - since / index:
            self.dropped += 1
            return False
        self.arrivals_s[index] = arrival_s
        time.sleep(max(0.0, arrival_s - now))
        return True

    def spare_s(self, time_s: float) -> float:
        """How long it is to the arrival of a frame [s]."""
        if not self.paced:
            return 0.0
        return max(0.0, self.began_s + time_s - self.first_s - time.perf_counter())


def write_live(out: Path, summary: dict[str, float | int], **how: str | int | bool) -> None:
    """`live.json`: the summary, how the stream was run, and the machine."""
    out.mkdir(parents=True, exist_ok=True)
    record = {"command": "bench live", **how, "machine": machine(), **summary}
    write_whole(out / "live.json", json.dumps(record, indent=1) + "\n", durable=False)
