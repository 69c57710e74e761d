"""What does a large dataset cost? From the times and sizes of a rendered one, into docs/scaling.md."""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from bench.output import machine
from evidence.measuring import measuring
from synth.dataset import size_forecast
from synth.dataset.store import Dataset
from synth.engine.slots import SEQUENCES_A_PROCESS
from synth.errors import UserError

_BY_FRAME = ("render", "flow", "store")
_BEGIN, _END = "<!-- measured: bench experiment cost -->\n", "<!-- end -->\n"


def tables(found: dict[str, Any]) -> str:
    """Both tables, in Markdown."""
    planned, (width, height) = found["planned"], found["frame_px"]
    hours = planned["cpu_hours"]
    rate = planned["frames_per_s_a_core"]
    rows = [
        *((name, f"{spent:.2f}", "") for name, spent in found["cpu_s_a_frame"].items()),
        *((name, "", f"{spent:.2f}") for name, spent in found["cpu_s_a_sequence"].items()),
        (
            f"start of a worker (imports), once in {SEQUENCES_A_PROCESS} sequences",
            "",
            f"{found['cpu_s_a_start']:.1f}",
        ),
    ]
    amounts = [
        ("processor", f"{hours:,} CPU-hours: {hours / 16:.0f} hours on 16 cores, {hours / 256:.1f} on 256"),
        ("disk", f"{planned['disk_tb']} TB in {planned['files']:,} files"),
        ("memory", f"{found['peak_rss_mb'] / 1e3:.1f} GB a worker"),
        ("a core makes", f"{rate} frames or {size_forecast.amount(rate * found['bytes_a_frame'])} a second"),
    ]
    about = (
        f"{width} x {height} px, {found['variant']}, flow by {found['flow_backend']}, "
        f"{found['machine']['processor']}; {found['bytes_a_frame'] / 1e6:.2f} MB a frame on disk."
    )
    lines = ["| stage | CPU-s a frame | CPU-s a sequence |", "| --- | --- | --- |"]
    lines += [f"| {' | '.join(row)} |" for row in rows]
    lines += ["", about, "", f"{planned['frames']:,} frames, as {planned['sequences']:,} sequences:", ""]
    lines += ["| what | amount |", "| --- | --- |", *(f"| {name} | {text} |" for name, text in amounts)]
    return "\n".join(lines) + "\n"


@measuring(
    "out --frames 1000000 --page docs/scaling.md",
    out="docs/results/engine/cost",
    file="cost.json",
    text=tables,
)
def cost(
    dataset: Annotated[Path, typer.Argument(help="A dataset of the job to be planned; two sequences do.")],
    frames: Annotated[int, typer.Option(help="Frames of the dataset to be planned.")] = 1_000_000,
    length: Annotated[int, typer.Option(help="Frames of its sequences.")] = 60,
    page: Annotated[Path | None, typer.Option(help="Also put the tables into this page.")] = None,
) -> dict[str, Any]:
    """Says what so many frames take in CPU-hours, disk and memory, at the rates of a rendered dataset."""
    found = {**rates(dataset, length), "machine": machine.describe()}
    found["planned"] = plan(found, frames, length)
    if page is not None:
        whole = page.read_text("utf-8")
        if _BEGIN not in whole or _END not in whole:
            raise UserError(f"{page}: has no place for the tables ({_BEGIN.strip()} ... {_END.strip()})")
        before, after = whole.split(_BEGIN)[0], whole.split(_END, 1)[1]
        page.write_text(f"{before}{_BEGIN}{tables(found)}{_END}{after}", "utf-8")
    return found


def rates(dataset: Path, length: int) -> dict[str, Any]:
    """Medians over the sequences: CPU-s a frame and a sequence by stage, bytes, files; largest memory."""
    by_frame: dict[str, list[float]] = {}
    once: dict[str, list[float]] = {}
    sizes, files, fixed, peak = [], [], [], 0.0
    for one in Dataset(dataset):
        if not one.attrs.get("timings"):
            raise UserError(f"{one.path}: records no timings")
        peak = max(peak, float(one.attrs["timings"]["peak_rss_mb"]))
        for name, spent in one.attrs["timings"].items():
            if isinstance(spent, dict):
                side, share = (by_frame, one.frames) if name in _BY_FRAME else (once, 1)
                side.setdefault(name, []).append(float(spent["cpu_s"]) / share)
        framed = [name for name in one.fields if one[name].ndim >= 3 and one[name].dims[0] == "frame"]
        sizes.append(sum(size_forecast.size(one.path / name) for name in framed) / one.frames)
        fixed.append(size_forecast.size(one.path) - sizes[-1] * one.frames)
        # A field is its metadata and its shards; the group has metadata of its own.
        shards = [-(-length // one[name].together) if name in framed else 1 for name in one.fields]
        files.append(1 + len(one.fields) + sum(shards))
        size = one.size
    return {
        "frame_px": [size[1], size[0]],
        "sequences": len(sizes),
        "cpu_s_a_frame": {name: round(float(np.median(spent)), 3) for name, spent in by_frame.items()},
        "cpu_s_a_sequence": {name: round(float(np.median(spent)), 3) for name, spent in once.items()},
        "cpu_s_a_start": round(_start(), 2),
        "bytes_a_frame": round(float(np.median(sizes))),
        "bytes_a_sequence": round(float(np.median(fixed))),
        "files_a_sequence": int(np.median(files)),
        "peak_rss_mb": peak,
        "flow_backend": one.attrs["flow_backend"],
        "variant": one.attrs.get("variant", "-"),
    }


def plan(found: dict[str, Any], frames: int, length: int) -> dict[str, Any]:
    """What `frames` frames take, as sequences of `length`."""
    sequences = -(-frames // length)
    each = sum(found["cpu_s_a_frame"].values())
    once = sum(found["cpu_s_a_sequence"].values()) + found["cpu_s_a_start"] / SEQUENCES_A_PROCESS
    return {
        "frames": frames,
        "sequences": sequences,
        "cpu_hours": round((frames * each + sequences * once) / 3600),
        "disk_tb": round((frames * found["bytes_a_frame"] + sequences * found["bytes_a_sequence"]) / 1e12, 2),
        "files": sequences * found["files_a_sequence"],
        "frames_per_s_a_core": round(1 / (each + once / length), 3),
    }


def _start() -> float:
    """CPU-s of a process that imports all that a worker needs."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", "import synth.sequence.pipeline, synth.engine.worker"], check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
