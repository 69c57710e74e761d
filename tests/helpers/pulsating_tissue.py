"""Recordings of contacts on pulsating tissue, from a mesh that no method uses."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from fake_recording import texture
from warped_cortex import inverse

from bench.methods.compliance import TO_CAMERA, ElasticBlock, picture
from bench.methods.method_interface import Method
from bench.recording import recording_writer
from bench.recording.recording_folder import open_recording
from bench.scoring.evaluate_recording import evaluate_recording
from bench.scoring.result import Result
from synth.arrays import Floats
from synth.flow.recording.decode import RecordingFlowSettings

YOUNG_KPA, _FPS = 3.0, 10.0
_CONTACT_MM, _RADIUS_MM = 4.0, 12.0
_HEART, _BREATH = (0.4, 1.2), (0.25, 0.25)  # mm, Hz


def draw_contact(rng: np.random.Generator, seconds: float, size: int) -> dict[str, Any]:
    """A contact's times, force and displacement on linear tissue, from a mesh that no method uses.

    Returns:
        time_s (T,), force_mn (T, 3), field (size, size, 2) px per mN, mm_per_px, phase (2,) of the pulse.
    """
    mm_per_px = 2 * _RADIUS_MM / size
    block = ElasticBlock.build(2500)
    place, steps = rng.uniform(-3, 3, 2), np.arange(-_CONTACT_MM, _CONTACT_MM + 0.1, 0.8)
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps))
    share = np.clip(1 - (x**2 + y**2) / _CONTACT_MM**2, 0, None) ** 2
    contact = block.embed(np.column_stack([x, y])[share > 0] + place)
    direction = rng.normal(size=3) * [1.0, 1.0, 0.5]
    direction /= np.linalg.norm(direction)
    load = contact.gather(np.outer(share[share > 0] / share.sum(), TO_CAMERA.T @ direction))
    coarse = np.linspace(-_RADIUS_MM - 1, _RADIUS_MM + 1, 41)
    points = np.column_stack([axis.ravel() for axis in np.meshgrid(coarse, coarse)])
    displacement = picture(block.embed(points), block.system.solve(load)).reshape(41, 41, 2) / YOUNG_KPA
    positions = ((np.arange(size) - (size - 1) / 2) * mm_per_px + _RADIUS_MM + 1) / (coarse[1] - coarse[0])
    across, down = np.meshgrid(positions.astype(np.float32), positions.astype(np.float32))
    field = cv2.remap(displacement.astype(np.float32), across, down, cv2.INTER_CUBIC) / mm_per_px
    time_s = np.arange(0, seconds, 1 / _FPS)
    force, begin = np.zeros(len(time_s)), 2.0
    while begin < seconds - 3:
        duration_s, peak = rng.uniform(1.0, 2.5), rng.uniform(15, 40)
        inside = (time_s > begin) & (time_s < begin + duration_s)
        force += inside * peak * np.sin(np.pi * (time_s - begin) / duration_s) ** 2
        begin += duration_s + rng.uniform(0.8, 2.0)
    curves = {"time_s": time_s, "force_mn": force[:, None] * direction, "field": field}
    return curves | {"mm_per_px": mm_per_px, "phase": rng.uniform(0, 2 * np.pi, 2)}


def pulse_motion(time_s: float, phase: Floats, size: int) -> Floats:
    """Displacement of the surface by heart and breath, (size, size, 2) mm, in closed form."""
    y, x = (np.mgrid[:size, :size] - (size - 1) / 2) / (size / 2)
    bulge = 1 - 0.5 * (x**2 + y**2)
    heart = np.stack([0.8 * bulge + 0.2 * x * bulge, 0.6 * bulge + 0.2 * y * bulge], axis=-1)
    breath = np.stack([-0.3 + 0.2 * y, 0.9 + 0.1 * x], axis=-1)
    turns = [2 * np.pi * rate * time_s + p for (_, rate), p in zip((_HEART, _BREATH), phase, strict=True)]
    wave = np.sin(turns[0]) + 0.3 * np.sin(2 * turns[0])
    return np.asarray(_HEART[0] * wave * heart + _BREATH[0] * np.sin(turns[1]) * breath, np.float64)


def record(
    folder: Path, contact: Mapping[str, Any], pulse: float, size: int, remove: bool, rng: np.random.Generator
) -> None:
    """Writes a recording of `size` px: a texture moved by `draw_contact` and pulse, the sensor, no masks.

    `pulse`: factor on the pulse, 0: still tissue; `remove`: whether meta.yaml requests its removal.
    """
    (folder / "frames").mkdir(parents=True)
    rest = texture(size, size, rng)
    y, x = np.mgrid[:size, :size].astype(np.float32)
    times, force = contact["time_s"], contact["force_mn"]
    inside = np.hypot(x - (size - 1) / 2, y - (size - 1) / 2) < 0.46 * size
    for k, time in enumerate(times):
        displacement = float(np.linalg.norm(force[k])) * contact["field"]
        pulse_shift = pulse_motion(time, contact["phase"], size)
        pulse_shift = pulse_shift - pulse_motion(float(times[0]), contact["phase"], size)
        displacement = displacement + pulse * pulse_shift / contact["mm_per_px"]
        source = inverse(displacement.astype(np.float32))
        rgb = cv2.remap(rest, source[..., 0], source[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        rgb[~inside] = 90  # moving surroundings would indicate a moving camera
        picture_8bit = np.clip(rgb + rng.normal(0, 1.5, rgb.shape), 0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / "frames" / f"{k:04d}.png"), picture_8bit[..., ::-1])
    cv2.imwrite(str(folder / "tissue.png"), inside.astype(np.uint8) * 255)
    (folder / "masks").mkdir()  # no instrument in view
    cv2.imwrite(str(folder / "masks" / "000000.png"), np.zeros((size, size), np.uint8))
    recording_writer.write_frames(folder, times)
    recording_writer.write_force(folder, times, force / 1000)
    about = {"scale_mm_per_px": float(contact["mm_per_px"]), "young_kpa": YOUNG_KPA}
    sensor = {"axes": "camera", "low_pass_hz": None}
    recording_writer.write_meta(folder, about | {"pulse": {"remove": remove}, "sensor": sensor})


def score(folder: Path, methods: Mapping[str, Method], backend: str) -> Result:
    """Scores of all frames of the recording."""
    recording = open_recording(folder)
    scale = recording.scale
    settings = RecordingFlowSettings(backend, shrink=1, rate_hz=None)
    return evaluate_recording(recording, methods, next(iter(methods)), scale, settings, {})
