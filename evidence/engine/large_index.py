"""Do status and report stay quick on a dataset of a hundred thousand sequences?"""

from __future__ import annotations

import json as json_
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from bench.output import machine, write
from synth.dataset import index
from synth.dataset.folder import write_whole
from synth.job.schema import Job

_TIMED = """
import json, resource, sys, time
from pathlib import Path
wall = time.perf_counter()
from synth.engine import status
from synth.publish import report
root = Path(sys.argv[2])
status.read_status(root) if sys.argv[1] == "status" else report.write_report(root, root / "report.html")
used = resource.getrusage(resource.RUSAGE_SELF)
print(json.dumps({"cpu_s": used.ru_utime + used.ru_stime, "wall_s": time.perf_counter() - wall,
                  "peak_mb": used.ru_maxrss * 1024 / 1e6}))
"""


def scale(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the results.")] = Path(
        "docs/results/engine/scale"
    ),
    sequences: Annotated[int, typer.Option(help="Rows of the simulated index.")] = 100_000,
    seed: Annotated[int, typer.Option(help="Of the simulated rows.")] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print JSON to standard output.")] = False,
) -> None:
    """Simulates an index (and the folders it names) and times `synth status` and `synth report` on it."""
    with tempfile.TemporaryDirectory() as scratch:
        root = Path(scratch)
        simulate(root, sequences, np.random.default_rng(seed))
        found = {name: _timed(name, root) for name in ("status", "report")}
    result = {"sequences": sequences, **found, "seed": seed, "machine": machine.describe()}
    write.keep(out, "scale.json", result)
    if json:
        print(json_.dumps(result))
    else:
        for name, row in found.items():
            print(f"{name}: {row['cpu_s']:.2f} CPU-s, {row['wall_s']:.2f} s, {row['peak_mb']:.0f} MB")


def simulate(root: Path, count: int, rng: np.random.Generator) -> None:
    """A dataset's folder with `count` sequences in name only: index, failures, empty stores."""
    job = Job(sequences=count)
    described = {"identity": "0" * 32, "job": job.model_dump(mode="json")}
    write_whole(root / "dataset.json", json_.dumps(described))
    (root / ".run/failed").mkdir(parents=True)
    rows = []
    for k in range(count):
        if k % 500 == 7:
            reason = f"reason {k % 3}"
            record = {"index": k, "reason": reason, "kind": "crash", "tries": 3, "log": ""}
            write_whole(root / f".run/failed/{k:06d}.json", json_.dumps(record), durable=False)
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
    done = subprocess.run(
        [sys.executable, "-c", _TIMED, name, str(root)], capture_output=True, text=True, check=True
    )
    return {key: round(value, 3) for key, value in json_.loads(done.stdout).items()}
