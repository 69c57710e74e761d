"""Time and memory of `bench score` on a synthetic recording of a minute."""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bench.recording import recording_writer
from evidence import report, result_status
from evidence.study import Study
from synth.arrays import Floats, Pixels
from synth.errors import UserError

_PERIOD_S, _PEAK_PX, _PX_A_MN = 4.0, 9.0, 1.0  # a force that such a motion of soft tissue may take
_SENSOR_HZ, _FPS, _SIZE = 200.0, 30.0, (680, 480)


def measure(model: Path, seconds: float = 60.0) -> dict[str, Any]:
    """Time and memory of `bench score` with a model folder, on a recording of a moved texture."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch, "recording")
        record(folder, seconds)
        words = ["score", str(folder), "--model", str(model), "-o", scratch]
        began = time.perf_counter()
        done = subprocess.run([sys.executable, "-m", "bench", *words], capture_output=True, text=True)
        wall = time.perf_counter() - began
        if done.returncode:
            raise UserError(f"the scoring failed: {done.stderr or done.stdout}")
        scored = json.loads(Path(scratch, "score.json").read_text())
    about = {"seconds": seconds, "fps": _FPS, "size": list(_SIZE), "frames": scored["frames"]}
    return {"data": result_status.data(model), **about, "wall_s": wall, "timings": scored["timings"]}


def record(folder: Path, seconds: float) -> None:
    """Writes a recording of a texture moved by a bump, without masks, with a proportional force."""
    folder.mkdir(parents=True)
    times = np.arange(round(seconds * _FPS)) / _FPS
    rest = texture(_SIZE[1], _SIZE[0], np.random.default_rng(0))
    pictures = (pushed(rest, move) for move in _motion(times))
    recording_writer.write_video(folder / "video.mp4", pictures, times, crf=12)
    clock = np.arange(0, seconds, 1 / _SENSOR_HZ)
    recording_writer.write_force(folder, clock, np.outer(_motion(clock) / _PX_A_MN / 1000, [1.0, 0.0, 0.0]))
    sensor = {"axes": "camera", "low_pass_hz": None}
    recording_writer.write_meta(
        folder, {"scale_mm_per_px": 35.0 / _SIZE[0], "young_kpa": 2.0, "sensor": sensor}
    )


def _motion(time_s: Floats) -> Floats:
    """Displacement of the bump's centre [px]: one press a period after half a second at rest."""
    return _PEAK_PX * np.clip(np.sin(2 * np.pi * (time_s - 0.5) / _PERIOD_S), 0, None) * (time_s > 0.5)


def texture(height: int, width: int, rng: np.random.Generator) -> Pixels:
    """Band-pass filtered noise in the colours of tissue, (H, W, 3) uint8."""
    noise = rng.normal(size=(height, width)).astype(np.float32)
    fine = cv2.GaussianBlur(noise, (0, 0), 1.5) - cv2.GaussianBlur(noise, (0, 0), 6)
    grey = 110 + 45 * fine / fine.std()
    return np.asarray(np.clip(grey[..., None] * [1.1, 0.7, 0.6], 0, 210), np.uint8)


def pushed(rest: Pixels, peak_px: float) -> Pixels:
    """The texture (H, W, 3) moved to the right by a bump of `peak_px` at the centre."""
    height, width = rest.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    bump = np.exp(-((x - width / 2) ** 2 + (y - height / 2) ** 2) / (2 * (0.18 * height) ** 2))
    source = (x - peak_px * bump).astype(np.float32)
    return np.asarray(cv2.remap(rest, source, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT), np.uint8)


def page(tree: Mapping[str, Any]) -> report.Page:
    """Time by stage and in total."""
    stages = {name: spent for name, spent in tree["timings"].items() if isinstance(spent, Mapping)}
    memory = sum(value for name, value in tree["timings"].items() if name.endswith("peak_rss_mb"))
    times = {name: [spent["wall_s"]] for name, spent in stages.items()}
    width, height = tree["size"]
    words = (
        f"**{tree['wall_s']:.0f} s, {tree['wall_s'] / tree['seconds']:.1f} times the recording's length, and "
        f"{memory / 1000:.1f} GB** in two processes (targets: twice the length, 2 GB). Recording: "
        f"{tree['seconds']:g} s, {width} x {height} at {tree['fps']:g} a second, without masks; "
        f"{tree['frames']} frames processed, flow on images of at least 320 columns.",
        "Accuracy: [fusion of network and physics](fusion/README.md), [degraded recordings]"
        "(stability/README.md).",
    )
    chart = report.intervals("By stage, in two parallel processes", "wall time [s]", times)
    rows = [{"stage": name} | dict(spent) for name, spent in stages.items()]
    return report.Page("Scoring: time and memory", tree, words, (report.Section("", rows),), chart)


STUDY = Study(measure, "scoring/results.json", page, ("learn/models/mono",), needs=("score",), timed=True)
