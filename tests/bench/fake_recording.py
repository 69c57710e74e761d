"""Recordings with a known answer: a texture moved by a smooth field in proportion to a known force."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from ruamel.yaml import YAML

from bench import video
from bench.follow import Answer, Scene

GAIN_MN_PER_PX = 40.0


def texture(height: int, width: int, seed: int = 0) -> NDArray[np.uint8]:
    """Band-passed noise in tissue colours, (H, W, 3) uint8."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(height, width)).astype(np.float32)
    fine = cv2.GaussianBlur(noise, (0, 0), 1.5) - cv2.GaussianBlur(noise, (0, 0), 6)
    grey = 110 + 45 * fine / fine.std()
    return np.clip(np.stack([grey * 1.1, grey * 0.7, grey * 0.6], axis=-1), 0, 210).astype(np.uint8)


def pushed(rest: NDArray[np.uint8], peak_px: float) -> NDArray[np.uint8]:
    """The texture moved right by a bump of `peak_px` in the middle."""
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
        sensor_hz: float = 100.0,
        meta: Mapping[str, Any] | None = None,
        footage: str = "png",
        force: bool = True,
    ) -> Path:
        folder = self.root / name
        (folder / "frames").mkdir(parents=True)
        time = np.arange(frames) / fps
        rest = texture(*size)
        pictures = [pushed(rest, f / GAIN_MN_PER_PX) for f in force_curve(time)]
        if footage == "png":
            for k, rgb in enumerate(pictures):
                cv2.imwrite(str(folder / "frames" / f"{k:04d}.png"), rgb[..., ::-1])
            rows = [f"{k},{t:.6f}" for k, t in enumerate(time)]
            (folder / "frames.csv").write_text("\n".join(["frame,t_s", *rows]) + "\n")
        else:
            (folder / "frames").rmdir()
            video.write_video(folder / "video.mp4", iter(pictures), time, crf=6)
        if force:
            t = np.arange(0, time[-1] + 1e-9, 1 / sensor_hz)
            rows = [f"{a:.6f},{b / 1000:.9f},0,0" for a, b in zip(t, force_curve(t), strict=True)]
            (folder / "force.csv").write_text("\n".join(["t_s,fx_n,fy_n,fz_n", *rows]) + "\n")
        about = {"scale_mm_per_px": 0.2, "young_kpa": 1.0, "sensor": {"axes": "camera", "low_pass_hz": None}}
        with (folder / "meta.yaml").open("w") as file:
            YAML().dump({**about, **(meta or {})}, file)
        return folder


class Bump:
    """The inverse of `pushed`: force from the largest displacement. What a perfect method would be."""

    def __call__(
        self, flow: NDArray[np.float32], confidence: NDArray[np.float32], scene: Scene, picture: bool
    ) -> Answer:
        length = np.linalg.norm(flow, axis=-1)
        height, width = length.shape
        middle = flow[height // 2 - 4 : height // 2 + 4, width // 2 - 4 : width // 2 + 4, 0]
        force = GAIN_MN_PER_PX * float(np.median(middle))
        return Answer(np.array([force, 0.0, 0.0]), length.astype(np.float32) if picture else None)
