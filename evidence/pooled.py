"""Recordings scored by `bench score`, and pooled on a page by `bench pool`."""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from evidence import report
from synth.errors import UserError

PRETRAINED = {1: "mono", 2: "stereo"}  # model by number of cameras
FOLDERS = {1: "monocular", 2: "stereo"}  # of the results, likewise
_REFUSED = 2  # exit code of `bench score` for a recording without valid numbers, which the page counts


def score_and_pool(recordings: Sequence[Path], cameras: int, out: Path) -> None:
    """Scores each recording in FOLDER-score next to it, unless it has been, and writes the page into `out`.

    Raises UserError: a command failed.
    """
    model = PRETRAINED[cameras]
    scores = [folder.with_name(f"{folder.name}-score") for folder in recordings]
    for folder, score in zip(recordings, scores, strict=True):
        if not (score / "score.json").is_file():
            _bench("score", str(folder), "--model", model, "-o", str(score))
    by = f"{report.command()}\n    bench score RECORDING --model {model}\n    bench pool SCORES"
    _bench("pool", *map(str, scores), "-o", str(out), "--by", by)


def _bench(*words: str) -> None:
    code = subprocess.run([sys.executable, "-m", "bench", *words]).returncode
    if code and not (words[0] == "score" and code == _REFUSED):
        raise UserError(f"bench {words[0]}: exit code {code}")
