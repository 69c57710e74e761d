"""What a run says when the disk fills, the folder is read-only, another run is at work, the clock jumps."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated, Any
from unittest import mock

import typer

from evidence.engine import work
from evidence.measuring import measuring
from synth.checks import verify
from synth.dataset.folder import Folder
from synth.engine import run as engine
from synth.engine.progress import Bars
from synth.errors import UserError
from synth.job.schema import Job


@measuring(
    "--full tiny --read-only ro",
    out="docs/results/engine/faults",
    file="faults.json",
)
def faults(
    full: Annotated[Path, typer.Option(help="A file system of a few megabytes, empty.")],
    read_only: Annotated[Path, typer.Option(help="A read-only file system.")],
) -> dict[str, Any]:
    """Meets each fault for real, and checks that every store that is left is whole."""
    found = {"full disk": _refusal(full / "out")}
    # As if others had filled it after the forecast.
    with mock.patch("synth.dataset.size_forecast.refuse_if_too_large"):
        found["disk that fills up"] = _refusal(full / "out")
    found["read-only folder"] = _refusal(read_only / "out")
    return found | meet_oddities()


def meet_oddities() -> dict[str, dict[str, Any]]:
    """The faults that need no file system of their own: a name, a clock, a second run."""
    with tempfile.TemporaryDirectory() as scratch:
        expected = run_stand_ins(Path(scratch) / "calm").content_hash
        strange = run_stand_ins(Path(scratch) / "größe μm 脳 'out'").content_hash
        clock = _hash_with_another_clock(Path(scratch) / "clock")
        return {
            "odd name": {"equal": strange == expected},
            "clock change": {"equal": clock == expected},
            "two runs": _start_two(Path(scratch) / "two", expected),
        }


def run_stand_ins(root: Path) -> engine.Summary:
    """A small stand-in run: twelve sequences of about a quarter of a megabyte."""
    job = Job.model_validate(
        {"sequences": 12, "frames": 5, "render": {"size": (160, 120)}, "flow": {"backend": "ideal"}}
    )
    options = engine.Options(workers=2, work="evidence.engine.work:sequence", environment=work.environment())
    with Bars() as bars:
        return engine.run_job(job, root, options, bars)


def _refusal(root: Path) -> dict[str, Any]:
    """The one line that the user gets, and whether what is left is whole."""
    try:
        run_stand_ins(root)
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


_PROGRAM = """
import sys
from pathlib import Path
from evidence.engine.faults import run_stand_ins
print(run_stand_ins(Path(sys.argv[1])).content_hash)
"""


def _hash_with_another_clock(root: Path) -> str:
    """The hash of a run, workers included, whose clock jumps over decades while it goes on."""
    with tempfile.TemporaryDirectory() as early:
        (Path(early) / "sitecustomize.py").write_text(_JUMPING)
        found = work.environment()
        found["PYTHONPATH"] = os.pathsep.join([early, found["PYTHONPATH"]])
        words = [sys.executable, "-c", _PROGRAM, str(root)]
        done = subprocess.run(words, env={**os.environ, **found}, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def _start_two(root: Path, expected: str) -> dict[str, Any]:
    """Two runs on one folder at the same time: exit codes, what the second says, what is there at last."""
    words = [sys.executable, "-c", _PROGRAM, str(root)]
    slow = {**os.environ, **work.environment(STAND_IN_FRAME_S=0.4)}
    both = [
        subprocess.Popen(words, env=slow, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    ends = [process.communicate()[1].strip().splitlines()[-1] for process in both]
    codes = sorted(process.returncode for process in both)
    says = next((end for end in ends if "another run" in end), "nothing").replace(str(root.parent), "...")
    return {
        "codes": codes,
        "says": says,
        "equal": run_stand_ins(root).content_hash == expected,
        **_left(root),
    }
