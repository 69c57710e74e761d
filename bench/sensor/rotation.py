"""The sensor's axes in the camera's: tissue that is pulled moves the way it is pulled.

On tissue that is alike in all directions of the picture, the mean motion around a contact is along the part
of the force that lies in the picture, whatever the part along the view does. So over a span in which a tool
pulls and pushes in many directions, motion = gain × (the picture's two rows of the rotation) × force. The
rotation is the least-squares one (Wahba's problem, SIAM Review 7, 1965, with the third component of one side
unseen).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from bench import bootstrap

Floats = NDArray[np.float64]

_LEAST_TURNING = 20  # frames
_FLAT = 0.1  # of the largest standard deviation of force: a direction with less is not known
_EXPLAINED = 0.5  # share of the motion's variance
_SURE_DEG = 15.0
_RESAMPLES = 100
# The angle's deviation over the misfit: of six numbers of equal error a gain and a rotation leave two.
_FREEDOM = float(np.sqrt(2.5))
_STARTS = Rotation.create_group("O")


@dataclass(frozen=True)
class SensorRotation:
    """What was found."""

    rows: tuple[tuple[float, ...], ...]
    """Rows of the rotation from the sensor's axes to the camera's; empty if none could be tried."""
    deviation_deg: float
    """Standard deviation of its angle [deg]: of bootstrap resamples, and of what no rotation can explain."""
    explained: float
    """Share of the motion's variance that it explains."""
    refused: str
    """Why it must not be used; empty when it may be."""

    def describe(self) -> str:
        """In words."""
        return f"± {self.deviation_deg:.1f}°, {100 * self.explained:.0f}% of the motion explained"


def find_rotation(moved: Floats, seen: Floats, force_mn: Floats) -> SensorRotation:
    """The rotation at which the tissue's motion best follows the force.

    Args:
        moved: (T, P, 2) motion of P parts of the tissue in the picture (right, down) from rest, any unit.
        seen: (T, P) in 0..1, how much of each was seen.
        force_mn: (T, 3) in the sensor's axes, tared; frames with NaN are left out.

    Returns:
        The rotation, refused where there are fewer than `_LEAST_TURNING`, the force keeps to a plane, less
        than half of the motion is explained, or its angle is known to 15° only.
    """
    good = np.isfinite(force_mn).all(axis=1)
    if good.sum() < _LEAST_TURNING:
        return _none(f"only {good.sum()} frames with force that could be followed, {_LEAST_TURNING} needed")
    force, shift = force_mn[good], _shift(moved[good], seen[good])
    spread = np.linalg.svd(force - force.mean(axis=0), compute_uv=False)
    if spread[2] < _FLAT * spread[0] or not shift.any():
        return _none("the force keeps to a plane or a line" if shift.any() else "nothing moves")
    every = np.ones(len(force))
    turn, explained, misfit = _fitted(force, shift, every, _STARTS)
    rng = np.random.default_rng(0)  # the same recording gives the same rotation
    block = max(bootstrap.block_length(axis) for axis in (*force.T, *shift.T))
    again = [
        _fitted(force, shift, weights, Rotation.concatenate([turn]))[0]
        for weights in bootstrap.counts(len(force), block, _RESAMPLES, rng)
    ]
    apart = np.array([(one * turn.inv()).magnitude() for one in again])
    deviation = float(np.degrees(np.hypot(np.sqrt(np.mean(np.square(apart))), _FREEDOM * misfit)))
    refused = ""
    if explained < _EXPLAINED:
        refused = f"only {100 * explained:.0f}% of the motion follows the force"
    elif deviation > _SURE_DEG:
        refused = f"known to {deviation:.0f}° only"
    return SensorRotation(tuple(map(tuple, turn.as_matrix().tolist())), deviation, explained, refused)


def _shift(moved: Floats, seen: Floats) -> Floats:
    """(T, 2) mean motion, each part weighted alike in all frames by how much it moves."""
    weight = seen * np.square(moved).sum(axis=2).mean(axis=0)
    whole = weight.sum(axis=1)
    return np.asarray((weight[..., None] * moved).sum(axis=1) / np.maximum(whole, 1e-12)[:, None], np.float64)


def _fitted(force: Floats, shift: Floats, weights: Floats, starts: Rotation) -> tuple[Rotation, float, float]:
    """The best rotation from any start, the share of variance it explains, and what of the linear part no
    rotation explains, as a share of its length. Both sides may have a zero of their own."""
    part = weights / weights.sum()
    force, shift = force - part @ force, shift - part @ shift
    moment = (force * part[:, None]).T @ force
    scale = np.linalg.cholesky(moment + 1e-9 * np.trace(moment) * np.eye(3))
    # Motion over force as it would be without any constraint, both sides in the force's own metric.
    asked = np.linalg.solve(scale, (force * part[:, None]).T @ shift).T

    def along(turn: Rotation) -> Floats:
        return np.asarray(turn.as_matrix()[:2] @ scale, np.float64)

    def left(vector: Floats, start: Rotation) -> Floats:
        said = along(Rotation.from_rotvec(vector) * start)
        gain = max(float((asked * said).sum() / np.square(said).sum()), 0.0)
        return np.asarray((asked - gain * said).ravel(), np.float64)

    tried = [(least_squares(left, np.zeros(3), args=(start,)), start) for start in starts]
    best, start = min(tried, key=lambda one: float(one[0].cost))
    total = float((part[:, None] * np.square(shift)).sum())
    unexplained = total - float(np.square(asked).sum()) + 2 * float(best.cost)
    misfit = np.sqrt(2 * best.cost / max(float(np.square(asked).sum()), 1e-12))
    explained = 1 - unexplained / total if total > 0 else 0.0
    return Rotation.from_rotvec(best.x) * start, explained, float(misfit)


def _none(reason: str) -> SensorRotation:
    return SensorRotation((), float("nan"), float("nan"), reason)
