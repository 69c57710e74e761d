"""`bench live`: a camera or a video as a stream, masked and tracked frame by frame, with its latency."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from bench.methods.method_interface import Method, MethodContext
from bench.tracking.capture import Camera
from synth.errors import UserError
from synth.flow.estimator import name_motion
from synth.flow.recording.decode import Footage, RecordingFlowSettings
from synth.flow.recording.finding import Finding, problems
from synth.flow.recording.flow import LocalFlow
from synth.flow.recording.video_pass import Pace, VideoPass
from synth.video.pixel_scale import StatedScale, pixel_mm


@dataclass(frozen=True)
class LiveFrame:
    """Result of one processed frame."""

    index: int
    latency_s: float  # from arrival to result
    stages_s: dict[str, float]  # time for mask, flow and force
    confidence: float  # mean over the visible tissue
    trusted: bool
    largest_px: float  # largest motion of the visible tissue
    force_mn: float | None  # magnitude of the total force; None: no model, or a lost frame


@dataclass
class Stream:
    """Results of a stream."""

    frames: list[LiveFrame] = field(default_factory=list)
    dropped: int = 0  # frames that arrived while another was processed
    size: tuple[int, int] = (0, 0)  # height, width of the downsampled pictures [px]
    findings: tuple[Finding, ...] = ()

    def summary(self) -> dict[str, float | int]:
        """Latency percentiles [ms], mean time of each stage [ms], dropped and lost frames."""
        latency = 1e3 * np.array([frame.latency_s for frame in self.frames])
        result: dict[str, float | int] = {"frames": len(self.frames), "dropped": self.dropped}
        result |= {"height": self.size[0], "width": self.size[1]}
        result |= {f"p{q}_ms": float(np.percentile(latency, q)) for q in (50, 95, 99)}
        for stage in self.frames[0].stages_s:
            result[f"{stage}_ms"] = 1e3 * float(np.mean([frame.stages_s[stage] for frame in self.frames]))
        result["untrusted"] = sum(not frame.trusted for frame in self.frames)
        return result


def stream_video(
    footage: Footage,
    settings: RecordingFlowSettings,
    *,
    method: Method | None = None,
    scale_mm_per_px: StatedScale | None = None,
    young_kpa: float | None = None,
    paced: bool = True,
    report: Callable[[LiveFrame], None] = lambda frame: None,
    flow: LocalFlow | None = None,
    camera: Camera | None = None,
    seconds: float = math.inf,
) -> Stream:
    """Tracks a video or a camera as a stream; the first frame is the rest frame.

    `settings`: without a limit on the rate and search for pulsation. `scale_mm_per_px`: of the original
    pixels; "unknown": forces are correct up to a factor, for any E. `paced`: whether frames that arrive while
    another is processed are dropped. `report`: called with every frame. `flow`: as of `track_recording`.
    `camera`: that the footage is of: the stream ends after so many `seconds`, or on Ctrl-C.
    UserError for an unreadable video, fewer than two frames, or a method without a scale.
    """
    if method is not None and scale_mm_per_px is None:
        raise UserError("a model requires --scale (mm per pixel, or unknown): forces depend on it")
    pace = _VideoClock(paced) if camera is None else _CameraClock(camera)
    video = VideoPass(footage, settings, flow=flow, pace=pace)
    stream = Stream(size=(video.rest.tissue.shape[0], video.rest.tissue.shape[1]))
    mm_per_px = pixel_mm(scale_mm_per_px or 1.0, video.rest.size[1]) * video.rest.shrink
    young = None if scale_mm_per_px == "unknown" else young_kpa
    scene = MethodContext(video.rest.tissue, mm_per_px, young, recovered_by=name_motion(settings.backend))
    stops = () if camera is None else (KeyboardInterrupt,)
    with suppress(*stops):
        for motion in video.frames():
            if motion.is_rest:
                continue
            start_s, force = time.perf_counter(), None
            if method is not None and motion.trusted:
                force = method(motion, scene, False).size_mn
            end_s, visible = time.perf_counter(), motion.confidence > 0
            frame = LiveFrame(
                index=motion.index,
                latency_s=end_s - pace.arrivals_s.pop(motion.index),
                stages_s={"mask": motion.masking_s, "flow": motion.wall_s, "force": end_s - start_s},
                confidence=float(motion.confidence[visible].mean()) if visible.any() else 0.0,
                trusted=motion.trusted,
                largest_px=float(np.hypot(*motion.flow[visible].T).max()) if visible.any() else 0.0,
                force_mn=force,
            )
            stream.frames.append(frame)
            report(frame)
            if camera is not None and (motion.time_s or 0.0) - (video.rest.time_s or 0.0) >= seconds:
                break
    stream.dropped, stream.findings = pace.dropped, problems(video.findings)
    if not stream.frames:
        raise UserError(f"{footage.name}: fewer than two frames")
    return stream


class _CameraClock(Pace):
    """A `Pace`, which see, of a camera: its frames have arrived when they are asked for."""

    def __init__(self, camera: Camera) -> None:
        self._camera, self._last = camera, 0
        self.dropped = 0
        self.arrivals_s: dict[int, float] = {}

    def start(self, time_s: float) -> None:
        self._last_s = time.perf_counter()

    def is_due(self, index: int, time_s: float) -> bool:
        self.dropped += max(index - self._last - 1, 0) if self._last else 0
        self._last, self._last_s = index, time_s
        self.arrivals_s[index] = time_s
        return True

    def spare_s(self, time_s: float) -> float:
        return 0.0

    def wait_s(self) -> float:
        return max(0.0, self._last_s + self._camera.period_s - time.perf_counter())


class _VideoClock(Pace):
    """A `Pace`, which see, with the clock of the video."""

    def __init__(self, paced: bool) -> None:
        self.paced, self.dropped = paced, 0
        self.arrivals_s: dict[int, float] = {}  # of frames in process, by index

    def start(self, time_s: float) -> None:
        self.first_s, self.began_s = time_s, time.perf_counter()

    def is_due(self, index: int, time_s: float) -> bool:
        """Waits until a frame arrives; False if the next one has arrived already."""
        since, now = time_s - self.first_s, time.perf_counter()
        arrival_s = self.began_s + since if self.paced else now
        if arrival_s < now - since / index:
            self.dropped += 1
            return False
        self.arrivals_s[index] = arrival_s
        time.sleep(max(0.0, arrival_s - now))
        return True

    def spare_s(self, time_s: float) -> float:
        return max(0.0, self.began_s + time_s - self.first_s - time.perf_counter()) if self.paced else 0.0

    def wait_s(self) -> float:
        return 0.0
