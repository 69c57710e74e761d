"""`bench check`: what of a recording is usable, what is missing and what looks wrong."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.recording import clocks, pixel_scale
from bench.recording.folder import Recording, open_recording
from bench.recording.meta import LEAST_INTERVALS, LEAST_TURNING
from bench.recording.second_eye import LATE, SecondEye
from synth.errors import UserError
from synth.recording_flow.frame_faults import find_fault
from synth.recording_flow.video_flow import RecordingFlowSettings, VideoFlow

_WIDEST_MM, _NARROWEST_MM = 300.0, 3.0
_SOFTEST_KPA, _STIFFEST_KPA = 0.05, 100.0
_JUMP = 3.0  # median intervals
_SURGICAL_N = 5.0
_RATE_HZ = 10.0  # frames a second that are looked at unless more are asked for
_LEAST_PRESS = 5  # frames of a press that settle its gain
_OFF_ROWS_PX = 0.5  # of small pictures: the calibration is not this pair's, or no longer
_NOISY_MM = 0.16  # depth motion from which on force is no better than with one eye
_OTHER_SCALE = 0.1  # by more than that the scale and the second eye's calibration contradict each other
_LOOKED_AT = 12  # frames that are followed to see whether they can be


@dataclass(frozen=True)
class RecordingFinding:
    """One line of the answer."""

    state: str
    """`ok`, `odd` (usable, but look at it), `lack` (optional, not there) or `bad` (can't be scored)."""
    what: str
    """Which part of the recording."""
    said: str
    """What was found."""


@dataclass
class _Checked:
    """What the checks before have found."""

    findings: list[RecordingFinding] = field(default_factory=list)
    mm_per_px: float | None = None
    time_s: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    """Of the usable frames."""
    size: tuple[int, int] = (0, 0)
    """Height, width [px]."""
    frames: int = 0

    def add(self, state: str, what: str, said: str) -> None:
        self.findings.append(RecordingFinding(state, what, said))

    def judge(self, fine: bool, what: str, said: str) -> None:
        """`ok` or `odd`."""
        self.add("ok" if fine else "odd", what, said)


def check_recording(folder: Path, phantom: bool = False) -> list[RecordingFinding]:
    """Opens a recording, decodes its pictures and compares what its files say. Raises no UserError.

    `phantom`: as of `open_recording`.
    """
    found = _Checked()
    try:
        recording = open_recording(folder, phantom)
    except UserError as error:
        return [RecordingFinding("bad", "recording", str(error))]
    for note in recording.notes:
        found.add("odd", "files", note)
    for what, check in (
        ("scale", _check_scale),
        ("pictures", _check_pictures),
        ("following", _check_following),
        ("sensor", _check_sensor),
        ("spans", _check_spans),
    ):
        try:
            check(recording, found)
        except UserError as error:
            found.add("bad", what, str(error))
    return found.findings


def is_usable(found: list[RecordingFinding]) -> bool:
    """Whether anything can be predicted from it."""
    return all(finding.state != "bad" for finding in found)


def _check_scale(recording: Recording, found: _Checked) -> None:
    """Millimetres and kilopascals."""
    young = recording.meta.young_kpa
    if young is None:
        found.add("lack", "stiffness", "young_kpa unknown: only relative force can be had")
    else:
        usual = _SOFTEST_KPA <= young <= _STIFFEST_KPA
        said = f"± {100 * recording.meta.young_uncertainty:.2g}%" if usual else "is odd: is it in kPa?"
        found.judge(usual, "stiffness", f"E = {young:g} kPa {said}")
    scale = pixel_scale.find_scale(recording.meta, recording.folder)
    found.mm_per_px = scale.mm_per_px
    said = f"{scale.mm_per_px:.4g} mm/px ± {100 * scale.uncertainty:.2g}% ({scale.source})"
    found.add("ok", "scale", said)


def _check_pictures(recording: Recording, found: _Checked) -> None:
    """Decodes every picture: how many there are, how large, and when."""
    times: list[float] = []
    timeless = back = 0
    fault = broken = ""
    try:
        for picture in recording.frames():
            found.size = (picture.rgb.shape[0], picture.rgb.shape[1])
            found.frames += 1
            if picture.index == recording.meta.rest_frame:
                fault = find_fault(picture.rgb, recording.tissue_mask(found.size))
            if picture.time_s is None:
                timeless += 1
            elif times and picture.time_s <= times[-1]:
                back += 1
            else:
                times.append(picture.time_s)
    except UserError as error:
        broken = str(error)
    if not found.frames:
        raise UserError(broken)
    t = found.time_s = np.array(times)
    width = found.size[1]
    found.judge(not broken, "pictures", broken or f"{found.frames} of {width} x {found.size[0]} px")
    if fault:
        found.add("bad", "pictures", f"nothing can be measured: the rest frame is {fault}")
    if recording.meta.rest_frame >= found.frames:
        found.add("bad", "rest frame", f"rest_frame is {recording.meta.rest_frame} of {found.frames} frames")
    if found.mm_per_px and not _NARROWEST_MM <= found.mm_per_px * width <= _WIDEST_MM:
        wide = f"{found.mm_per_px * width:.3g} mm"
        found.add("odd", "scale", f"the picture would be {wide} wide: is the scale in mm/px?")
    if len(t) < 2:
        found.add("bad", "times", "fewer than two frames have a time")
        return
    # From the first frame to the last: stamps that come in bursts have a median step of their own.
    rate = (len(t) - 1) / (t[-1] - t[0])
    jumps = np.diff(t) > _JUMP * np.median(np.diff(t))
    found.add("ok", "times", f"{t[-1] - t[0]:.2f} s at {rate:.4g} frames a second")
    if timeless or back:
        found.add("odd", "times", f"{timeless} frames without a time, {back} whose time runs back")
    if jumps.any():
        found.add("odd", "times", f"{jumps.sum()} gaps, the longest {np.diff(t).max():.3g} s")
    if not 0.5 <= rate <= 1000:
        found.add("odd", "times", f"{rate:.3g} frames a second: are the times in seconds?")


def _check_following(recording: Recording, found: _Checked) -> None:
    """Follows a few frames as `bench score` would: what is masked, and whether the tissue can be followed."""
    if not found.frames:
        return
    if recording.tissue is None:
        found.add("lack", "tissue", "no tissue.png: the whole picture is taken for tissue")
    elif not recording.tissue_mask(found.size).any():
        found.add("bad", "tissue", "tissue.png marks nothing")
    if recording.masks:
        recording.masks.read(next(iter(recording.masks.by_frame), 0), found.size)
    found.add("ok" if recording.masks else "lack", "tool", recording.describe_tool(found.frames))
    first = recording.meta.rest_frame
    last = max((recording.expected_frames() or _LOOKED_AT) - 1, first)
    wanted = {first, *np.linspace(first, last, _LOOKED_AT).astype(int).tolist()}
    pictures = (picture for picture in recording.frames() if picture.index in wanted)
    second = SecondEye(recording, found.mm_per_px or 1.0) if recording.has_two_eyes else None
    settings = RecordingFlowSettings(rate_hz=None, pulse=False)
    video = VideoFlow(recording.film(pictures), settings, second=second)
    for _ in video.frames():
        pass
    if video.summary.frames:
        found.judge(not video.summary.is_odd, "following", video.summary.describe())
    stereo = None if second is None else second.quality
    if stereo is None:  # one eye; of two, the rest frame is at fault
        return
    odd = stereo.epipolar_px > _OFF_ROWS_PX or not stereo.noise_mm < _NOISY_MM or stereo.lag > LATE
    found.judge(not odd, "second eye", stereo.describe())
    stated = found.mm_per_px
    if stated and abs(stereo.mm_per_px / stated - 1) > _OTHER_SCALE:
        found.add("odd", "scale", f"{stated:.4g} mm/px, but the second eye finds {stereo.mm_per_px:.4g}")


def _check_sensor(recording: Recording, found: _Checked) -> None:
    force, meta, times = recording.force, recording.meta, found.time_s
    if force is None:
        found.add("lack", "sensor", "no force.csv: predictions only")
        return
    t = force.time_s
    peak = float(np.nanmax(np.linalg.norm(force.force_mn, axis=1)))
    rate = (len(t) - 1) / (t[-1] - t[0])
    found.add("ok", "sensor", f"{len(t)} rows at {rate:.4g} a second, up to {peak:.3g} mN")
    if peak > 1000 * _SURGICAL_N and meta.tissue == "brain":
        found.add("odd", "sensor", f"{peak / 1000:.3g} N is much for a brain: is force.csv in newtons?")
    if not meta.sensor.free_s:
        found.add("lack", "sensor", "no sensor.free_s: no tare, no drift, no noise floor")
    for start, stop in meta.sensor.free_s:
        if not ((t >= start) & (t <= stop)).any():
            found.add("bad", "sensor", f"sensor.free_s: no samples between {start:g} and {stop:g} s")
    if len(times) > 1:
        offset = meta.sync.offset_s if meta.sync.method == "offset" else 0.0
        common = min(times[-1], t[-1] + offset) - max(times[0], t[0] + offset)
        share = max(common, 0) / (times[-1] - times[0])
        other = clocks.find_other_unit(times, t)
        said = other or f"the sensor covers {100 * share:.0f}% of the video"
        found.judge(share > 0.9 and not other, "clocks", said)


def _check_spans(recording: Recording, found: _Checked) -> None:
    """Whether the spans that calibrate are long enough, and in the record, before anything is computed."""
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
            said = f"{name} holds {inside_s:.3g} s of video, {frames / rate:.3g} s are needed"
            found.judge(inside_s >= frames / rate, part, said)
    if clock is not None and recording.force is not None:
        t, margin = recording.force.time_s, meta.sync.search_s
        lacks = max(t[0] - (clock[0] - margin), (clock[1] + margin) - t[-1], 0.0)
        if lacks > 0:
            said = f"force.csv lacks {lacks:.3g} s of sync.calibration_s and {margin:g} s on either side"
            found.add("odd", "clocks", said)
