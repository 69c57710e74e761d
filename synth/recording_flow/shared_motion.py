"""The camera's motion where tissue fills the picture: the similarity in its flow that no contact explains.

A contact moves all tissue too, most near itself, and always in much the same shape: elasticity is linear. So
what a frame's motion has besides its similarity is a few shapes times amounts, which no camera changes; each
has a constant similarity of its own. A Kalman filter (J. Basic Eng. 82, 1960) separates the camera's, which
changes, from these. Before a shape has been observed without the camera's motion, its similarity is that of
the least forces on an elastic half-space (Johnson, Contact Mechanics, 1985, ch. 3) that make the rest of it.
A recording's is smoothed from both ends (Rauch, Tung & Striebel, AIAA J. 3, 1965).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from synth.flow.estimator import Flags
from synth.recording_flow.camera_motion import (
    CameraPath,
    Course,
    Floats,
    Similarity,
    SimilarityBasis,
    weigh_outliers,
)
from synth.recording_flow.pulse import CELLS, PulseEstimate, SurfaceMotion, in_cells


@dataclass(frozen=True)
class MotionModel:
    """Constants of the filter: by hand, on closed forms (tests/.../test_shared_motion.py)."""

    least_px: float = 0.3  # of a first or sudden motion that is a camera's
    impure: float = 0.2  # share of it that may be no similarity
    jump: float = 5.0  # usual steps: what is sudden
    usual: int = 8  # steps whose median is usual
    noise_px: float = 0.02  # of a frame's similarity
    calm_px: float = 0.005  # by which a camera at rest moves from frame to frame
    rounds: int = 4  # of a robust fit
    most: float = 0.7  # quantile over cells: less is left of most; a tool and its shadow are in the rest
    shapes: int = 4  # of contacts, at most
    new_px: float = 0.12  # what shapes leave of a motion is another shape's, if it is more
    new: float = 0.15  # and if it is more than this share of the motion
    doubt: float = 0.5  # deviation of the half-space's similarity, for a shape of 1 px [px]
    nodes: int = 8  # of the half-space's lattice, across the picture
    poisson: float = 0.45  # of the half-space
    normal: float = 0.3  # motion across that a load along the view makes, over that of one across
    blunt: float = 0.7  # of loads, in spacings of the lattice
    ridge: float = 0.2  # of least forces, over the mean of the Gram matrix's diagonal


MODEL = MotionModel()


class SharedMotion:
    """What of a surface's motion is the camera's, frame by frame."""

    def __init__(self, tissue: Flags, shapes: Floats | None = None) -> None:
        """At the rest frame. `tissue`: (h, w); `shapes`: (2 P, S) that contacts are known to make, if any."""
        self._basis = SimilarityBasis(tissue.shape)
        inside = in_cells(np.zeros((*tissue.shape, 2), np.float32), tissue.astype(np.float32))[1]
        self._inside = inside > 0.5
        rows, columns = inside.shape
        y, x = np.mgrid[:rows, :columns] + 0.5
        at = np.column_stack([x.ravel() / columns, y.ravel() / rows]) * tissue.shape[::-1] - 0.5
        self._columns = self._basis.design(at)
        """(2 P, 4) of the P cells' x and y."""
        self._unit = self._rms(self._columns)
        self._prior = _half_space(at, tissue.shape, self._columns)
        self.shapes = np.zeros((len(self._columns), 0))
        """(2 P, S) what is no similarity of the contacts' motions, each with a root mean square of 1 px."""
        self.course: Course = []
        """Since it first moved."""
        self._grows = shapes is None
        self._state, self._covariance = np.zeros(4), np.zeros((4, 4))
        self._before: tuple[Floats, Floats] | None = None
        self._steps: list[float] = []
        self._past: list[tuple[Floats, Floats, Floats]] = []
        self._times: list[float] = []
        self._starts = 0
        for shape in np.zeros((0, 0)) if shapes is None else shapes.T:
            self._learn(shape)

    def add(
        self, time_s: float, motion: NDArray[np.float32], visible: NDArray[np.float32]
    ) -> Similarity | None:
        """Where the camera is in a frame; None: it has stood still since the rest frame.

        Args:
            time_s: of the frame.
            motion: (r, c, 2) px of the cells, see `in_cells`.
            visible: (r, c) share of each that is.
        """
        weight = np.where(visible > CELLS.visible, visible * self._inside, 0.0).ravel().astype(np.float64)
        now = motion.reshape(-1).astype(np.float64)
        if np.count_nonzero(weight) < 2 * (self._columns.shape[1] + MODEL.shapes):
            return self.course[-1][1] if self.course else None
        plain, _, rest = self._fit(now, weight, self.shapes[:, :0])
        alike, amounts, left = self._fit(now, weight, self.shapes)
        left_px = self._size(left, weight)
        if (
            self._grows
            and self.shapes.shape[1] < MODEL.shapes
            and left_px > max(MODEL.new_px, MODEL.new * self._size(rest, weight))
        ):
            self._learn(left)
            alike, amounts, left = self._fit(now, weight, self.shapes)
            left_px = self._size(left, weight)
        usual = float(np.median(self._steps[-MODEL.usual :])) if self._steps else 0.0
        change = self._sudden(now, weight, usual, (self._length(plain), self._size(rest, weight)))
        self._before = now, weight
        moves = change or (max(usual, MODEL.calm_px) if self._starts else 0.0)
        self._starts = self._starts or (len(self._times) + 1 if change else 0)
        count = len(self._state)
        predicted = self._covariance.copy()
        predicted[range(4), range(4)] += np.square(moves / self._unit) / (1 if change else 2)
        seen = np.hstack([np.eye(4), *(amount * np.eye(4) for amount in amounts)])
        noise = np.diag((MODEL.noise_px**2 + left_px**2) / np.square(self._unit) / 2)
        gain = predicted @ seen.T @ np.linalg.inv(seen @ predicted @ seen.T + noise)
        last = self._state
        self._state = last + gain @ (alike - seen @ last)
        keep = np.eye(count) - gain @ seen
        self._covariance = keep @ predicted @ keep.T + gain @ noise @ gain.T
        self._past.append((self._state, self._covariance, predicted))
        self._times.append(time_s)
        if not self._starts:
            self._steps.append(0.0)
            return None
        step = self._length(self._state[:4] - last[:4])
        found = self._similarity(self._state, self._covariance)
        if found.deviation_px < max(0.05, 0.3 * step):
            self._steps.append(step)
        self.course.append((time_s, found, step))
        return found

    def path(self) -> CameraPath | None:
        """Where the camera was in all frames, by what came after them too; None: it stood still."""
        if not self._starts:
            return None
        state, covariance, predicted = self._past[-1]
        found = [self._similarity(state, covariance)]
        for before, spread, forecast in self._past[-2::-1]:
            back = spread @ np.linalg.pinv(predicted, rcond=1e-10, hermitian=True)
            state = before + back @ (state - before)
            covariance = spread + back @ (covariance - predicted) @ back.T
            predicted = forecast
            found.append(self._similarity(state, covariance))
        moved = found[::-1]
        still: list[Similarity | None] = [None] * (self._starts - 1)
        return CameraPath(np.array(self._times), (*still, *moved[self._starts - 1 :]))

    def _fit(self, motion: Floats, weight: Floats, shapes: Floats) -> tuple[Floats, Floats, Floats]:
        """(4,) similarity, (S,) amounts of shapes, (2 P,) what is left, of the P cells that are visible."""
        both, left = np.hstack([self._columns, shapes]), motion
        answer, sure = np.zeros(both.shape[1]), weight
        for _ in range(MODEL.rounds):
            weighed = np.repeat(sure, 2)[:, None] * both
            answer = np.linalg.lstsq(weighed.T @ both, weighed.T @ motion, rcond=1e-9)[0]
            left = motion - both @ answer
            off = np.linalg.norm(left.reshape(-1, 2), axis=1)
            sure = weight * weigh_outliers(off, off[weight > 0])[0]
        return np.asarray(answer[:4]), np.asarray(answer[4:]), left * np.repeat(weight > 0, 2)

    def _learn(self, shape: Floats) -> None:
        """Another shape, (2 P,), and of which similarity it may be."""
        both = np.hstack([self._columns, self.shapes])
        shape = shape - both @ np.linalg.lstsq(both, shape, rcond=None)[0]
        shape = shape / self._rms(shape[:, None])[0]
        self.shapes = np.column_stack([self.shapes, shape])
        self._state = np.concatenate([self._state, self._prior @ shape])
        count = len(self._state)
        covariance = np.zeros((count, count))
        covariance[:-4, :-4] = self._covariance
        covariance[range(count - 4, count), range(count - 4, count)] = np.square(MODEL.doubt / self._unit) / 2
        self._covariance = covariance

    def _sudden(self, now: Floats, weight: Floats, usual: float, since_rest: tuple[float, float]) -> float:
        """Length of a motion that is a similarity and nothing else, since the frame before or first; or 0."""
        found = [] if self._starts else [since_rest]
        if self._before is not None:
            both = np.minimum(weight, self._before[1])
            if np.count_nonzero(both) > 8:
                alike, _, left = self._fit(now - self._before[0], both, self.shapes[:, :0])
                found.append((self._length(alike), self._size(left, both)))
        return max(
            (
                size
                for size, left in found
                if size > max(MODEL.least_px, MODEL.jump * usual) and left < MODEL.impure * size
            ),
            default=0.0,
        )

    def _similarity(self, state: Floats, covariance: Floats) -> Similarity:
        of_cells = (self._columns @ covariance[:4, :4] * self._columns).sum(axis=1)
        deviation = float(np.sqrt(max(2 * of_cells.mean(), 0.0)))
        return Similarity(self._basis.matrix(state[:4]), deviation, self._length(state[:4]))

    def _length(self, answer: Floats) -> float:
        return float(self._rms((self._columns @ answer)[:, None])[0])

    @staticmethod
    def _rms(columns: Floats) -> Floats:
        """(C,) root mean square length of the cells' vectors in columns (2 P, C)."""
        return np.asarray(np.sqrt(2 * np.square(columns).mean(axis=0)), np.float64)

    @staticmethod
    def _size(left: Floats, weight: Floats) -> float:
        """Less than this is left of most cells: of a tool's, or its shadow's, it may be much."""
        return float(np.quantile(np.linalg.norm(left.reshape(-1, 2), axis=1)[weight > 0], MODEL.most))


