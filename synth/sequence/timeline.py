"""State of a sequence at any time, also between its frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from synth.arrays import Floats
from synth.fem.deformation import Deformation
from synth.render.appearance.light import Lighting
from synth.render.camera.camera import Camera
from synth.render.camera.camera_motion import CameraMotion
from synth.render.idle import IdleInstrument, with_idle
from synth.render.scene import SceneState

_SUBFRAMES = 4  # pictures averaged over an open shutter


@dataclass(frozen=True)
class Timeline:
    """Surface, instruments, microscope and lamps of one sequence over time."""

    rest: Floats  # (V, 3) mm, the surface at rest
    motion: Deformation
    camera: Camera  # at rest
    camera_motion: CameraMotion
    light: Lighting
    fps: float
    idle: tuple[IdleInstrument, ...] = ()

    def at(self, frame: float) -> SceneState:
        """The state at a frame, or linearly interpolated between two."""
        last = len(self.motion.displacement) - 1
        frame = float(np.clip(frame, 0, last))
        before = int(frame)
        fraction = frame - before
        after = min(before + 1, last)

        def between(values: np.ndarray) -> np.ndarray:
            if fraction == 0:
                return np.asarray(values[before])
            return np.asarray((1 - fraction) * values[before] + fraction * values[after])

        acting = between(self.motion.tip), between(self.motion.shaft)
        tips, shafts = with_idle(self.idle, frame / self.fps, *acting)
        return SceneState(
            vertices=self.rest + between(self.motion.displacement),
            tips=tips,
            shafts=shafts,
            camera=self.camera_motion.at(self.camera, frame / self.fps),
            power=self.light.gain(frame / max(last, 1)),
        )

    def exposure(self, frame: int, shutter: float) -> list[SceneState]:
        """States at even times around a frame while the shutter is open; none for an instantaneous shutter.

        `shutter`: open time, as a part of the time between frames.
        """
        if shutter == 0:
            return []
        offsets = shutter * ((np.arange(_SUBFRAMES) + 0.5) / _SUBFRAMES - 0.5)
        return [self.at(frame + offset) for offset in offsets]
