"""`bench pareto learn`: what a network costs a frame, and what it gets wrong where it has been trained."""

from __future__ import annotations

import itertools
import json as json_
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from rich.console import Console
from rich.table import Table

from bench.machine import describe
from learn.grid import Grid, Scales, channels
from learn.model import Architecture, flops, fused, parameters
from learn.reference import build
from learn.settings import PRESETS
from learn.threads import set_threads


def pareto(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for results.")] = Path(
        "docs/results/learn/pareto"
    ),
    runs: Annotated[Path, typer.Option(help="Runs whose errors are shown.")] = Path("docs/results/learn"),
    repeats: Annotated[int, typer.Option(help="Frames timed, at least.")] = 30,
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
    json: Annotated[bool, typer.Option("--json", help="Print JSON on stdout.")] = False,
) -> None:
    """Time every network a frame, channels included, on one core (or a GPU), beside its error."""
    set_threads(1)
    errors = _errors(runs)
    rows = []
    for arch, size, layout, precision in _choices(device):
        row = measure(arch, size, layout, precision, repeats, device)
        row["map_rmse"] = errors.get(_shape(arch, size))
        rows.append(row)
        if not json:
            Console(stderr=True).print(
                f"{row['name']}: p50 {row['cpu_ms_p50']:.1f} ms, p95 {row['cpu_ms_p95']:.1f} ms"
            )
    result = {
        "machine": describe() | {"device": device, "threads": 1, "torch": torch.__version__},
        "rows": rows,
    }
    out.mkdir(parents=True, exist_ok=True)
    (out / f"data-{device}.json").write_text(json_.dumps(result, indent=1) + "\n")
    if json:
        print(json_.dumps(result))
    else:
        Console().print(_table(rows))


def measure(
    arch: Architecture, size: int, layout: str, precision: str, repeats: int, device: str = "cpu"
) -> dict[str, Any]:
    """Latency of one frame from displacement on the grid to the force map on it, batch norms folded.

    CPU time on the CPU (other processes take turns, they don't count), wall time on a GPU. Heavy networks are
    timed at least five times, light ones `repeats` times.
    """
    torch.manual_seed(0)
    model = fused(build(arch)).to(device)
    if layout == "channels_last":
        model = model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    grid, scales = Grid(size), Scales(0.2, 0.03, 0.07, 2.0, 0.003)
    displacement = torch.randn(1, 2, size, size, device=device) * 0.1
    mask = torch.ones(1, 1, size, size, device=device)

    @torch.inference_mode()
    def frame() -> None:
        with torch.autocast(torch.device(device).type, torch.bfloat16, enabled=precision == "bf16"):
            x = channels(displacement, mask, grid.pitch_mm, scales)
            if layout == "channels_last":
                x = x.contiguous(memory_format=torch.channels_last)
            model(x)

    times = np.array(list(_timed(frame, repeats if flops(arch, size) < 5e9 else 5, device)))
    names = {v.arch: k for k, v in PRESETS.items() if v.size == size}
    return {
        "name": f"{arch.name} w{arch.width} stem{arch.stem} {size} {layout} {precision}",
        "preset": names.get(arch, ""),
        "size": size,
        "parameters": parameters(build(arch)),
        "gflop": round(flops(arch, size) / 1e9, 3),
        "cpu_ms_p50": round(float(np.quantile(times, 0.5)), 3),
        "cpu_ms_p95": round(float(np.quantile(times, 0.95)), 3),
        "cpu_ms_least": round(float(times.min()), 3),
        "frames": len(times),
    }


def _timed(frame: Callable[[], None], repeats: int, device: str) -> Iterator[float]:
    for _ in range(3):
        frame()
    for _ in range(repeats):
        if device == "cpu":
            start = time.process_time()
            frame()
            yield 1e3 * (time.process_time() - start)
        else:
            torch.cuda.synchronize()
            start = time.perf_counter()
            frame()
            torch.cuda.synchronize()
            yield 1e3 * (time.perf_counter() - start)


def _choices(device: str) -> Iterator[tuple[Architecture, int, str, str]]:
    base = PRESETS["paper"].arch
    precisions = ("fp32",) if device == "cpu" else ("fp32", "bf16")
    layouts = ("contiguous", "channels_last")
    shapes = [(16, 4), (8, 4), (32, 4), (16, 2), (16, 1), (32, 1)]
    for (width, stem), size in itertools.product(shapes, (256, 192, 128)):
        if size % (stem * 16):
            continue
        arch = Architecture(width=width, stem=stem, levels=base.levels, dropout=0.05)
        light = flops(arch, size) < 5e9
        for layout, precision in itertools.product(layouts if light else layouts[:1], precisions):
            yield arch, size, layout, precision
    yield Architecture(name="unet"), 256, "contiguous", "fp32"


def _shape(arch: Architecture, size: int) -> tuple[Any, ...]:
    return arch.name, arch.width, arch.stem, arch.levels, size


def _errors(root: Path) -> dict[tuple[Any, ...], float]:
    """Mean map RMSE over tested sequences of every network that has runs on ideal flow."""
    found: dict[tuple[Any, ...], list[float]] = {}
    for file in sorted(root.glob("ideal/runs/*.json")):
        run = json_.loads(file.read_text())
        arch, kind = run["settings"]["arch"], run["settings"]["objective"]["kind"]
        if run["control"] or kind != "mse":
            continue
        key = (arch["name"], arch["width"], arch["stem"], arch["levels"], run["settings"]["size"])
        found.setdefault(key, []).append(run["columns"]["known"]["map_rmse"])
    return {k: float(np.mean(v)) for k, v in found.items()}


def _table(rows: list[dict[str, Any]]) -> Table:
    table = Table(title="A frame, channels included", title_justify="left")
    for head in ("network", "preset", "parameters [M]", "GFLOP", "p50 [ms]", "p95 [ms]", "map RMSE [mN/mm²]"):
        table.add_column(head, justify="left" if head in ("network", "preset") else "right")
    for r in sorted(rows, key=lambda r: float(r["cpu_ms_p50"])):
        error = "-" if r["map_rmse"] is None else f"{r['map_rmse']:.4f}"
        table.add_row(
            r["name"],
            r["preset"],
            f"{r['parameters'] / 1e6:.2f}",
            f"{r['gflop']:.2f}",
            f"{r['cpu_ms_p50']:.1f}",
            f"{r['cpu_ms_p95']:.1f}",
            error,
        )
    return table
