"""A block of fatty liver under two lamps, pressed by up to 3 mm: pictures and true flow, without a brain.

python examples/liver_block.py folder
"""

import sys

import numpy as np
from PIL import Image
from scipy import ndimage, spatial

import synth

# Shape [mm]: a box of 34 x 26 x 9 with a domed top and rounded edges.
uv = np.stack(np.meshgrid(*[np.linspace(0, 1, 120)] * 2), axis=-1).reshape(-1, 2)
x, y = np.sin(np.pi * (uv - 0.5)).T
rest = np.stack([17 * x, 13 * y, 9 * ((1 - x**8) * (1 - y**8)) ** 0.25 - 1.2 * (x**2 + y**2)], axis=1)

# Maps: lobules of dark red liver, more or less full of fat, under a wet layer with dry patches.
waves = [ndimage.gaussian_filter(np.random.default_rng(s).normal(size=(1024, 1024)), s) for s in (90, 7, 2)]
regions, lobules, grain = (wave / wave.std() for wave in waves)
fat = 1 / (1 + np.exp(1.2 - 0.6 * regions - 0.7 * lobules - 0.4 * grain))[..., None]
albedo = (1 - fat) * [0.22, 0.045, 0.035] + fat * [0.55, 0.30, 0.15]
normal = np.stack([*np.gradient(-0.15 * lobules)[::-1], np.ones_like(lobules)], axis=-1)
normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
coat = synth.Coat(*(layer.astype(np.float32) for layer in (albedo, normal, 1 / (1 + np.exp(1 + regions)))))
liver = synth.Wet(coat, roughness=0.04, dry_roughness=0.3, ambient=np.full(3, 0.08))
block = synth.Body(rest, spatial.Delaunay(uv).simplices, uv.astype(np.float32), liver)

# Lamps next to a pinhole camera 300 mm away, which is tilted by 15 degrees.
lamps = [synth.Lamp(np.array([x_mm, -10, 300.0]), np.zeros(3), 4.0, np.full(3, 1.6e5)) for x_mm in (-45, 45)]
K = np.array([[2200, 0, 159.5], [0, 2200, 119.5], [0, 0, 1]])
pose = spatial.transform.Rotation.from_euler("x", 165, degrees=True).as_matrix(), np.array([0, 0, 300.0])
camera = synth.Camera(K, np.zeros(5), *pose, (320, 240), aperture_mm=0, focus_mm=300, mm_per_px=300 / 2200)
renderer = synth.Renderer(synth.SceneContent(block, lamps), camera)
dent = np.exp(-(rest[:, :2] ** 2).sum(axis=1) / 32)[:, None] * rest[:, 2:] / 9 * [0, 0, -1]
for k in range(4):
    frame = renderer.render(synth.SceneState(rest + k * dent), seed=k)
    Image.fromarray(frame.rgb).save(f"{sys.argv[1]}/{k}.png")
    np.save(f"{sys.argv[1]}/{k}.npy", frame.flow)  # (240, 320, 2) px from the first frame to this one
