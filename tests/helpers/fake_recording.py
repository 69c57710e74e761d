"""Recordings with known force: a texture moved by a smooth field proportional to the force."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.methods.method_interface import ForceEstimate, FrameMotion, Method, MethodContext
from bench.recording import recording_writer
from bench.recording.recording_folder import open_recording
from bench.scoring.evaluate_recording import evaluate_recording
from bench.scoring.result import Result
from synth.flow.recording.decode import RecordingFlowSettings

GAIN_MN_PER_PX = 40.0
SENSOR_HZ = 100.0


def texture(height: int, width: int, seed: int | np.random.Generator = 0) -> NDArray[np.uint8]:
    """Band-pass filtered noise in the colours of tissue, (H, W, 3)."""
    noise = np.random.default_rng(seed).normal(size=(height, width)).astype(np.float32)
    fine = cv2.GaussianBlur(noise, (0, 0), 1.5) - cv2.GaussianBlur(noise, (0, 0), 6)
    grey = 110 + 45 * fine / fine.std()
    return np.asarray(np.clip(grey[..., None] * [1.1, 0.7, 0.6], 0, 210), np.uint8)


def push_texture(rest: NDArray[np.uint8], peak_px: float) -> NDArray[np.uint8]:
    """The texture (H, W, 3) moved to the right by a bump of `peak_px` at the centre."""
    height, width = rest.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    bump = np.exp(-((x - width / 2) ** 2 + (y - height / 2) ** 2) / (2 * (0.18 * height) ** 2))
    source = (x - peak_px * bump).astype(np.float32)
    return np.asarray(cv2.remap(rest, source, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT), np.uint8)


def force_curve(time_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Two presses a period of 2 s, peak 120 mN; 0 in the first 0.2 s."""
    return 120 * np.clip(np.sin(2 * np.pi * (time_s - 0.2) / 2), 0, None) * (time_s >= 0.2)


@dataclass(frozen=True)
class Maker:
    """Writes recordings under one folder."""

    root: Path

    def __call__(
        self,
        name: str = "rec",
        *,
        frames: int = 30,
        fps: float = 10.0,
        size: tuple[int, int] = (96, 128),
        meta: Mapping[str, Any] | None = None,
        footage: str = "png",
    ) -> Path:
        folder = self.root / name
        (folder / "frames").mkdir(parents=True)
        time = np.arange(frames) / fps
        rest = texture(*size)
        pictures = [push_texture(rest, f / GAIN_MN_PER_PX) for f in force_curve(time)]
        if footage == "png":
            for k, rgb in enumerate(pictures):
                cv2.imwrite(str(folder / "frames" / f"{k:04d}.png"), rgb[..., ::-1])
            recording_writer.write_frames(folder, time)
        else:
            (folder / "frames").rmdir()
            recording_writer.write_video(folder / "video.mp4", iter(pictures), time, crf=6)
        t = np.arange(0, time[-1] + 1e-9, 1 / SENSOR_HZ)
        recording_writer.write_force(folder, t, np.outer(force_curve(t) / 1000, [1.0, 0.0, 0.0]))
        about = {"scale_mm_per_px": 0.2, "young_kpa": 1.0, "sensor": {"axes": "camera", "low_pass_hz": None}}
        tissue = {"membrane": "stripped", "poisson": [0.45, 0.45]}  # two tissues to solve, not twelve
        recording_writer.write_meta(folder, {**about, **tissue, **(meta or {})})
        return folder


class Bump:
    """The inverse of `push_texture`: the exact force from the displacement at the centre."""

    def __call__(self, frame: FrameMotion, scene: MethodContext, picture: bool) -> ForceEstimate:
        length = np.linalg.norm(frame.flow, axis=-1)
        height, width = length.shape
        middle = frame.flow[height // 2 - 4 : height // 2 + 4, width // 2 - 4 : width // 2 + 4, 0]
        force = GAIN_MN_PER_PX * float(np.median(middle))
        return ForceEstimate(np.array([force, 0.0, 0.0]), length.astype(np.float32) if picture else None)


def score_recording(folder: Path, methods: Mapping[str, Method] | None = None, **settings: Any) -> Result:
    """The result of scoring a recording; by default `Bump` on every frame, in this process."""
    recording = open_recording(folder)
    methods_by_name = dict(methods or {"bump": Bump()})
    flow = settings.pop("flow_here", None)
    chosen_settings = RecordingFlowSettings(**({"shrink": 1, "rate_hz": None} | settings))
    scale = recording.scale
    return evaluate_recording(
        recording, methods_by_name, next(iter(methods_by_name)), scale, chosen_settings, {}, flow=flow
    )
