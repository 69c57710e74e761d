"""The camera's own motion in a film: a similarity of the picture, found on what doesn't deform, and undone.

A microscope is bumped, sways, zooms and turns, and a method takes that for the tissue's motion. Corners (Shi
& Tomasi, CVPR 1994) of the rest frame's surroundings, rim, drape and bone, are followed into each frame
(Lucas & Kanade, IJCAI 1981, in Bouguet's pyramid), and a similarity is fitted to them, robustly. Where too
little of the surroundings shows, the tissue's own corners are taken too: what most of them share is the
camera's, for a contact's motion falls with distance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from synth.flow.estimator import Flags, Rgb

Floats = NDArray[np.float64]

_CORNERS, _APART_PX, _RIM_PX = 200, 5, 4  # the rim between tissue and surroundings may show either
_SMOOTH_PX = 1.0  # bilinear sampling of sharper pictures is off by up to 0.03 px
_FLOOR, _GREY = 3.0, 32.0  # of local contrast, as in `synth.flow.opencv`
_WINDOW = (13, 13)
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.01)
_FAR_PX = 5.0  # of jumps beyond that many corners are lost
_LEAST_POINTS, _ROUNDS, _SINGULAR = 20, 6, 1e8
_OUTLIER = 4.0  # standard deviations from which on a corner counts nothing (Tukey's biweight)
_LEAST_SPREAD_PX = 0.03  # of followed corners
_TOGETHER = 3.0  # neighbouring corners err alike: so many count as one
_UNCERTAIN_PX = 0.15  # deviation over the tissue from which on corners show too little
_UNLIKE = 0.1  # of the motion, by which surroundings near and far differ that deform
_STILL_PX, _SURE = 0.05, 4.0  # motion of less, or of so few deviations, is a still camera's
_SHARED, _LEFT_OVER = 0.6, 0.25  # of the corners have less than this of the motion left, if it is a camera's
_LEAST_SHARED_PX, _NEAR_PX = (
    0.3,
    0.5,
)  # of the first such motion; what is nearer to rest is judged as if so far


@dataclass(frozen=True, eq=False)
class Similarity:
    """How a picture is shifted, turned and scaled against the rest frame's."""

    matrix: Floats
    """(2, 3): from the rest frame's pixels to the picture's."""
    deviation_px: float = 0.0
    """Standard deviation of the shift that it gives the tissue."""
    length_px: float = 0.0
    """Root mean square of that shift."""

    def undo(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """A picture (H, W[, C]) uint8 as a camera at rest would have taken it."""
        x, y = map(_unbiased, self._places(picture.shape))
        return np.asarray(
            cv2.remap(picture, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), np.uint8
        )

    def outside(self, size: tuple[int, ...]) -> Flags:
        """(H, W) what of the rest frame's picture the moved camera doesn't show."""
        x, y = self._places(size)
        return (x < 0) | (y < 0) | (x > size[1] - 1) | (y > size[0] - 1)

    def _places(self, size: tuple[int, ...]) -> list[NDArray[np.float32]]:
        x, y = np.arange(size[1]), np.arange(size[0])[:, None]
        return [(a * x + b * y + c).astype(np.float32) for a, b, c in self.matrix]


class CameraTracker:
    """The camera's motion since the rest frame, frame by frame."""

    def __init__(self, rest: Rgb, tissue: Flags, blocked: Flags) -> None:
        """Starts at the rest frame (H, W, 3); `tissue`: (H, W) may deform; `blocked`: (H, W) tool, glare."""
        self._centre, self._unit = np.array(tissue.shape[::-1]) / 2, tissue.shape[1] / 2
        self._rest = _contrast(rest)
        element = np.ones((2 * _RIM_PX + 1, 2 * _RIM_PX + 1), np.uint8)
        near, hidden = (cv2.dilate(one.astype(np.uint8), element) > 0 for one in (tissue, blocked))
        outer, inner = (_corners(self._rest, where & ~hidden) for where in (~near, near))
        self._points = {False: outer, True: np.concatenate([outer, inner])}  # by whether most must share it
        rows, columns = np.nonzero(tissue)
        some = slice(None, None, max(1, len(rows) // 100))
        self._tissue = np.column_stack([columns, rows])[some].astype(np.float64)
        self._last: Similarity | None = None
        self._unknown_s: list[float] = []
        self._deforms = False
        # Time, where, and how far from where it was in the frame before.
        self._course: list[tuple[float, Similarity, float]] = []

    def find(self, rgb: Rgb, time_s: float | None) -> Similarity | None:
        """Where the camera is in a frame (H, W, 3) uint8; None: it has stood still since the rest frame.

        Where that can't be told, it is where it was in the frame before.
        """
        now = _contrast(rgb)
        last = self._last
        before = last or Similarity(np.eye(2, 3))
        found = self._find(now, before)
        if found is None and self._length((jump := self._jump(now)) - before.matrix) > _FAR_PX:
            found = self._find(now, Similarity(jump))
        if found is None:
            self._unknown_s.append(time_s or 0.0)
            if last is not None:
                self._last = replace(last, deviation_px=float(np.hypot(last.deviation_px, self._usual_px())))
        # Once it has moved, what is less is still more than nothing.
        elif last is not None or found.length_px > max(_STILL_PX, _SURE * found.deviation_px):
            step = self._length(found.matrix - before.matrix)
            self._course.append((time_s or 0.0, found, step))
            if last is not None and step < _SURE * found.deviation_px:
                # No more than it may err by, as where a contact moves much: it goes on as it usually does.
                share = 1 / (1 + (found.deviation_px / max(self._usual_px(), 1e-3)) ** 2)
                found = replace(found, matrix=last.matrix + share * (found.matrix - last.matrix))
            self._last = found
        return self._last

    def describe(self, shrink: int) -> list[str]:
        """How it moved, in pixels of a film that is `shrink` times larger than the pictures here."""
        if not self._course:
            return []
        time_s, found, step = zip(*self._course, strict=True)
        most, sudden = max(one.length_px for one in found), int(np.argmax(step))
        sure = float(np.median([one.deviation_px for one in found]))
        said = (
            f"the camera moved by up to {shrink * most:.2g} px, from {time_s[0]:.3g} s on, most at once at "
        )
        said += (
            f"{time_s[sudden]:.3g} s, {shrink * step[sudden]:.2g} px: taken off to ± {shrink * sure:.1g} px"
        )
        if unknown := [time for time in self._unknown_s if time > time_s[0]]:
            said += f"; in {len(unknown)} frames, from {unknown[0]:.3g} s on, nothing shows where it is"
        return [said]

    def _usual_px(self) -> float:
        """How far it moves from frame to frame."""
        return float(np.median([step for *_, step in self._course]))

    def _jump(self, now: NDArray[np.uint8]) -> Floats:
        """(2, 3) the shift of the whole picture, however far (phase correlation)."""
        first, second = (one.astype(np.float32) for one in (self._rest, now))
        shift, _ = cv2.phaseCorrelate(first, second, cv2.createHanningWindow(now.shape[::-1], cv2.CV_32F))
        return np.column_stack([np.eye(2), shift])

    def _find(self, now: NDArray[np.uint8], near: Similarity) -> Similarity | None:
        """A similarity near another: of the surroundings, else of all; None where the surroundings deform."""
        self._deforms = False
        found = self._fit(now, near, False)
        return found if found or self._deforms else self._fit(now, near, True)

    def _fit(self, now: NDArray[np.uint8], near: Similarity, shared: bool) -> Similarity | None:
        """A similarity near another of the surroundings' corners; `shared`: of all, and most must have it."""
        points = self._points[shared]
        if len(points) < _LEAST_POINTS:
            return None
        start = (points @ near.matrix[:, :2].T + near.matrix[:, 2]).astype(np.float32)
        how = None, None, _WINDOW, 3, _STOP, cv2.OPTFLOW_USE_INITIAL_FLOW
        there, status, _ = cv2.calcOpticalFlowPyrLK(self._rest, now, points, start, *how)
        known = (status[:, 0] > 0) & ((there > 3) & (there < np.array(now.shape[::-1]) - 4)).all(axis=1)
        if known.sum() < _LEAST_POINTS:
            return None
        at, shift = points[known].astype(np.float64), (there - points)[known].astype(np.float64)
        guess, _ = cv2.estimateAffinePartial2D(at, at + shift, ransacReprojThreshold=0.5)
        if guess is None:
            return None
        design, answer = self._design(at), np.zeros(4)
        left = at + shift - (at @ guess[:, :2].T + guess[:, 2])
        for _ in range(_ROUNDS):
            off = np.linalg.norm(left, axis=1)
            spread = max(float(np.median(off)) / 1.18, _LEAST_SPREAD_PX)  # Rayleigh's median
            weight = np.maximum(1 - (off / (_OUTLIER * spread)) ** 2, 0) ** 2
            weighed = np.repeat(weight, 2)[:, None] * design
            normal = weighed.T @ design
            if weight.sum() < _LEAST_POINTS / 2 or np.linalg.cond(normal) > _SINGULAR:
                return None
            answer = np.linalg.solve(normal, weighed.T @ shift.ravel())
            left = shift - (design @ answer).reshape(-1, 2)
        tissue = self._design(self._tissue)
        variance = _TOGETHER * spread**2 * 2 * ((tissue @ np.linalg.inv(normal)) * tissue).sum(axis=1).mean()
        x, y, larger, turned = answer / np.array([1, 1, self._unit, self._unit])
        linear = np.array([[1 + larger, -turned], [turned, 1 + larger]])
        matrix = np.column_stack([linear, self._centre - linear @ self._centre + (x, y)])
        length = self._length(matrix - np.eye(2, 3))
        # What moves more beside the tissue than far from it is tissue that the mask leaves out.
        away = np.linalg.norm(at - self._tissue.mean(axis=0), axis=1)
        beside = away < np.median(away)
        apart = [
            (weight[:, None] * left)[half].sum(axis=0) / weight[half].sum() for half in (beside, ~beside)
        ]
        self._deforms = not shared and bool(
            np.linalg.norm(apart[0] - apart[1]) > max(_UNLIKE * length, _STILL_PX)
        )
        if self._deforms:
            return None
        most = float(np.quantile(np.linalg.norm(left, axis=1), _SHARED)) if shared else 0.0
        least, near_px = (_LEAST_SHARED_PX * shared, 0.0) if self._last is None else (0.0, _NEAR_PX)
        if variance > _UNCERTAIN_PX**2 or length < least or most > _LEFT_OVER * max(length, near_px):
            return None
        # The half of what is left may be a contact's, and in it.
        return Similarity(matrix, float(np.sqrt(variance + most**2 / 4)), length)

    def _length(self, matrix: Floats) -> float:
        """Root mean square over the tissue of a shift (2, 3) [px]."""
        return float(np.sqrt(np.square(self._tissue @ matrix[:, :2].T + matrix[:, 2]).sum(axis=1).mean()))

    def _design(self, at: Floats) -> Floats:
        """(2 N, 4) x and y of the shifts at places (N, 2) px by one px in x and y, of scale and of turn."""
        x, y = ((at - self._centre) / self._unit).T
        one, nothing = np.ones_like(x), np.zeros_like(x)
        return np.column_stack([one, nothing, x, -y, nothing, one, y, x]).reshape(-1, 4)


def _contrast(rgb: Rgb) -> NDArray[np.uint8]:
    """(H, W) local contrast about 128: gain and offset of the light are taken out."""
    grey = cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), _SMOOTH_PX)
    detail = grey - cv2.blur(grey, _WINDOW)
    # A blur's running sums may end below 0 where a picture is blank.
    spread = np.sqrt(np.maximum(cv2.blur(detail * detail, _WINDOW), 0)) + _FLOOR
    return np.asarray(np.clip(128 + _GREY * detail / spread, 0, 255), np.uint8)


def _corners(picture: NDArray[np.uint8], where: Flags) -> NDArray[np.float32]:
    """(N, 2) px."""
    mask = where.astype(np.uint8) * 255
    found = cv2.goodFeaturesToTrack(picture, _CORNERS, 0.01, _APART_PX, mask=mask, blockSize=7)
    return np.zeros((0, 2), np.float32) if found is None else np.asarray(found[:, 0], np.float32)


def _unbiased(place: NDArray[np.float32]) -> NDArray[np.float32]:
    """Where OpenCV's cubic kernel (a = -3/4) has to be asked to answer a ramp at `place` [px] rightly.

    It answers at t + (a + 1/2) 2 t (1 - t) (2t - 1) of a pixel instead of t: off by up to 0.05 px.
    """
    part = asked = place - np.floor(place)
    for _ in range(2):
        asked = part + 0.5 * asked * (1 - asked) * (2 * asked - 1)
    return np.asarray(place - part + asked, np.float32)
