"""A blunt hook of one's own, made here as an STL in centimetres, presses the tissue: a picture and its mask.

python examples/own_instrument.py folder
"""

import sys
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

import synth


def make_hook(path: Path) -> None:
    """Writes a hook [cm]: a shaft along x that ends in a quarter of a circle, its tip at (2, 0, -0.45)."""
    turn = np.linspace(0, np.pi / 2, 12)
    bend = np.column_stack([0.3 - 0.3 * np.cos(turn), 0 * turn, 0.15 + 0.3 * np.sin(turn)])
    middle = np.vstack([[0.0, 0.0, 0.0], bend, [1.0, 0.0, 0.45], [11.0, 0.0, 0.45]])
    radius = np.array([0.04, *np.linspace(0.07, 0.09, 12), 0.12, 0.3])
    tangents = np.gradient(middle, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    sides = np.cross(tangents, [0.0, 1.0, 0.0])  # across the hook and, y, through it
    radials = np.cos(angle)[:, None, None] * [0.0, 1.0, 0.0] + np.sin(angle)[:, None, None] * sides
    rings = middle + radius[:, None] * radials  # (24, R, 3)
    indices = np.arange(24 * len(middle)).reshape(24, -1)
    next_indices = np.roll(indices, -1, axis=0)
    a, b, c, d = indices[:, :-1], next_indices[:, :-1], next_indices[:, 1:], indices[:, 1:]
    tube = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    ends = indices[:, [0, -1]]
    fans = np.stack([np.broadcast_to(ends[:1], (22, 2)), ends[1:-1], ends[2:]], axis=-1).reshape(-1, 3)
    points = rings.reshape(-1, 3) + np.array([2.0, 0.0, -0.45])
    trimesh.Trimesh(points, np.concatenate([tube, fans])).export(path)


def press(folder: Path) -> synth.Scene:
    """The hook as the instrument of a push in the middle of the opening."""
    make_hook(folder / "hook.stl")
    hook = {"file": folder / "hook.stl", "tip": [2.0, 0, -0.45], "axis": [1, 0, 0], "unit_mm": 10}
    push = {"gesture": "push", "instrument": hook, "place": [0, 0], "direction": [0, 0, -1], "load": 0.2}
    fem = {"instrument_list": [push], "footprint_mm": 3}
    return synth.simulate(synth.Job.model_validate({"seed": 4, "frames": 10, "fem": fem}))


if __name__ == "__main__":
    out = Path(sys.argv[1])
    scene = press(out)
    frame = scene.frame(scene.strongest)
    Image.fromarray(frame.rgb).save(out / "picture.png")
    Image.fromarray(255 * frame.tool.astype(np.uint8)).save(out / "mask.png")
