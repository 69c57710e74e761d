"""Slow drift of the microscope on its stand: its camera at any time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from synth.render.camera.camera import Camera

_SLOW_HZ = (0.05, 0.25)
_WAVES = 3
_TURN = 0.002  # rad of rotation about each axis per mm of shift


@dataclass(frozen=True)
class CameraMotion:
    """Drift of the microscope in one sequence, from its pose in the rest frame."""

    drift_mm: float  # largest shift, approximately
    seed: int

    def at(self, camera: Camera, seconds: float) -> Camera:
        """The camera at a time, `camera` being that of time 0."""
        if self.drift_mm == 0:
            return camera
        # Six random waves (x, y, z and three rotations), 0 at time 0.
        rng = np.random.default_rng([self.seed, 0])
        hertz = rng.uniform(*_SLOW_HZ, (_WAVES, 6))
        phase = rng.uniform(0, 2 * np.pi, (_WAVES, 6))
        waves = np.sin(2 * np.pi * hertz * seconds + phase) - np.sin(phase)
        shift = waves.sum(axis=0) * self.drift_mm / np.sqrt(_WAVES)
        turn = Rotation.from_rotvec(shift[3:] * _TURN).as_matrix()
        # The rotation is about the craniotomy, which so stays in view.
        return replace(camera, rotation=turn @ camera.rotation, translation=camera.translation + shift[:3])
