"""Camera motion where tissue fills the picture: the similarity part of the flow that contacts do not explain.

A contact moves all of the tissue too, most near itself, and in a shape that is nearly constant because
elasticity is linear. The motion of a frame besides its similarity is therefore a sum of a few shapes times
amplitudes, which camera motion does not change; each shape comes with a constant similarity of its own. A
Kalman filter (J. Basic Eng. 82, 1960) separates the similarity of the camera, which changes, from these.
Until a shape has been observed without camera motion, its similarity is predicted from the smallest forces on
an elastic half-space (Johnson, Contact Mechanics, 1985, ch. 3) that explain the shape. For recordings the
estimate is smoothed in both directions (Rauch, Tung & Striebel, AIAA J. 3, 1965).
"""

from __future__ import annotations

import numpy as np

from synth.arrays import Floats, Map, Mask
from synth.flow.recording.camera_path import CameraPath, Course, Similarity, SimilarityBasis, weigh_outliers
from synth.flow.recording.find_pulse import Cell, PulseEstimate, SurfaceMotion, in_cells


class Model:
    """Constants of the filter, chosen by hand on closed forms (tests/.../test_shared_motion.py)."""

    least_px: float = 0.3  # least length of a first or sudden camera motion
    impure: float = 0.2  # largest residual of its fit by a similarity, over its length
    jump: float = 5.0  # least length of a sudden motion over the usual step
    usual: int = 8  # number of steps whose median is the usual step
    noise_px: float = 0.02  # noise of the similarity of a frame
    calm_px: float = 0.005  # step of a camera at rest
    rounds: int = 4  # iterations of a robust fit
    most: float = 0.7  # quantile over cells of the residual: a tool and its shadow are above it
    shapes: int = 4  # most shapes
    new_px: float = 0.12  # least residual that becomes a new shape
    new: float = 0.15  # the same over the motion without its similarity
    doubt: float = 0.5  # standard deviation of the predicted similarity of a shape of 1 px [px]
    nodes: int = 8  # loads on the half-space across the picture
    poisson: float = 0.45  # of the half-space
    normal: float = 0.3  # lateral motion by an axial load over that by a lateral load
    blunt: float = 0.7  # radius of a load, in spacings of the loads
    ridge: float = 0.2  # regularisation of forces, over the mean diagonal of the Gram matrix


