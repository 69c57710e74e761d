"""Recordings scored by `bench score`, and pooled on a page by `bench pool`."""

import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from bench.methods.comparison import PHYSICS
from bench.recording import recording_writer
from bench.recording.meta import read_meta
from bench.scoring import pool
from evidence import report, result_cache, result_status
from synth.errors import UserError
from synth.system import checked_file

# Options of `bench score` by number of cameras: with two a pretrained network is scored next to physics.
_OPTIONS = {1: (), 2: ("--model", "stereo", "--main", PHYSICS)}
FOLDERS = {1: "monocular", 2: "stereo"}  # of the results, likewise
RIGHT = "right.mp4", "pair.yaml"  # files of a recording's right camera: its video and the calibration
_REFUSED = 2  # exit code of `bench score` for a recording without valid numbers, which the page counts


def copy_left(stereo: Path, mono: Path) -> None:
    """Copies a recording with two cameras without its right one, unless that has been done."""
    if mono.exists():
        return
    with checked_file.folder_of(mono) as part:
        shutil.copytree(stereo, part, ignore=shutil.ignore_patterns(*RIGHT), dirs_exist_ok=True)
        meta = read_meta(stereo / "meta.yaml")
        recording_writer.write_meta(
            part, meta.model_dump(mode="json", exclude_unset=True, exclude={"stereo"})
        )


def score_and_pool(recordings: Sequence[Path], cameras: int, out: Path) -> None:
    """Scores each recording in FOLDER-score next to it, unless this code has scored the same files.

    Writes the page into `out`.

    Raises UserError: a command failed, or no recording has valid numbers.
    """
    options = _OPTIONS[cameras]
    scores = [folder.with_name(f"{folder.name}-score") for folder in recordings]
    for folder, score in zip(recordings, scores, strict=True):
        key = result_cache.key(*options, result_status.content(folder, ("*",)))
        key_file = score / "inputs.key"
        if not key_file.is_file() or key_file.read_text("utf-8") != key:
            words = ("score", str(folder), *options, "-o", str(score))
            (score / "score.json").unlink(missing_ok=True)
            code = subprocess.run([sys.executable, "-m", "bench", *words]).returncode
            if code not in (0, _REFUSED) or not (score / "score.json").is_file():
                raise UserError(f"bench score: exit code {code}")
            checked_file.write_whole(key_file, key)
    line = shlex.join(["bench", "score", "RECORDING", *options])
    provenance = f"{report.command()}\n    {line}\n    bench pool SCORES"
    pool.write(pool.pool(pool.read(scores)), out, provenance)
