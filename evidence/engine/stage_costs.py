"""What each stage of a dataset cost: CPU-seconds a frame and peak memory, from what the stores recorded."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from evidence.measuring import measuring
from synth.dataset.store import Dataset
from synth.errors import UserError


@measuring("out --out runs/stages", said="Folder for stages.json.", file="stages.json")
def stages(
    data: Annotated[Path, typer.Argument(help="A dataset made by `synth render`.")],
) -> dict[str, Any]:
    """CPU-seconds a frame and peak memory, stage by stage, of a rendered dataset."""
    return measure(Dataset(data))


def measure(dataset: Dataset) -> dict[str, Any]:
    """Median and largest over sequences of each stage's CPU time a frame [s], and the peak memory [MB].

    Raises:
        UserError: a store has no timings.
    """
    costs: dict[str, list[float]] = {}
    peak, size, frames = 0.0, (0, 0), 0
    for sequence in dataset:
        timings = sequence.attrs.get("timings")
        if not timings:
            raise UserError(f"{sequence.path}: records no timings")
        peak = max(peak, float(timings["peak_rss_mb"]))
        size, frames = sequence.size, sequence.frames
        for name, spent in timings.items():
            if isinstance(spent, dict):
                costs.setdefault(name, []).append(float(spent["cpu_s"]) / sequence.frames)
    summary = {
        name: {"median": round(float(np.median(c)), 4), "largest": round(max(c), 4)}
        for name, c in costs.items()
    }
    return {
        "sequences": len(dataset),
        "frames": frames,
        "size": [size[1], size[0]],
        "cpu_s_a_frame": summary,
        "cpu_s_a_frame_all_stages": round(sum(stage["median"] for stage in summary.values()), 4),
        "peak_rss_mb": peak,
    }
