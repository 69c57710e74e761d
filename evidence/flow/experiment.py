"""Flow: endpoint error, divergence, masks, drift and time, each figure asked against measured.

Run: python -m evidence.flow.experiment [--only time]
"""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import torch
import typer
from numpy.typing import NDArray

from evidence import report
from evidence.flow.measure import Error, epe, inpainted, measure
from evidence.flow.scenes import CLEAN, Flags, Pair, Recipe, Rgb, Stage, pairs
from synth.flow import mask_detection
from synth.flow.estimator import create
from synth.flow.track import Tracker
from synth.job.schema import Job
from synth.render.scene import SceneState
from synth.sequence import scenario
from synth.sequence.scene import at_rest

Row = dict[str, Any]
_WET = {"glare": 0.75}  # of a job's light: the automatic mask then takes about 30% of the tissue
_HALF = 112  # px, of the crop around a rendered contact


def main(
    out: Path = report.RESULTS / "flow/benchmark",
    only: Annotated[str, typer.Option(help="Parts to run.")] = "warped,drift,rendered,time",
    count: int = 6,
    frames: Annotated[int, typer.Option(min=60, help="Of the drift sequence.")] = 200,
    seed: int = 2641,
) -> None:
    """Asked against measured on `count` pairs a source; seeds 4 and 5 were tuned on."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    parts: dict[str, Callable[[], Iterator[Row]]] = {
        "warped": lambda: _warped(count, seed),
        "drift": lambda: _drift(frames, seed),
        "rendered": lambda: _rendered(max(2, count // 2), seed),
        "time": lambda: _time(seed),
    }
    rows = [{"part": part} | row for part in only.split(",") for row in parts[part]()]
    found = {"torch": torch.__version__, "opencv": cv2.__version__, "rows": rows}
    report.save(out, "results.json", found, page(found))
    report.show(found)


def row(what: str, on: str, measured: float, asked: float | None = None, unit: str = "px") -> Row:
    """One figure; asked: the largest value allowed, None for comparison only."""
    return {"what": what, "on": on, "asked": asked, "measured": measured, "unit": unit}


def page(found: Mapping[str, Any]) -> report.Page:
    """Draws `results.json`."""
    charts = []
    for on in dict.fromkeys(one["on"] for one in found["rows"]):
        asked = [one for one in found["rows"] if one["on"] == on and one["asked"]]
        if asked:
            shares = report.bars({one["what"]: one["measured"] / one["asked"] for one in asked})
            charts.append(report.Chart(f"{on}: reached where at most 1", "measured / asked", shares))
    sections = [report.Section("Every figure", found["rows"])]
    return report.Page("Flow: asked against measured", found, charts, sections)


def _asked(on: str, ours: Error) -> Iterator[Row]:
    yield row("EPE mean, given masks", on, ours.mean, 0.20)
    yield row("EPE contact, given masks", on, ours.contact, 0.40)
    yield row("EPE contact where it is seen, given masks", on, ours.contact_seen, 0.40)
    yield row("EPE hidden under the tool, given masks", on, ours.hidden, 0.45)
    yield row("magnitude error", on, ours.magnitude, 0.06, "share")
    yield row("divergence, relative RMS", on, ours.divergence, 0.45, "share")
    yield row("divergence, 1 - correlation", on, 1 - ours.divergence_r, 0.10, "share")


def _automatic(picture: Rgb, _: Flags) -> Flags:
    """Masks without hand work."""
    return ~mask_detection.blocked(picture)


def _warped(count: int, seed: int) -> Iterator[Row]:
    on = "warped procedural cortex"
    dirty, clean = list(pairs(Recipe(), count, seed)), list(pairs(CLEAN, count, seed))
    ours = measure(create("tvl1"), dirty)
    yield from _asked(on, ours)
    for name in ("opencv-tvl1", "dis"):
        theirs = measure(create(name), dirty)
        yield row(f"EPE mean, given masks: {name}", on, theirs.mean)
        yield row(f"divergence, relative RMS: {name}", on, theirs.divergence, unit="share")
    filled = measure(create("tvl1"), [inpainted(pair) for pair in dirty])
    yield row("EPE masked / mean-intensity inpainting", on, ours.mean / filled.mean, 0.6, "ratio")
    unaided = measure(create("tvl1"), dirty, _automatic)
    yield row("EPE automatic / exact masks", on, unaided.mean / ours.mean, 1.25, "ratio")
    mine, theirs = measure(create("tvl1"), clean), measure(create("opencv-tvl1"), clean)
    yield row("EPE clean pairs", on, mine.mean, 0.12)
    yield row("EPE clean pairs / tuned OpenCV TV-L1", on, mine.mean / theirs.mean, 1.3, "ratio")


def _drift(frames: int, seed: int) -> Iterator[Row]:
    """Pulls and releases in cycles of 40 frames; errors at equal phase, early and late."""
    rng = np.random.default_rng([seed, 200])
    stage = Stage.set(Recipe(), rng)
    rest = stage.rest(rng)
    tracker = Tracker("tvl1", rest[0], rest[1], np.ones(rest[1].shape, bool))
    errors = []
    for t in range(1, frames):
        shot = stage.against(rest, 0.5 - 0.5 * float(np.cos(2 * np.pi * t / 40)), rng)
        flow, _ = tracker.step(shot.now, ~shot.now_usable)
        errors.append(float(epe(flow, shot.flow)[shot.inside & ~shot.hidden].mean()))
    early, late, on = float(np.mean(errors[19:39])), float(np.mean(errors[-20:])), f"{frames} frames, 224²"
    yield row("last 20 frames / frames 20-40", on, late / early, 1.3, "ratio")
    yield row("EPE mean, last 20 frames", on, late)


def _rendered(count: int, seed: int) -> Iterator[Row]:
    for on, light in (("rendered, 7 px, default glare", {}), ("rendered, 7 px, 30% glare", _WET)):
        wet = list(rendered(count, seed, 7.0, light=light))
        share = float(np.mean([pair.glare[pair.inside].mean() for pair in wet]))
        yield row("share of tissue masked as glare", on, share, unit="share")
        for name in ("tvl1", "opencv-tvl1", "dis"):
            found = measure(create(name), wet)
            asked = (0.14, 0.33, 0.16) if name == "tvl1" else (None, None, None)
            yield row(f"EPE mean, automatic glare mask: {name}", on, found.mean, asked[0])
            yield row(f"EPE 95th percentile, automatic glare mask: {name}", on, found.p95, asked[1])
            yield row(f"EPE in glare, automatic glare mask: {name}", on, found.glare, asked[2])
    tooled = [_cropped(pair) for pair in rendered(count, seed + 1, 10.0, tool=True)]
    yield from _asked("rendered, 10 px, tool, 224²", measure(create("tvl1"), tooled))


def rendered(
    count: int, seed: int, peak_px: float, *, tool: bool = False, light: Mapping[str, float] | None = None
) -> Iterator[Pair]:
    """Pairs of our own renderer, with own anatomy, look and view, glare masked as from the picture alone.

    The surface is pulled by a field in closed form, not by the FEM: its size can be asked for, and flow is
    measured apart from physics.
    """
    render = {"size": (640, 480), "spp": 4, "tool": tool}
    job = Job.model_validate(
        {"seed": seed, "sequences": count, "frames": 2, "render": render, "light": light or {}}
    )
    for index in range(count):
        yield _pair(job, index, peak_px)


def _pair(job: Job, index: int, peak_px: float) -> Pair:
    scene = at_rest(job, index, ["pull"])
    rng = np.random.default_rng([job.seed, index])
    rest = scene.surface.vertices
    dimple = _dimple(rest, rng, job.anatomy.craniotomy.radius_mm)
    held = int(np.argmax(np.linalg.norm(dimple, axis=1)))
    azimuth = rng.uniform(0, 2 * np.pi)
    shaft = np.array([np.cos(azimuth), np.sin(azimuth), 1.0]) / np.sqrt(2)
    side = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    tips, shafts = rest[held] + np.stack([side, -side]), np.stack([shaft, shaft])
    seeds = scenario.frame_seeds(job, index)

    def shoot(amount: float, away_mm: float, seed: int) -> Any:
        at = tips + amount * dimple[held] + away_mm * shafts
        return scene.renderer.render(SceneState(rest + amount * dimple, at, shafts), seed)

    before = shoot(0.0, 60.0, seeds[0])
    amount = peak_px * scene.view.mm_per_px
    # Perspective and tilt: the picture's peak is not the world's.
    seen = shoot(amount, 60.0, seeds[1]).flow
    now = shoot(amount * peak_px / float(np.hypot(seen[..., 0], seen[..., 1]).max()), 0.0, seeds[1])
    tissue, length = scene.tissue, np.hypot(now.flow[..., 0], now.flow[..., 1])
    glare = mask_detection.glare(now.rgb)
    return Pair(
        rest=before.rgb,
        now=now.rgb,
        flow=now.flow,
        rest_usable=tissue & ~mask_detection.glare(before.rgb),
        now_usable=~(glare | now.tool),
        tool=now.tool,
        glare=glare,
        hidden=tissue & ~now.visible,
        contact=tissue & (length > 0.7 * length.max()),
        inside=tissue,
    )


def _dimple(rest: NDArray[np.float64], rng: np.random.Generator, radius_mm: float) -> NDArray[np.float64]:
    """Displacement (V, 3) of a pull near the middle, largest 1: outwards and sideways, 1/r beyond."""
    towards, lift = rng.uniform(0, 2 * np.pi), rng.uniform(0.2, 0.6)
    away = rest[:, :2] - rng.uniform(-3, 3, 2)
    distance = np.linalg.norm(away, axis=1)
    rim = np.clip(1.15 - np.linalg.norm(rest[:, :2], axis=1) / radius_mm, 0, 0.5) / 0.5
    size = rim**2 * (3 - 2 * rim) / np.sqrt(1 + (distance / 3.0) ** 2)
    field = size[:, None] * np.array([np.cos(towards), np.sin(towards), lift])
    field[:, :2] -= 0.05 * (size * np.exp(-((distance / 4.0) ** 2)))[:, None] * away
    return np.asarray(field / np.linalg.norm(field, axis=1).max(), np.float64)


def _cropped(pair: Pair) -> Pair:
    """The square around the contact."""
    height, width = pair.contact.shape
    row, column = (int(np.median(at)) for at in np.nonzero(pair.contact))
    top = int(np.clip(row - _HALF, 0, height - 2 * _HALF))
    left = int(np.clip(column - _HALF, 0, width - 2 * _HALF))
    crop = slice(top, top + 2 * _HALF), slice(left, left + 2 * _HALF)
    return Pair(**{name: np.ascontiguousarray(value[crop]) for name, value in vars(pair).items()})


def _time(seed: int) -> Iterator[Row]:
    some = list(pairs(replace(Recipe(), size=256), 5, seed))
    measure(create("tvl1"), some[:1])  # compiles
    on = f"256², one thread, {platform.machine()}"
    yield row("CPU cold", on, measure(create("tvl1"), some).cpu_s, 0.5, "CPU-s")
    yield row("CPU warm", on, measure(create("tvl1"), some, warm=0.9).cpu_s, 0.2, "CPU-s")


if __name__ == "__main__":
    typer.run(main)
