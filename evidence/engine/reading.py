"""How long does a random frame take to come from a dataset, as a network asks for it?"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
import zarr

from evidence.measuring import measuring
from synth.dataset.store import Dataset
from synth.dataset.torch_dataset import Frames

_SETS = {
    "flow and traction": ("flow", "traction"),
    "picture, flow and traction": ("rgb", "flow", "traction"),
    "all that has frames": (),
}


@measuring("out --count 50 --out runs/reading", out="docs/results/engine/reading", file="reading.json")
def reading(
    dataset: Annotated[Path, typer.Argument(help="A rendered dataset.")],
    count: Annotated[int, typer.Option(help="Random frames for each set of fields.")] = 100,
    seed: Annotated[int, typer.Option(help="Of the choice of frames.")] = 0,
) -> dict[str, Any]:
    """Reads random frames by the dataset's own reader and by plain Zarr; files are in the system's memory."""
    first = Dataset(dataset)[0]
    every = tuple(name for name in first.fields if first[name].ndim >= 3 and first[name].dims[0] == "frame")
    rows: list[dict[str, Any]] = []
    for title, fields in _SETS.items():
        frames = Frames(dataset, fields or every)
        chosen = np.random.default_rng(seed).integers(len(frames), size=count)
        for position in sorted({0, len(frames) - 1, *(int(k) for k in chosen)}):
            frames[position]  # every store opened, every file in memory: what is timed is our own work
        found = {
            "ours": _timed(lambda k, frames=frames: frames[k], chosen),  # type: ignore[misc]
            "zarr": _timed(_by_zarr(dataset, fields or every, first.frames), chosen),
        }
        raw = sum(first[name][0].nbytes for name in fields or every)
        rows.append({"fields": list(fields or every), "title": title, "raw_mb": round(raw / 1e6, 2), **found})
    return {
        "frame_px": [first.size[1], first.size[0]],
        "sequences": len(Dataset(dataset)),
        "frames_read": count,
        "sets": rows,
        "seed": seed,
    }


def _by_zarr(dataset: Path, fields: tuple[str, ...], frames: int) -> Any:
    groups = [zarr.open_group(str(path), mode="r") for path in Dataset(dataset).paths]
    arrays = [{name: group[name] for name in fields} for group in groups]

    def read(position: int) -> Any:
        return {name: array[position % frames] for name, array in arrays[position // frames].items()}

    return read


def _timed(read: Any, chosen: Any) -> dict[str, float]:
    spent = []
    for position in chosen:
        start = time.perf_counter()
        read(int(position))
        spent.append(1e3 * (time.perf_counter() - start))
    return {
        "median_ms": round(float(np.median(spent)), 2),
        "p95_ms": round(float(np.quantile(spent, 0.95)), 2),
    }
