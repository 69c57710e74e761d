"""`bench pareto learn`: what a network costs a frame, and what it gets wrong where it has been trained."""

from __future__ import annotations

import html
import itertools
import json as json_
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from rich.console import Console

from bench import plot
from bench.learn_runs import column
from bench.learn_table import markdown
from bench.machine import describe
from learn.cost import flops, parameters
from learn.grid import Grid, Scales, channels
from learn.model import Architecture, fused
from learn.quick import Quick
from learn.reference import build
from learn.settings import PRESETS
from learn.statistics import Interval, interval
from learn.threads import set_threads

LIGHT = 5e9
"""FLOP a frame up to which a network is timed in every layout and precision, and `repeats` times."""


@dataclass(frozen=True)
class Choice:
    """One way to run one network."""

    arch: Architecture
    size: int
    layout: str = "quick"
    """`contiguous`, `channels_last`, or `quick` (`learn.quick`, as `learn predict` and live use run it)."""
    precision: str = "fp32"

    @property
    def name(self) -> str:
        stem = f"stem{self.arch.stem}{'+detail' if self.arch.detail else ''}"
        return f"{self.arch.name} w{self.arch.width} {stem} depth{self.arch.levels} {self.size}"

    @property
    def preset(self) -> str:
        found = [k for k, v in PRESETS.items() if v.size == self.size and shape(v.arch) == shape(self.arch)]
        return ", ".join(found)


def pareto(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for results.")] = Path(
        "docs/results/learn/pareto"
    ),
    runs: Annotated[Path, typer.Option(help="Runs whose errors are shown.")] = Path("docs/results/learn"),
    repeats: Annotated[int, typer.Option(help="Frames timed, at least.")] = 30,
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
    only: Annotated[
        str,
        typer.Option(
            help="Only networks whose name and way hold one of these, by commas; none: errors anew."
        ),
    ] = "",
    json: Annotated[bool, typer.Option("--json", help="Print JSON on stdout.")] = False,
) -> None:
    """Time every network a frame, channels included, on one core (or a GPU), beside its error."""
    set_threads(1)
    known = errors(runs)
    file = out / f"data-{device}.json"
    # A part that is timed anew takes the place of what was there; the rest stays.
    rows: list[dict[str, Any]] = json_.loads(file.read_text())["rows"] if only and file.is_file() else []
    result = {
        "command": f"bench pareto learn --repeats {repeats} --device {device}",
        "machine": describe() | {"device": device, "threads": 1, "torch": torch.__version__},
        "rows": rows,
    }
    out.mkdir(parents=True, exist_ok=True)
    for choice in _choices(device, known):
        named = f"{choice.name} {choice.layout} {choice.precision}"
        if not any(word in named for word in only.split(",")):
            continue
        row = measure(choice, repeats, device) | {"arch": asdict(choice.arch)}
        rows[:] = [r for r in rows if _way(r) != _way(row)] + [row]
        # After every one: a run that is stopped has what it timed.
        file.write_text(json_.dumps(result, indent=1) + "\n")
        if not json:
            Console(stderr=True).print(
                f"{row['name']} {choice.layout} {choice.precision}: p50 {row['ms_p50']:.1f} ms, "
                f"p95 {row['ms_p95']:.1f} ms"
            )
    _write(out, known)
    if json:
        print(json_.dumps(result))


