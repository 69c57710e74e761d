"""Stand-ins for the pipeline: sequences without rendering, and sequences that fail."""

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from synth.dataset.store import Writer
from synth.errors import UserError
from synth.job.schema import Job

ProgressCallback = Callable[[str, int, int], None]


def sequence(job: Job, index: int, folder: Path, report: ProgressCallback) -> None:
    """A sequence of random fields, which depend on the job's seed and the index alone."""
    rng = np.random.default_rng((job.seed, index))
    width, height = job.render.size
    writer = Writer(folder, index, frames=job.frames, size=(height, width), job=job)
    writer.put("time", np.arange(job.frames) / job.fps)
    writer.put("force", rng.normal(size=(job.frames, 3)))
    writer.put("tissue", rng.random((height, width)) > 0.2)
    writer.put("area", rng.random((height, width)))
    for t in range(job.frames):
        report("render", t, job.frames)
        writer.put_frame("rgb", t, rng.integers(0, 256, (height, width, 3)).astype(np.uint8))
        for name in ("visible", "tool", "glare"):
            writer.put_frame(name, t, rng.random((height, width)) > 0.5)
        writer.put_frame("flow", t, rng.normal(size=(height, width, 2)))
        writer.put_frame("depth", t, rng.random((height, width)) + 300)
        writer.put_frame("traction", t, rng.normal(size=(height, width, 3)))
    writer.seal(**attributes(index, rng))


def attributes(index: int, rng: np.random.Generator) -> dict[str, Any]:
    """Attributes of a stand-in's store."""
    gesture = {"kind": "pull", "load": 0.1}
    return {
        "scenario": {"index": index, "family": "healthy", "gestures": [gesture]},
        "scale_mm_per_px": 0.1,
        "young_kpa": float(rng.uniform(0.5, 3)),
        "poisson": 0.4,
        "timings": {"render": {"cpu_s": time.process_time(), "wall_s": 0.0}},
    }


def fail_by_index(job: Job, index: int, folder: Path, report: ProgressCallback) -> None:
    """Sequence 1 aborts, 2 fills memory, 3 is NaN, 4 raises, 6 and 8 are refused, 7 fails once."""
    if index == 1:
        report("render", 0, 1)
        os.abort()
    if index == 2:
        blocks = []
        while True:
            blocks.append(np.ones(1 << 22))
            report("fem", len(blocks), 1 << 20)
    if index == 3:
        writer = Writer(folder, index, frames=job.frames, size=(8, 8), job=job)
        writer.put("force", np.full((job.frames, 3), np.nan))
    if index == 4:
        raise ZeroDivisionError("by nought")
    if index in (6, 8):
        raise UserError("the load is past the material's range")
    if index == 7:
        marker = folder / ".run" / "tried"
        if not marker.exists():
            marker.touch()
            os.kill(os.getpid(), 9)
    sequence(job, index, folder, report)


def record_gpus(job: Job, index: int, folder: Path, report: ProgressCallback) -> None:
    """A slow sequence that writes the GPUs visible to it into a file, so that every worker gets one."""
    (folder / ".run" / f"saw-{index}").write_text(os.environ.get("CUDA_VISIBLE_DEVICES", "unset"))
    slow(job, index, folder, report)


def hang(job: Job, index: int, folder: Path, report: ProgressCallback) -> None:
    """A sequence that takes ten minutes."""
    time.sleep(600)


def full(job: Job, index: int, folder: Path, report: ProgressCallback) -> None:
    """A sequence; from the third one on the disk is full."""
    if index >= 2:
        raise OSError(28, "No space left on device")
    sequence(job, index, folder, report)


def slow(job: Job, index: int, folder: Path, report: ProgressCallback) -> None:
    """A sequence that takes a quarter of a second, so that it can be interrupted."""
    for t in range(5):
        report("fem", t, 5)
        time.sleep(0.05)
    sequence(job, index, folder, report)


def stuck(job: Job, index: int, folder: Path, report: ProgressCallback) -> None:
    """A sequence; from the fourth one on it runs until it is interrupted."""
    while index >= 3:
        report("fem", 0, 5)
        time.sleep(0.05)
    sequence(job, index, folder, report)


