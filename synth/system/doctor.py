"""A report of what this machine offers to the program, what it lacks, and how to fix that."""

from __future__ import annotations

import ctypes
import importlib.util
import os
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from synth.errors import first_line
from synth.system import cache, gpu, llvm, packages
from synth.system.checked_file import folder_bytes
from synth.system.terminal import hang

_ELSEWHERE = "only Linux is supported: use WSL 2 on Windows, or the container (Dockerfile)"
_OF_SYSTEM = {"fcntl": "synth render and datasets", "resource": "bench score and learn predict"}
_LEAST_FREE_GB, _LEAST_MEMORY_GB = 5.0, 4.0


@dataclass(frozen=True)
class Diagnosis:
    """One line of the report."""

    what: str
    found: str
    good: bool = True
    advice: str = ""  # how to fix it, if it is not good


def diagnose(folder: Path) -> list[Diagnosis]:
    """All lines of the report; `folder` is where datasets are to be written."""
    parts: tuple[tuple[str, Callable[[], Iterable[Diagnosis]]], ...] = (
        ("system", _system),
        ("disk", lambda: [_disk(folder)]),
        ("renderer", renderer),
        ("CUDA", lambda: [_cuda()]),
        ("compiled kernels", lambda: [_kernels()]),
        ("packages", lambda: [Diagnosis(name, version) for name, version in packages.versions().items()]),
    )
    diagnoses = list[Diagnosis]()
    for what, examine in parts:
        try:
            diagnoses += examine()
        except Exception as error:  # of another system: the report is about what doesn't work
            why = f"can't be examined here ({type(error).__name__}: {first_line(error)})"
            diagnoses.append(Diagnosis(what, why, False, _ELSEWHERE))
    return diagnoses


def _system() -> Iterator[Diagnosis]:
    machine = packages.machine()
    name = str(machine["system"])
    yield Diagnosis("system", f"{name}, {machine['processor']}", name == "Linux", _ELSEWHERE)
    for module, needed in _OF_SYSTEM.items():
        if module in sys.modules and sys.modules[module] is None:
            lacks = True  # find_spec raises over it
        else:
            lacks = importlib.util.find_spec(module) is None
        if lacks:
            yield Diagnosis(module, f"not in this Python: {needed} can't run", False, _ELSEWHERE)
    yield Diagnosis("cores", str(machine["cores"]))
    enough = float(machine["memory_gb"]) >= _LEAST_MEMORY_GB
    yield Diagnosis(
        "memory", f"{machine['memory_gb']} GB", enough, "use --workers 1 and a smaller render.size"
    )


def lines(diagnoses: Sequence[Diagnosis]) -> list[str]:
    """The report as lines of text."""
    width, text = max(len(diagnosis.what) for diagnosis in diagnoses), []
    for diagnosis in diagnoses:
        text += hang(f"{'ok  ' if diagnosis.good else 'LACK'} {diagnosis.what:<{width}}  ", diagnosis.found)
        if not diagnosis.good:
            text += hang(f"     {'':<{width}}  -> ", diagnosis.advice)
    return text


def renderer() -> list[Diagnosis]:
    """What the renderer needs: system libraries that the loader doesn't find, else LLVM."""
    if lacking := list(_lacking()):
        return lacking
    library = llvm.find()
    if library is not None:
        return [Diagnosis("LLVM", library)]
    newer = "install the Python package karellen-llvm-core (x86-64), or LLVM 17 or newer (Debian: libllvm19)"
    return [Diagnosis("LLVM", "none works: scalar_rgb renders, at half the speed", False, newer)]


def _lacking() -> Iterator[Diagnosis]:
    """A system library that the renderer is linked to but the loader doesn't find."""
    spec = importlib.util.find_spec("drjit")
    for threads in Path(spec.origin or "").parent.glob("libnanothread.so") if spec else ():
        try:
            ctypes.CDLL(str(threads))
        except OSError as error:
            advice = "install it (Debian: apt-get install libatomic1): without it nothing is rendered"
            yield Diagnosis("renderer's libraries", str(error), False, advice)


def _kernels() -> Diagnosis:
    try:
        place = cache.folder("kernels")
    except OSError as error:
        return Diagnosis("compiled kernels", f"not cached ({error})", False, "set SULCUS_CACHE to a folder")
    size_mb, limit_mb = folder_bytes(place) / 1e6, cache.LIMIT_BYTES / 1e6
    return Diagnosis("compiled kernels", f"{size_mb:.0f} MB of at most {limit_mb:.0f} in {place}")


def _disk(folder: Path) -> Diagnosis:
    place = next(parent for parent in (folder.resolve(), *folder.resolve().parents) if parent.exists())
    free, writable = shutil.disk_usage(place).free / 1e9, os.access(place, os.W_OK)
    text = f"{free:.1f} GB free at {place}{'' if writable else ', not writable'}"
    return Diagnosis("disk", text, writable and free >= _LEAST_FREE_GB, "choose another folder with -o")


def _cuda() -> Diagnosis:
    device = gpu.probe()
    if device is None:
        return Diagnosis("CUDA", "no GPU (not needed)")
    capability = ".".join(map(str, device.capability))
    text = f"{device.devices} GPU, driver {device.driver or 'unknown'}, compute capability {capability}"
    why = gpu.obstacle(device)
    use = "" if why else "; render.variant=cuda_ad_rgb uses it"
    return Diagnosis("CUDA", text + use, why is None, why or "")
