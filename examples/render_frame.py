"""Renders one frame with its ground truth: a push on cortex, tilted by 15 degrees, in warm light.

python examples/render_frame.py frame.png
"""

from __future__ import annotations

import sys

import numpy as np
from PIL import Image

import synth


def push(load: float = 0.3) -> synth.Scene:
    """A scene with a push of peak load P = F/(E a^2) = `load`."""
    job = synth.Job.model_validate(
        {
            "seed": 4,
            "frames": 5,
            "anatomy": {"vertices": 6000},
            "light": {"main": 0.6},
            "fem": {"gestures": ["push"], "load": load, "young_kpa": 1.0, "tets": 1000},
            "render": {"size": [320, 240], "tilt_deg": 15, "field_mm": 34},
        }
    )
    return synth.simulate(job, 0)


def describe(scene: synth.Scene, frame: synth.Frame) -> dict[str, float]:
    """Ground truth of a frame in numbers."""
    labelled = np.einsum("hwk,hw->k", frame.traction, scene.area)  # 1 kPa mm2 = 1 mN
    return {
        "force_mn": float(np.linalg.norm(frame.force)),
        "labelled_force_mn": float(np.linalg.norm(labelled)),
        "largest_motion_mm": float(np.linalg.norm(scene.motion.displacement[frame.index], axis=1).max()),
        "largest_flow_px": float(np.linalg.norm(frame.flow, axis=2).max()),
    }


if __name__ == "__main__":
    scene = push()
    frame = scene.frame(scene.strongest)
    Image.fromarray(frame.rgb).save(sys.argv[1])
    print(sys.argv[1], {name: round(value, 3) for name, value in describe(scene, frame).items()})
