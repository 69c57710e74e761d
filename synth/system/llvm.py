"""Search for an LLVM that works with Mitsuba's fast variant: a wrong one aborts the process."""

from __future__ import annotations

import functools
import hashlib
import os
import re
import subprocess
import sys
from contextlib import suppress
from importlib import metadata
from pathlib import Path

from synth.system import cache, packages, target_processor

_PACKAGE = "karellen-llvm-core"  # a dependency on x86-64 Linux: no other package is one library
_OLDEST = 17  # drjit 1.5 aborts with 15 and 16 and refuses 14
_FOLDERS = "x86_64-linux-gnu", "aarch64-linux-gnu", ".", "../lib64", "../local/lib"  # from /usr/lib
_PROBE = (
    "import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); import drjit as dr; "
    "x = dr.arange(mi.Float, 16); x += 1; dr.eval(x); assert dr.sum(x)[0] == 136"
)


@functools.cache
def find() -> str | None:
    """Path of a libLLVM that works with the fast renderer on this machine, tested in a subprocess, or None.

    Of `SULCUS_LLVM` (a parent process's result, empty for none), else `DRJIT_LIBLLVM_PATH`, else of the
    installed Python package, else the system's newest.
    """
    inherited = os.environ.get("SULCUS_LLVM")
    if inherited is not None:
        return inherited or None
    override = os.environ.get("DRJIT_LIBLLVM_PATH")
    paths = [override] if override else [*find_packaged(), *candidates()]
    return next((path for path in paths if probe(path)), None)


def find_packaged() -> list[str]:
    """The LLVM library that was installed with this program as a Python package, if it was."""
    try:
        files = metadata.files(_PACKAGE) or ()
    except metadata.PackageNotFoundError:
        return []
    paths = (Path(str(file.locate())) for file in files if re.fullmatch(r"libLLVM\.so\.[\d.]+", file.name))
    return [str(path.resolve()) for path in paths if path.exists()]


def candidates() -> list[str]:
    """LLVM libraries of a usable version of this system, newest first."""
    folders = [*(Path("/usr/lib", name) for name in _FOLDERS), *Path("/usr/lib").glob("llvm-*/lib")]
    versions: dict[Path, int] = {}
    for path in [*_linker(), *(path for folder in folders for path in folder.glob("libLLVM*"))]:
        match = re.search(r"libLLVM(?:-(\d+)\.so|\.so\.(\d+))", path.name)
        version = int(next(filter(None, match.groups()))) if match else 0
        if version >= _OLDEST and path.exists():
            versions.setdefault(path.resolve(), version)
    return [str(path) for path, _ in sorted(versions.items(), key=lambda item: (-item[1], str(item[0])))]


def probe(path: str) -> bool:
    """Whether a small kernel runs with the LLVM at `path`, tested in a process that may crash.

    Once: that this file works with these packages on this processor is noted in the user's cache.
    """
    if not Path(path).exists():
        return False
    status = Path(path).stat()
    key_parts = path, status.st_size, status.st_mtime_ns, packages.versions(), target_processor.target()
    note: Path | None = None
    with suppress(OSError):  # nowhere to note it
        note = cache.folder("llvm") / f"works-{hashlib.sha256(repr(key_parts).encode()).hexdigest()[:16]}"
        if note.exists():
            return True
    environment = {**os.environ, "DRJIT_LIBLLVM_PATH": path}
    command = [sys.executable, "-c", _PROBE]
    try:
        works = not subprocess.run(command, env=environment, capture_output=True, timeout=120).returncode
    except subprocess.TimeoutExpired:
        return False
    if works and note:
        with suppress(OSError):  # a full disk
            note.touch()
    return works


def _linker() -> list[Path]:
    try:
        listing = subprocess.run(["ldconfig", "-p"], capture_output=True, text=True, check=False).stdout
    except FileNotFoundError:  # not a glibc system
        return []
    return [Path(path) for path in re.findall(r"=> (\S*libLLVM\S*)", listing)]
