"""Findings on a recording: what is usable, missing or looks wrong, for `bench check` and `bench score`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.recording import clocks, pixel_scale
from bench.recording.folder import Force, Recording, open_recording
from bench.recording.footage import as_footage
from bench.recording.meta import LEAST_INTERVALS, LEAST_TURNING, Meta
from bench.recording.right_pictures import LATE, RightPictures, StereoQuality
from bench.recording.tracking_picture import draw_tracking
from synth.errors import UserError
from synth.recording_flow.decode import RecordingFlowSettings
from synth.recording_flow.finding import Finding, judge_scale, judge_young, worth_saying
from synth.recording_flow.passes import VideoPass
from synth.system.checked_file import write_picture
from synth.video.read import Picture

_JUMP = 3.0  # median intervals
_SURGICAL_N = 5.0
_LOADED = 0.25  # share of the range of force above which the tissue is not at rest
_RATE_HZ = 10.0  # default rate of tracked frames
_LEAST_PRESS = 5  # frames of a press that determine its gain
_OFF_ROWS_PX, _OTHER_ROWS_PX = 0.5, 2.0  # of reduced frames: an outdated calibration, one of another pair
_NOISY_MM = 0.16  # depth motion from which force is no better than monocular
# Logarithm of the stated scale over the stereo scale: from the first they contradict each other, from the
# second the error of force is too large for any result.
_OTHER_SCALE, _ANOTHER_SCALE = 0.1, 0.3
_UNITS_MM = {"metres": 1000.0, "centimetres": 10.0, "micrometres": 0.001}
_TRIED = 12  # frames that are tracked to test whether tracking works


@dataclass
class _Checked:
    """The findings so far and what later checks need."""

    findings: list[Finding] = field(default_factory=list)
    mm_per_px: float | None = None
    times: list[float] = field(default_factory=list)  # of the usable frames [s]
    timeless: int = 0  # frames without a time
    back: int = 0  # frames whose time runs backwards
    size: tuple[int, int] = (0, 0)  # height, width [px]
    frames: int = 0
    last: int = -1  # number of the last frame
    picture: Path | None = None  # PNG of what is tracked

    @property
    def time_s(self) -> NDArray[np.float64]:
        return np.array(self.times)

    def add(self, state: str, what: str, message: str) -> None:
        self.findings.append(Finding(state, what, message))


def check_recording(folder: Path, phantom: bool = False, picture: Path | None = None) -> list[Finding]:
    """Opens a recording, decodes its pictures and checks its files against each other. Raises no UserError.

    `phantom`: as in `open_recording`. `picture`: PNG of what is tracked, written if tracking works.
    """
    found = _Checked(picture=picture)
    try:
        recording = open_recording(folder, phantom)
    except UserError as error:
        return [Finding("bad", "recording", str(error))]
    for note in recording.notes:
        found.add("odd", "files", note)
    for what, check in (
        ("scale", _check_scale),
        ("pictures", _check_video),
        ("times", _check_times),
        ("sensor", _check_sensor),
        ("spans", _check_spans),
    ):
        try:
            check(recording, found)
        except UserError as error:
            found.add("bad", what, str(error))
    first = worth_saying(found.findings)
    return [*first, *(one for one in found.findings if one not in first)]


def judge(
    recording: Recording, mm_per_px: float, video: VideoPass, stereo: StereoQuality | None
) -> list[Finding]:
    """Findings on a tracked recording, the same in `bench check` and `bench score`.

    Args:
        recording: the opened recording.
        mm_per_px: scale of its own pixels.
        video: its video, tracked to the end.
        stereo: quality of its right or depth camera, if it has one.
    """
    meta = recording.meta
    found = [
        *judge_young(meta.young_kpa, meta.tissue == "phantom"),
        *judge_scale(mm_per_px, video.rest.size[1]),
    ]
    found += video.findings if stereo is None else [*video.findings, *judge_stereo(stereo, mm_per_px)]
    return (
        found if recording.force is None else [*found, *judge_zero(recording.force, meta, video.rest.time_s)]
    )


def judge_zero(force: Force, meta: Meta, rest_s: float | None) -> list[Finding]:
    """Findings on load where there should be none: in `sensor.free_s`, or at the rest frame.

    Uses raw samples, because a tare would hide the load.
    """
    known = np.isfinite(force.force_mn).all(axis=1)
    t, newtons = force.time_s[known], force.force_mn[known]
    size = np.linalg.norm(newtons, axis=1)
    least, most = float(size.min()), float(size.max())
    found = []
    if most > 1000 * _SURGICAL_N and meta.tissue == "brain":
        message = f"{most / 1000:.3g} N is a large force for a brain: is force.csv in newtons?"
        found.append(Finding("odd", "sensor", message))
    offset = {"clock": 0.0, "offset": meta.sync.offset_s}.get(meta.sync.method)
    if rest_s is not None and offset is not None and t[0] <= rest_s - offset <= t[-1]:
        there = float(np.interp(rest_s, t + offset, size))
        if there - least > _LOADED * (most - least):
            best = float(t[size.argmin()] + offset)
            lowest = f"the minimum is {least:.3g} mN at {best:.3g} s"
            message = f"the sensor measures {there:.3g} mN at the rest frame; {lowest}"
            found.append(Finding("odd", "rest frame", message))
    for start, stop in meta.sensor.free_s:
        inside = newtons[(t >= start) & (t <= stop)]
        if len(inside) > 2:
            low, high = np.percentile(inside, (5, 95), axis=0)
            change = float(np.linalg.norm(high - low))
            if change > _LOADED * np.linalg.norm(np.ptp(newtons, axis=0)):
                message = f"sensor.free_s: force changes by {change:.3g} mN between {start:g} and {stop:g} s"
                found.append(Finding("odd", "sensor", message))
    return found


def judge_stereo(stereo: StereoQuality, mm_per_px: float) -> list[Finding]:
    """Findings on the right or depth camera: its pictures, calibration, noise and scale."""
    found = [Finding("bad", "stereo", f"the right camera {stereo.fault}")] if stereo.fault else []
    if stereo.epipolar_px > _OTHER_ROWS_PX:
        rows = f"rows of left and right picture are {stereo.epipolar_px:.2g} px off"
        message = f"{rows}: is the calibration of this camera pair?"
        found.append(Finding("bad", "stereo", message))
    elif stereo.epipolar_px > _OFF_ROWS_PX or not stereo.noise_mm < _NOISY_MM or stereo.lag > LATE:
        found.append(Finding("odd", "stereo", stereo.describe()))
    off = abs(np.log(stereo.mm_per_px / mm_per_px))
    if off > _OTHER_SCALE:
        message = f"{mm_per_px:.4g} mm/px is stated, but stereo gives {stereo.mm_per_px:.4g}"
        for unit, times in _UNITS_MM.items():
            if abs(np.log(times * stereo.mm_per_px / mm_per_px)) < _ANOTHER_SCALE:
                message += f": if its calibration is in {unit}, multiply mm_per_unit by {times:g}"
        found.append(Finding("bad" if off > _ANOTHER_SCALE else "odd", "scale", message))
    return found


def is_usable(found: list[Finding]) -> bool:
    """Whether force can be predicted from the recording."""
    return all(finding.state != "bad" for finding in found)


def _check_scale(recording: Recording, found: _Checked) -> None:
    """Scale and stiffness."""
    young = recording.meta.young_kpa
    if young is None:
        found.add("lack", "stiffness", "young_kpa unknown: forces are relative")
    elif not judge_young(young):
        found.add("ok", "stiffness", f"E = {young:g} kPa ± {100 * recording.meta.young_uncertainty:.2g}%")
    scale = pixel_scale.find_scale(recording.meta, recording.folder)
    found.mm_per_px = scale.mm_per_px
    error = f"{100 * scale.uncertainty:.2g}%"
    found.add("ok", "scale", f"{scale.mm_per_px:.4g} mm/px ± {error} ({scale.source})")


def _check_video(recording: Recording, found: _Checked) -> None:
    """Decodes every picture once, and tracks a few as `bench score` does."""
    first = recording.meta.rest_frame
    numbers = [number for number in recording.numbers() or range(_TRIED) if number >= first] or [first]
    only = frozenset(numbers[k] for k in np.linspace(0, len(numbers) - 1, _TRIED).astype(int))
    pictures = _counted(recording, found)
    whole = as_footage(recording, found.mm_per_px or 1.0)
    footage = replace(whole, pictures=lambda: pictures, only=only)
    stereo, video = None, None
    try:
        video = VideoPass(footage, RecordingFlowSettings(rate_hz=None, pulse=False))
        right, tracked = RightPictures(video), []
        for frame in video.frames():
            right.add(frame)
            tracked.append(frame)
        stereo = right.quality
        if found.picture is not None:
            write_picture(found.picture, draw_tracking(tracked, video.rest.tissue, video.rest.shrink))
    except UserError as error:
        found.add("bad", "tracking", str(error))
    for _ in pictures:
        pass  # frames that were not tracked count too
    if not found.frames:
        return
    found.add("ok", "pictures", f"{found.frames} frames of {found.size[1]} x {found.size[0]} px")
    if found.last < first:
        found.add("bad", "rest frame", f"rest_frame is {first}, the last frame {found.last}")
    if recording.tissue is None:
        found.add("lack", "tissue", "no tissue.png: the whole picture is assumed to be tissue")
    found.add("ok" if recording.masks else "lack", "tool", recording.describe_tool(found.frames))
    if video is None:
        return
    if video.summary.frames:
        found.add("odd" if video.summary.is_odd else "ok", "tracking", video.summary.describe())
    if stereo is not None and not judge_stereo(stereo, found.mm_per_px or stereo.mm_per_px):
        found.add("ok", "stereo", stereo.describe())
    found.findings += judge(recording, found.mm_per_px or 0.0, video, stereo)


def _counted(recording: Recording, found: _Checked) -> Iterator[Picture]:
    """Yields and counts the pictures, up to the first unreadable one."""
    try:
        for picture in recording.frames():
            found.size, found.frames = (picture.rgb.shape[0], picture.rgb.shape[1]), found.frames + 1
            found.last = picture.index
            if picture.time_s is None:
                found.timeless += 1
            elif found.times and picture.time_s <= found.times[-1]:
                found.back += 1
            else:
                found.times.append(picture.time_s)
            yield picture
    except UserError as error:
        found.add("bad", "pictures", str(error))


def _check_times(recording: Recording, found: _Checked) -> None:
    t = found.time_s
    if len(t) < 2:
        found.add("bad", "times", "fewer than two frames have a time")
        return
    # From first to last frame: the median interval misleads where stamps come in bursts.
    rate = (len(t) - 1) / (t[-1] - t[0])
    jumps = np.diff(t) > _JUMP * np.median(np.diff(t))
    found.add("ok", "times", f"{t[-1] - t[0]:.2f} s at {rate:.4g} frames per second")
    if found.timeless or found.back:
        found.add("odd", "times", f"{found.timeless} frames without a time, {found.back} backwards in time")
    if jumps.any():
        found.add("odd", "times", f"{jumps.sum()} gaps, the longest {np.diff(t).max():.3g} s")
    if not 0.5 <= rate <= 1000:
        found.add("odd", "times", f"{rate:.3g} frames per second: are the times in seconds?")


def _check_sensor(recording: Recording, found: _Checked) -> None:
    force, meta, times = recording.force, recording.meta, found.time_s
    if force is None:
        found.add("lack", "sensor", "no force.csv: predictions only")
        return
    t = force.time_s
    peak = float(np.nanmax(np.linalg.norm(force.force_mn, axis=1)))
    rate = (len(t) - 1) / (t[-1] - t[0])
    found.add("ok", "sensor", f"{len(t)} samples at {rate:.4g} Hz, up to {peak:.3g} mN")
    if not meta.sensor.free_s:
        found.add("lack", "sensor", "no sensor.free_s: no tare, no drift correction, no noise floor")
    for start, stop in meta.sensor.free_s:
        if not ((t >= start) & (t <= stop)).any():
            found.add("bad", "sensor", f"sensor.free_s: no samples between {start:g} and {stop:g} s")
    if len(times) > 1:
        offset = meta.sync.offset_s if meta.sync.method == "offset" else 0.0
        common = min(times[-1], t[-1] + offset) - max(times[0], t[0] + offset)
        share = max(common, 0) / (times[-1] - times[0])
        other = clocks.find_other_unit(times, t)
        message = other or f"the sensor covers {100 * share:.0f}% of the video"
        found.add("ok" if share > 0.9 and not other else "odd", "clocks", message)


def _check_spans(recording: Recording, found: _Checked) -> None:
    """Whether the spans for calibration are long enough and covered by the force record."""
    meta, times = recording.meta, found.time_s
    if len(times) < 2:
        return
    rate = min((len(times) - 1) / (times[-1] - times[0]), _RATE_HZ)
    clock = meta.sync.calibration_s if meta.sync.method == "correlate" else None
    for part, name, span, frames in (
        ("clocks", "sync.calibration_s", clock, LEAST_INTERVALS),
        ("sensor", "sensor.turn_s", meta.sensor.turn_s, LEAST_TURNING),
        ("press", "press_s", meta.press_s, _LEAST_PRESS),
    ):
        if span is not None:
            inside_s = max(min(span[1], times[-1]) - max(span[0], times[0]), 0.0)
            message = f"{name} covers {inside_s:.3g} s of video; at least {frames / rate:.3g} s are needed"
            found.add("ok" if inside_s >= frames / rate else "odd", part, message)
    if clock is not None and recording.force is not None:
        t, margin = recording.force.time_s, meta.sync.search_s
        lacks = max(t[0] - (clock[0] - margin), (clock[1] + margin) - t[-1], 0.0)
        if lacks > 0:
            message = f"force.csv lacks {lacks:.3g} s of sync.calibration_s and {margin:g} s on either side"
            found.add("odd", "clocks", message)
