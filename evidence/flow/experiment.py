"""Flow: endpoint error, divergence, masks, drift and time against their targets."""

import platform
from collections.abc import Iterator, Mapping
from typing import Any

import cv2
import numpy as np
import torch

from evidence import report
from evidence.flow.measure import average_jaccard, epe, mean_errors
from evidence.flow.scenes import CLEAN, Pair, Recipe, Stage, pairs
from evidence.study import Study
from synth.flow.confidence import LOW_CONFIDENCE
from synth.flow.estimator import create
from synth.flow.track import Tracker
from synth.flow.tvl1 import Tvl1
from synth.job import reader
from synth.sequence.simulation import simulate

Row = dict[str, Any]
_OOD = report.CHECKOUT / "evidence/curves/mission-ood.yaml"


def measure(count: int = 6, frames: int = 200, seed: int = 2641) -> dict[str, Any]:
    """Figures against their targets, on `count` pairs a source; seeds 4 and 5 were tuned on.

    `frames`: of the drift sequence, at least 60.
    """
    rows = [
        *_measure_warped(count, seed),
        *_measure_drift(frames, seed),
        *_measure_contact(5 * count),
        *_measure_time(seed),
    ]
    return {"torch": torch.__version__, "opencv": cv2.__version__, "rows": rows}


def row(what: str, on: str, measured: float, target: float | None = None, unit: str = "px") -> Row:
    """One figure; target: the largest value allowed, None for comparison only."""
    return {"what": what, "on": on, "target": target, "measured": measured, "unit": unit}


def page(data: Mapping[str, Any]) -> report.Page:
    """Draws `results.json`."""
    limited = [row for row in data["rows"] if row["target"]]
    shares = {f"{row['what']}; {row['on']}": [row["measured"] / row["target"]] for row in limited}
    chart = report.intervals("Target reached if at most 1", "measured / target", shares)
    is_reached = [row["measured"] <= row["target"] for row in limited]
    words = [f"**{sum(is_reached)} of {len(is_reached)} targets are reached.**"]
    sections = [report.Section("", data["rows"])]
    return report.Page("Flow: measured values and targets", data, words, sections, chart)


def _measure_warped(count: int, seed: int) -> Iterator[Row]:
    on = "warped procedural cortex"
    image_pairs, clean_pairs = list(pairs(Recipe(), count, seed)), list(pairs(CLEAN, count, seed))
    errors = mean_errors(create("tvl1"), image_pairs)
    yield row("EPE mean, exact masks", on, errors["mean"], 0.20)
    yield row("EPE mean of no flow", on, errors["still"])
    yield row("EPE contact, exact masks", on, errors["contact"], 0.40)
    yield row("EPE visible part of the contact, exact masks", on, errors["contact_visible"], 0.40)
    yield row("EPE hidden under the tool, exact masks", on, errors["hidden"], 0.45)
    yield row("magnitude error", on, errors["magnitude"], 0.06, "share")
    yield row("divergence, relative RMS", on, errors["divergence"], 0.45, "share")
    yield row("divergence, 1 - correlation", on, 1 - errors["divergence_r"], 0.10, "share")
    for name in ("opencv-tvl1", "dis"):
        baseline = mean_errors(create(name), image_pairs)
        yield row(f"EPE mean, exact masks: {name}", on, baseline["mean"])
        yield row(f"divergence, relative RMS: {name}", on, baseline["divergence"], unit="share")
    detected_px = mean_errors(create("tvl1"), image_pairs, detected=True)["mean"]
    yield row("EPE automatic / exact masks", on, detected_px / errors["mean"], 1.25, "ratio")
    clean_errors, opencv_errors = (mean_errors(create(name), clean_pairs) for name in ("tvl1", "opencv-tvl1"))
    yield row("EPE clean pairs", on, clean_errors["mean"], 0.12)
    yield row("EPE clean pairs, of no flow", on, clean_errors["still"])
    yield row(
        "EPE clean pairs / tuned OpenCV TV-L1", on, clean_errors["mean"] / opencv_errors["mean"], 1.3, "ratio"
    )


