"""The runs of an experiment as two tables: a line a run (`runs.json`), one a sequence (`sequences.parquet`).

What runs have in common of their settings stands once. A run's numbers have six digits, a
sequence's scores four, the moments of its map seven, for they are subtracted from one another.
`pandas.read_parquet` shows the second to whoever wants to check.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from bench.output.write import keep
from evidence.measuring import four_digits, shortened

SCORES = (
    "map_r2",
    "map_rmse",
    "map_rmse_wide",
    "force_mae",
    "peak_error_share",
    "ghost_relative",
    "ghost_far",
    "stray_mn",
    "low_over_mn",
    "localisation_mm",
)
"""What is kept of a tested sequence (`ClipScore` and `coarse_rmse` say what they are), beside its moments."""
MOMENTS = ("n", "t", "p", "tt", "pp", "tp")
"""Of force density true (t) and said (p) over the map's cells: count, sums, sums of products."""
_OF_YOUNG = ("map_r2_pooled", "force_r2_pooled", "force_mae")
_LEFT_OUT = ("sequences", "intervals", "scales", "definitions")
_TYPES = ((("run", "sequence"), pa.string()), (SCORES + MOMENTS, pa.float32()))
_SCHEMA = pa.schema([(name, kind) for names, kind in _TYPES for name in names])


def write(folder: Path, runs: Sequence[Mapping[str, Any]]) -> None:
    """Both tables of runs as `evidence.learn.runs` gives them, by name."""
    runs = sorted(runs, key=lambda run: str(run["name"]))
    settings = [run["settings"] for run in runs]
    common = {k: v for k, v in settings[0].items() if all(k in s and s[k] == v for s in settings)}
    lines = []
    for run in runs:
        known, *others = run["columns"]
        line = {k: v for k, v in run.items() if k not in _LEFT_OUT}
        line["settings"] = {k: v for k, v in run["settings"].items() if k not in common}
        line["history"] = [run["history"][0], run["history"][-1]]
        line["columns"] = {known: run["columns"][known]}
        line["columns"] |= {young: {k: run["columns"][young][k] for k in _OF_YOUNG} for young in others}
        lines.append(json.dumps(shortened(line), separators=(",", ":")))
    text = f'{{"settings": {json.dumps(common)}, "runs": [\n' + ",\n".join(lines) + "\n]}\n"
    keep(folder, "runs.json", text)
    rows = [
        {"run": run["name"], "sequence": s["name"]}
        | {name: four_digits(s[name]) for name in SCORES if s.get(name) is not None}
        # An R² of 0.9 is a difference of these: a digit more.
        | {name: four_digits(value, 16) for name, value in zip(MOMENTS, s["map_moments"], strict=False)}
        for run in runs
        for s in run["sequences"]
    ]
    pq.write_table(
        pa.Table.from_pylist(rows, _SCHEMA),
        folder / "sequences.parquet",
        compression="zstd",
        compression_level=19,
        use_dictionary=["run", "sequence"],
        use_byte_stream_split=[*SCORES, *MOMENTS],
    )


def read(folder: Path) -> list[dict[str, Any]]:
    """The runs of an experiment, by name, as they were written; none if there are no tables."""
    if not (folder / "runs.json").is_file():
        return []
    tree = json.loads((folder / "runs.json").read_text("utf-8"))
    rows: dict[str, list[dict[str, Any]]] = {}
    for line in pq.read_table(folder / "sequences.parquet").to_pylist():
        row = {name: line[name] for name in SCORES if line[name] is not None}
        row |= {"name": line["sequence"], "map_moments": [line[name] for name in MOMENTS]}
        rows.setdefault(line["run"], []).append(row)
    return [
        run | {"settings": tree["settings"] | run["settings"], "sequences": rows[run["name"]]}
        for run in tree["runs"]
    ]


def column(runs: Iterable[Mapping[str, Any]], key: str) -> NDArray[np.float64]:
    """One score of every tested sequence of some runs, in order; NaN where it has none."""
    return np.array([s.get(key, math.nan) for run in runs for s in run["sequences"]], np.float64)
