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

    max_corners: int = 200  # most corners
    min_distance_px: int = 5  # least distance of corners
    margin_px: int = 4  # margin between tissue and surroundings
    smooth_px: float = 1.0  # Gaussian blur: bilinear sampling of sharper pictures errs by up to 0.03 px
    window: tuple[int, int] = (13, 13)  # px, for local contrast and Lucas & Kanade
    large_jump_px: float = 5.0  # length of a jump beyond which corners are searched at the shifted position
    min_points: int = 20  # least number of tracked corners
    iterations: int = 6  # iterations of the robust fit
    max_condition: float = 1e8  # condition number above which a fit is rejected
    outlier_sigmas: float = 4.0  # standard deviations beyond which a corner has no weight (Tukey's biweight)
    min_spread_px: float = 0.03  # least standard deviation of tracked corners
    variance_factor: float = 3.0  # factor of the variance, for correlated errors of neighbouring corners
    max_deviation_px: float = 0.15  # largest standard deviation of the shift of the tissue
    max_mismatch: float = 0.1  # relative difference of near and far surroundings above which they deform
    min_motion_px: float = 0.05  # least shift of a moving camera
    min_sigmas: float = 4.0  # least shift in standard deviations


@dataclass(frozen=True, eq=False)
class Similarity:
    """Shift, rotation and scale of a picture relative to the rest frame."""

    matrix: Floats  # (2, 3): from pixels of the rest frame to pixels of the picture
    deviation_px: float = 0.0  # standard deviation of the shift over the tissue
    length_px: float = 0.0  # root mean square of the shift over the tissue

    def undo(self, picture: Pixels) -> Pixels:
        """Resamples a picture (H, W[, C]) uint8 to the view of the camera at rest."""
        x, y = map(_compensate_bias, self._map_pixels(picture.shape))
        resampled = cv2.remap(picture, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(resampled, np.uint8)

    def outside(self, size: tuple[int, ...]) -> Mask:
        """Mask (H, W) of the pixels of the rest frame that are outside the moved picture."""
        x, y = self._map_pixels(size)
        return (x < 0) | (y < 0) | (x > size[1] - 1) | (y > size[0] - 1)

    def _map_pixels(self, size: tuple[int, ...]) -> list[Map]:
        x, y = np.arange(size[1]), np.arange(size[0])[:, None]
        return [(a * x + b * y + c).astype(np.float32) for a, b, c in self.matrix]

    def steady(self, flow: Map) -> Map:
        """Removes the camera motion from a flow (H, W, 2) px from the rest frame."""
        y, x = np.mgrid[: flow.shape[0], : flow.shape[1]].astype(np.float32)
        inverse = cv2.invertAffineTransform(self.matrix).astype(np.float32)
        positions = flow + np.dstack([x, y])
        return np.asarray(positions @ inverse[:, :2].T + inverse[:, 2] - np.dstack([x, y]), np.float32)

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
    similarities: tuple[Similarity | None, ...]  # at these times; None: no camera motion since the rest frame

    def at(self, time_s: float) -> Similarity | None:
        """Camera motion at a time; between frames that of the previous frame."""
        known = int(np.searchsorted(self.time_s, time_s, side="right"))
        return self.similarities[known - 1] if known else None


class SimilarityBasis:
    """Small similarities about the middle of a picture as four parameters [px]: shift in x and y, and the
    shifts by scale and rotation at a distance of half the width."""

    def __init__(self, size: tuple[int, ...]) -> None:
        """`size`: (H, W) of the picture."""
        self._centre, self._unit = np.array(size[::-1]) / 2, size[1] / 2

    def design(self, positions: Floats) -> Floats:
        """(2 N, 4) derivatives of the shifts in x and y at places (N, 2) px by the parameters."""
        x, y = ((positions - self._centre) / self._unit).T
        ones, zeros = np.ones_like(x), np.zeros_like(x)
        return np.column_stack([ones, zeros, x, -y, zeros, ones, y, x]).reshape(-1, 4)

    def matrix(self, parameters: Floats) -> Floats:
        """(2, 3): from pixels of the rest frame to pixels of the picture."""
        x, y, scale, rotation = parameters / np.array([1, 1, self._unit, self._unit])
        linear = np.array([[1 + scale, -rotation], [rotation, 1 + scale]])
        return np.column_stack([linear, self._centre - linear @ self._centre + (x, y)])


Course = list[tuple[float, Similarity, float]]
"""Time [s], camera motion since the rest frame, and motion since the previous frame [px]."""


def describe_course(course: Course, shrink: int) -> str:
    """A sentence on the camera motion, in pixels of the video before downsampling by `shrink`."""
    time_s, similarities, steps = zip(*course, strict=True)
    peak_px, jump = max(similarity.length_px for similarity in similarities), int(np.argmax(steps))
    deviations_px = np.array([similarity.deviation_px for similarity in similarities])
    text = f"the camera moved by up to {shrink * peak_px:.2g} px from {time_s[0]:.3g} s on, with the largest "
    text += f"step of {shrink * steps[jump]:.2g} px at {time_s[jump]:.3g} s; "
    text += f"this is removed to ± {shrink * np.median(deviations_px):.1g} px"
    largest_px = deviations_px.max()
    is_uneven = largest_px > 2 * np.median(deviations_px)
    return text + (f", at worst ± {shrink * largest_px:.1g} px" if is_uneven else "")


class CameraTracker:
    """Estimates the camera motion since the rest frame, frame by frame."""

    def __init__(self, rest: Pixels, tissue: Mask, blocked: Mask) -> None:
        """Starts at the rest frame (H, W, 3); masks (H, W): `tissue` may deform; `blocked`: tool, glare."""
        self._basis = SimilarityBasis(tissue.shape)
        self._rest = _contrast(rest)
        element = np.ones((2 * Corner.margin_px + 1,) * 2, np.uint8)
        tissue_margin, hidden = (cv2.dilate(mask.astype(np.uint8), element) > 0 for mask in (tissue, blocked))
        free = (~tissue_margin & ~hidden).astype(np.uint8)
        options = Corner.max_corners, 0.01, Corner.min_distance_px
        corners = cv2.goodFeaturesToTrack(self._rest, *options, mask=free, blockSize=7)
        self._points = np.zeros((0, 2), np.float32) if corners is None else corners[:, 0]  # (N, 2) px
        self.is_blind = len(self._points) < Corner.min_points  # too little surroundings in the rest frame
        rows, columns = np.nonzero(tissue)
        stride = slice(None, None, max(1, len(rows) // 100))
        self._tissue = np.column_stack([columns, rows])[stride].astype(np.float64)
        self._last: Similarity | None = None
        self._unknown_s: list[float] = []
        self._course: Course = []

    def find(self, rgb: Pixels, time_s: float | None) -> Similarity | None:
        """Camera motion in a frame (H, W, 3) uint8, else in the previous one; None: none since rest."""
        now = _contrast(rgb)
        last = self._last
        before = last or Similarity(np.eye(2, 3))
        similarity = self._fit_surroundings(now, before)
        if similarity is None:
            jump = self._measure_jump(now)
            if self._length(jump - before.matrix) > Corner.large_jump_px:
                similarity = self._fit_surroundings(now, Similarity(jump))
        if similarity is None:
            self._unknown_s.append(time_s or 0.0)
            if last is not None:
                deviation_px = float(np.hypot(last.deviation_px, self._median_step_px()))
                self._last = replace(last, deviation_px=deviation_px)
        # The threshold holds only for the first motion.
        elif last is not None or similarity.length_px > max(
            Corner.min_motion_px, Corner.min_sigmas * similarity.deviation_px
        ):
            step = self._length(similarity.matrix - before.matrix)
            self._course.append((time_s or 0.0, similarity, step))
            if last is not None and step < Corner.min_sigmas * similarity.deviation_px:
                # A step within the error, as during a large contact, is shrunk towards the usual step.
                share = 1 / (1 + (similarity.deviation_px / max(self._median_step_px(), 1e-3)) ** 2)
                matrix = last.matrix + share * (similarity.matrix - last.matrix)
                similarity = replace(similarity, matrix=matrix)
            self._last = similarity
        return self._last

    def describe(self, shrink: int) -> list[str]:
        """Sentences on the camera motion, in pixels of the video before downsampling by `shrink`."""
        if not self._course:
            return []
        time_s, text = self._course[0][0], describe_course(self._course, shrink)
        if unknown := [time for time in self._unknown_s if time > time_s]:
            text += f"; in {len(unknown)} frames, from {unknown[0]:.3g} s on, it could not be estimated"
        return [text]

    def _median_step_px(self) -> float:
        """Median step from frame to frame [px]."""
        return float(np.median([step for *_, step in self._course]))

    def _measure_jump(self, now: Pixels) -> Floats:
        """Shift (2, 3) of the whole picture, of any length, by phase correlation."""
        first, second = (picture.astype(np.float32) for picture in (self._rest, now))
        shift, _ = cv2.phaseCorrelate(first, second, cv2.createHanningWindow(now.shape[::-1], cv2.CV_32F))
        return np.column_stack([np.eye(2), shift])

    def _fit_surroundings(self, now: Pixels, initial: Similarity) -> Similarity | None:
        """Similarity of the surroundings, started at `initial`; None: too few corners, or they deform."""
        points = self._points
        if self.is_blind:
            return None
        start = (points @ initial.matrix[:, :2].T + initial.matrix[:, 2]).astype(np.float32)
        options = None, None, Corner.window, 3, _STOP, cv2.OPTFLOW_USE_INITIAL_FLOW
        targets, status, _ = cv2.calcOpticalFlowPyrLK(self._rest, now, points, start, *options)
        known = (status[:, 0] > 0) & ((targets > 3) & (targets < np.array(now.shape[::-1]) - 4)).all(axis=1)
        if known.sum() < Corner.min_points:
            return None
        sources, shift = points[known].astype(np.float64), (targets - points)[known].astype(np.float64)
        guess, _ = cv2.estimateAffinePartial2D(sources, sources + shift, ransacReprojThreshold=0.5)
        if guess is None:
            return None
        design, parameters = self._basis.design(sources), np.zeros(4)
        residual = sources + shift - (sources @ guess[:, :2].T + guess[:, 2])
        for _ in range(Corner.iterations):
            length_px = np.linalg.norm(residual, axis=1)
            weight, spread = weigh_outliers(length_px, length_px)
            weighted_design = np.repeat(weight, 2)[:, None] * design
            normal = weighted_design.T @ design
            if weight.sum() < Corner.min_points / 2 or np.linalg.cond(normal) > Corner.max_condition:
                return None
            parameters = np.linalg.solve(normal, weighted_design.T @ shift.ravel())
            residual = shift - (design @ parameters).reshape(-1, 2)
        tissue = self._basis.design(self._tissue)
        leverage = ((tissue @ np.linalg.inv(normal)) * tissue).sum(axis=1).mean()
        variance = Corner.variance_factor * spread**2 * 2 * leverage
        matrix = self._basis.matrix(parameters)
        motion_px = self._length(matrix - np.eye(2, 3))
        # Surroundings that move more near the tissue than far from it are tissue outside the mask.
        distance = np.linalg.norm(sources - self._tissue.mean(axis=0), axis=1)
        near_shift, far_shift = (
            (weight[:, None] * residual)[half].sum(axis=0) / weight[half].sum()
            for half in (distance < np.median(distance), distance >= np.median(distance))
        )
        deforms = np.linalg.norm(near_shift - far_shift) > max(
            Corner.max_mismatch * motion_px, Corner.min_motion_px
        )
        if deforms or variance > Corner.max_deviation_px**2:
            return None
        return Similarity(matrix, float(np.sqrt(variance)), motion_px)

    def _length(self, matrix: Floats) -> float:
        """Root mean square of a shift (2, 3) over the tissue [px]."""
        return float(np.sqrt(np.square(self._tissue @ matrix[:, :2].T + matrix[:, 2]).sum(axis=1).mean()))


def weigh_outliers(distance_px: Floats, typical_px: Floats) -> tuple[Floats, float]:
    """Tukey's biweight (N,) of distances [px], and a component's standard deviation from typical ones."""
    spread = max(float(np.median(typical_px)) / 1.18, Corner.min_spread_px)  # Rayleigh's median
    return np.maximum(1 - (distance_px / (Corner.outlier_sigmas * spread)) ** 2, 0) ** 2, spread


def _contrast(rgb: Pixels) -> Pixels:
    """Local contrast (H, W) of a frame."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return image.local_contrast(cv2.GaussianBlur(grey, (0, 0), Corner.smooth_px), Corner.window)


def _compensate_bias(position: Map) -> Map:
    """Sampling position at which OpenCV's cubic kernel (a = -3/4) reproduces a ramp at `position` [px].

    At a fraction t of a pixel it returns the ramp at t + (a + 1/2) 2 t (1 - t) (2t - 1), up to 0.05 px off.
    """
    fraction = sample = position - np.floor(position)
    for _ in range(2):
        sample = fraction + 0.5 * sample * (1 - sample) * (2 * sample - 1)
    return np.asarray(position - fraction + sample, np.float32)
