"""Lag of the right camera's pictures behind the left ones, from when the rows of both change.

What moves stays in its rows of rectified pictures, whatever its depth.
"""

from __future__ import annotations

import cv2
import numpy as np

from synth.arrays import Floats, Pixels
from synth.flow import image
from synth.flow.stereo.rig import Rectified

_SMOOTH_PX = 1.5  # Gaussian blur: sensor noise changes too
_MOST, _STEP, _LEAST = 3.0, 0.25, 0.5  # lags, in frames: largest, step, smallest that counts
_BETTER = 0.75  # largest residual of another lag over that of none; late by a frame 0.4, simultaneous 0.9
_LEAST_FRAMES = 4  # from the end of the video


class StereoTiming:
    """Measures the change of each row in both cameras."""

    def __init__(self, rectified: Rectified) -> None:
        self._rectified = rectified
        self._last: list[Pixels] = []
        self._changes: list[Floats] = []  # (2, H) of each frame
        self._time_s: list[float] = []

    def add(self, left: Pixels, right: Pixels, time_s: float) -> None:
        """Adds the next frame's pictures (H, W, 3)."""
        greys = [self._rectified.picture(image.luminance(rgb), k) for k, rgb in enumerate((left, right))]
        now = [cv2.GaussianBlur(grey, (0, 0), _SMOOTH_PX) for grey in greys]
        pairs = zip(now, self._last or now, strict=True)
        self._changes.append(np.array([np.abs(picture - last).mean(axis=1) for picture, last in pairs]))
        self._last = now
        self._time_s.append(time_s)

    def find_lag_s(self) -> tuple[float, float | None]:
        """Lag [s], negative: early, 0: none or unknown; and the time [s] from which on, None: the start."""
        lag, first_frame = find_lag(*np.array(self._changes, np.float64)[1:].swapaxes(0, 1))
        if not lag:
            return 0.0, None
        step_s = float(np.median(np.diff(self._time_s)))
        return lag * step_s, self._time_s[first_frame + 1] if first_frame > _LEAST_FRAMES else None


def find_lag(left: Floats, right: Floats) -> tuple[float, int]:
    """Lag of the right camera in frames (negative: early) and its first frame, from the change of each row
    since the picture before (T, H); 0.0: none, or unknown."""
    frames = np.arange(len(left))
    if len(frames) < 2 * _LEAST_FRAMES:
        return 0.0, 0
    # Above the noise.
    left, right = (np.maximum(change - np.median(change, axis=0), 0) for change in (left, right))
    left, right = (change / max(float(np.linalg.norm(change)), 1e-9) for change in (left, right))

    def measure_difference(lag: float) -> Floats:
        """Squared difference of the cameras' changes, (T,); NaN beyond the video."""
        positions = frames - lag
        below = np.clip(positions.astype(int), 0, len(frames) - 2)
        share = (positions - below)[:, None]
        difference = np.square(right - (1 - share) * left[below] - share * left[below + 1]).sum(axis=1)
        return np.where((positions >= 0) & (positions <= frames[-1]), difference, np.nan)

    best_share, best_lag, prompt_difference = _BETTER, (0.0, 0), measure_difference(0.0)
    for lag in np.arange(-_MOST, _MOST + _STEP, _STEP):
        late_difference = measure_difference(float(lag))
        is_known = np.isfinite(late_difference)
        if abs(lag) < _LEAST or is_known.sum() < 2 * _LEAST_FRAMES or not prompt_difference[is_known].any():
            continue
        prompt, late = np.where(is_known, prompt_difference, 0.0), np.where(is_known, late_difference, 0.0)
        mixed = np.cumsum(prompt) - prompt + np.cumsum(late[::-1])[::-1]  # if late from each frame on
        first_frame = int(np.argmin(mixed[:-_LEAST_FRAMES]))
        share = float(np.sqrt(mixed[first_frame] / prompt.sum()))
        if share < best_share:
            best_share, best_lag = share, (float(lag), first_frame)
    return best_lag
