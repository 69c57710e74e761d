"""Files from strangers: each is read, or refused in a line with exit code 2, within 5 s and 1 GB.

    with hostile.Guard() as guard:
        hostile.assert_told(guard.answer("bench", "check", folder))

`Guard` starts one process that loads the program and forks for every case, so that a case that hangs, takes
all memory or dies harms no other, and costs milliseconds. `@hostile.cases(...)` draws the cases with
hypothesis: a share of 200 in the quick run, of 2,000 in the slow one (`slow=True`).
"""

from __future__ import annotations

import importlib
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis.strategies import SearchStrategy

SECONDS = 5
"""CPU time that a case may take; a machine that others use too makes of the clock what it likes."""
BYTES = 1_000_000_000
"""What it may take in memory beyond what the loaded program has."""
PATIENCE_S = 30
"""Wall time after which a case hangs: it waits for what never comes, for it takes no CPU time."""
READERS = 6
"""What is read from strangers, and shares the cases: job, meta, csv, card, index, attributes."""

_ROOT = Path(__file__).resolve().parents[2]
_LOADED = (
    "synth.cli",
    "learn.cli",
    "bench.cli",
    "bench.recording.check",
    "learn.inference.predict",
    "synth.checks.verify",
    "synth.engine.run",
    "synth.job.reader",
)


@dataclass(frozen=True)
class Answer:
    """How a command ended."""

    code: int
    """Exit code; negative: the signal that ended it; -SIGALRM if it hung."""
    out: str
    error: str
    cpu_s: float
    peak_mb: float
    """Largest memory in all, the loaded program's included."""


class Guard:
    """A process with the program loaded, which forks for every case."""

    def __init__(self, *modules: str) -> None:
        """`modules`: loaded besides the usual ones, so that no case pays for them."""
        path = os.pathsep.join([str(_ROOT), os.environ.get("HOSTILE_PATH", "")])
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": path, "COLUMNS": "200"}
        self._process = subprocess.Popen(
            [sys.executable, __file__, *_LOADED, *modules],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            cwd=_ROOT,
            env=environment,
            text=True,
        )

    def answer(self, program: str, *words: str | Path, cwd: Path | None = None) -> Answer:
        """Runs `synth`, `learn` or `bench` with the words that follow it."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        case = {"program": program, "words": [str(word) for word in words], "cwd": str(cwd or _ROOT)}
        self._process.stdin.write(json.dumps(case) + "\n")
        self._process.stdin.flush()
        return Answer(**json.loads(self._process.stdout.readline()))

    def __enter__(self) -> Guard:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.communicate()
        assert self._process.returncode == 0


def assert_told(answer: Answer, *, lines: int = 1) -> None:
    """The file was read, or refused: exit code 2, and no more than `lines` lines on stderr."""
    told = f"exit code {answer.code} after {answer.cpu_s:.1f} s\n{answer.out[-2000:]}\n{answer.error[-2000:]}"
    assert answer.code in (0, 2), told
    assert answer.cpu_s <= SECONDS, told
    said = answer.error.strip().splitlines()
    assert "Traceback" not in answer.error + answer.out, told
    if answer.code == 2:
        assert said or answer.out.strip(), told  # `bench check` says on stdout what it finds
        assert len(said) <= lines, told
        assert max(map(len, said), default=0) < 2000, told


def cases(*, slow: bool = False, **drawn: SearchStrategy[Any]) -> Callable[[Callable[..., None]], Any]:
    """Draws a reader's share of the cases, the same ones in every run."""
    count = (2000 if slow else 200) // READERS + 1

    def decorate(test: Callable[..., None]) -> Any:
        chosen = settings(
            max_examples=count,
            derandomize=True,
            database=None,
            deadline=None,
            suppress_health_check=list(HealthCheck),
        )
        return chosen(given(**drawn)(test))

    return decorate


def _serve() -> None:
    for name in sys.argv[1:]:
        importlib.import_module(name)
    answers = os.fdopen(os.dup(1), "w")
    for line in sys.stdin:
        answers.write(json.dumps(_fork(json.loads(line))) + "\n")
        answers.flush()


def _fork(case: dict[str, Any]) -> dict[str, Any]:
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as error:
        child = os.fork()
        if child == 0:
            _run(case, out.fileno(), error.fileno())
        until, status = time.monotonic() + PATIENCE_S, None
        while True:
            ended, status, used = os.wait4(child, os.WNOHANG)
            if ended:
                break
            if time.monotonic() > until:
                os.killpg(child, signal.SIGKILL)
                _, _, used = os.wait4(child, 0)
                status = signal.SIGALRM.value
                break
            time.sleep(0.002)
        texts = []
        for file in (out, error):
            file.seek(0)
            texts.append(file.read(1_000_000).decode("utf-8", "replace"))
    return {
        "code": os.waitstatus_to_exitcode(status),
        "out": texts[0],
        "error": texts[1],
        "cpu_s": used.ru_utime + used.ru_stime,
        "peak_mb": used.ru_maxrss * 1024 / 1e6,
    }


def _run(case: dict[str, Any], out: int, error: int) -> None:
    """In the child: the command, within its limits. Doesn't return."""
    code = 70
    try:
        os.setsid()
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(out, 1)
        os.dup2(error, 2)
        os.chdir(case["cwd"])
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + BYTES, taken + BYTES))
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS + 1, SECONDS + 1))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        sys.argv = [case["program"], *case["words"]]
        importlib.import_module(f"{case['program']}.cli").app(args=case["words"])
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else int(bool(ended.code))
    except BaseException:
        traceback.print_exc()
        code = 1
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(code)


if __name__ == "__main__":
    _serve()
