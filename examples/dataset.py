"""A dataset beyond the job keys: a tip that stirs in circles, a microscope on an arc, a pale appearance.

Copy it and change what you like: every choice is a plain value, and all that is drawn can be replaced.

python examples/dataset.py stirred 4
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import synth

FPS, FRAMES = 25.0, 12


@dataclass(frozen=True)
class Arc:
    """A microscope that turns about the craniotomy's centre from its drawn pose at time 0."""

    deg_per_s: float

    def at(self, camera: synth.Camera, seconds: float) -> synth.Camera:
        """The camera at a time; `camera` is that of time 0."""
        angle = np.radians(self.deg_per_s * seconds)
        turn = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
        return replace(camera, rotation=camera.rotation @ turn)  # x -> R x + t: the origin stays where it was


def stir(radius_mm: float, turns: float, frames: int) -> synth.ToolMotion:
    """Motion of a tip that descends, presses harder, runs round a circle and leaves; frame 0 is at rest."""
    t = np.linspace(0, 1, frames)
    load = np.sin(np.pi * np.clip((t - 0.1) / 0.8, 0, 1)) ** 2  # touches at 10% of the time, leaves at 90%
    away = np.clip(1 - t / 0.1, 0, 1) + np.clip((t - 0.9) / 0.1, 0, 1)
    phase = 2 * np.pi * turns * t
    circle = radius_mm * np.stack([np.cos(phase) - 1, np.sin(phase)], axis=1)
    return synth.ToolMotion(load, away, circle)


def main(root: Path, sequences: int) -> None:
    # Common to all sequences: picture, frame rate, fidelity. Tools, camera and appearance are set below.
    job = synth.Job.model_validate(
        {
            "seed": 11,
            "sequences": sequences,
            "frames": FRAMES,
            "fps": FPS,
            "anatomy": {"vertices": 6000},
            "fem": {"gestures": ["push"], "load": [0.05, 0.15], "tets": 1000},
            "render": {"size": [192, 144], "spp": 4},
            "store": {"extra": ["camera"]},  # poses, which can't be drawn from the job
            "card": {"title": "Stirred cortex"},
        }
    )
    rng = np.random.default_rng(job.seed)
    with synth.open_dataset(root, job) as folder:
        for k in range(sequences):
            # A plausible patient, instrument and microscope, drawn by the generator ...
            case = synth.draw_scenario(job, k)
            # ... with our own appearance, path of the camera and path of the tool.
            appearance = replace(
                case.appearance,
                gyrus_albedo=(0.80, 0.62, 0.55),
                pial_absorbance=0.2 * case.appearance.pial_absorbance,
                sensor=replace(case.appearance.sensor, exposure=0.8 * case.appearance.sensor.exposure),
            )
            case = replace(case, appearance=appearance, camera_motion=Arc(rng.uniform(4, 10)))
            motion = stir(radius_mm=rng.uniform(1, 2), turns=rng.choice([-1.0, 1.0]), frames=FRAMES)
            # Mechanics, pictures, ground truth and recovered flow are computed, and the store is sealed.
            scene = synth.simulate(job, k, case=case, motions=[motion])
            path = synth.write_scene(scene, folder)
            peak = np.linalg.norm(scene.force, axis=1).max()
            print(f"{path.name}: {peak:.2f} mN at most, {case.appearance.family}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
