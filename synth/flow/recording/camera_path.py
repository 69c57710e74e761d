"""Camera motion in a video: a similarity of the picture, estimated on rigid surroundings and removed.

Corners (Shi & Tomasi, CVPR 1994) of the surroundings in the rest frame (rim, drape and bone) are tracked into
each frame (Lucas & Kanade, IJCAI 1981, in Bouguet's pyramid), and a similarity is fitted to them robustly.
Where the surroundings are too small, `shared_motion` estimates it from the tissue.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from synth.arrays import Floats, Map, Mask, Pixels
from synth.flow import image

_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.01)


class Corner:
    """Constants of the fit, chosen by hand on textures (tests/synth/flow/recording/test_camera_motion.py)."""

    corners: int = 200  # most corners
    apart_px: int = 5  # least distance of corners
    rim_px: int = 4  # margin between tissue and surroundings
    smooth_px: float = 1.0  # Gaussian blur: bilinear sampling of sharper pictures errs by up to 0.03 px
    window: tuple[int, int] = (13, 13)  # px, for local contrast and Lucas & Kanade
    far_px: float = 5.0  # length of a jump beyond which corners are searched at the shifted position
    points: int = 20  # least number of tracked corners
    rounds: int = 6  # iterations of the robust fit
    singular: float = 1e8  # condition number above which a fit is rejected
    outlier: float = 4.0  # standard deviations beyond which a corner has no weight (Tukey's biweight)
    spread_px: float = 0.03  # least standard deviation of tracked corners
    correlated: float = 3.0  # factor of the variance, for correlated errors of neighbouring corners
    uncertain_px: float = 0.15  # largest standard deviation of the shift of the tissue
    unlike: float = 0.1  # relative difference of near and far surroundings above which they deform
    still_px: float = 0.05  # least shift of a moving camera
    sure: float = 4.0  # least shift in standard deviations


@dataclass(frozen=True, eq=False)
class Similarity:
    """Shift, rotation and scale of a picture relative to the rest frame."""

    matrix: Floats  # (2, 3): from pixels of the rest frame to pixels of the picture
    deviation_px: float = 0.0  # standard deviation of the shift over the tissue
    length_px: float = 0.0  # root mean square of the shift over the tissue

    def undo(self, picture: Pixels) -> Pixels:
        """Resamples a picture (H, W[, C]) uint8 to the view of the camera at rest."""
        x, y = map(_unbiased, self._places(picture.shape))
        found = cv2.remap(picture, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(found, np.uint8)

    def outside(self, size: tuple[int, ...]) -> Mask:
        """Mask (H, W) of the pixels of the rest frame that are outside the moved picture."""
        x, y = self._places(size)
        return (x < 0) | (y < 0) | (x > size[1] - 1) | (y > size[0] - 1)

    def _places(self, size: tuple[int, ...]) -> list[Map]:
        x, y = np.arange(size[1]), np.arange(size[0])[:, None]
        return [(a * x + b * y + c).astype(np.float32) for a, b, c in self.matrix]

    def steady(self, flow: Map) -> Map:
        """Removes the camera motion from a flow (H, W, 2) px from the rest frame."""
        y, x = np.mgrid[: flow.shape[0], : flow.shape[1]].astype(np.float32)
        back = cv2.invertAffineTransform(self.matrix).astype(np.float32)
        at = flow + np.dstack([x, y])
        return np.asarray(at @ back[:, :2].T + back[:, 2] - np.dstack([x, y]), np.float32)

    def distance_px(self, other: Similarity | None, size: tuple[int, ...]) -> float:
        """Root mean square difference of two shifts over a picture (H, W) [px]; None: no camera motion."""
        matrix = self.matrix - (np.eye(2, 3) if other is None else other.matrix)
        y, x = np.mgrid[: size[0] : 8, : size[1] : 8]
        shift = np.column_stack([x.ravel(), y.ravel()]) @ matrix[:, :2].T + matrix[:, 2]
        return float(np.sqrt(np.square(shift).sum(axis=1).mean()))


@dataclass(frozen=True, eq=False)
class CameraPath:
    """Camera motion over a recording."""

    time_s: Floats  # (T,), increasing
    found: tuple[Similarity | None, ...]  # at these times; None: no camera motion since the rest frame

    def at(self, time_s: float) -> Similarity | None:
        """Camera motion at a time; between frames that of the previous frame."""
        known = int(np.searchsorted(self.time_s, time_s, side="right"))
        return self.found[known - 1] if known else None


class SimilarityBasis:
    """Small similarities about the middle of a picture as four parameters [px]: shift in x and y, and the
    shifts by scale and rotation at a distance of half the width."""

    def __init__(self, size: tuple[int, ...]) -> None:
        """`size`: (H, W) of the picture."""
        self._centre, self._unit = np.array(size[::-1]) / 2, size[1] / 2

    def design(self, at: Floats) -> Floats:
        """(2 N, 4) derivatives of the shifts in x and y at places (N, 2) px by the parameters."""
        x, y = ((at - self._centre) / self._unit).T
        one, nothing = np.ones_like(x), np.zeros_like(x)
        return np.column_stack([one, nothing, x, -y, nothing, one, y, x]).reshape(-1, 4)

    def matrix(self, parameters: Floats) -> Floats:
        """(2, 3): from pixels of the rest frame to pixels of the picture."""
        x, y, larger, turned = parameters / np.array([1, 1, self._unit, self._unit])
        linear = np.array([[1 + larger, -turned], [turned, 1 + larger]])
        return np.column_stack([linear, self._centre - linear @ self._centre + (x, y)])


Course = list[tuple[float, Similarity, float]]
"""Time [s], camera motion since the rest frame, and motion since the previous frame [px]."""


def describe_course(course: Course, shrink: int) -> str:
    """A sentence on the camera motion, in pixels of the video before downsampling by `shrink`."""
    time_s, found, step = zip(*course, strict=True)
    most, sudden = max(one.length_px for one in found), int(np.argmax(step))
    sure = np.array([one.deviation_px for one in found])
    text = f"the camera moved by up to {shrink * most:.2g} px from {time_s[0]:.3g} s on, with the largest "
    text += f"step of {shrink * step[sudden]:.2g} px at {time_s[sudden]:.3g} s; "
    text += f"this is removed to ± {shrink * np.median(sure):.1g} px"
    return text + (f", at worst ± {shrink * sure.max():.1g} px" if sure.max() > 2 * np.median(sure) else "")


class CameraTracker:
    """Estimates the camera motion since the rest frame, frame by frame."""

    def __init__(self, rest: Pixels, tissue: Mask, blocked: Mask) -> None:
        """Starts at the rest frame (H, W, 3); masks (H, W): `tissue` may deform; `blocked`: tool, glare."""
        self._basis = SimilarityBasis(tissue.shape)
        self._rest = _contrast(rest)
        element = np.ones((2 * Corner.rim_px + 1,) * 2, np.uint8)
        near, hidden = (cv2.dilate(one.astype(np.uint8), element) > 0 for one in (tissue, blocked))
        free = (~near & ~hidden).astype(np.uint8)
        how = Corner.corners, 0.01, Corner.apart_px
        found = cv2.goodFeaturesToTrack(self._rest, *how, mask=free, blockSize=7)
        self._points = np.zeros((0, 2), np.float32) if found is None else found[:, 0]  # (N, 2) px
        self.is_blind = len(self._points) < Corner.points  # too little surroundings in the rest frame
        rows, columns = np.nonzero(tissue)
        some = slice(None, None, max(1, len(rows) // 100))
        self._tissue = np.column_stack([columns, rows])[some].astype(np.float64)
        self._last: Similarity | None = None
        self._unknown_s: list[float] = []
        self._course: Course = []

    def find(self, rgb: Pixels, time_s: float | None) -> Similarity | None:
        """Camera motion in a frame (H, W, 3) uint8, else in the previous one; None: none since rest."""
        now = _contrast(rgb)
        last = self._last
        before = last or Similarity(np.eye(2, 3))
        found = self._find(now, before)
        if found is None and self._length((jump := self._jump(now)) - before.matrix) > Corner.far_px:
            found = self._find(now, Similarity(jump))
        if found is None:
            self._unknown_s.append(time_s or 0.0)
            if last is not None:
                self._last = replace(last, deviation_px=float(np.hypot(last.deviation_px, self._usual_px())))
        # The threshold holds only for the first motion.
        elif last is not None or found.length_px > max(Corner.still_px, Corner.sure * found.deviation_px):
            step = self._length(found.matrix - before.matrix)
            self._course.append((time_s or 0.0, found, step))
            if last is not None and step < Corner.sure * found.deviation_px:
                # A step within the error, as during a large contact, is shrunk towards the usual step.
                share = 1 / (1 + (found.deviation_px / max(self._usual_px(), 1e-3)) ** 2)
                found = replace(found, matrix=last.matrix + share * (found.matrix - last.matrix))
            self._last = found
        return self._last

    def describe(self, shrink: int) -> list[str]:
        """Sentences on the camera motion, in pixels of the video before downsampling by `shrink`."""
        if not self._course:
            return []
        time_s, text = self._course[0][0], describe_course(self._course, shrink)
        if unknown := [time for time in self._unknown_s if time > time_s]:
            text += f"; in {len(unknown)} frames, from {unknown[0]:.3g} s on, it could not be estimated"
        return [text]

    def _usual_px(self) -> float:
        """Median step from frame to frame [px]."""
        return float(np.median([step for *_, step in self._course]))

    def _jump(self, now: Pixels) -> Floats:
        """Shift (2, 3) of the whole picture, of any length, by phase correlation."""
        first, second = (one.astype(np.float32) for one in (self._rest, now))
        shift, _ = cv2.phaseCorrelate(first, second, cv2.createHanningWindow(now.shape[::-1], cv2.CV_32F))
        return np.column_stack([np.eye(2), shift])

    def _find(self, now: Pixels, near: Similarity) -> Similarity | None:
        """Similarity of the surroundings, started at `near`; None: too few corners, or they deform."""
        points = self._points
        if self.is_blind:
            return None
        start = (points @ near.matrix[:, :2].T + near.matrix[:, 2]).astype(np.float32)
        how = None, None, Corner.window, 3, _STOP, cv2.OPTFLOW_USE_INITIAL_FLOW
        there, status, _ = cv2.calcOpticalFlowPyrLK(self._rest, now, points, start, *how)
        known = (status[:, 0] > 0) & ((there > 3) & (there < np.array(now.shape[::-1]) - 4)).all(axis=1)
        if known.sum() < Corner.points:
            return None
        at, shift = points[known].astype(np.float64), (there - points)[known].astype(np.float64)
        guess, _ = cv2.estimateAffinePartial2D(at, at + shift, ransacReprojThreshold=0.5)
        if guess is None:
            return None
        design, parameters = self._basis.design(at), np.zeros(4)
        left = at + shift - (at @ guess[:, :2].T + guess[:, 2])
        for _ in range(Corner.rounds):
            off = np.linalg.norm(left, axis=1)
            weight, spread = weigh_outliers(off, off)
            weighed = np.repeat(weight, 2)[:, None] * design
            normal = weighed.T @ design
            if weight.sum() < Corner.points / 2 or np.linalg.cond(normal) > Corner.singular:
                return None
            parameters = np.linalg.solve(normal, weighed.T @ shift.ravel())
            left = shift - (design @ parameters).reshape(-1, 2)
        tissue = self._basis.design(self._tissue)
        leverage = ((tissue @ np.linalg.inv(normal)) * tissue).sum(axis=1).mean()
        variance = Corner.correlated * spread**2 * 2 * leverage
        matrix = self._basis.matrix(parameters)
        length = self._length(matrix - np.eye(2, 3))
        # Surroundings that move more near the tissue than far from it are tissue outside the mask.
        away = np.linalg.norm(at - self._tissue.mean(axis=0), axis=1)
        close, far = (
            (weight[:, None] * left)[half].sum(axis=0) / weight[half].sum()
            for half in (away < np.median(away), away >= np.median(away))
        )
        deforms = np.linalg.norm(close - far) > max(Corner.unlike * length, Corner.still_px)
        if deforms or variance > Corner.uncertain_px**2:
            return None
        return Similarity(matrix, float(np.sqrt(variance)), length)

    def _length(self, matrix: Floats) -> float:
        """Root mean square of a shift (2, 3) over the tissue [px]."""
        return float(np.sqrt(np.square(self._tissue @ matrix[:, :2].T + matrix[:, 2]).sum(axis=1).mean()))


def weigh_outliers(off: Floats, typical: Floats) -> tuple[Floats, float]:
    """Tukey's biweight (N,) of distances [px], and a component's standard deviation from `typical` ones."""
    spread = max(float(np.median(typical)) / 1.18, Corner.spread_px)  # Rayleigh's median
    return np.maximum(1 - (off / (Corner.outlier * spread)) ** 2, 0) ** 2, spread


def _contrast(rgb: Pixels) -> Pixels:
    """Local contrast (H, W) of a frame."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return image.local_contrast(cv2.GaussianBlur(grey, (0, 0), Corner.smooth_px), Corner.window)


def _unbiased(place: Map) -> Map:
    """Sampling position at which OpenCV's cubic kernel (a = -3/4) reproduces a ramp at `place` [px].

    At a fraction t of a pixel it returns the ramp at t + (a + 1/2) 2 t (1 - t) (2t - 1), up to 0.05 px off.
    """
    part = sampled = place - np.floor(place)
    for _ in range(2):
        sampled = part + 0.5 * sampled * (1 - sampled) * (2 * sampled - 1)
    return np.asarray(place - part + sampled, np.float32)