def consistent(job: Job, index: int, folder: Path, report: ProgressCallback, fault: str = "") -> None:
    """A flat tissue, parallel to the image plane, that slides to the right under a load: all invariants hold.

    `fault` names a field that is made wrong, for tests of the checks.
    """
    rng = np.random.default_rng((job.seed, index))
    width, height = job.render.size
    frames, focal, distance = job.frames, 1000.0, 300.0
    rows, columns = np.mgrid[:height, :width].astype(np.float64)
    texture = _texture(rng)
    tissue = np.hypot(rows - height / 2, columns - width / 2) < 0.45 * height
    area = np.where(tissue, (distance / focal) ** 2, 0.0)
    spot = np.exp(-((rows - height / 2) ** 2 + (columns - width / 2) ** 2) / (2 * (height / 20) ** 2))
    spot *= spot > 1e-3
    load = np.array([1.0, 0.5, 2.0])
    spot /= (spot * area).sum()
    share = np.arange(frames) / (frames - 1)
    pressing = 0.0 if fault == "still" else 1.0
    force = share[:, None] * load * {"force": 2.0, "no_force": 0.0}.get(fault, pressing)

    writer = Writer(folder, index, frames=frames, size=(height, width), job=job)
    writer.put("time", np.arange(frames) / job.fps)
    writer.put("force", force)
    writer.put("tissue", tissue & (fault != "no_tissue"))
    writer.put("area", area)
    for t in range(frames):
        shift_px = 6.0 * share[t]
        tool = columns < 6
        flow = np.zeros((height, width, 2))
        flow[tissue, 0] = -shift_px if fault == "flow" else shift_px
        flow[tissue, 1] = 1.0 if fault == "rest" and t == 0 else 0.0
        if fault == "fold" and t:
            flow[tissue, 0] -= 2 * (columns - width / 2)[tissue] * (np.abs(columns - width / 2) < 10)[tissue]
        recovered = flow + (0.1 if fault == "recovered_rest" else 0.0)
        picture = texture(rows, columns - shift_px) * (fault != "black")
        is_outside = (columns + flow[..., 0] < 8) | (columns + flow[..., 0] > width - 1)
        writer.put_frame("rgb", t, np.repeat(picture[..., None], 3, axis=-1).astype(np.uint8))
        writer.put_frame("flow", t, flow)
        occlusion = tool | (np.abs(rows - height / 2) < 8) if fault == "visibility" else tool
        writer.put_frame("visible", t, ~is_outside)
        writer.put_frame("tool", t, occlusion)
        writer.put_frame("glare", t, np.zeros_like(tissue))
        writer.put_frame("depth", t, np.full((height, width), -1.0 if fault == "depth" and t else distance))
        load_share = 1e-3 if fault == "load_rest" and t == 0 else share[t] * pressing
        writer.put_frame("traction", t, load_share * spot[..., None] * load)
        if job.render.stereo_mm:
            motion = np.zeros((height, width, 3))
            motion[..., 0] = flow[..., 0] * distance / focal
            motion[..., 2] = 0.1 * tissue if fault == "motion" else 0.0
            writer.put_frame("motion", t, motion)
            writer.put_frame("rgb_right", t, np.repeat(picture[..., None], 3, axis=-1).astype(np.uint8))
            writer.put_frame("flow_right", t, -flow if fault == "right_flow" else flow)
            writer.put_frame("visible_right", t, ~is_outside)
            writer.put_frame("depth_right", t, np.full((height, width), distance + (fault == "right_depth")))
        writer.put_frame("flow_recovered", t, recovered)
        writer.put_frame("flow_confidence", t, np.ones((height, width)))
    writer.put("disparity", np.full((height, width), 1.0 if fault == "disparity" else 0.0))
    baseline = job.render.stereo_mm
    right_centre_px = width / 2 + focal * baseline / distance
    calibration = {"distortion": [0.0] * 5, "rotation": np.eye(3).tolist()}
    right = calibration | {
        "K": [[focal, 0, right_centre_px], [0, focal, height / 2], [0, 0, 1]],
        "baseline_mm": baseline,
    }
    right["translation"] = [-baseline, 0.0, distance]
    focal *= 0.5 if fault == "camera" else 1.0
    tip = np.zeros((frames, 2, 3))
    tip[:, :, 0] = (6.0 * share * distance / 1000.0 + (3.0 if fault == "contact" else 0.0))[:, None]
    energy = 0.4 * np.square(share) * (load @ load)
    energy[-1] *= 1.7 if fault == "compliance" else 1.0
    attrs = attributes(index, rng)
    attrs["scenario"]["gestures"][0]["footprint_mm"] = 3.0
    attrs["scale_mm_per_px"] = distance / 1000.0 * (1.5 if fault == "scale" else 1.0)
    attrs["translation"] = [0.0, 0.0, distance]
    attrs["K"] = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
    instruments = [{"tip_mm": tip.tolist(), "force_mn": force.tolist()}]
    mechanics = {"elastic": True, "energy_mn_mm": energy.tolist(), "instruments": instruments}
    writer.seal(**attrs, **calibration, **({"right": right} if baseline else {}), mechanics=mechanics)


def _texture(rng: np.random.Generator) -> Callable[..., Any]:
    waves = rng.normal(scale=0.6, size=(20, 2))
    phases = rng.uniform(0, 6.28, 20)

    def brightness(rows: Any, columns: Any) -> Any:
        total = sum(np.sin(a * rows + b * columns + c) for (a, b), c in zip(waves, phases, strict=True))
        return np.clip(128 + 15 * total, 0, 255)

    return brightness


def wrong(fault: str) -> Callable[[Job, int, Path, ProgressCallback], None]:
    """`consistent` with one fault, sealed."""
    return lambda job, index, folder, report: consistent(job, index, folder, report, fault)
