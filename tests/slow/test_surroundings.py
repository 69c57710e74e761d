"""A dataset does not depend on the name of its folder or on the system clock."""

from __future__ import annotations

from pathlib import Path

from fake_run import Silent, options, start

from synth.dataset import index
from synth.engine import run as engine
from synth.job.schema import Job

JOB = Job(sequences=4, frames=5, render={"size": (160, 120)}, flow={"backend": "ideal"})
# Imported by every Python process, workers too: each reading of the clock is years from the previous one.
JUMPING = """
import itertools, time
real, jumps = time.time, itertools.cycle((-40, 0, 40, 7))
time.time = lambda: real() + next(jumps) * 365 * 86400.0
time.time_ns = lambda: int(time.time() * 1e9)
"""


def test_an_unusual_name_and_a_jumping_clock_change_nothing(tmp_path: Path) -> None:
    calm = engine.run_job(JOB, tmp_path / "calm", options("sequence"), Silent())
    odd = engine.run_job(JOB, tmp_path / "größe μm 脳 'out'", options("sequence"), Silent())
    assert odd.content_hash == calm.content_hash
    (tmp_path / "sitecustomize.py").write_text(JUMPING)
    run = start(tmp_path / "clock", JOB, "sequence", PYTHONPATH=str(tmp_path))
    assert run.wait() == 0
    assert index.dataset_hash(index.read_index(tmp_path / "clock").to_pylist()) == calm.content_hash
