"""The 90% interval of physics' force, from what a video shows and states without the truth.

Half the width is P s(x) q. P is the video's largest estimate. s is the expected error over P, log-linear in
features x of a frame (`ErrorModel`): the size of the estimate, the spread of the posterior, in the frame and
over the video, which knows what is stated and what two cameras see, and how much the tissue moves. q are the
5% and 95% quantiles of the error over P s, which differ as force is rather missed than invented, weighted so
that each make and each of its recordings counts alike. `weights.interval_table` fits model and quantiles on
the same recordings, and states what they hold by cross-validation over makes (`reached`). A video whose
features lie beyond those of the table's recordings, or whose motion another estimator or version of it
recovered, has no interval.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from pydantic import ConfigDict, FiniteFloat, TypeAdapter

from bench.methods.force_mixture import ForceMixture
from bench.methods.method_interface import ForceEstimate, MethodContext
from learn.uncertainty.error_model import ErrorModel
from synth.arrays import Floats, Map
from synth.job.types import Positive

LEVEL = 0.9
TABLE = Path(__file__).with_suffix(".json")
NAMES = {
    "size": "size of the force",
    "spread": "spread of the posterior",
    "overall spread": "spread of the posterior over the video",
    "shape": "disagreement of force and mean flow",
    "motion": "amount of motion",
    "stated": "what is stated",
}
"""What each feature is, in words."""
OF_VIDEO = ("overall spread", "shape", "motion")
"""Features of a video, on which it depends whether the table holds for it."""
# Added before logarithms, so that small values aren't distinguished; of the largest force, and mm.
_SIZE, _SPREAD, _SHAPE, _MOTION_MM = 0.05, 0.02, 0.02, 0.005
_LARGEST = 0.98  # quantile over the frames that is the largest: without outliers
_BEYOND = 0.15  # share of a feature's range by which a video may lie outside it
NORMAL = 1.645  # 95% quantile of the normal distribution: half of the 90% interval


@dataclass(frozen=True, eq=False)
class VideoEstimates:
    """The forces of a video's T tracked frames, and what is known of them."""

    size_mn: Floats  # (T,) magnitude of the force
    spread_mn: Floats  # (T,) standard deviation of the posterior
    motion_mm: Floats  # (T,) mean length of the flow over the tissue
    cameras: int
    stated: float
    """Share of tissue, instruments, membrane and rest (or ex vivo) that the recording states, 0 to 1."""

    @property
    def largest_mn(self) -> float:
        """The largest force's magnitude."""
        return float(np.quantile(self.size_mn, _LARGEST))


@dataclass(frozen=True)
class CameraModel:
    """Error model and quantiles for recordings of one number of cameras."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    error: ErrorModel
    below: Positive  # factors of the expected error, to the lower end
    above: Positive  # and to the upper
    recordings: int
    scores: int  # recordings, each with more and with less stated


@dataclass(frozen=True)
class IntervalTable:
    """Calibration of the interval, as stored in the package."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    features: tuple[str, ...]
    by_cameras: dict[int, CameraModel]
    makes: dict[str, int]  # recordings of each make
    flow: str
    """Estimator and version of the motion that it is for, as of `name_motion`: that of its recordings, or a
    later one on which it was checked."""
    stating: dict[str, Positive]
    """Mean width of the intervals with what a recording may state over that without it."""
    reached: dict[str, dict[str, FiniteFloat]]
    """Counts, holds and widths by cross-validation: each make is calibrated without its recordings."""
    checked: dict[str, dict[str, FiniteFloat]] = field(default_factory=dict)
    """The same of recordings, rendered anew and with motion by `flow`, on which it was checked; empty: it was
    fitted on that motion."""

    def bound(self, video: VideoEstimates, gain: float) -> tuple[Floats, Floats]:
        """Lower and upper ends (T,) mN. `gain`: relative standard deviation of every force, from E."""
        model, size = self.by_cameras[video.cameras], video.size_mn
        half = video.largest_mn * model.error.predict(describe(video))
        common = NORMAL * gain * size
        low = size - np.hypot(model.below * half, common)
        return np.maximum(low, 0.0), size + np.hypot(model.above * half, common)

    def find_gaps(self, video: VideoEstimates) -> list[str]:
        """The features in which a video is beyond the table's recordings, in words; empty: none."""
        if video.cameras not in self.by_cameras:
            return [f"{video.cameras} cameras"]
        error, values = self.by_cameras[video.cameras].error, describe(video)[0]
        gaps = []
        for k, name in enumerate(self.features):
            spare = _BEYOND * (error.high[k] - error.low[k])
            if name in OF_VIDEO and not error.low[k] - spare <= values[k] <= error.high[k] + spare:
                gaps.append(f"{NAMES[name]} ({'low' if values[k] < error.low[k] else 'high'})")
        return gaps

    def find_reason(self, video: VideoEstimates, recovered_by: str) -> str:
        """Why a video's force has no interval; empty if it has one.

        `recovered_by`: estimator of the motion and its version, empty if not known.
        """
        if recovered_by != self.flow:
            estimator = recovered_by or "another"
            return f"no interval: it is calibrated for motion by {self.flow}, and this is by {estimator}"
        if gaps := self.find_gaps(video):
            return f"no interval: beyond the recordings that it is calibrated on in {' and '.join(gaps)}"
        return ""


