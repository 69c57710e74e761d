"""`bench experiment loading`: what a training step spends where, in the published way and in ours.

The published loop is written anew from its description: one file a sample opened in `__getitem__`, vertices
scattered onto the picture, channels by NumPy, a plain DataLoader, contiguous float32. Network, batch,
optimizer and
loss are the same on both sides, so only the loop differs.
"""

from __future__ import annotations

import json as json_
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from bench.output import charts, result_page
from bench.output.machine import describe
from bench.output.write import keep
from evidence.measuring import measuring
from learn.data.clips import Clip, pack, unpack
from learn.data.grid import Scales
from learn.loss import Objective, loss
from learn.network.d2fnet import Architecture
from learn.network.monai_unet import build
from learn.settings import Settings, replace
from learn.training.batches import Frames, inputs, measure_scales
from learn.training.threads import set_threads

VERTICES = 8000
"""Surface vertices a published sample scatters."""
Step = Callable[[], tuple[float, float]]
"""One step; seconds spent on data, and on the network."""


@measuring("--steps 3 --out runs/loading")
def loading(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for results.")] = Path(
        "docs/results/learn/loading"
    ),
    size: Annotated[int, typer.Option(help="Grid cells along an edge.")] = 128,
    width: Annotated[int, typer.Option(help="Channels of the first level.")] = 32,
    batch: Annotated[int, typer.Option(min=2, help="Frames a step.")] = 8,
    steps: Annotated[int, typer.Option(min=1, help="Steps timed of each way, after one that isn't.")] = 3,
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
    json: Annotated[bool, typer.Option("--json", help="Print JSON on stdout.")] = False,
) -> None:
    """Time training steps in the published way and in ours, data and network apart."""
    set_threads(1)
    settings = Settings(
        size=size, batch=batch, arch=Architecture(width=width, output="magnitude"), channels_last=True
    )
    with tempfile.TemporaryDirectory() as scratch:
        clip = _phantom(settings, 4 * batch)
        pack(clip, Path(scratch) / "packed")
        packed = unpack(Path(scratch) / "packed")
        ways = {
            "published loop, fp32": _published(
                clip, replace(settings, channels_last=False), Path(scratch) / "samples", device
            ),
            "ours, fp32": _ours(packed, settings, device),
            "ours, bf16": _ours(packed, replace(settings, precision="bf16-mixed"), device),
        }
        rows = [_row(name, step, steps, batch) for name, step in ways.items()]
    for row in rows:
        row["against published"] = round(row["frames/s"] / rows[0]["frames/s"], 2)
        row["data, against published"] = round(rows[0]["data [ms]"] / row["data [ms]"], 1)
    result = {"machine": describe() | {"device": device, "threads": 1}, "size": size, "width": width}
    result |= {"batch": batch, "steps": steps, "vertices": VERTICES, "rows": rows}
    keep(out, f"data-{device}.json", result)
    result_page.write(drawn(out), out)
    if json:
        print(json_.dumps(result))
    else:
        print(result_page.markdown(rows))


def drawn(out: Path) -> result_page.Page:
    """What every data file in `out` says."""
    found = [json_.loads(file.read_text()) for file in sorted(out.glob("data-*.json"))]
    shown = [
        charts.Chart(
            f"{one['machine']['device']}, one thread, {one['size']}², width {one['width']}, stem 1, batch "
            f"{one['batch']}",
            "training throughput [frames/s]",
            charts.bars({row["way"]: row["frames/s"] for row in one["rows"]}),
        )
        for one in found
    ]
    return result_page.Page(
        "Learn: what a training step spends where",
        found[0],
        shown,
        [result_page.Section(chart.title, one["rows"]) for chart, one in zip(shown, found, strict=True)],
        (_HOW,),
        "bench experiment loading",
        "README.md",
    )


_HOW = (
    "The published loop is our reading of its description, not its code: one .npz a sample opened in "
    "`__getitem__`, 8000 vertices scattered onto the picture, channels by NumPy, plain DataLoader, "
    "contiguous float32. Network, batch, optimizer and loss are the same for all rows; ours also turns and "
    "mirrors every frame."
)


def _row(name: str, step: Step, steps: int, batch: int) -> dict[str, Any]:
    step()
    times = np.array([step() for _ in range(steps)])
    data, net = np.median(times, axis=0)
    return {
        "way": name,
        "data [ms]": round(1e3 * float(data), 1),
        "network [ms]": round(1e3 * float(net), 1),
        "data share": round(float(data / (data + net)), 3),
        "frames/s": round(batch / float(data + net), 2),
    }


