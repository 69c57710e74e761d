"""NVIDIA GPUs, found by the driver's own libraries, and why the renderer can't use one."""

from __future__ import annotations

import ctypes
import functools
import os
import re
import subprocess
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

_LEAST_DRIVER = 535
_BROKEN_DRIVERS = range(565, 570)  # OptiX's compiler fails on Dr.Jit's kernels (Dr.Jit's notes)
_LEAST_CAPABILITY = (7, 5)
_MAJOR, _MINOR = 75, 76  # CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_*


@dataclass(frozen=True)
class Gpu:
    """The driver and its first device."""

    devices: int
    driver: str  # version; empty if unknown
    capability: tuple[int, int]
    optix: bool  # whether `libnvoptix.so.1` is present, which traces rays


def visible() -> tuple[str, ...]:
    """Names of the GPUs in CUDA_VISIBLE_DEVICES, else of all that nvidia-smi lists."""
    variable = os.environ.get("CUDA_VISIBLE_DEVICES")
    if variable is not None:
        return tuple(name.strip() for name in variable.split(",") if name.strip())
    try:
        listing = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, timeout=30).stdout
    except (OSError, subprocess.TimeoutExpired):  # no driver, or it does not respond
        return ()
    return tuple(str(k) for k in range(len(re.findall("^GPU ", listing, re.MULTILINE))))


@functools.cache
def probe() -> Gpu | None:
    """The GPU of this machine; None if there is no driver or device."""
    cuda, count, parts = _library("libcuda.so.1"), ctypes.c_int(), list[int]()
    if not cuda or cuda.cuInit(0) or cuda.cuDeviceGetCount(ctypes.byref(count)) or not count.value:
        return None
    for attribute in (_MAJOR, _MINOR):
        cuda.cuDeviceGetAttribute(ctypes.byref(value := ctypes.c_int()), attribute, 0)
        parts.append(value.value)
    return Gpu(count.value, _driver(), (parts[0], parts[1]), _library("libnvoptix.so.1") is not None)


def _library(name: str) -> ctypes.CDLL | None:
    with suppress(OSError):
        return ctypes.CDLL(name)
    return None


def obstacle(gpu: Gpu | None) -> str | None:
    """Why the renderer cannot run on a GPU, with the remedy; None if it can."""
    if gpu is None:
        return "no NVIDIA GPU with a driver was found"
    if not gpu.optix:
        return (
            "the driver's OptiX (libnvoptix.so.1) is missing: install libnvidia-gl, or start the container "
            "with NVIDIA_DRIVER_CAPABILITIES=compute,utility,graphics"
        )
    release = int(gpu.driver.split(".")[0] or _LEAST_DRIVER)
    if release < _LEAST_DRIVER or release in _BROKEN_DRIVERS:
        return f"driver {gpu.driver}: {_LEAST_DRIVER} or newer is needed, other than 565 to 569"
    if gpu.capability < _LEAST_CAPABILITY:
        return f"compute capability {'.'.join(map(str, gpu.capability))}: 7.5 or more is needed"
    return None


def _driver() -> str:
    with suppress(OSError):
        match = re.search(r"\b\d{3}\.\d+(\.\d+)?\b", Path("/proc/driver/nvidia/version").read_text("utf-8"))
        return match[0] if match else ""
    return ""