def measure(choice: Choice, repeats: int, device: str = "cpu") -> dict[str, Any]:
    """Latency of one frame from displacement on the grid to the force map on it, batch norms folded.

    CPU time on the CPU (other processes take turns, they don't count), wall time on a GPU. Heavy networks are
    timed at least five times, light ones `repeats` times.
    """
    torch.manual_seed(0)
    arch, size = choice.arch, choice.size
    model = build(arch).eval()
    net: Callable[..., Any] = (
        Quick(model, arch, size) if choice.layout == "quick" else fused(model).to(device)
    )
    if choice.layout == "channels_last":
        net = net.to(memory_format=torch.channels_last)  # type: ignore[attr-defined]
    grid, scales = Grid(size), Scales(0.2, 0.03, 0.07, 2.0, 0.003)
    displacement = torch.randn(1, 2, size, size, device=device) * 0.1
    mask = torch.ones(1, 1, size, size, device=device)

    @torch.inference_mode()
    def frame() -> None:
        with torch.autocast(torch.device(device).type, torch.bfloat16, enabled=choice.precision == "bf16"):
            x = channels(displacement, mask, grid.pitch_mm, scales)
            if choice.layout == "channels_last":
                x = x.contiguous(memory_format=torch.channels_last)
            net(x)

    cost = flops(arch, size)
    times = np.array(list(_timed(frame, repeats if cost < LIGHT else 5, device)))
    return {
        "name": choice.name,
        "preset": choice.preset,
        "layout": choice.layout,
        "precision": choice.precision,
        "size": size,
        "parameters": parameters(model),
        "gflop": round(cost / 1e9, 3),
        "ms_p50": round(float(np.quantile(times, 0.5)), 3),
        "ms_p95": round(float(np.quantile(times, 0.95)), 3),
        "ms_least": round(float(times.min()), 3),
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


def _choices(device: str, trained: dict[tuple[Architecture, int], Interval]) -> Iterator[Choice]:
    stems = [(8, 4), (16, 4), (32, 4), (16, 2), (16, 1), (32, 1)]
    shapes = [(*s, 4, False) for s in stems] + [(16, 4, 3, False), (16, 4, 3, True)]
    ways = [("contiguous", "fp32"), ("channels_last", "fp32"), ("channels_last", "bf16")]
    ways = [("quick", "fp32"), *ways] if device == "cpu" else ways
    for (width, stem, levels, detail), size in itertools.product(shapes, (256, 192, 128)):
        if size % (stem * 2**levels):
            continue
        arch = Architecture(width=width, stem=stem, levels=levels, dropout=0.05, detail=detail)
        for layout, precision in ways if flops(arch, size) < LIGHT else ways[:1]:
            yield Choice(arch, size, layout, precision)
    yield Choice(Architecture(name="unet"), 256, ways[0][0])
    for arch, size in trained:
        yield Choice(arch, size, ways[0][0])


def _way(row: dict[str, Any]) -> tuple[Any, ...]:
    return architecture(row["arch"]), row["size"], row["layout"], row["precision"]


def shape(arch: Architecture) -> tuple[Any, ...]:
    """What sets the time a frame takes, of an architecture."""
    return arch.name, arch.width, arch.stem, arch.levels, arch.detail


def errors(root: Path) -> dict[tuple[Architecture, int], Interval]:
    """Map RMSE over tested sequences [mN/mm²], with interval, of networks trained alike (MSE, fold and seed
    0)."""
    found: dict[tuple[Architecture, int], Interval] = {}
    for file in sorted([*root.glob("ideal/runs/*.json"), *root.glob("fine/runs/*.json")]):
        run = json_.loads(file.read_text())
        tree = run["settings"]["arch"]
        if run["control"] or run["settings"]["objective"]["kind"] != "mse" or tree["output"] != "magnitude":
            continue
        if not file.stem.endswith("fold0-seed0") or file.stem.startswith(("long", "film")):
            continue
        found[architecture(tree), run["settings"]["size"]] = interval(
            column([run], "map_rmse"), np.random.default_rng(0)
        )
    return found


def architecture(tree: dict[str, Any]) -> Architecture:
    """An architecture as a run's settings hold it."""
    return Architecture(**tree | {"bounds": tuple(tree["bounds"])})


def _lines(rows: list[dict[str, Any]]) -> list[dict[str, object]]:
    return [
        {
            "network": r["name"],
            "preset": r["preset"] or None,
            "way": f"{r['layout']}, {r['precision']}",
            "parameters [M]": round(r["parameters"] / 1e6, 2),
            "GFLOP": r["gflop"],
            "p50 [ms]": r["ms_p50"],
            "p95 [ms]": r["ms_p95"],
            "map RMSE [mN/mm²]": _text(r["map_rmse"]),
        }
        for r in sorted(rows, key=lambda r: float(r["ms_p50"]))
    ]


def _text(error: list[float] | None) -> str | None:
    return None if error is None else f"{error[0]:.4f} [{error[1]:.4f}, {error[2]:.4f}]"


def _write(out: Path, errors: dict[tuple[Architecture, int], Interval]) -> None:
    """README.md, chart.svg and index.html from every data file there."""
    parts, panels = [_HEAD], []
    for file in sorted(out.glob("data-*.json")):
        result = json_.loads(file.read_text())
        device, rows = result["machine"]["device"], result["rows"]
        with_errors(rows, errors)
        parts.append(f"## {device}\n\n{markdown(_lines(rows))}\n")
        panels += chart(rows, device)
    (out / "README.md").write_text("\n".join(parts))
    if panels:
        plot.write(panels, out, "Learn: error against time")
    else:
        text = html.escape("\n".join(parts))
        (out / "index.html").write_text(plot.page("Learn: time a frame", f"<pre>{text}</pre>"), "utf-8")


def with_errors(
    rows: list[dict[str, Any]], known: dict[tuple[Architecture, int], Interval]
) -> list[dict[str, Any]]:
    """The rows, each with `map_rmse`: the error of its network and the interval's ends, or None.

    Presets may have moved since the rows were timed: they are named anew.
    """
    for row in rows:
        arch = architecture(row["arch"])
        row["preset"] = Choice(arch, row["size"]).preset
        error = known.get((arch, row["size"]))
        row["map_rmse"] = None if error is None else [error.mean, error.low, error.high]
    return rows


def chart(rows: list[dict[str, Any]], device: str) -> list[plot.Panel]:
    """The chart of one device's rows that have an error, if any."""
    scored = [r for r in rows if r["map_rmse"] is not None]
    curves = [
        plot.Curve(
            f"{size}² grid",
            tuple(r["ms_p50"] for r in own),
            tuple(r["map_rmse"][0] for r in own),
            tuple(f"{r['name']} ({r['preset']})" if r["preset"] else r["name"] for r in own),
            ringed=tuple(k for k, r in enumerate(own) if r["preset"] and r["layout"] == "quick"),
            ends=tuple((r["map_rmse"][1], r["map_rmse"][2]) for r in own),
        )
        for size, own in ((n, [r for r in scored if r["size"] == n]) for n in (64, 128, 256))
        if own
    ]
    if not curves:
        return []
    title = f"Learn: error of the map against time, {device}"
    return [plot.Panel(title, "p50 [ms]", "map RMSE [mN/mm²]", tuple(curves), log_x=True, front=True)]


_HEAD = """# Learn: time a frame, and error where it was trained

`bench pareto learn`. From displacement on the grid to the force map, channels included, batch norms folded,
one frame at a time; CPU time of one thread on a CPU, wall time on a GPU. `cpu` is the preset of `learn train`
where none is named, `live` is `d2fnet-s`. Errors are of the study's runs on fold 0 with MSE (mean over
tested sequences, BCa interval); only those networks have one: the others are too large to train here.
Machine: 2 cores, no GPU.
"""
