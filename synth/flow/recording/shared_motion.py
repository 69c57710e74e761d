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
from synth.flow.recording.find_pulse import Cell, PulseEstimate, SurfaceMotion, average_cells


class Model:
    """Constants of the filter, chosen by hand on closed forms (tests/.../test_shared_motion.py)."""

    min_motion_px: float = 0.3  # least length of a first or sudden camera motion
    max_impurity: float = 0.2  # largest residual of its fit by a similarity, over its length
    jump_factor: float = 5.0  # least length of a sudden motion over the usual step
    median_steps: int = 8  # number of steps whose median is the usual step
    noise_px: float = 0.02  # noise of the similarity of a frame
    calm_px: float = 0.005  # step of a camera at rest
    iterations: int = 4  # iterations of a robust fit
    residual_quantile: float = 0.7  # quantile over cells of the residual: a tool and its shadow are above it
    max_shapes: int = 4  # most shapes
    new_shape_px: float = 0.12  # least residual that becomes a new shape
    new_shape_share: float = 0.15  # the same over the motion without its similarity
    shape_deviation: float = 0.5  # standard deviation of the predicted similarity of a shape of 1 px [px]
    nodes: int = 8  # loads on the half-space across the picture
    poisson: float = 0.45  # of the half-space
    normal_share: float = 0.3  # lateral motion by an axial load over that by a lateral load
    load_radius: float = 0.7  # radius of a load, in spacings of the loads
    ridge: float = 0.2  # regularisation of forces, over the mean diagonal of the Gram matrix


class SharedMotion:
    """Estimates camera motion from the motion of tissue, frame by frame."""

    def __init__(self, tissue: Mask, shapes: Floats | None = None) -> None:
        """Starts at rest with a tissue mask (h, w) and the known shapes (2 P, S) of contacts, if any."""
        self._basis = SimilarityBasis(tissue.shape)
        inside = average_cells(np.zeros((*tissue.shape, 2), np.float32), tissue.astype(np.float32))[1]
        self._inside = inside > 0.5
        rows, columns = inside.shape
        y, x = np.mgrid[:rows, :columns] + 0.5
        positions = np.column_stack([x.ravel() / columns, y.ravel() / rows]) * tissue.shape[::-1] - 0.5
        self._columns = self._basis.design(positions)  # (2 P, 4) for x and y of the P cells
        self._unit = self._rms(self._columns)
        self._prior = _half_space(positions, tissue.shape, self._columns)
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
            self._add_shape(shape)

    def add(self, time_s: float, motion: Map, visible: Map) -> Similarity | None:
        """Camera motion in a frame by the results (r, c, 2) px, (r, c) of `average_cells`; None: none."""
        weight = np.where(visible > Cell.min_visible, visible * self._inside, 0.0).ravel().astype(np.float64)
        now = motion.reshape(-1).astype(np.float64)
        if np.count_nonzero(weight) < 2 * (self._columns.shape[1] + Model.max_shapes):
            return self.course[-1][1] if self.course else None
        plain_parameters, _, deformation = self._fit(now, weight, self.shapes[:, :0])
        parameters, amplitudes, residual = self._fit(now, weight, self.shapes)
        residual_px, deformation_px = self._size(residual, weight), self._size(deformation, weight)
        grows = self._grows and self.shapes.shape[1] < Model.max_shapes
        if grows and residual_px > max(Model.new_shape_px, Model.new_shape_share * deformation_px):
            self._add_shape(residual)
            parameters, amplitudes, residual = self._fit(now, weight, self.shapes)
            residual_px = self._size(residual, weight)
        usual_px = float(np.median(self._steps[-Model.median_steps :])) if self._steps else 0.0
        jump_px = self._measure_jump(now, weight, usual_px, (self._length(plain_parameters), deformation_px))
        self._before = now, weight
        motion_px = jump_px or (max(usual_px, Model.calm_px) if self._starts else 0.0)
        self._starts = self._starts or (len(self._times) + 1 if jump_px else 0)
        count = len(self._state)
        predicted = self._covariance.copy()
        predicted[range(4), range(4)] += np.square(motion_px / self._unit) / (1 if jump_px else 2)
        observed = np.hstack([np.eye(4), *(amplitude * np.eye(4) for amplitude in amplitudes)])
        noise = np.diag((Model.noise_px**2 + residual_px**2) / np.square(self._unit) / 2)
        gain = predicted @ observed.T @ np.linalg.inv(observed @ predicted @ observed.T + noise)
        last = self._state
        self._state = last + gain @ (parameters - observed @ last)
        keep = np.eye(count) - gain @ observed
        self._covariance = keep @ predicted @ keep.T + gain @ noise @ gain.T
        self._past.append((self._state, self._covariance, predicted))
        self._times.append(time_s)
        if not self._starts:
            self._steps.append(0.0)
            return None
        step = self._length(self._state[:4] - last[:4])
        similarity = self._similarity(self._state, self._covariance)
        if similarity.deviation_px < max(0.05, 0.3 * step):
            self._steps.append(step)
        self.course.append((time_s, similarity, step))
        return similarity

    def path(self) -> CameraPath | None:
        """Camera motion in all frames, smoothed with later frames; None: none."""
        if not self._starts:
            return None
        state, covariance, predicted = self._past[-1]
        similarities = [self._similarity(state, covariance)]
        for earlier, earlier_covariance, forecast in self._past[-2::-1]:
            gain = earlier_covariance @ np.linalg.pinv(predicted, rcond=1e-10, hermitian=True)
            state = earlier + gain @ (state - earlier)
            covariance = earlier_covariance + gain @ (covariance - predicted) @ gain.T
            predicted = forecast
            similarities.append(self._similarity(state, covariance))
        still_frames = self._starts - 1
        return CameraPath(np.array(self._times), (*[None] * still_frames, *similarities[::-1][still_frames:]))

    def _fit(self, motion: Floats, weight: Floats, shapes: Floats) -> tuple[Floats, Floats, Floats]:
        """Robust fit to visible cells: similarity (4,), amplitudes (S,) of shapes and residual (2 P,)."""
        design, residual = np.hstack([self._columns, shapes]), motion
        fitted, robust_weight = np.zeros(design.shape[1]), weight
        for _ in range(Model.iterations):
            weighted_design = np.repeat(robust_weight, 2)[:, None] * design
            fitted = np.linalg.lstsq(weighted_design.T @ design, weighted_design.T @ motion, rcond=1e-9)[0]
            residual = motion - design @ fitted
            length_px = np.linalg.norm(residual.reshape(-1, 2), axis=1)
            robust_weight = weight * weigh_outliers(length_px, length_px[weight > 0])[0]
        return np.asarray(fitted[:4]), np.asarray(fitted[4:]), residual * np.repeat(weight > 0, 2)

    def _add_shape(self, shape: Floats) -> None:
        """Adds a shape (2 P,) and the prediction of its similarity to the state."""
        known = np.hstack([self._columns, self.shapes])
        shape = shape - known @ np.linalg.lstsq(known, shape, rcond=None)[0]
        shape = shape / self._rms(shape[:, None])[0]
        self.shapes = np.column_stack([self.shapes, shape])
        self._state = np.concatenate([self._state, self._prior @ shape])
        count = len(self._state)
        covariance = np.zeros((count, count))
        covariance[:-4, :-4] = self._covariance
        covariance[range(count - 4, count), range(count - 4, count)] = (
            np.square(Model.shape_deviation / self._unit) / 2
        )
        self._covariance = covariance

    def _measure_jump(
        self, now: Floats, weight: Floats, usual_px: float, since_rest: tuple[float, float]
    ) -> float:
        """Length of a sudden or first motion that is a pure similarity; 0: there is none."""
        candidates = [] if self._starts else [since_rest]
        if self._before is not None:
            common_weight = np.minimum(weight, self._before[1])
            if np.count_nonzero(common_weight) > 8:
                parameters, _, residual = self._fit(now - self._before[0], common_weight, self.shapes[:, :0])
                candidates.append((self._length(parameters), self._size(residual, common_weight)))
        min_length = max(Model.min_motion_px, Model.jump_factor * usual_px)
        return max(
            (
                length
                for length, residual in candidates
                if length > min_length and residual < Model.max_impurity * length
            ),
            default=0.0,
        )

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
    def _size(residual: Floats, weight: Floats) -> float:
        """Size of a residual (2 P,) [px]: a quantile over cells that ignores a tool and its shadow."""
        return float(
            np.quantile(np.linalg.norm(residual.reshape(-1, 2), axis=1)[weight > 0], Model.residual_quantile)
        )


