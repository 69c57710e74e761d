"""What the renderer costs and whether it keeps its promises: time, memory, accuracy of truth, equal bytes."""

from __future__ import annotations

import hashlib
import os
import resource
import subprocess
import sys
import time
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from bench.output import machine, write
from evidence.measuring import measuring
from evidence.render.case import Case, case
from synth.job.schema import Job
from synth.sequence import scenario

_NOISE_SEEDS = 4
_SCENERY = ("retractor", "cottonoid", "bone", "drape")


class Question(StrEnum):
    """What to measure."""

    cost = "cost"
    first = "first"
    frames = "frames"
    scenes = "scenes"
    scenery = "scenery"
    truth = "truth"
    bytes = "bytes"


@measuring("cost frames", said="Folder for one JSON a question.")
def experiment(
    question: Annotated[list[Question], typer.Argument(help="What to measure.")],
    variant: Annotated[str, typer.Option(help="As in a job's render.variant.")] = "auto",
    spp: Annotated[int, typer.Option(min=1, help="Light paths a pixel.")] = 4,
    count: Annotated[int, typer.Option(min=2, help="Frames or scenes to measure over.")] = 20,
    seed: Annotated[int, typer.Option(help="Of the job.")] = 11,
    out: Path | None = None,
) -> dict[str, Any]:
    """Time, memory, truth and determinism of 640x480 frames with the instrument in view."""
    job = Job.model_validate({"seed": seed, "render": {"variant": variant, "spp": spp}})
    measured: dict[str, Any] = {}
    for asked in question:
        found = _MEASURES[asked](job, count)
        found |= {"variant": variant, "spp": spp, "seed": seed, "machine": machine.describe()}
        measured[asked.value] = found
        if out is not None:
            name = f"{asked.value}.json" if variant == "auto" else f"{asked.value}-{variant}.json"
            write.keep(out, name, found)
    return measured


def _cost(job: Job, count: int) -> dict[str, Any]:
    """CPU-seconds a frame: update, render, sensor and truth."""
    ours = case(job, 0)
    _shoot(ours, 0)
    spent = []
    for k in range(count):
        start = time.process_time()
        _shoot(ours, k)
        spent.append(time.process_time() - start)
    return {"count": count, "cpu_s_a_frame": _summary(spent), "variant_used": ours.studio.variant}


def _first(job: Job, count: int) -> dict[str, Any]:
    """From the start of a fresh process to its first frame: CPU and elapsed seconds."""
    code = (
        "import sys, time; from synth.job.schema import Job; from evidence.render.cost import _shoot; "
        "from evidence.render.case import case; _shoot(case(Job.model_validate_json(sys.argv[1]), 0), 0); "
        "print(time.process_time())"
    )
    cpu, elapsed = [], []
    for _ in range(min(count, 3)):
        start = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-c", code, job.model_dump_json()], capture_output=True, text=True, check=True
        )
        elapsed.append(time.perf_counter() - start)
        cpu.append(float(done.stdout.split()[-1]))
    return {"cpu_s": _summary(cpu), "elapsed_s": _summary(elapsed), "load": list(os.getloadavg())}


