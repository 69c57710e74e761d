"""`bench check`: what of a recording is usable, what is missing and what looks wrong."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.recording import clocks, pixel_scale
from bench.recording.folder import Recording, open_recording
from bench.recording.meta import LEAST_INTERVALS, LEAST_TURNING
from bench.recording.second_eye import LATE, SecondEye, Sight
from learn.inference.quality import find_fault
from learn.inference.video_flow import Account, Footage, Settings, VideoFlow
from synth.errors import UserError

_WIDEST_MM, _NARROWEST_MM = 300.0, 3.0
_SOFTEST_KPA, _STIFFEST_KPA = 0.05, 100.0
_JUMP = 3.0  # median intervals
_SURGICAL_N = 5.0
_RATE_HZ = 10.0  # frames a second that are looked at unless more are asked for
_LEAST_PRESS = 5  # frames of a press that settle its gain
OFF_ROWS_PX = 0.5  # of small pictures: the calibration is not this pair's, or no longer
NOISY_MM = 0.16  # depth motion from which on force is no better than with one eye
_OTHER_SCALE = 0.1  # by more than that the scale and the second eye's calibration contradict each other
_LOOKED_AT = 12  # frames that are followed to see whether they can be


@dataclass(frozen=True)
class Finding:
    """One line of the answer."""

    state: str
    """`ok`, `odd` (usable, but look at it), `lack` (optional, not there) or `bad` (can't be scored)."""
    what: str
    """Which part of the recording."""
    said: str
    """What was found."""


class _Findings(list[Finding]):
    """What is found, line by line."""

    def add(self, state: str, what: str, said: str) -> None:
        self.append(Finding(state, what, said))


def check_recording(folder: Path, phantom: bool = False) -> list[Finding]:
    """Opens a recording, decodes its pictures and compares what its files say. Raises no UserError.

    `phantom`: as of `open_recording`.
    """
    found = _Findings()
    try:
        recording = open_recording(folder, phantom)
    except UserError as error:
        found.add("bad", "recording", str(error))
        return found
    for note in recording.notes:
        found.add("odd", "files", note)
    scale = None
    try:
        scale = pixel_scale.find_scale(recording.meta, recording.folder)
        said = f"{scale.mm_per_px:.4g} mm/px ± {100 * scale.uncertainty:.2g}% ({scale.source})"
        found.add("ok", "scale", said)
    except UserError as error:
        found.add("bad", "scale", str(error))
    times, size, count = _check_pictures(recording, found)
    if size is not None:
        _check_masks(recording, size, count, found)
        width = scale.mm_per_px * size[1] if scale is not None else _NARROWEST_MM
        if not _NARROWEST_MM <= width <= _WIDEST_MM:
            said = f"the picture would be {width:.3g} mm wide: is the scale in mm/px?"
            found.add("odd", "scale", said)
    _check_sensor(recording, times, found)
    _check_spans(recording, times, found)
    _check_stiffness(recording, found)
    return found


def is_usable(found: list[Finding]) -> bool:
    """Whether anything can be predicted from it."""
    return all(finding.state != "bad" for finding in found)


def _check_pictures(
    recording: Recording, found: _Findings
) -> tuple[NDArray[np.float64], tuple[int, int] | None, int]:
    """Times of the usable frames [s], height and width of the first, and how many frames there are."""
    times: list[float] = []
    size: tuple[int, int] | None = None
    count = timeless = back = 0
    fault = ""
    try:
        for picture in recording.frames():
            size = size or (picture.rgb.shape[0], picture.rgb.shape[1])
            count += 1
            if picture.index == recording.meta.rest_frame:
                fault = find_fault(picture.rgb, recording.tissue_mask(size))
            if picture.time_s is None:
                timeless += 1
            elif times and picture.time_s <= times[-1]:
                back += 1
            else:
                times.append(picture.time_s)
    except UserError as error:
        found.add("odd" if count else "bad", "pictures", str(error))
        return np.array(times), size, count
    assert size is not None
    t = np.array(times)
    found.add("ok", "pictures", f"{count} of {size[1]} x {size[0]} px")
    if fault:
        found.add("bad", "pictures", f"nothing can be measured: the rest frame is {fault}")
    if len(t) < 2:
        found.add("bad", "times", "fewer than two frames have a time")
        return t, size, count
    steps = np.diff(t)
    step = float(np.median(steps))
    # From the first frame to the last: stamps that come in bursts have a median step of their own.
    rate = (len(t) - 1) / (t[-1] - t[0])
    found.add("ok", "times", f"{t[-1] - t[0]:.2f} s at {rate:.4g} frames a second")
    if timeless or back:
        found.add("odd", "times", f"{timeless} frames without a time, {back} whose time runs back")
    if (jumps := steps > _JUMP * step).any():
        longest = int(steps.argmax())
        where = f"the longest {steps[longest]:.3g} s at {t[longest]:.3g} s"
        found.add("odd", "times", f"{jumps.sum()} gaps, {where}")
    if not 0.5 <= rate <= 1000:
        found.add("odd", "times", f"{rate:.3g} frames a second: are the times in seconds?")
    if recording.meta.rest_frame >= count:
        found.add("bad", "rest frame", f"rest_frame is {recording.meta.rest_frame} of {count} frames")
    return t, size, count


def _check_masks(recording: Recording, size: tuple[int, int], frames: int, found: _Findings) -> None:
    try:
        tissue = recording.tissue_mask(size)
        if recording.tissue is None:
            found.add("lack", "tissue", "no tissue.png: the whole picture is taken for tissue")
        elif not tissue.any():
            found.add("bad", "tissue", "tissue.png marks nothing")
        if recording.has_masks:
            recording.tool(next(iter(recording.masks), 0), size)
        found.add("ok" if recording.has_masks else "lack", "tool", recording.describe_tool(frames))
        _check_following(recording, found)
    except UserError as error:
        found.add("bad", "masks", str(error))


def _check_following(recording: Recording, found: _Findings) -> None:
    """Follows a few frames as `bench score` would: what is masked, and whether the tissue can be followed."""
    first = recording.meta.rest_frame
    count = recording.expected_frames() or _LOOKED_AT
    wanted = {first, *np.linspace(first, max(count - 1, first), _LOOKED_AT).astype(int).tolist()}
    pictures = (picture for picture in recording.frames() if picture.index in wanted)
    tool = recording.tool if recording.has_masks else None
    footage = Footage(pictures, str(recording.folder), recording.tissue_mask, tool, first)
    video, account = VideoFlow(footage, Settings(rate_hz=None, pulse=False)), Account()
    second = SecondEye(recording, video) if recording.right or recording.depths else None
    for step in video.steps():
        account.add(step.found, video.tissue)
        if second is not None:
            try:
                second.move(step)
            except UserError as error:
                found.add("bad", "second eye", str(error))
                second = None
    sight = None if second is None else second.sight
    if sight is not None:  # without one the rest frame is at fault
        _check_sight(sight, recording, found)
    if account.frames:
        found.add("odd" if account.is_odd else "ok", "following", account.describe())


def _check_sight(sight: Sight, recording: Recording, found: _Findings) -> None:
    odd = sight.epipolar_px > OFF_ROWS_PX or not sight.noise_mm < NOISY_MM or sight.lag > LATE
    found.add("odd" if odd else "ok", "second eye", sight.describe())
    with contextlib.suppress(UserError):  # said already
        stated = pixel_scale.find_scale(recording.meta, recording.folder).mm_per_px
        if abs(sight.mm_per_px / stated - 1) > _OTHER_SCALE:
            said = f"{stated:.4g} mm/px, but the second eye finds {sight.mm_per_px:.4g}"
            found.add("odd", "scale", said)


def _check_sensor(recording: Recording, times: NDArray[np.float64], found: _Findings) -> None:
    force, meta = recording.force, recording.meta
    if force is None:
        found.add("lack", "sensor", "no force.csv: predictions only")
        return
    t = force.time_s
    lacking = 1 - float(np.isfinite(force.force_mn).all(axis=1).mean())
    peak = float(np.nanmax(np.linalg.norm(force.force_mn, axis=1)))
    rate = (len(t) - 1) / (t[-1] - t[0])
    found.add("ok", "sensor", f"{len(t)} rows at {rate:.4g} a second, up to {peak:.3g} mN")
    if peak > 1000 * _SURGICAL_N and meta.tissue == "brain":
        said = f"{peak / 1000:.3g} N is much for a brain: is force.csv in newtons?"
        found.add("odd", "sensor", said)
    if peak == 0:
        found.add("odd", "sensor", "force is zero throughout")
    if lacking > 0.05:
        found.add("odd", "sensor", f"{100 * lacking:.0f}% of rows lack a force")
    if not meta.sensor.free_s:
        found.add("lack", "sensor", "no sensor.free_s: no tare, no drift, no noise floor")
    if len(times) > 1:
        offset = meta.sync.offset_s if meta.sync.method == "offset" else 0.0
        common = min(times[-1], t[-1] + offset) - max(times[0], t[0] + offset)
        share = max(common, 0) / (times[-1] - times[0])
        said = f"the sensor covers {100 * share:.0f}% of the video"
        found.add("ok" if share > 0.9 else "odd", "clocks", said)
        ratio = (t[-1] - t[0]) / (times[-1] - times[0])
        if not 0.01 <= ratio <= 100:
            said = f"the sensor's record is {ratio:.3g} times as long: seconds?"
            found.add("odd", "clocks", clocks.find_other_unit(times, t) or said)


def _check_spans(recording: Recording, times: NDArray[np.float64], found: _Findings) -> None:
    """Whether the spans that calibrate are long enough, and in the record, before anything is computed."""
    meta = recording.meta
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
            found.add("ok" if inside_s >= frames / rate else "odd", part, said)
    if clock is not None and recording.force is not None:
        t, margin = recording.force.time_s, meta.sync.search_s
        lacks = max(t[0] - (clock[0] - margin), (clock[1] + margin) - t[-1], 0.0)
        if lacks > 0:
            said = f"force.csv lacks {lacks:.3g} s of sync.calibration_s and {margin:g} s on either side"
            found.add("odd", "clocks", said)
    for start, stop in meta.sensor.free_s:
        force = recording.force
        if force is not None and not ((force.time_s >= start) & (force.time_s <= stop)).any():
            found.add("bad", "sensor", f"sensor.free_s: no samples between {start:g} and {stop:g} s")


def _check_stiffness(recording: Recording, found: _Findings) -> None:
    young = recording.meta.young_kpa
    if young is None:
        found.add("lack", "stiffness", "young_kpa unknown: only relative force can be had")
    elif not _SOFTEST_KPA <= young <= _STIFFEST_KPA:
        found.add("odd", "stiffness", f"E = {young:g} kPa: is it in kPa?")
    else:
        spread = 100 * recording.meta.young_uncertainty
        found.add("ok", "stiffness", f"E = {young:g} kPa ± {spread:.2g}%")
