"""Running the engine with a stand-in for the pipeline."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from synth.dataset.dataset_folder import claim, parse_part
from synth.dataset.index import write_index
from synth.engine.child import Attempt
from synth.engine.journal import Watcher
from synth.engine.run import Options, run_job
from synth.job.schema import Job
from synth.publish import card

HERE = Path(__file__).resolve().parent
_BEFORE = filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))
# Workers import the stand-in.
os.environ["PYTHONPATH"] = os.pathsep.join(dict.fromkeys([*_BEFORE, str(HERE), str(HERE.parents[1])]))


class Silent(Watcher):
    """A watcher that records the attempts."""

    def __init__(self) -> None:
        self.attempts: list[tuple[Attempt, bool]] = []

    def stage(self, index: int, stage: str, done: int, of: int) -> None:
        assert 0 <= done <= of

    def end(self, attempt: Attempt, again: bool) -> None:
        self.attempts.append((attempt, again))


def options(work: str, **settings: object) -> Options:
    return Options(work=f"fake_work:{work}", **{"workers": 1, "mix_versions": True, **settings})  # type: ignore[arg-type]


def in_process(job: Job, root: Path, work: Callable[..., None]) -> None:
    """Makes the output of a run without worker processes."""
    with claim(root, job) as folder:
        for index in range(job.sequences):
            work(job, index, root, lambda *_: None)
        write_index(folder)
        card.write_card(folder)


def start(root: Path, job: Job, work: str, part: str = "") -> subprocess.Popen[bytes]:
    """Starts a run in a process of its own, which can be killed."""
    # Tests in a shell's background ignore SIGINT, and so would their children.
    program = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "import sys; sys.path[:0] = sys.argv[5:]; from pathlib import Path; import fake_run; "
        "fake_run.run_here(Path(sys.argv[1]), sys.argv[2], sys.argv[3], sys.argv[4])"
    )
    words = [str(root), job.model_dump_json(), work, part, str(HERE), str(HERE.parents[1])]
    return subprocess.Popen([sys.executable, "-c", program, *words])


def run_here(root: Path, job: str, work: str, part: str) -> None:
    """The run in the process of `start`."""
    run_options = options(work, part=parse_part(part) if part else None)
    run_job(Job.model_validate_json(job), root, run_options, Silent())


def wait_for(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    """Waits for a condition. Raises AssertionError after `seconds`."""
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, "nothing happened"
        time.sleep(0.02)