def _frames(job: Job, count: int) -> dict[str, Any]:
    """Memory over many frames of one scene."""
    ours = case(job, 0)
    resident = []
    for k in range(count):
        _shoot(ours, k % 24)
        resident.append(_resident_mb())
    return _growth(resident, after=max(count // 10, 1))


def _scenes(job: Job, count: int) -> dict[str, Any]:
    """Memory over many scenes, one after another in one process."""
    resident = []
    for k in range(count):
        _shoot(case(job.model_copy(update={"seed": job.seed + k}), 0), 0)
        resident.append(_resident_mb())
    return _growth(resident, after=max(count // 10, 1))


def _scenery(job: Job, count: int) -> dict[str, Any]:
    """A frame's CPU and its tissue's noise with all scenery allowed over those with none, in turns."""
    told = job.render.model_dump() | {"scenery": _SCENERY}
    full = Job.model_validate({**job.model_dump(exclude={"render"}), "render": told})
    rows, shown = [], []
    for index in range(2):
        cases = {}
        for name, of in (("none", job), ("scenery", full)):
            start = time.process_time()
            cases[name] = case(of, index)
            _shoot(cases[name], 0)
            rows.append({"scene": index, "with": name, "first_s": time.process_time() - start})
        shown.append(list(scenario.draw(full, index).look.scenery))
        spent: dict[str, list[float]] = {name: [] for name in cases}
        for k in range(count):
            for name in sorted(cases, reverse=bool(k % 2)):
                start = time.process_time()
                _shoot(cases[name], k)
                spent[name].append(time.process_time() - start)
        tissue = cases["none"].studio.still.tissue & cases["scenery"].studio.still.tissue
        for row, (name, one) in zip(rows[-2:], cases.items(), strict=True):
            row |= {"frame_s": float(np.median(spent[name])), **_noise(one, tissue)}
        rows[-1]["ratio"] = float(np.median(np.array(spent["scenery"]) / spent["none"]))
    return {"count": count, "shown": shown, "rows": [_short(row) for row in rows]}


def _noise(ours: Case, where: np.ndarray[Any, np.dtype[np.bool_]]) -> dict[str, float]:
    """Standard deviation of the light over seeds, as a share of its mean, over pixels of a mask."""
    light = np.stack(
        [
            ours.studio.frame(ours.vertices, ours.tips, ours.shafts, k).radiance.mean(axis=2)[where]
            for k in range(_NOISE_SEEDS)
        ]
    ).astype(np.float64)
    share = light.std(axis=0, ddof=1) / np.maximum(light.mean(axis=0), 1e-6)
    return {"noise_median": float(np.median(share)), "noise_mean": float(share.mean())}


def _short(row: dict[str, Any]) -> dict[str, Any]:
    return {k: float(f"{v:.4g}") if isinstance(v, float) else v for k, v in row.items()}


def _truth(job: Job, count: int) -> dict[str, Any]:
    """Flow against a projection that shares nothing with it: OpenCV's, of points found by trimesh."""
    import cv2
    import trimesh

    errors = []
    for k in range(min(count, 4)):
        ours = case(job, k)
        studio, lens, faces = ours.studio, ours.studio.camera, ours.studio.surface.faces
        moved = ours.moved(2.5)
        flow = studio.frame(moved, ours.held(2.5), ours.shafts, 0).flow
        rows, columns = np.nonzero(studio.still.tissue)
        chosen = np.random.default_rng(k).choice(len(rows), 4000, replace=False)
        pixels = np.stack([columns[chosen], rows[chosen]], axis=1).astype(float)
        flat = cv2.undistortPoints(pixels, lens.K, lens.distortion)[:, 0]
        rays = np.concatenate([flat, np.ones((len(flat), 1))], 1) @ lens.rotation
        mesh = trimesh.Trimesh(ours.vertices, faces, process=False)
        where, ray, face = mesh.ray.intersects_location(
            np.broadcast_to(lens.centre, rays.shape), rays, multiple_hits=False
        )
        bary = trimesh.triangles.points_to_barycentric(ours.vertices[faces[face]], where)
        goal = np.einsum("nk,nkc->nc", bary, moved[faces[face]])
        turn, _ = cv2.Rodrigues(lens.rotation)
        seen, _ = cv2.projectPoints(goal, turn, lens.translation, lens.K, lens.distortion)
        ours_flow = flow[rows[chosen], columns[chosen]][ray]
        errors.append(np.linalg.norm(seen[:, 0] - pixels[ray] - ours_flow, axis=1))
    error = np.concatenate(errors)
    quantiles = {q: float(np.quantile(error, float(q))) for q in ("0.5", "0.99", "0.999", "1.0")}
    return {"points": len(error), "error_px_quantiles": quantiles}


def _bytes(job: Job, count: int) -> dict[str, Any]:
    """Hashes of a frame and its truth with 1, 2 and 4 threads, each in a process of its own."""
    code = (
        "import sys; from synth.job.schema import Job; from evidence.render.case import case; "
        "from evidence.render.cost import digest; "
        "print(digest(case(Job.model_validate_json(sys.argv[1]), 0)))"
    )
    hashes = {}
    for threads in ("1", "2", "4"):
        done = subprocess.run(
            [sys.executable, "-c", code, job.model_dump_json()],
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, "SULCUS_THREADS": threads},
        )
        hashes[f"{threads} threads"] = done.stdout.split()[-1]
    return {"sha256": hashes, "identical": len(set(hashes.values())) == 1}


def digest(ours: Case) -> str:
    """SHA-256 over three frames and their truth."""
    hashed = hashlib.sha256()
    for k in range(3):
        shot = ours.studio.frame(ours.moved(0.5 * k), ours.held(0.5 * k), ours.shafts, k)
        for array in (shot.rgb, shot.radiance, shot.flow, shot.visible, shot.depth, shot.tool, shot.glare):
            hashed.update(np.ascontiguousarray(array).tobytes())
    return hashed.hexdigest()


def _shoot(ours: Case, k: int) -> None:
    lift = 0.1 * k
    ours.studio.frame(ours.moved(lift), ours.held(lift), ours.shafts, k)


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def _growth(resident: list[float], after: int) -> dict[str, Any]:
    """Resident memory once warm and at the end; the warm-up is the first tenth."""
    warm, last = resident[after], resident[-1]
    return {
        "count": len(resident),
        "resident_mb": {"warm": round(warm, 1), "last": round(last, 1), "largest": round(max(resident), 1)},
        "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3, 1),
        "growth_percent": round(100 * (last / warm - 1), 2),
        "every_tenth_mb": [round(v, 1) for v in resident[:: max(len(resident) // 10, 1)]],
    }


def _summary(values: list[float]) -> dict[str, float]:
    low, middle, high = (round(float(f(values)), 3) for f in (np.min, np.median, np.max))
    return {"min": low, "median": middle, "max": high}


_MEASURES = {
    Question.cost: _cost,
    Question.first: _first,
    Question.frames: _frames,
    Question.scenes: _scenes,
    Question.scenery: _scenery,
    Question.truth: _truth,
    Question.bytes: _bytes,
}