def find_path(surface: SurfaceMotion, pulse: PulseEstimate | None) -> CameraPath | None:
    """The camera's over a recording, of what its pulse leaves; None: it stood still."""
    inside = surface.tissue.astype(np.float32)

    def own(time_s: float) -> NDArray[np.float32] | float:
        return 0.0 if pulse is None else in_cells(pulse.at(time_s)[..., :2], inside)[0]

    def through(shared: SharedMotion) -> SharedMotion:
        for time_s, motion, visible in zip(surface.time_s, surface.motion, surface.visible, strict=True):
            shared.add(time_s, motion[..., :2] - own(time_s), visible)
        return shared

    once = through(SharedMotion(surface.tissue))
    return through(SharedMotion(surface.tissue, once.shapes)).path() if once.course else None


def _half_space(at: Floats, size: tuple[int, ...], columns: Floats) -> Floats:
    """(4, 2 P) the similarity in the motion of cells at places (P, 2) px by forces, of what else it has.

    Cerruti's and Boussinesq's solutions on a lattice of nodes in and around a picture (h, w), blunted by
    their spacing; along the view with the share in the plane that blunt tips have on a surface that bulges.
    """
    apart = size[1] / MODEL.nodes
    x, y = (apart * (np.arange(-1, round(length / apart) + 1) + 0.5) for length in size[::-1])
    nodes = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    dx, dy = np.moveaxis(at[:, None] - nodes, -1, 0)
    r = np.sqrt(dx**2 + dy**2 + (MODEL.blunt * apart) ** 2)
    along, mixed = (1 - MODEL.poisson) / r, MODEL.poisson / r**3
    across_x = [along + mixed * dx**2, mixed * dx * dy, MODEL.normal * dx / r**2]
    across_y = [mixed * dx * dy, along + mixed * dy**2, MODEL.normal * dy / r**2]
    moved = np.stack([np.hstack(across_x), np.hstack(across_y)], 1).reshape(2 * len(at), -1)
    inverse = np.linalg.pinv(columns)
    beside = moved - columns @ (inverse @ moved)
    gram = beside @ beside.T
    gram += MODEL.ridge * np.trace(gram) / len(gram) * np.eye(len(gram))
    return np.asarray(inverse @ moved @ np.linalg.solve(gram, beside).T, np.float64)
