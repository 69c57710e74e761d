"""Recordings scored by `bench score`, and pooled on a page by `bench pool`."""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from bench.scoring import pool
from evidence import report
from synth.errors import UserError

PRETRAINED = {1: "mono", 2: "stereo"}  # model by number of cameras
FOLDERS = {1: "monocular", 2: "stereo"}  # of the results, likewise
_REFUSED = 2  # exit code of `bench score` for a recording without valid numbers, which the page counts


def score_and_pool(recordings: Sequence[Path], cameras: int, out: Path) -> None:
    """Scores each recording in FOLDER-score next to it, unless it has been, and writes the page into `out`.

    Raises UserError: a command failed, or no recording has valid numbers.
    """
    model = PRETRAINED[cameras]
    scores = [folder.with_name(f"{folder.name}-score") for folder in recordings]
    for folder, score in zip(recordings, scores, strict=True):
        if not (score / "score.json").is_file():
            words = ("score", str(folder), "--model", model, "-o", str(score))
            code = subprocess.run([sys.executable, "-m", "bench", *words]).returncode
            if code not in (0, _REFUSED):
                raise UserError(f"bench score: exit code {code}")
    by = f"{report.command()}\n    bench score RECORDING --model {model}\n    bench pool SCORES"
    pool.write(pool.pool(pool.read(scores)), out, by)
