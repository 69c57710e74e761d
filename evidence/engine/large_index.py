"""Do status and report stay quick on a dataset of a hundred thousand sequences?"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from evidence.measuring import measuring
from synth.dataset import index
from synth.dataset.folder import write_whole
from synth.errors import UserError
from synth.job.schema import Job

_ASKED = ("status", "report")


@measuring("--sequences 10000 --out runs/scale", out="docs/results/engine/scale", file="scale.json")
def scale(
    sequences: Annotated[int, typer.Option(help="Rows of the simulated index.")] = 100_000,
    seed: Annotated[int, typer.Option(help="Of the simulated rows.")] = 0,
) -> dict[str, Any]:
    """Simulates an index (and the folders it names) and times `synth status` and `synth report` on it."""
    with tempfile.TemporaryDirectory() as scratch:
        root = Path(scratch)
        simulate(root, sequences, np.random.default_rng(seed))
        found = {name: _timed(name, root) for name in _ASKED}
    return {"sequences": sequences, **found, "seed": seed}


def simulate(root: Path, count: int, rng: np.random.Generator) -> None:
    """A dataset's folder with `count` sequences in name only: index, failures, empty stores."""
    job = Job(sequences=count)
    described = {"identity": "0" * 32, "job": job.model_dump(mode="json")}
    write_whole(root / "dataset.json", json.dumps(described))
    (root / ".run/failed").mkdir(parents=True)
    rows = []
    for k in range(count):
        if k % 500 == 7:
            reason = f"reason {k % 3}"
            record = {"index": k, "reason": reason, "kind": "crash", "tries": 3, "log": ""}
            write_whole(root / f".run/failed/{k:06d}.json", json.dumps(record), durable=False)
            rows.append({"index": k, "status": "failed", "reason": reason})
            continue
        (root / f"{k:06d}.zarr").mkdir()
        rows.append(_row(k, rng))
    index.save_rows(root, rows)


def _row(k: int, rng: np.random.Generator) -> dict[str, Any]:
    return {
        "index": k,
        "status": "done",
        "path": f"{k:06d}.zarr",
        "content_hash": f"{int(rng.integers(1 << 62)):032x}",
        "anatomy": f"seed-{k % 5000}",
        "family": ("healthy", "pale")[k % 2],
        "gesture": ("pull", "push")[k % 2],
        "young_kpa": float(rng.uniform(0.5, 3)),
        "poisson": 0.4,
        "load": float(rng.uniform(0.02, 0.12)),
        "peak_force_mn": float(rng.gamma(2, 3)),
        "peak_flow_px": float(rng.gamma(2, 3)),
        "peak_motion_mm": float(rng.gamma(2, 0.3)),
        "frames": 24,
        "fps": 25.0,
        "width": 640,
        "height": 480,
        "scale_mm_per_px": 0.05,
        "flow_backend": "opencv-tvl1",
        "split": "train",
        "cpu_s": float(rng.uniform(20, 40)),
    }


def _timed(name: str, root: Path) -> dict[str, float]:
    """Time and memory of `synth NAME`, its start included."""
    begun = time.perf_counter()
    asked = subprocess.Popen([sys.executable, "-m", "synth", name, str(root)], stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(asked.pid, 0)
    asked.returncode = os.waitstatus_to_exitcode(status)
    if asked.returncode:
        raise UserError(f"synth {name}: ended with {asked.returncode}")
    found = {
        "cpu_s": used.ru_utime + used.ru_stime,
        "wall_s": time.perf_counter() - begun,
        "peak_mb": used.ru_maxrss * 1024 / 1e6,
    }
    return {key: round(value, 3) for key, value in found.items()}
