"""Running the engine with a stand-in for the pipeline."""

from __future__ import annotations

import os
from pathlib import Path

from synth.child import Attempt
from synth.engine import Options

HERE = Path(__file__).resolve().parent


class Silent:
    """A watcher that remembers the attempts."""

    def __init__(self) -> None:
        self.attempts: list[tuple[Attempt, bool]] = []

    def begin(self, total: int, already: int, failed: int) -> None:
        self.begun = (total, already, failed)

    def stage(self, index: int, stage: str, done: int, of: int) -> None:
        assert 0 <= done <= of

    def end(self, attempt: Attempt, again: bool) -> None:
        self.attempts.append((attempt, again))


def options(work: str, **more: object) -> Options:
    path = os.pathsep.join([str(HERE), str(HERE.parents[1])])
    return Options(work=f"fake_work:{work}", environment={"PYTHONPATH": path}, **{"workers": 2, **more})  # type: ignore[arg-type]
