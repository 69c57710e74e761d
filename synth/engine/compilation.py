"""Compilation of the program's loops, once and before workers start: else each would compile them all.

`python -m synth.engine.compilation PART PARTS` compiles a part, as numba compiles one loop at a time.
"""

from __future__ import annotations

import gc
import hashlib
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress

from synth.dataset import provenance
from synth.system import cache, packages, target_processor

_ALL_S = 14  # CPU seconds, measured with an empty cache on a processor of 2023
_MOST = 4  # processes: more would be busy importing


def compile_once(environment: Mapping[str, str], processes: int, tell: Callable[[str], None]) -> None:
    """Compiles all loops in up to `processes` processes, unless that was done before on this machine.

    `environment`: added to that of the processes; `tell` is called with a line of text before it begins.
    """
    with suppress(OSError):  # nowhere to store anything: workers compile for themselves
        marker = cache.folder("loops") / f"compiled-{_key()}"
        if marker.exists():
            return
        parts = min(processes, _MOST)
        tell(f"compiling the program's loops once, about {round(_ALL_S / parts + 3)} s")
        program, child_environment = (
            [sys.executable, "-m", "synth.engine.compilation"],
            {**os.environ, **environment},
        )
        children: list[subprocess.Popen[bytes]] = []
        try:
            for part in range(parts):
                words = [*program, str(part), str(parts)]
                children.append(subprocess.Popen(words, env=child_environment, stdout=subprocess.DEVNULL))
            codes = [process.wait() for process in children]
        finally:
            for process in children:
                process.kill()
                process.wait()
        if not any(codes):  # else workers compile what is missing, and report what is wrong
            marker.touch()


def _key() -> str:
    """A word for all that numba's own cache depends on."""
    versions = (
        packages.versions(),
        target_processor.target(),
        str(provenance.HOME),
        os.environ.get("NUMBA_CACHE_DIR"),
    )
    return hashlib.sha256(repr((provenance.code("synth"), *versions)).encode()).hexdigest()[:16]


if __name__ == "__main__":
    gc.disable()  # a tenth faster
    import synth.sequence.pipeline  # noqa: F401  # all modules with loops
    from synth.system import jit

    jit.compile_loops(int(sys.argv[1]), int(sys.argv[2]))
