"""The result of scoring one recording, and its `score.json`."""

from __future__ import annotations

import platform
from dataclasses import dataclass, field
from typing import Any

from bench.bootstrap import Interval
from bench.recording.recording_scale import PixelScale
from bench.scoring.skill import skill_of
from bench.sensor.clock_sync import Offset
from bench.sensor.rotation import SensorRotation
from bench.tracking.tracking import TrackedRecording
from learn.evaluation.statistics import as_plain
from synth.arrays import Floats, Mask
from synth.flow.recording.finding import Finding, first_fault
from synth.formats import SCORE
from synth.system import packages

_METHOD_KEYS = (
    "interval", "scores", "intervals", "calibrated", "worse_by_mn", "gain", "components", "events",
)  # fmt: skip
MOST_LOST = 0.2  # largest share of lost frames for scores: the remaining frames are the easy ones


@dataclass(frozen=True)
class Gain:
    """The factor between a length of flow and force."""

    mn_per_mm: float  # NaN if it can't be determined
    source: str
    """`press`: fitted on the separate press; `hindsight`: on the scored frames, the best gain possible.
    Without a sensor the name of the method whose curve it is fitted to."""


@dataclass(frozen=True)
class MethodScore:
    """One method on one recording."""

    force_mn: Floats  # (T, 3) camera axes [mN]
    size_mn: Floats  # (T,) magnitude [mN]
    scores: dict[str, float] = field(default_factory=dict)  # empty without a sensor
    components: dict[str, dict[str, float]] = field(default_factory=dict)
    """Agreement by camera axis, if the sensor's axes are the camera's."""
    events: list[dict[str, float]] = field(default_factory=list)
    intervals: dict[str, Interval] = field(default_factory=dict)  # 95%, by a block bootstrap over frames
    calibrated: dict[str, float] = field(default_factory=dict)
    """Scores after the gain found on the separate press, and that gain; empty without a press."""
    worse_by_mn: Interval | None = None
    """Interval of the main method's MAE minus this one's, paired; None for the main method."""
    gain: Gain | None = None  # of a length of flow; None for force estimators
    low_mn: Floats | None = None  # (T,) lower end of the prediction interval [mN]; None: no intervals
    high_mn: Floats | None = None  # (T,) upper end
    interval: dict[str, float] = field(default_factory=dict)
    """`level` (absent: not calibrated for this motion), mean `width_mn`, with sensor and E `coverage`."""


@dataclass(frozen=True)
class Result:
    """The result of scoring a recording."""

    recording: str
    main: str
    """Name of the method that the report is about."""
    time_s: Floats
    sensor_mn: Floats | None
    """(T,) magnitude at the frames' times [mN]."""
    sensor_axes_mn: Floats | None
    """(T, 3)."""
    methods: dict[str, MethodScore]
    scale: PixelScale
    relative_uncertainty: float
    """Relative standard deviation of every force from scale (force is proportional to its square) and E."""
    noise_floor_mn: float
    scored: Mask
    """(T,) whether the frame is scored: not in calibration spans."""
    lost: Mask
    """(T,) whether tracking was lost: no method has an estimate there."""
    sync: Offset | None
    """The search for the clocks' offset; None if there was none."""
    notes: tuple[str, ...]
    steps: tuple[str, ...]
    """Processing steps of the sensor."""
    settings: dict[str, Any]
    tracked: TrackedRecording
    turn: SensorRotation | None = None
    """The sensor's rotation found on `sensor.turn_s`; None without that span."""
    findings: tuple[Finding, ...] = ()
    """Errors, then warnings."""
    absolute: bool = True
    """Whether E is known, so that forces are in newtons and not those of tissue of 1 kPa."""
    environment: dict[str, str] = field(
        default_factory=lambda: {"system": f"{platform.system()} {platform.machine()}", **packages.versions()}
    )

    @property
    def fault(self) -> str:
        """Why the recording can't be measured; empty if it can."""
        return first_fault(self.findings)

    @property
    def refused(self) -> str:
        """Why the result has no numbers; empty if it has, or if it only lacks a sensor."""
        if self.fault:
            return f"Nothing can be measured: {self.fault}"
        if self.lost.any() and self.lost_share > MOST_LOST:
            return (
                f"{100 * self.lost_share:.0f}% of the frames to be scored were lost: no scores are reported"
            )
        left = self.left
        return "" if left is None or left > 1 else f"{left} frames are left to be scored (see the notes)"

    @property
    def left(self) -> int | None:
        """Number of frames that are scored; None without a sensor."""
        if self.sensor_mn is None:
            return None
        return int((self.scored & ~self.lost & (self.sensor_mn >= 0)).sum())

    @property
    def aligned(self) -> bool:
        """Whether the clocks' offset is as stated, or was found."""
        return self.sync is None or not self.sync.refused

    @property
    def lost_share(self) -> float:
        """Share of the frames to be scored that were lost."""
        return float(self.lost[self.scored].mean()) if self.scored.any() else 0.0


def as_json(result: Result) -> dict[str, Any]:
    """The result as JSON-ready values; undefined numbers are null."""
    done, methods = result.tracked, result.methods
    ends = {
        end: {name: getattr(method, end) for name, method in methods.items() if method.interval}
        for end in ("low_mn", "high_mn")
    }
    tree = {
        "format": "sulcus-score",
        "format_version": SCORE,
        "recording": result.recording,
        "findings": result.findings,
        "fault": result.fault,
        "main": result.main,
        "frames": len(result.time_s),
        "lost": {"frames": int(result.lost.sum()), "share": result.lost_share, "most": MOST_LOST},
        "scores": methods[result.main].scores,
        "methods": {
            name: {key: getattr(method, key) for key in _METHOD_KEYS if key != "interval" or method.interval}
            for name, method in methods.items()
        },
        "scale": result.scale,
        "relative_uncertainty": result.relative_uncertainty,
        "noise_floor_mn": result.noise_floor_mn,
        "skill": skill_of(result),
        "pulse": done.pulse,
        "right_camera": done.stereo,
        "aligned": result.aligned,
        "sync": result.sync,
        "turn": result.turn,
        "notes": result.notes,
        "sensor_steps": result.steps,
        "settings": result.settings,
        "environment": result.environment,
        "masks": {"kind": result.settings.get("masks"), "frames": done.summary.frames, **done.summary.shares},
        "timings": done.timings,
        "curve": {
            "frame": done.frame,
            "t_s": result.time_s,
            "scored": result.scored,
            "lost": result.lost,
            "sensor_mn": result.sensor_mn,
            "sensor_axes_mn": result.sensor_axes_mn,
            "confidence": done.confidence,
            "predicted_mn": {name: method.size_mn for name, method in methods.items()},
            "predicted_axes_mn": {name: method.force_mn for name, method in methods.items()},
            **{end: curves for end, curves in ends.items() if curves},
        },
    }
    plain: dict[str, Any] = as_plain(tree, digits=9)
    return plain