def _phantom(settings: Settings, frames: int) -> Clip:
    n, rng = settings.size, np.random.default_rng(0)
    return Clip(
        name="phantom",
        content_hash="phantom",
        group="phantom",
        family="",
        gesture="",
        young_kpa=1.0,
        mask=np.ones((n, n), np.float32),
        displacement={"ideal": rng.normal(0, 0.1, (frames, 2, n, n)).astype(np.float32)},
        confidence=np.ones((frames, n, n), np.float32),
        density=rng.gamma(0.1, 0.1, (frames, 3, n, n)).astype(np.float32),
        force=rng.normal(size=(frames, 3)),
    )


class _Samples(Dataset[tuple[Tensor, Tensor]]):
    """One file a sample, as the published loader has it."""

    def __init__(self, clip: Clip, folder: Path, size: int) -> None:
        folder.mkdir()
        self.files, self.size = [], size
        rng = np.random.default_rng(1)
        at = rng.integers(0, size, (VERTICES, 2))
        for t in range(clip.frames):
            moved = clip.displacement["ideal"][t][:, at[:, 0], at[:, 1]].T
            force = np.linalg.norm(clip.density[t], axis=0)[at[:, 0], at[:, 1]]
            self.files.append(folder / f"{t:04d}.npz")
            np.savez(self.files[-1], at=at, moved=moved, force=force)

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, index: int) -> tuple[Tensor, Tensor]:
        with np.load(self.files[index]) as file:
            at, moved, force = file["at"], file["moved"], file["force"]
        planes = np.zeros((5, self.size, self.size), np.float32)
        target = np.zeros((1, self.size, self.size), np.float32)
        rows, cols = at[:, 0], at[:, 1]
        planes[0, rows, cols], planes[1, rows, cols] = moved[:, 0], moved[:, 1]
        target[0, rows, cols] = force
        planes[2] = np.hypot(planes[0], planes[1])
        planes[3, rows, cols] = 1
        planes[4] = np.gradient(planes[0], axis=1) + np.gradient(planes[1], axis=0)
        for k in (0, 1, 2, 4):
            planes[k] /= np.percentile(np.abs(planes[k]), 99.9) + 1e-8
        return torch.from_numpy(planes), torch.from_numpy(target)


def _published(clip: Clip, settings: Settings, folder: Path, device: str) -> Step:
    loader = DataLoader(_Samples(clip, folder, settings.size), batch_size=settings.batch, shuffle=True)
    optimize = _optimizer(settings, device)

    def batches() -> Iterator[tuple[Tensor, Tensor]]:
        while True:
            yield from loader

    source = batches()

    def step() -> tuple[float, float]:
        began = time.perf_counter()
        x, y = (part.to(device) for part in next(source))
        loaded = _now(device)
        optimize(x, y, x[:, 3:4])
        return loaded - began, _now(device) - loaded

    return step


def _ours(clip: Clip, settings: Settings, device: str) -> Step:
    frames, scales = Frames([clip], settings), measure_scales([clip], settings)
    optimize, rng = _optimizer(settings, device), np.random.default_rng(2)

    def step() -> tuple[float, float]:
        began = time.perf_counter()
        batch = frames.batch(frames.order(rng, 0.0)[: settings.batch]).to(torch.device(device))
        x = inputs(batch, settings, scales).contiguous(memory_format=torch.channels_last)
        loaded = _now(device)
        optimize(x, batch.target, batch.mask, scales)
        return loaded - began, _now(device) - loaded

    return step


def _optimizer(settings: Settings, device: str) -> Callable[..., None]:
    torch.manual_seed(0)
    model = build(settings.arch).to(device).train()
    if settings.channels_last:
        model = model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-4)

    def step(x: Tensor, y: Tensor, mask: Tensor, scales: Scales = Scales(1, 1, 1, 1, 1)) -> None:
        with torch.autocast(device, torch.bfloat16, enabled=settings.precision == "bf16-mixed"):
            said = model(x)
        terms = loss(said.float(), y, mask, Objective(), scales.target, scales.spread)
        optimizer.zero_grad()
        terms.sum.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(model.parameters(), settings.clip)
        optimizer.step()

    return step


def _now(device: str) -> float:
    if device == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter()