class SharedMotion:
    """Estimates camera motion from the motion of tissue, frame by frame."""

    def __init__(self, tissue: Mask, shapes: Floats | None = None) -> None:
        """Starts at rest with a tissue mask (h, w) and the known shapes (2 P, S) of contacts, if any."""
        self._basis = SimilarityBasis(tissue.shape)
        inside = in_cells(np.zeros((*tissue.shape, 2), np.float32), tissue.astype(np.float32))[1]
        self._inside = inside > 0.5
        rows, columns = inside.shape
        y, x = np.mgrid[:rows, :columns] + 0.5
        at = np.column_stack([x.ravel() / columns, y.ravel() / rows]) * tissue.shape[::-1] - 0.5
        self._columns = self._basis.design(at)  # (2 P, 4) for x and y of the P cells
        self._unit = self._rms(self._columns)
        self._prior = _half_space(at, tissue.shape, self._columns)
        self.shapes = np.zeros((len(self._columns), 0))  # (2 P, S) with a root mean square of 1 px each
        self.course: Course = []  # since the first camera motion
        self._grows = shapes is None
        self._state, self._covariance = np.zeros(4), np.zeros((4, 4))
        self._before: tuple[Floats, Floats] | None = None
        self._steps: list[float] = []
        self._past: list[tuple[Floats, Floats, Floats]] = []
        self._times: list[float] = []
        self._starts = 0
        for shape in np.zeros((0, 0)) if shapes is None else shapes.T:
            self._learn(shape)

    def add(self, time_s: float, motion: Map, visible: Map) -> Similarity | None:
        """Camera motion in a frame by the results (r, c, 2) px, (r, c) of `in_cells`; None: none so far."""
        weight = np.where(visible > Cell.visible, visible * self._inside, 0.0).ravel().astype(np.float64)
        now = motion.reshape(-1).astype(np.float64)
        if np.count_nonzero(weight) < 2 * (self._columns.shape[1] + Model.shapes):
            return self.course[-1][1] if self.course else None
        plain, _, rest = self._fit(now, weight, self.shapes[:, :0])
        alike, amounts, left = self._fit(now, weight, self.shapes)
        left_px = self._size(left, weight)
        grows = self._grows and self.shapes.shape[1] < Model.shapes
        if grows and left_px > max(Model.new_px, Model.new * self._size(rest, weight)):
            self._learn(left)
            alike, amounts, left = self._fit(now, weight, self.shapes)
            left_px = self._size(left, weight)
        usual = float(np.median(self._steps[-Model.usual :])) if self._steps else 0.0
        change = self._sudden(now, weight, usual, (self._length(plain), self._size(rest, weight)))
        self._before = now, weight
        moves = change or (max(usual, Model.calm_px) if self._starts else 0.0)
        self._starts = self._starts or (len(self._times) + 1 if change else 0)
        count = len(self._state)
        predicted = self._covariance.copy()
        predicted[range(4), range(4)] += np.square(moves / self._unit) / (1 if change else 2)
        observed = np.hstack([np.eye(4), *(amount * np.eye(4) for amount in amounts)])
        noise = np.diag((Model.noise_px**2 + left_px**2) / np.square(self._unit) / 2)
        gain = predicted @ observed.T @ np.linalg.inv(observed @ predicted @ observed.T + noise)
        last = self._state
        self._state = last + gain @ (alike - observed @ last)
        keep = np.eye(count) - gain @ observed
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
        """Camera motion in all frames, smoothed with later frames; None: none."""
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
        still = self._starts - 1
        return CameraPath(np.array(self._times), (*[None] * still, *found[::-1][still:]))

    def _fit(self, motion: Floats, weight: Floats, shapes: Floats) -> tuple[Floats, Floats, Floats]:
        """Robust fit to visible cells: similarity (4,), amplitudes (S,) of shapes and residual (2 P,)."""
        both, left = np.hstack([self._columns, shapes]), motion
        fitted, sure = np.zeros(both.shape[1]), weight
        for _ in range(Model.rounds):
            weighed = np.repeat(sure, 2)[:, None] * both
            fitted = np.linalg.lstsq(weighed.T @ both, weighed.T @ motion, rcond=1e-9)[0]
            left = motion - both @ fitted
            off = np.linalg.norm(left.reshape(-1, 2), axis=1)
            sure = weight * weigh_outliers(off, off[weight > 0])[0]
        return np.asarray(fitted[:4]), np.asarray(fitted[4:]), left * np.repeat(weight > 0, 2)

    def _learn(self, shape: Floats) -> None:
        """Adds a shape (2 P,) and the prediction of its similarity to the state."""
        both = np.hstack([self._columns, self.shapes])
        shape = shape - both @ np.linalg.lstsq(both, shape, rcond=None)[0]
        shape = shape / self._rms(shape[:, None])[0]
        self.shapes = np.column_stack([self.shapes, shape])
        self._state = np.concatenate([self._state, self._prior @ shape])
        count = len(self._state)
        covariance = np.zeros((count, count))
        covariance[:-4, :-4] = self._covariance
        covariance[range(count - 4, count), range(count - 4, count)] = np.square(Model.doubt / self._unit) / 2
        self._covariance = covariance

    def _sudden(self, now: Floats, weight: Floats, usual: float, since_rest: tuple[float, float]) -> float:
        """Length of a sudden or first motion that is a pure similarity; 0: there is none."""
        found = [] if self._starts else [since_rest]
        if self._before is not None:
            both = np.minimum(weight, self._before[1])
            if np.count_nonzero(both) > 8:
                alike, _, left = self._fit(now - self._before[0], both, self.shapes[:, :0])
                found.append((self._length(alike), self._size(left, both)))
        least = max(Model.least_px, Model.jump * usual)
        return max((size for size, left in found if size > least and left < Model.impure * size), default=0.0)

    def _similarity(self, state: Floats, covariance: Floats) -> Similarity:
        of_cells = (self._columns @ covariance[:4, :4] * self._columns).sum(axis=1)
        deviation = float(np.sqrt(max(2 * of_cells.mean(), 0.0)))
        return Similarity(self._basis.matrix(state[:4]), deviation, self._length(state[:4]))

    def _length(self, similarity: Floats) -> float:
        """Root mean square of a similarity (4,) over the cells [px]."""
        return float(self._rms((self._columns @ similarity)[:, None])[0])

    @staticmethod
    def _rms(columns: Floats) -> Floats:
        """Root mean square (C,) over cells of the vectors in columns (2 P, C)."""
        return np.asarray(np.sqrt(2 * np.square(columns).mean(axis=0)), np.float64)

    @staticmethod
    def _size(left: Floats, weight: Floats) -> float:
        """Size of a residual (2 P,) [px]: a quantile over cells that ignores a tool and its shadow."""
        return float(np.quantile(np.linalg.norm(left.reshape(-1, 2), axis=1)[weight > 0], Model.most))


def find_path(surface: SurfaceMotion, pulse: PulseEstimate | None) -> CameraPath | None:
    """Camera motion over a recording, from the motion without pulsation; None: none."""
    inside = surface.tissue.astype(np.float32)

    def estimate(shared: SharedMotion) -> SharedMotion:
        for time_s, motion, visible in zip(surface.time_s, surface.motion, surface.visible, strict=True):
            own = 0.0 if pulse is None else in_cells(pulse.at(time_s)[..., :2], inside)[0]
            shared.add(time_s, motion[..., :2] - own, visible)
        return shared

    first = estimate(SharedMotion(surface.tissue))
    return estimate(SharedMotion(surface.tissue, first.shapes)).path() if first.course else None


def _half_space(at: Floats, size: tuple[int, ...], columns: Floats) -> Floats:
    """Matrix (4, 2 P) that predicts the similarity of a motion by forces from the rest of the motion.

    The motion of cells at places (P, 2) px follows Cerruti's and Boussinesq's solutions for loads on a
    lattice in and around a picture (h, w), smoothed over their spacing. The lateral motion by axial loads has
    the share that blunt tips have on a curved surface.
    """
    apart = size[1] / Model.nodes
    x, y = (apart * (np.arange(-1, round(length / apart) + 1) + 0.5) for length in size[::-1])
    nodes = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    dx, dy = np.moveaxis(at[:, None] - nodes, -1, 0)
    r = np.sqrt(dx**2 + dy**2 + (Model.blunt * apart) ** 2)
    along, mixed = (1 - Model.poisson) / r, Model.poisson / r**3
    across_x = [along + mixed * dx**2, mixed * dx * dy, Model.normal * dx / r**2]
    across_y = [mixed * dx * dy, along + mixed * dy**2, Model.normal * dy / r**2]
    moved = np.stack([np.hstack(across_x), np.hstack(across_y)], 1).reshape(2 * len(at), -1)
    inverse = np.linalg.pinv(columns)
    rest = moved - columns @ (inverse @ moved)
    gram = rest @ rest.T
    gram += Model.ridge * np.trace(gram) / len(gram) * np.eye(len(gram))
    return np.asarray(inverse @ moved @ np.linalg.solve(gram, rest).T, np.float64)