@lru_cache(maxsize=1)
def read_table() -> IntervalTable:
    """The package's calibration."""
    return TypeAdapter(IntervalTable).validate_python(json.loads(TABLE.read_text("utf-8")))


def bound(
    estimates: Sequence[ForceEstimate], video: VideoEstimates, gain: float, recovered_by: str
) -> tuple[list[ForceEstimate], str]:
    """Physics' estimates of a video with the calibrated interval, or without one and why.

    `gain`, `recovered_by`: as of `IntervalTable.bound` and `find_reason`.
    """
    table = read_table()
    reason = table.find_reason(video, recovered_by)
    if any(np.isnan(estimate.low_mn) for estimate in estimates):
        reason = "no interval: the error of forces of this motion isn't bounded"
    if reason:
        return [replace(estimate, low_mn=math.nan, high_mn=math.nan) for estimate in estimates], reason
    ends = table.bound(video, gain)
    bounded = [
        replace(estimate, low_mn=float(low), high_mn=float(high))
        for estimate, low, high in zip(estimates, *ends, strict=True)
    ]
    return bounded, ""


def find_motion(flow: Map, scene: MethodContext) -> float:
    """Mean length [mm] of a frame's flow (H, W, 2) px over the tissue."""
    lengths = np.linalg.norm(flow[scene.tissue].astype(np.float64), axis=1)
    return float(lengths.mean()) * scene.scale_mm_per_px


def gather(
    estimates: Sequence[ForceEstimate], motion_mm: Floats, cameras: int, stated: float
) -> VideoEstimates:
    """What the interval is computed from; `motion_mm` (T,), `cameras`, `stated`: as of `VideoEstimates`."""
    sizes = np.array([estimate.size_mn for estimate in estimates])
    spread = np.array([find_spread(estimate.likely) if estimate.likely else np.nan for estimate in estimates])
    return VideoEstimates(sizes, spread, motion_mm, cameras, stated)


def describe(video: VideoEstimates) -> Floats:
    """Features (T, F) of a video's frames, in the order of `NAMES`."""
    size, largest_mn = video.size_mn, max(video.largest_mn, 1e-9)
    overall_mn = max(_rms(size), 1e-9)
    is_moving = np.ptp(video.motion_mm) > 0 and np.ptp(size) > 0
    r = float(np.corrcoef(video.motion_mm, size)[0, 1]) if is_moving else 0.0
    of_video = (
        np.log(_rms(video.spread_mn) / overall_mn + _SPREAD),
        np.log(1 + _SHAPE - r),
        np.log(float(np.quantile(video.motion_mm, _LARGEST)) + _MOTION_MM),
        video.stated,
    )
    columns = (
        np.log(size / largest_mn + _SIZE),
        np.log(video.spread_mn / largest_mn + _SPREAD),
        *(np.full(len(size), value) for value in of_video),
    )
    return np.stack(columns, axis=1)


def find_spread(mixture: ForceMixture) -> float:
    """Standard deviation of a distribution of force: root of the trace of its covariance."""
    deviation = mixture.force - mixture.mean
    within = np.trace(mixture.covariance, axis1=1, axis2=2)
    return float(np.sqrt(mixture.weight @ (within + np.square(deviation).sum(axis=1))))


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
