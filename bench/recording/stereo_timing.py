"""Lag of the right camera's pictures behind the left ones, from the motion that both show.

In rectified pictures the vertical motion is equal and the horizontal motion nearly so: a millimetre towards
the camera changes the disparity by less than a tenth of the shift from a millimetre across the view. So
corners (Shi & Tomasi, CVPR 1994) are tracked in each camera (Lucas & Kanade, IJCAI 1981, in Bouguet's
pyramid), and the right camera's motion is compared with the left camera's at other times.
"""

from __future__ import annotations

import cv2
import numpy as np

from synth.arrays import Floats, Map, Mask, Pixels
from synth.flow import image
from synth.flow.stereo.track import StereoTracker

Motion = Floats  # (T, P, 2) px of P points since the rest frame, the first; NaN: not tracked

_CORNERS, _APART_PX, _LEAST_POINTS = 200, 5, 8
_WINDOW = (13, 13)
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)
_BACK_PX = 0.5  # largest forward-backward error of a tracked corner
_MOST, _STEP, _LEAST = 3.0, 0.25, 0.5  # lags, in frames: largest, step, smallest that counts
_MOVING, _MOVED_PX = 0.4, 0.3  # motion of the corners used, as a share of the largest motion and at least
_BETTER = 0.75  # largest residual of another lag over that of none; 0.98 and more if simultaneous
_LEAST_FRAMES = 4  # from the end of the video


class StereoTiming:
    """Tracks the tissue's corners in both cameras."""

    def __init__(self, stereo: StereoTracker, left: Pixels, right: Pixels, usable: Mask) -> None:
        """The rest pictures (H, W, 3); `usable`: (H, W) tissue in the left picture."""
        self._rectified = r = stereo.rectified
        self._rest = [self._picture(rgb, camera) for camera, rgb in enumerate((left, right))]
        mask = (r.flags(usable, 0) & stereo.rest.found).astype(np.uint8)
        corners = cv2.goodFeaturesToTrack(
            self._rest[0], _CORNERS, 0.01, _APART_PX, mask=mask, blockSize=_WINDOW[0] // 2
        )
        at = np.zeros((0, 2), np.float32) if corners is None else np.asarray(corners[:, 0], np.float32)
        x, y = np.rint(at).astype(int).T
        in_right = at - np.column_stack([stereo.rest.disparity[y, x], np.zeros(len(at))])
        self._at: list[Map] = [at, in_right.astype(np.float32)]
        self._last = list(self._at)
        self._moved: list[list[Map]] = [[np.zeros_like(at)] for _ in range(2)]
        self._time_s = [0.0]

    def add(self, left: Pixels, right: Pixels, time_s: float) -> None:
        """Adds the next frame's pictures (H, W, 3)."""
        if len(self._at[0]) < _LEAST_POINTS:
            return
        how = None, None, _WINDOW, 3, _STOP, cv2.OPTFLOW_USE_INITIAL_FLOW
        for camera, rgb in enumerate((left, right)):
            rest, now, at = self._rest[camera], self._picture(rgb, camera), self._at[camera]
            there, good, _ = cv2.calcOpticalFlowPyrLK(rest, now, at, self._last[camera].copy(), *how)
            back, _, _ = cv2.calcOpticalFlowPyrLK(now, rest, there, at.copy(), *how)
            known = (np.linalg.norm(back - at, axis=1) < _BACK_PX) & (good[:, 0] > 0)
            self._last[camera] = np.where(known[:, None], there, self._last[camera]).astype(np.float32)
            self._moved[camera].append(np.where(known[:, None], there - at, np.nan))
        self._time_s.append(time_s)

    def find_lag_s(self) -> tuple[float, float | None]:
        """Lag [s], negative: early, 0: none or unknown; and the time [s] from which on, None: the start."""
        lag, since = find_lag(*(np.array(moved, np.float64) for moved in self._moved))
        if not lag:
            return 0.0, None
        step_s = float(np.median(np.diff(self._time_s)))
        return lag * step_s, self._time_s[since] if since > _LEAST_FRAMES else None

    def _picture(self, rgb: Pixels, camera: int) -> Pixels:
        """Local contrast of the rectified picture, (H, W)."""
        grey = cv2.GaussianBlur(self._rectified.picture(rgb @ image.GREY, camera), (0, 0), 1)
        return image.local_contrast(grey, _WINDOW)


def find_lag(left: Motion, right: Motion) -> tuple[float, int]:
    """Lag of the right camera in frames (negative: early) and its first frame; 0.0: none, or unknown."""
    frames = np.arange(len(left))
    known = np.isfinite(left + right).all(axis=2)
    length = np.linalg.norm(np.where(np.isfinite(left + right), left, 0), axis=2)
    length = np.where(known.mean(axis=0) > 0.5, np.percentile(length, 90, axis=0), 0)
    if len(frames) < 2 * _LEAST_FRAMES or not len(length):
        return 0.0, 0
    moving = length > max(_MOVING * float(np.percentile(length, 90)), _MOVED_PX)
    left, right = left[:, moving], right[:, moving]

    def apart(lag: float) -> Floats:
        """Median squared difference of the cameras' motions, (T,); NaN beyond the video."""
        at = np.maximum(frames - lag, 0)
        below = np.minimum(at.astype(int), len(frames) - 2)
        share = (at - below)[:, None, None]
        off = np.square(right - (1 - share) * left[below] - share * left[below + 1]).sum(axis=2)
        found = np.isfinite(off).sum(axis=1) >= _LEAST_POINTS
        return np.array(
            [
                np.nanmedian(one) if enough and inside else np.nan
                for one, enough, inside in zip(off, found, at <= frames[-1], strict=True)
            ]
        )

    best, answer, now = _BETTER, (0.0, 0), apart(0.0)
    for lag in np.arange(-_MOST, _MOST + _STEP, _STEP):
        other = apart(float(lag))
        both = np.isfinite(now) & np.isfinite(other)
        if abs(lag) < _LEAST or both.sum() < 2 * _LEAST_FRAMES or not now[both].any():
            continue
        prompt, late = np.where(both, now, 0.0), np.where(both, other, 0.0)
        mixed = np.cumsum(prompt) - prompt + np.cumsum(late[::-1])[::-1]  # if late from each frame on
        since = 1 + int(np.argmin(mixed[1:-_LEAST_FRAMES]))
        share = float(np.sqrt(mixed[since] / prompt.sum()))
        if share < best:
            best, answer = share, (float(lag), since)
    return answer
