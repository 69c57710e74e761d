"""`bench pareto learn`: what a network costs a frame, beside what it gets wrong where it has been trained."""

from __future__ import annotations

import itertools
import json as json_
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from rich.console import Console

from bench.output import charts, result_page, write
from bench.output.machine import describe
from evidence.learn.cost import flops, parameters
from evidence.learn.experiment import BESIDE
from evidence.learn.preset_errors import GRIDS, Known, Shape, architecture, errors, shape
from evidence.measuring import measuring
from learn.data.grid import Grid, Scales, channels
from learn.evaluation.statistics import Interval
from learn.network.d2fnet import Architecture, fused
from learn.network.monai_unet import build
from learn.network.traced import Quick
from learn.settings import PRESETS
from learn.training.threads import set_threads
from synth.errors import UserError

TURNS = 4
"""Times that all networks are gone through."""
LIGHT = 5e9
"""FLOP a frame up to which a network is timed in every layout and precision, and `repeats` times."""


@dataclass(frozen=True)
class Choice:
    """One way to run one network."""

    arch: Architecture
    size: int
    layout: str = "quick"
    """`contiguous`, `channels_last`, or `quick` (`learn.network.traced`, as live use runs it)."""
    precision: str = "fp32"

    @property
    def name(self) -> str:
        stem = f"stem{self.arch.stem}{'+detail' if self.arch.detail else ''}"
        return f"{self.arch.name} w{self.arch.width} {stem} depth{self.arch.levels} {self.size}"

    @property
    def preset(self) -> str:
        # Those of two eyes have other channels: nothing of theirs was timed here.
        one_eye = {k: v for k, v in PRESETS.items() if not v.arch.depth}
        found = [k for k, v in one_eye.items() if v.size == self.size and shape(v.arch) == shape(self.arch)]
        return ", ".join(found)


@measuring("--out runs/learn --repeats 10")
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
            help="Time only networks whose name and way hold one of these words, by commas (empty: all) "
            "and keep the others' times. A word that none holds times nothing: pages and errors anew."
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
    choices = list(dict.fromkeys(_choices(device, known)))
    asked = {(shape(c.arch), c.size, c.layout, c.precision) for c in choices}
    chosen = [c for c in choices if any(word in _named(c) for word in only.split(","))]
    if not chosen and not any(out.glob("data-*.json")):
        raise UserError(f"--only {only}: no network's name or way holds that, and {out} has no times to show")
    new = measure(chosen, repeats, device)
    again = {_way(row) for row in new}
    rows[:] = [r for r in rows if _way(r) in asked - again] + new
    if new:
        write.keep(out, file.name, result)
    for row in () if json else new:
        Console(stderr=True).print(
            f"{row['name']} {row['layout']} {row['precision']}: p50 {row['ms_p50']:.1f} ms, "
            f"p95 {row['ms_p95']:.1f} ms"
        )
    result_page.write(drawn(out, known), out)
    if json:
        print(json_.dumps(result))


def measure(choices: Sequence[Choice], repeats: int, device: str = "cpu") -> list[dict[str, Any]]:
    """Latency of one frame from displacement on the grid to the force map on it, batch norms folded.

    CPU time on the CPU (other processes take turns, they don't count), wall time on a GPU. Heavy networks are
    timed at least five times, light ones `repeats` times, all of them in turns: a machine that is faster at
    one time than at another then is so to all.
    """
    frames = [_frame(choice, device) for choice in choices]
    costs = [flops(choice.arch, choice.size) for choice in choices]
    times: list[list[float]] = [[] for _ in choices]
    for _ in range(TURNS):
        for frame, cost, own in zip(frames, costs, times, strict=True):
            own += _timed(frame, -(-(repeats if cost < LIGHT else 5) // TURNS), device)
    return [
        {
            "name": choice.name,
            "preset": choice.preset,
            "layout": choice.layout,
            "precision": choice.precision,
            "size": choice.size,
            "parameters": parameters(build(choice.arch)),
            "gflop": round(cost / 1e9, 3),
            "ms_p50": round(float(np.quantile(own, 0.5)), 3),
            "ms_p95": round(float(np.quantile(own, 0.95)), 3),
            "ms_least": round(min(own), 3),
            "frames": len(own),
            "arch": choice.arch.model_dump(),
        }
        for choice, cost, own in zip(choices, costs, times, strict=True)
    ]


def _frame(choice: Choice, device: str) -> Callable[[], None]:
    """What answers one frame, made ready."""
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

    return frame


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


def _choices(device: str, trained: Known) -> Iterator[Choice]:
    stems = [(8, 4), (16, 4), (32, 4), (16, 2), (16, 1), (32, 1)]
    shapes = [(*s, 4, False) for s in stems] + [(16, 4, 3, False), (16, 4, 3, True)]
    ways = [("contiguous", "fp32"), ("channels_last", "fp32"), ("channels_last", "bf16")]
    ways = [("quick", "fp32"), *ways] if device == "cpu" else ways
    for (width, stem, levels, detail), size in itertools.product(shapes, (256, 192, 128)):
        if size % (stem * 2**levels):
            continue
        arch = Architecture(width=width, stem=stem, levels=levels, detail=detail)
        for layout, precision in ways if flops(arch, size) < LIGHT else ways[:1]:
            yield Choice(arch, size, layout, precision)
    yield Choice(Architecture(name="unet"), 256, ways[0][0])
    beside: list[tuple[Shape, int]] = [
        (("d2fnet", *sizes, False), PRESETS[name].size) for name, group in BESIDE.items() for sizes in group
    ]
    for (name, width, stem, levels, detail), size in [*trained, *beside]:
        arch = Architecture(name=name, width=width, stem=stem, levels=levels, detail=detail)
        yield Choice(arch, size, ways[0][0])


def _named(choice: Choice) -> str:
    return f"{choice.name} {choice.layout} {choice.precision}"


def _way(row: dict[str, Any]) -> tuple[Any, ...]:
    return shape(architecture(row["arch"])), row["size"], row["layout"], row["precision"]


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
            "frames": r["frames"],
            "map RMSE [mN/mm²]": _text(r["map_rmse"]),
            "against its grid's preset": _share(r["against"]),
            "map RMSE over 0.56 mm": _text(r["wide_rmse"]),
            "total force MAE [mN]": _text(r["force_mae"], 3),
            "seeds": r["seeds"],
        }
        for r in sorted(rows, key=lambda r: float(r["ms_p50"]))
    ]


