"""What scoring costs: a minute of video made for it, every method asked, the command's time and memory."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from bench.output import charts, result_page
from bench.recording import writer
from evidence.measuring import measuring
from evidence.scoring import phantom
from synth.errors import UserError

_PERIOD_S, _PEAK_PX, _PX_A_MN = 4.0, 9.0, 0.3
_SENSOR_HZ = 200.0


@measuring(
    "model --train out",
    out="docs/results/scoring",
    said="Folder for the results.",
    file="results.json",
    page=lambda found, out: result_page.write(drawn(found), out),
    text="README.md",
)
def cost(
    model: Annotated[Path, typer.Argument(help="Model folder of `learn train`.")],
    train: Annotated[Path, typer.Option(help="Its training data: the simpler methods are asked too.")],
    seconds: Annotated[float, typer.Option(min=2, help="Length of the recording.")] = 60.0,
    fps: Annotated[float, typer.Option(min=1, help="Frames a second.")] = 30.0,
    size: Annotated[tuple[int, int], typer.Option(help="Width and height [px].")] = (680, 480),
    seed: Annotated[int, typer.Option(help="Of the texture.")] = 0,
) -> dict[str, Any]:
    """Time and memory of `bench score` on a recording of a moved texture, all methods in the table.

    Raises:
        UserError: the scoring failed.
    """
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch, "recording")
        record(folder, seconds, fps, size, np.random.default_rng(seed))
        words = ["score", str(folder), "--model", str(model), "--train", str(train), "-o", scratch]
        began = time.perf_counter()
        done = subprocess.run([sys.executable, "-m", "bench", *words], capture_output=True, text=True)
        wall = time.perf_counter() - began
        if done.returncode:
            raise UserError(f"the scoring failed: {done.stderr.strip().splitlines()[-1]}")
        scored = json.loads(Path(scratch, "score.json").read_text())
    return {
        "seconds": seconds,
        "fps": fps,
        "size": list(size),
        "frames": scored["frames"],
        "wall_s": wall,
        "timings": scored["timings"],
        "command": shlex.join(["bench", "experiment", "scoring", "MODEL", "--train", "DATA"]),
    }


def record(folder: Path, seconds: float, fps: float, size: tuple[int, int], rng: np.random.Generator) -> None:
    """Writes a recording: a texture that a bump moves to and fro, without masks, force in proportion.

    Args:
        folder: made.
        seconds: length.
        fps: frames a second.
        size: width, height [px].
        rng: of the texture.
    """
    folder.mkdir(parents=True)
    times = np.arange(round(seconds * fps)) / fps
    writer.write_video(folder / "video.mp4", _pictures(times, size, rng), times, crf=12)
    clock = np.arange(0, seconds, 1 / _SENSOR_HZ)
    newtons = np.zeros((len(clock), 3))
    newtons[:, 0] = _motion(clock) / _PX_A_MN / 1000
    writer.write_force(folder, clock, newtons)
    writer.write_meta(
        folder,
        {
            "scale_mm_per_px": 35.0 / size[0],
            "young_kpa": 2.0,
            "sensor": {"axes": "camera", "low_pass_hz": None},
        },
    )


def _motion(time_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels at the bump's middle: a press a period, the first half second still."""
    return _PEAK_PX * np.clip(np.sin(2 * np.pi * (time_s - 0.5) / _PERIOD_S), 0, None) * (time_s > 0.5)


def _pictures(
    times: NDArray[np.float64], size: tuple[int, int], rng: np.random.Generator
) -> Iterator[NDArray[np.uint8]]:
    rest = phantom.texture(size[1], size[0], rng)
    return (phantom.pushed(rest, move) for move in _motion(times))


def drawn(tree: Mapping[str, Any]) -> result_page.Page:
    """What `results.json` says."""
    stages = {k: v for k, v in tree["timings"].items() if isinstance(v, Mapping)}
    memory = sum(v for k, v in tree["timings"].items() if k.endswith("peak_rss_mb"))
    (width, height), ratio = tree["size"], tree["wall_s"] / tree["seconds"]
    bars = charts.bars({name: t["wall_s"] for name, t in stages.items()})
    title = f"{tree['seconds']:g} s of {width} x {height}: {tree['wall_s']:.0f} s in all"
    rows = [
        {"stage": name, "CPU [s]": f"{t['cpu_s']:.1f}", "wall [s]": f"{t['wall_s']:.1f}"}
        for name, t in stages.items()
    ]
    unit = "wall time by stage [s], two processes side by side"
    return result_page.Page(
        "What scoring costs",
        tree,
        [charts.Chart(title, unit, bars)],
        (result_page.Section("", rows),),
        (
            f"A recording of {tree['seconds']:g} s, {width} x {height} at {tree['fps']:g} a second, no "
            f"masks; {tree['frames']} frames looked at (10 a second), flow on pictures of at least 320 "
            f"columns. The whole command took *{tree['wall_s']:.0f} s, {ratio:.1f} times the recording's "
            f"length, and {memory / 1000:.1f} GB* in two processes, which work side by side. At most twice "
            "the length and 2 GB were asked.",
        ),
        name="README.md",
    )
