"""Detection of a clock that is not in seconds, by comparison with the recording's other clock."""

from __future__ import annotations

import numpy as np

from synth.arrays import Floats

_UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
_TIMES_AS_LONG = 100.0
_SLOW_SENSOR_S = 0.1
_SLOW_VIDEO_S = 1.0


def find_other_unit(frame_s: Floats, force_s: Floats) -> str:
    """Which clock, of frames (T,) or sensor (N,), seems not to be in seconds, in words; empty if none does.

    A sensor may run for hours next to a short video. So the longer record must be far longer, and sampled
    more slowly than such devices are: a fast sensor in milliseconds looks as if sampled about once a second.
    """
    if min(len(frame_s), len(force_s)) < 2 or min(np.ptp(frame_s), np.ptp(force_s)) <= 0:
        return ""
    ratio = float(np.ptp(force_s) / np.ptp(frame_s))
    for name, times, longer, slow in (
        ("force", force_s, ratio, _SLOW_SENSOR_S),
        ("video", frame_s, 1 / ratio, _SLOW_VIDEO_S),
    ):
        step = float(np.median(np.abs(np.diff(times))))
        if longer >= _TIMES_AS_LONG and step >= slow:
            unit = min((abs(np.log(longer * size)), unit) for unit, size in _UNITS.items())[1]
            other = "video" if name == "force" else "force"
            span = f"the {name}'s times span {longer:.3g} times those of the {other}"
            return f"{span}, {step:.3g} s apart: they look like {unit}, not seconds"
    return ""
