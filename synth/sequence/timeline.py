"""Where everything is at any time of a sequence, between its frames too."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from synth.fem.solver import Deformation
from synth.render.appearance.light import Lighting
from synth.render.camera.camera import Camera
from synth.render.camera.camera_motion import CameraMotion
from synth.render.scene import SceneState

_SUBFRAMES = 4  # pictures that make up a blurred one


@dataclass(frozen=True)
class Timeline:
    """Surface, instruments, microscope and lamps of one sequence over time."""

    motion: Deformation
    camera: Camera
    """At rest."""
    sway: CameraMotion
    light: Lighting
    fps: float

    def at(self, frame: float) -> SceneState:
        """The state at a frame, or of a time between two, where all moves straight from one to the next."""
        last = len(self.motion.displacement) - 1
        frame = float(np.clip(frame, 0, last))
        before = int(frame)
        part = frame - before
        after = min(before + 1, last)

        def between(values: np.ndarray) -> np.ndarray:
            return np.asarray(
                values[before] if part == 0 else (1 - part) * values[before] + part * values[after]
            )

        return SceneState(
            vertices=self.motion.rest + between(self.motion.displacement),
            tips=between(self.motion.tip),
            shafts=between(self.motion.shaft),
            camera=self.sway.at(self.camera, frame / self.fps),
            power=self.light.gain(frame / max(last, 1)),
        )

    def exposure(self, frame: int, shutter: float) -> list[SceneState]:
        """States while the shutter is open, evenly about a frame; none if it only opens for an instant.

        Args:
            frame: which.
            shutter: part of the time between frames.
        """
        if shutter == 0:
            return []
        offsets = shutter * ((np.arange(_SUBFRAMES) + 0.5) / _SUBFRAMES - 0.5)
        return [self.at(frame + offset) for offset in offsets]
