"""The rotation from the sensor's axes to the camera's: tissue moves in the direction of the force.

On tissue that is isotropic in the image plane, the mean motion around a contact is along the in-plane part of
the force, whatever its part along the optical axis. So over a span in which a tool pulls and pushes in many
directions, motion = gain × (first two rows of the rotation) × force. The rotation is found by least squares
(Wahba's problem, SIAM Review 7, 1965, with the third component of one side unobserved).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from bench import bootstrap
from bench.recording.meta import LEAST_TURNING
from synth.arrays import Floats

_FLAT = 0.1  # least standard deviation of force in any direction, as a share of the largest
_EXPLAINED = 0.5  # least share of the motion's variance
_SURE_DEG = 15.0
_RESAMPLES = 100
# The angle's deviation over the misfit: gain and rotation leave two degrees of freedom of six.
_FREEDOM = float(np.sqrt(2.5))
_STARTS = Rotation.create_group("O")


@dataclass(frozen=True)
class SensorRotation:
    """A sensor's rotation and its uncertainty."""

    rows: tuple[tuple[float, ...], ...] = ()  # of the rotation to the camera's axes; empty: not determined
    deviation_deg: float = np.nan  # standard deviation of its angle, from bootstrap resamples and misfit
    explained: float = np.nan  # share of the motion's variance
    refused: str = ""  # why it must not be used; empty if it may be

    def describe(self) -> str:
        """Uncertainty and explained motion, in words."""
        return f"± {self.deviation_deg:.1f}°, {100 * self.explained:.0f}% of the motion explained"


def find_rotation(moved: Floats, visible: Floats, force_mn: Floats) -> SensorRotation:
    """The rotation for which the tissue's motion best follows the force.

    `moved`: (T, P, 2) motion of P parts of the tissue in the picture (right, down) from rest, any unit;
    `visible`: (T, P) visible share of each part, in 0..1; `force_mn`: (T, 3) in the sensor's axes, tared;
    frames with NaN are left out. It is refused for few frames, forces in a plane, or a poor fit.
    """
    is_valid = np.isfinite(force_mn).all(axis=1)
    if is_valid.sum() < LEAST_TURNING:
        return SensorRotation(
            refused=f"only {is_valid.sum()} tracked frames with force, {LEAST_TURNING} needed"
        )
    force, shift = force_mn[is_valid], _shift(moved[is_valid], visible[is_valid])
    spread = np.linalg.svd(force - force.mean(axis=0), compute_uv=False)
    if not shift.any():
        return SensorRotation(refused="nothing moves")
    if spread[2] < _FLAT * spread[0]:
        return SensorRotation(refused="the force stays in a plane or on a line")
    equal = np.ones(len(force))
    turn, explained, misfit = _fit_rotation(force, shift, equal, _STARTS)
    rng = np.random.default_rng(0)  # reproducible
    block = max(bootstrap.block_length(axis) for axis in (*force.T, *shift.T))
    resamples = [
        _fit_rotation(force, shift, weights, Rotation.concatenate([turn]))[0]
        for weights in bootstrap.counts(len(force), block, _RESAMPLES, rng)
    ]
    angles = np.array([(resample * turn.inv()).magnitude() for resample in resamples])
    deviation = float(np.degrees(np.hypot(np.sqrt(np.mean(np.square(angles))), _FREEDOM * misfit)))
    refused = ""
    if explained < _EXPLAINED:
        refused = f"only {100 * explained:.0f}% of the motion follows the force"
    elif deviation > _SURE_DEG:
        refused = f"its angle has a standard deviation of {deviation:.0f}°"
    return SensorRotation(tuple(map(tuple, turn.as_matrix().tolist())), deviation, explained, refused)


def _shift(moved: Floats, visible: Floats) -> Floats:
    """Mean motion (T, 2), each part weighted by its mean squared motion over all frames."""
    weight = visible * np.square(moved).sum(axis=2).mean(axis=0)
    total = weight.sum(axis=1)
    return np.asarray((weight[..., None] * moved).sum(axis=1) / np.maximum(total, 1e-12)[:, None], np.float64)


def _fit_rotation(
    force: Floats, shift: Floats, weights: Floats, starts: Rotation
) -> tuple[Rotation, float, float]:
    """The best rotation over all starts, its share of explained variance, and its misfit relative to the
    unconstrained linear map; motion and force may have an offset."""
    part = weights / weights.sum()
    force, shift = force - part @ force, shift - part @ shift
    moment = (force * part[:, None]).T @ force
    scale = np.linalg.cholesky(moment + 1e-9 * np.trace(moment) * np.eye(3))
    # The unconstrained linear map from whitened force to motion.
    linear = np.linalg.solve(scale, (force * part[:, None]).T @ shift).T

    def project(turn: Rotation) -> Floats:
        return np.asarray(turn.as_matrix()[:2] @ scale, np.float64)

    def compute_residuals(vector: Floats, start: Rotation) -> Floats:
        rows = project(Rotation.from_rotvec(vector) * start)
        gain = max(float((linear * rows).sum() / np.square(rows).sum()), 0.0)
        return np.asarray((linear - gain * rows).ravel(), np.float64)

    fits = [(least_squares(compute_residuals, np.zeros(3), args=(start,)), start) for start in starts]
    best, start = min(fits, key=lambda fit: float(fit[0].cost))
    total = float((part[:, None] * np.square(shift)).sum())
    unexplained = total - float(np.square(linear).sum()) + 2 * float(best.cost)
    misfit = np.sqrt(2 * best.cost / max(float(np.square(linear).sum()), 1e-12))
    explained = 1 - unexplained / total if total > 0 else 0.0
    return Rotation.from_rotvec(best.x) * start, explained, float(misfit)
