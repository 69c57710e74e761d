"""What a run says when the disk fills, the folder is read-only, another run is at work, the clock jumps."""

from __future__ import annotations

import json as json_
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any
from unittest import mock

import typer

from bench.output import machine
from synth.checks import verify
from synth.dataset.folder import Folder
from synth.engine import run as engine
from synth.engine.progress import Bars
from synth.errors import UserError
from synth.job.schema import Job


def faults(
    full: Annotated[Path, typer.Option(help="A file system of a few megabytes, empty.")],
    read_only: Annotated[Path, typer.Option(help="A read-only file system.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the results.")] = Path(
        "docs/results/engine/faults"
    ),
    json: Annotated[bool, typer.Option("--json", help="Print JSON to standard output.")] = False,
) -> None:
    """Meets each fault for real, and checks that every store that is left is whole."""
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as scratch:
        calm = Path(scratch) / "calm"
        expected = run(calm).content_hash
        found["full disk"] = _refusal(lambda: run(full / "out"), full / "out")
        # As if others had filled it after the forecast.
        with mock.patch("synth.dataset.size_forecast.refuse_if_too_large"):
            found["disk that fills up"] = _refusal(lambda: run(full / "out"), full / "out")
        found["read-only folder"] = _refusal(lambda: run(read_only / "out"), read_only / "out")
        strange = Path(scratch) / "größe μm 脳 'out'"
        found["odd name"] = {"equal": run(strange).content_hash == expected}
        found["clock change"] = {"equal": _with_another_clock(Path(scratch) / "clock") == expected}
        found["two runs"] = _two_runs(Path(scratch) / "two", expected)
    result = {**found, "machine": machine.describe()}
    out.mkdir(parents=True, exist_ok=True)
    (out / "faults.json").write_text(json_.dumps(result, indent=1, ensure_ascii=False) + "\n")
    print(json_.dumps(result, indent=None if json else 1, ensure_ascii=False))


def run(root: Path, work: str = "sequence") -> engine.Summary:
    """A small stand-in run: six sequences of about half a megabyte."""
    job = Job.model_validate(
        {"sequences": 12, "frames": 5, "render": {"size": (160, 120)}, "flow": {"backend": "ideal"}}
    )
    with Bars() as bars:
        return engine.run_job(job, root, engine.Options(workers=2, work=f"evidence.engine.work:{work}"), bars)


def _refusal(attempt: Callable[[], Any], root: Path) -> dict[str, Any]:
    """The one line that the user gets, and whether what is left is whole."""
    try:
        attempt()
    except UserError as error:
        return {"says": str(error).replace(str(root.parent), "..."), **_left(root)}
    return {"says": "nothing", **_left(root)}


def _left(root: Path) -> dict[str, Any]:
    if not root.exists():
        return {"left": 0, "corrupt": 0}
    sealed = Folder(root).sealed()
    identity = str(Folder(root).described()["identity"]) if sealed else ""
    corrupt = 0
    for index in sealed:
        checks = {
            check.name: check.good for check in verify.verify_sequence(root / f"{index:06d}.zarr", identity)
        }
        corrupt += not (checks["readable"] and checks["checksum"] and checks["seal"])
    return {"left": len(sealed), "corrupt": corrupt}


# Found by every Python process, workers too: each look at the clock is in another year than the one before.
_JUMPING = """
import itertools, time
real, jumps = time.time, itertools.cycle((-40, 0, 40, 7))
time.time = lambda: real() + next(jumps) * 365 * 86400.0
time.time_ns = lambda: int(time.time() * 1e9)
"""


def _with_another_clock(root: Path) -> str:
    """The hash of a run, workers included, whose clock jumps over decades while it goes on."""
    program = "import sys; from pathlib import Path; from evidence.engine.faults import run\n"
    program += "print(run(Path(sys.argv[1])).content_hash)"
    with tempfile.TemporaryDirectory() as early:
        (Path(early) / "sitecustomize.py").write_text(_JUMPING)
        path = os.pathsep.join(filter(None, [early, os.environ.get("PYTHONPATH", "")]))
        done = subprocess.run(
            [sys.executable, "-c", program, str(root)],
            env={**os.environ, "PYTHONPATH": path},
            capture_output=True,
            text=True,
            check=True,
        )
    return done.stdout.strip()


def _two_runs(root: Path, expected: str) -> dict[str, Any]:
    program = (
        "import sys; from pathlib import Path; from evidence.engine.faults import run; run(Path(sys.argv[1]))"
    )
    words = [sys.executable, "-c", program, str(root)]
    environment = {**os.environ, "STAND_IN_FRAME_S": "0.4"}
    both = [subprocess.Popen(words, env=environment, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    ends = [process.communicate()[1].strip().splitlines()[-1] for process in both]
    codes = sorted(process.returncode for process in both)
    says = next((end for end in ends if "another run" in end), "nothing").replace(str(root.parent), "...")
    return {"codes": codes, "says": says, "equal": run(root).content_hash == expected, **_left(root)}
