"""Renders one frame with its truth: a surface, a camera, a light and a push with a fingertip's shape.

python examples/render_frame.py frame.png
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
from PIL import Image

from synth.job.schema import Job
from synth.render.anatomy import surface as anatomy
from synth.render.appearance.look import Look
from synth.render.camera import camera
from synth.render.scene import Shot, Studio


def frame(depth_mm: float = 2.0) -> Shot:
    """The cortex pressed in by `depth_mm`, seen 15 degrees askew in warm light."""
    job = Job.model_validate({"anatomy": {"vertices": 6000}, "render": {"size": [320, 240], "tool": False}})
    rng = np.random.default_rng(4)
    surface = anatomy.procedural(anatomy.Relief.draw(job.anatomy, rng), job.anatomy)
    view = replace(camera.View.draw(job.render, rng), tilt_deg=15.0, field_mm=34.0)
    look = Look.draw(job, "healthy", rng)
    look = replace(look, light=replace(look.light, kelvin=4200.0, main=0.6))
    studio = Studio(surface, look, camera.place(view, job.render), job)
    away = np.linalg.norm(surface.vertices[:, :2], axis=1)  # mm from the middle of the opening
    pressed = surface.vertices.copy()
    pressed[:, 2] -= depth_mm * np.exp(-((away / 5.0) ** 2))
    nowhere = np.zeros((2, 3))  # where the tips of the instrument would be, if it were shown
    return studio.frame(pressed, nowhere, nowhere, seed=1)


if __name__ == "__main__":
    shot = frame()
    Image.fromarray(shot.rgb).save(sys.argv[1])
    print(f"wrote {sys.argv[1]}; largest flow {np.linalg.norm(shot.flow, axis=2).max():.2f} px")