def _measure_drift(frames: int, seed: int) -> Iterator[Row]:
    """Drift over pulls and releases in cycles of 40 frames: errors at equal phase, early and late."""
    rng = np.random.default_rng([seed, 200])
    stage = Stage(Recipe(peak_px=10 * 192 / 224), 224, rng)
    rest = stage.shoot(0.0, "", rng)
    tracker = Tracker("tvl1", rest.rgb, rest.glare, np.ones(rest.glare.shape, bool))
    errors = []
    for t in range(1, frames):
        shot = Pair.of(rest, stage.shoot(0.5 - 0.5 * float(np.cos(2 * np.pi * t / 40)), "", rng))
        flow, _ = tracker.step(shot.now, ~shot.now_usable)
        errors.append(float(epe(flow, shot.flow)[shot.inside & ~shot.hidden].mean()))
    early, late, on = float(np.mean(errors[19:39])), float(np.mean(errors[-20:])), f"{frames} frames, 224²"
    yield row("last 20 frames / frames 20-40", on, late / early, 1.3, "ratio")
    yield row("EPE mean, last 20 frames", on, late)


def _measure_contact(count: int) -> Iterator[Row]:
    """Errors at the contact out of distribution, in the frame of the largest force.

    Error of a component over visible tissue with a traction above 5% of its largest, and the gain: the slope
    of recovered on true motion.
    """
    job = reader.load_job(str(_OOD))
    figures: dict[bool, list[tuple[float, float, float]]] = {False: [], True: []}
    for index in range(count):
        scene = simulate(job, index)
        frames = [scene.frame(t) for t in range(scene.strongest + 1)]
        last = frames[-1]
        size = np.linalg.norm(last.traction, axis=-1)
        in_contact = scene.tissue & last.visible & (size > 0.05 * size.max())
        true = last.flow[in_contact]
        paths = np.stack([frame.flow for frame in frames])
        visible = np.stack([frame.visible & scene.tissue for frame in frames])
        for corrected, rows in figures.items():
            track = scene.recover_flow(frames, Tvl1(corrected=corrected))
            flow, tracked = track.flow[-1][in_contact], track.confidence >= LOW_CONFIDENCE
            rms = scene.scale_mm_per_px * float(np.sqrt(np.mean((flow - true) ** 2)))
            gain = float((flow * true).sum() / (true * true).sum())
            rows.append((rms, gain, average_jaccard(epe(track.flow, paths), tracked, visible)))
    for corrected, rows in figures.items():
        errors, gains, jaccards = (np.array(column) for column in zip(*rows, strict=True))
        on = f"contact, {count} scenes out of distribution" + ("" if corrected else ", uncorrected")
        target = (0.03, 0.012, 3.0) if corrected else (None, None, None)
        middle = float(np.median(errors))
        yield row("1 - median gain", on, 1 - float(np.median(gains)), target[0], "share")
        yield row("error of a component, median", on, middle, target[1], "mm")
        yield row("error of a component, worst / median", on, errors.max() / middle, target[2], "ratio")
        yield row("Average Jaccard of all tissue at 2 to 32 px, mean", on, jaccards.mean(), unit="share")


def _measure_time(seed: int) -> Iterator[Row]:
    image_pairs = list(pairs(Recipe(), 5, seed, 256))
    mean_errors(create("tvl1"), image_pairs[:1])  # compiles
    on = f"256², one thread, {platform.machine()}"
    yield row("CPU cold", on, mean_errors(create("tvl1"), image_pairs)["cpu_s"], 0.5, "CPU-s")
    yield row("CPU warm", on, mean_errors(create("tvl1"), image_pairs, warm=0.9)["cpu_s"], 0.2, "CPU-s")


STUDY = Study(
    measure,
    "flow/benchmark/results.json",
    page,
    needs=("mesh", "mechanics", "picture", "truth", "flow"),
    timed=True,
)
