"""`bench check`: what of a recording is usable, what is missing and what looks wrong."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.recording import pixel_scale
from bench.recording.folder import Recording, open_recording
from synth.errors import UserError

_WIDEST_MM, _NARROWEST_MM = 300.0, 3.0
_SOFTEST_KPA, _STIFFEST_KPA = 0.05, 100.0
_JUMP = 3.0  # median intervals
_SURGICAL_N = 5.0


@dataclass(frozen=True)
class Finding:
    """One line of the answer."""

    state: str
    """`ok`, `odd` (usable, but look at it), `lack` (optional, not there) or `bad` (can't be scored)."""
    what: str
    """Which part of the recording."""
    said: str
    """What was found."""


def check_recording(folder: Path) -> list[Finding]:
    """Opens a recording, decodes its pictures and compares what its files say. Raises no UserError."""
    try:
        recording = open_recording(folder)
    except UserError as error:
        return [Finding("bad", "recording", str(error))]
    found = [Finding("odd", "files", note) for note in recording.notes]
    found += _scale(recording)
    times, size, pictures = _pictures(recording)
    found += pictures
    if size is not None:
        found += _masks(recording, size)
        found += _width(recording, size)
    return found + _sensor(recording, times) + _stiffness(recording)


def is_usable(found: list[Finding]) -> bool:
    """Whether anything can be predicted from it."""
    return all(finding.state != "bad" for finding in found)


def _scale(recording: Recording) -> list[Finding]:
    try:
        known = pixel_scale.find_scale(recording.meta, recording.folder)
    except UserError as error:
        return [Finding("bad", "scale", str(error))]
    said = f"{known.mm_per_px:.4g} mm/px ± {100 * known.uncertainty:.2g}% ({known.source})"
    return [Finding("ok", "scale", said)]


def _pictures(
    recording: Recording,
) -> tuple[NDArray[np.float64], tuple[int, int] | None, list[Finding]]:
    times: list[float] = []
    size: tuple[int, int] | None = None
    count = timeless = back = 0
    fps = recording.meta.fps
    try:
        for picture in recording.frames():
            size = size or (picture.rgb.shape[0], picture.rgb.shape[1])
            count += 1
            time = picture.time_s
            if time is None and fps is not None:
                time = picture.index / fps
            if time is None:
                timeless += 1
            elif times and time <= times[-1]:
                back += 1
            else:
                times.append(time)
    except UserError as error:
        state = "odd" if count else "bad"
        return np.array(times), size, [Finding(state, "pictures", str(error))]
    assert size is not None
    t = np.array(times)
    found = [Finding("ok", "pictures", f"{count} of {size[1]} x {size[0]} px")]
    if len(t) < 2:
        return t, size, [*found, Finding("bad", "times", "fewer than two frames have a time")]
    step = float(np.median(np.diff(t)))
    found.append(Finding("ok", "times", f"{t[-1] - t[0]:.2f} s at {1 / step:.4g} frames a second"))
    if timeless or back:
        found.append(
            Finding("odd", "times", f"{timeless} frames without a time, {back} whose time runs back")
        )
    jumps = np.flatnonzero(np.diff(t) > _JUMP * step)
    if len(jumps):
        worst = jumps[int(np.diff(t)[jumps].argmax())]
        longest = float(np.diff(t)[worst])
        found.append(
            Finding("odd", "times", f"{len(jumps)} gaps, the longest {longest:.3g} s at {t[worst]:.3g} s")
        )
    if not 0.5 <= 1 / step <= 1000:
        found.append(Finding("odd", "times", f"{1 / step:.3g} frames a second: are the times in seconds?"))
    if recording.meta.rest_frame >= count:
        found.append(
            Finding("bad", "rest frame", f"rest_frame is {recording.meta.rest_frame} of {count} frames")
        )
    return t, size, found


def _masks(recording: Recording, size: tuple[int, int]) -> list[Finding]:
    found = []
    try:
        tissue = recording.tissue_mask(size)
        if recording.tissue is None:
            found.append(Finding("lack", "tissue", "no tissue.png: the whole picture is taken for tissue"))
        elif not tissue.any():
            found.append(Finding("bad", "tissue", "tissue.png marks nothing"))
        if not recording.masks:
            found.append(
                Finding("lack", "tool", "no masks/: the instrument will be tracked as if it were tissue")
            )
        else:
            recording.tool(next(iter(recording.masks)), size)
            found.append(Finding("ok", "tool", f"{len(recording.masks)} masks"))
    except UserError as error:
        found.append(Finding("bad", "masks", str(error)))
    return found


def _width(recording: Recording, size: tuple[int, int]) -> list[Finding]:
    try:
        width = pixel_scale.find_scale(recording.meta, recording.folder).mm_per_px * size[1]
    except UserError:
        return []
    if _NARROWEST_MM <= width <= _WIDEST_MM:
        return []
    return [Finding("odd", "scale", f"the picture would be {width:.3g} mm wide: is the scale in mm/px?")]


def _sensor(recording: Recording, times: NDArray[np.float64]) -> list[Finding]:
    force, meta = recording.force, recording.meta
    if force is None:
        return [Finding("lack", "sensor", "no force.csv: predictions only")]
    t = force.time_s
    good = np.isfinite(force.force_mn).all(axis=1)
    peak = float(np.nanmax(np.linalg.norm(force.force_mn, axis=1)))
    rate = 1 / float(np.median(np.diff(t)))
    found = [Finding("ok", "sensor", f"{len(t)} rows at {rate:.4g} a second, up to {peak:.3g} mN")]
    if peak > 1000 * _SURGICAL_N:
        found.append(
            Finding("odd", "sensor", f"{peak / 1000:.3g} N is much for a brain: is force.csv in newtons?")
        )
    if peak == 0:
        found.append(Finding("odd", "sensor", "force is zero throughout"))
    if (~good).mean() > 0.05:
        found.append(Finding("odd", "sensor", f"{100 * (~good).mean():.0f}% of rows lack a force"))
    if not meta.sensor.free_s:
        found.append(Finding("lack", "sensor", "no sensor.free_s: no tare, no drift, no noise floor"))
    if len(times) > 1:
        offset = meta.sync.offset_s if meta.sync.method == "offset" else 0.0
        common = min(times[-1], t[-1] + offset) - max(times[0], t[0] + offset)
        share = max(common, 0) / (times[-1] - times[0])
        state = "ok" if share > 0.9 else "odd"
        found.append(Finding(state, "clocks", f"the sensor covers {100 * share:.0f}% of the video"))
        ratio = (t[-1] - t[0]) / (times[-1] - times[0])
        if ratio > 100 or ratio < 0.01:
            found.append(
                Finding("odd", "clocks", f"the sensor's record is {ratio:.3g} times as long: seconds?")
            )
    return found


def _stiffness(recording: Recording) -> list[Finding]:
    young = recording.meta.young_kpa
    if young is None:
        return [Finding("lack", "stiffness", "young_kpa unknown: only relative force can be had")]
    if not _SOFTEST_KPA <= young <= _STIFFEST_KPA:
        return [Finding("odd", "stiffness", f"E = {young:g} kPa: is it in kPa?")]
    return [Finding("ok", "stiffness", f"E = {young:g} kPa ± {100 * recording.meta.young_uncertainty:.2g}%")]