def _text(error: list[float] | None, digits: int = 4) -> str | None:
    return None if error is None else "{:.{n}f} [{:.{n}f}, {:.{n}f}]".format(*error, n=digits)


def _ends(i: Interval) -> list[float]:
    return [i.mean, i.low, i.high]


def _share(against: list[float] | None) -> str | None:
    return None if against is None else "{:+.0%} [{:+.0%}, {:+.0%}]".format(*against)


def drawn(out: Path, known: Known) -> result_page.Page:
    """What every data file in `out` says, with the errors that are known."""
    found = [json_.loads(file.read_text()) for file in sorted(out.glob("data-*.json"))]
    panels, sections = [], []
    for one in found:
        device, rows = one["machine"]["device"], with_errors(one["rows"], known)
        panels += chart(rows, device)
        sections.append(result_page.Section(device, _lines(rows)))
    title = "Learn: time a frame, and error where it was trained"
    return result_page.Page(title, found[0], panels, sections, _WORDS, name="README.md")


def with_errors(rows: list[dict[str, Any]], known: Known) -> list[dict[str, Any]]:
    """The rows, each with what is known of its network (`learn_trained.Trained`), as lists of a mean and its
    interval's ends; None where it was not trained.

    Presets may have moved since the rows were timed: they are named anew.
    """
    for row in rows:
        arch, size = architecture(row["arch"]), row["size"]
        row["preset"] = Choice(arch, size).preset
        found = known.get((shape(arch), size))
        row["map_rmse"] = None if found is None else _ends(found.error)
        row["wide_rmse"] = None if found is None else _ends(found.wide)
        row["force_mae"] = None if found is None else _ends(found.force)
        row["against"] = None if found is None or found.against is None else _ends(found.against)
        row["seeds"] = None if found is None else found.seeds
    return rows


def chart(rows: list[dict[str, Any]], device: str) -> list[charts.Panel]:
    """A chart for each preset's grid: one device's rows that have an error, as they are run live.

    Errors are differences from the preset, paired: what sequences have in common would hide them.
    """
    panels, way = [], "quick" if device == "cpu" else "contiguous"
    for size, name in sorted(GRIDS.items()):
        scored = [
            r
            for r in rows
            if r["size"] == size and r["layout"] == way and (r["against"] or r["preset"] == name)
        ]
        gaps = {id(r): [100 * v for v in r["against"] or (0.0, 0.0, 0.0)] for r in scored}
        curves = [
            charts.Curve(
                f"stem of {stem}",
                tuple(r["ms_p50"] for r in own),
                tuple(gaps[id(r)][0] for r in own),
                tuple(f"{_short(r)} ({r['preset']})" if r["preset"] else _short(r) for r in own),
                ringed=tuple(k for k, r in enumerate(own) if r["preset"]),
                ends=tuple((gaps[id(r)][1], gaps[id(r)][2]) for r in own),
            )
            for stem in (1, 2, 4)
            if (own := [r for r in scored if r["arch"]["stem"] == stem])
        ]
        if curves:
            title = f"Learn: networks on {size}² beside the preset {name} (on {device})"
            panels.append(
                charts.Panel(
                    title,
                    "median time a frame [ms]",
                    "map RMSE, more than the preset's [%]",
                    tuple(curves),
                    front=True,
                )
            )
    return panels


def _short(row: dict[str, Any]) -> str:
    arch = architecture(row["arch"])
    name = "" if arch.name == "d2fnet" else f"{arch.name} "
    return f"{name}w{arch.width} stem{arch.stem}{'+detail' if arch.detail else ''} depth{arch.levels}"


_WORDS = (
    "From displacement on the grid to the force map, channels included, batch norms folded, one frame at a "
    "time; CPU time of one thread on a CPU, wall time on a GPU. `cpu` is the preset of `learn train` where "
    "none is named, `live` is `d2fnet-s`. Networks beyond 5 GFLOP are timed a few times only; of the "
    "others, rows with fewer frames than `--repeats` were timed in an earlier run.",
    "Errors are of `bench experiment learn --presets` and, on 64², of the study's own runs: fold 0, with "
    "the loss and dropout of the grid's preset, in equal steps on the same batches, all saying magnitudes; "
    "mean over tested sequences (and seeds) with BCa interval, and beside it the difference from the "
    "preset, paired by sequences, as a share of the preset's error. A front is of one grid, as rendering "
    "has one a picture's width. Between grids compare the errors over cells of 0.56 mm (64²), onto which "
    "answer and truth are averaged, and those of the total force. `paper`, the published network (27.7 "
    "GFLOP), and what is as large can't be trained on this machine and have no error.",
)
