"""A recording and methods in, a scored result out: what `bench score` does."""

from __future__ import annotations

import json
import math
import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench import score, sensor
from bench.follow import Followed, Method, Progress, follow
from bench.recording import Recording
from bench.scale import Scale
from synth import versions

Curve = NDArray[np.float64]


@dataclass(frozen=True)
class Settings:
    """What decides a run of `bench score` besides the recording and the model."""

    backend: str = "opencv-tvl1"
    """Flow estimator."""
    shrink: int = 1
    """Flow is computed on pictures this many times smaller."""


@dataclass(frozen=True)
class Scored:
    """One method on one recording."""

    force_mn: Curve
    """(T, 3) camera axes [mN]."""
    size_mn: Curve
    """(T,) magnitude [mN]."""
    scores: dict[str, float]
    """Empty without a sensor."""
    components: dict[str, dict[str, float]]
    """Agreement by camera axis, when the sensor's axes are the camera's."""
    events: list[dict[str, float]]


@dataclass(frozen=True)
class Result:
    """One run."""

    recording: str
    main: str
    """Name of the method that the report is about."""
    time_s: Curve
    sensor_mn: Curve | None
    """(T,) magnitude at the frames' times [mN]."""
    sensor_axes_mn: Curve | None
    """(T, 3)."""
    methods: dict[str, Scored]
    scale: Scale
    relative_uncertainty: float
    """Of every force, from scale and stiffness."""
    noise_floor_mn: float
    notes: tuple[str, ...]
    steps: tuple[str, ...]
    settings: dict[str, Any]
    environment: dict[str, str]
    followed: Followed


def assess(
    recording: Recording,
    methods: Mapping[str, Method],
    main: str,
    scale: Scale,
    settings: Settings,
    described: Mapping[str, Any],
    progress: Progress = lambda done: None,
) -> Result:
    """Follows the recording and scores every method against its sensor.

    Args:
        recording: the opened recording.
        methods: by name, in the table's order.
        main: the one the report is about.
        scale: the recording's scale.
        settings: of this run.
        described: what the methods are, for the report.
        progress: told after every frame.

    Raises:
        UserError: as `follow` and `sensor.process`.
    """
    meta = recording.meta
    done = follow(
        recording,
        methods,
        scale.mm_per_px,
        backend=settings.backend,
        shrink=settings.shrink,
        pictured=main,
        progress=progress,
    )
    time = np.array(done.time_s)
    notes = [*recording.notes, *done.notes]
    axes = floor = None
    steps: tuple[str, ...] = ()
    if recording.force is None:
        notes.append("no force.csv: predictions only, nothing is scored")
    else:
        processed = sensor.process(recording.force, meta.sensor, meta.sync.offset_s)
        axes, floor, steps = sensor.at(processed, time), processed.noise_floor_mn, processed.steps
        covered = int(np.isfinite(axes).all(axis=1).sum())
        if covered == 0:
            notes.append(
                "force.csv and the video share no time: predictions only; are both clocks in seconds?"
            )
            axes = None
        elif covered < len(time):
            notes.append(f"the sensor covers {covered} of {len(time)} frames; only those are scored")
    if meta.young_kpa is None:
        notes.append("Young's modulus unknown: forces are those of tissue of 1 kPa and only relative")
    size = None if axes is None else np.linalg.norm(axes, axis=1)
    scored = {
        name: _scored(
            time, np.array(done.force_mn[name]), size, axes, meta.sensor.axes == "camera", floor or 0.0
        )
        for name in methods
    }
    return Result(
        recording=recording.name,
        main=main,
        time_s=time,
        sensor_mn=size,
        sensor_axes_mn=axes,
        methods=scored,
        scale=scale,
        relative_uncertainty=math.hypot(scale.uncertainty, meta.young_uncertainty),
        noise_floor_mn=floor or 0.0,
        notes=tuple(notes),
        steps=steps,
        settings={**asdict(settings), **described, "meta": meta.model_dump(mode="json", exclude_none=True)},
        environment=environment(),
        followed=done,
    )


def _scored(
    time_s: Curve, force: Curve, size: Curve | None, axes: Curve | None, camera_axes: bool, floor_mn: float
) -> Scored:
    length = np.sqrt(np.nansum(force**2, axis=1))
    length[~np.isfinite(force).any(axis=1)] = np.nan
    if size is None or axes is None:
        return Scored(force, length, {}, {}, [])
    scores, events = score.everything(time_s, size, length, floor_mn)
    components = {}
    if camera_axes and np.isfinite(force).any(axis=0).all():
        components = {axis: score.agreement(axes[:, k], force[:, k]) for k, axis in enumerate("xyz")}
    return Scored(force, length, scores, components, events)


def as_json(result: Result) -> dict[str, Any]:
    """The result as JSON-ready values; undefined numbers are null."""
    done = result.followed
    tree = {
        "format": "sulcus-score",
        "version": 1,
        "recording": result.recording,
        "main": result.main,
        "frames": len(result.time_s),
        "scores": result.methods[result.main].scores,
        "methods": {
            name: {"scores": m.scores, "components": m.components, "events": m.events}
            for name, m in result.methods.items()
        },
        "scale": asdict(result.scale),
        "relative_uncertainty": result.relative_uncertainty,
        "noise_floor_mn": result.noise_floor_mn,
        "notes": list(result.notes),
        "sensor_steps": list(result.steps),
        "settings": result.settings,
        "environment": result.environment,
        "timings": done.timings,
        "curve": {
            "frame": done.frame,
            "t_s": result.time_s,
            "sensor_mn": result.sensor_mn,
            "sensor_axes_mn": result.sensor_axes_mn,
            "confidence": done.confidence,
            "predicted_mn": {name: m.size_mn for name, m in result.methods.items()},
            "predicted_axes_mn": {name: m.force_mn for name, m in result.methods.items()},
        },
    }
    plain = _plain(tree)
    assert isinstance(plain, dict)
    return plain


def write_json(result: Result, path: Path) -> None:
    """Writes `score.json` whole or not at all."""
    part = path.with_name(path.name + ".part")
    part.write_text(json.dumps(as_json(result), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    part.replace(path)


def environment() -> dict[str, str]:
    """What the numbers were made with."""
    return {
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        **{name: str(version) for name, version in versions.of_everything().items()},
    }


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(part) for key, part in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    if isinstance(value, (float, np.floating)):
        return round(float(value), 9) if math.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return value