def find_path(surface: SurfaceMotion, pulse: PulseEstimate | None) -> CameraPath | None:
    """Camera motion over a recording, from the motion without pulsation; None: none."""
    inside = surface.tissue.astype(np.float32)

    def estimate(shared: SharedMotion) -> SharedMotion:
        for time_s, motion, visible in zip(surface.time_s, surface.motion, surface.visible, strict=True):
            pulsation = 0.0 if pulse is None else average_cells(pulse.at(time_s)[..., :2], inside)[0]
            shared.add(time_s, motion[..., :2] - pulsation, visible)
        return shared

    first = estimate(SharedMotion(surface.tissue))
    return estimate(SharedMotion(surface.tissue, first.shapes)).path() if first.course else None


def _half_space(positions: Floats, size: tuple[int, ...], columns: Floats) -> Floats:
    """Matrix (4, 2 P) that predicts the similarity of a motion by forces from the rest of the motion.

    The motion of cells at places (P, 2) px follows Cerruti's and Boussinesq's solutions for loads on a
    lattice in and around a picture (h, w), smoothed over their spacing. The lateral motion by axial loads has
    the share that blunt tips have on a curved surface.
    """
    spacing = size[1] / Model.nodes
    x, y = (spacing * (np.arange(-1, round(length / spacing) + 1) + 0.5) for length in size[::-1])
    nodes = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    dx, dy = np.moveaxis(positions[:, None] - nodes, -1, 0)
    r = np.sqrt(dx**2 + dy**2 + (Model.load_radius * spacing) ** 2)
    along, mixed = (1 - Model.poisson) / r, Model.poisson / r**3
    across_x = [along + mixed * dx**2, mixed * dx * dy, Model.normal_share * dx / r**2]
    across_y = [mixed * dx * dy, along + mixed * dy**2, Model.normal_share * dy / r**2]
    response = np.stack([np.hstack(across_x), np.hstack(across_y)], 1).reshape(2 * len(positions), -1)
    inverse = np.linalg.pinv(columns)
    deformation = response - columns @ (inverse @ response)
    gram = deformation @ deformation.T
    gram += Model.ridge * np.trace(gram) / len(gram) * np.eye(len(gram))
    return np.asarray(inverse @ response @ np.linalg.solve(gram, deformation).T, np.float64)
