"""NVIDIA GPUs, found by the driver's nvidia-smi, and why the renderer can't use one."""

from __future__ import annotations

import ctypes
import functools
import os
import re
import subprocess
from dataclasses import dataclass

_LEAST_DRIVER = 535
_BROKEN_DRIVERS = range(565, 570)
"""Releases whose OptiX compiler fails on Dr.Jit's kernels (Dr.Jit's notes on versions)."""
_LEAST_CAPABILITY = (7, 5)


@dataclass(frozen=True)
class Gpu:
    """The driver and its first device."""

    devices: int
    driver: str  # version; empty if unknown
    capability: tuple[int, int]
    optix: bool  # whether `libnvoptix.so.1` is present, which traces rays


def visible() -> tuple[str, ...]:
    """Names of the GPUs in CUDA_VISIBLE_DEVICES, else of all."""
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    if named is not None:
        return tuple(name.strip() for name in named.split(",") if name.strip())
    return tuple(map(str, range(len(_devices()))))


def probe() -> Gpu | None:
    """The GPU of this machine; None if there is no driver or no visible device."""
    devices, names = _devices(), visible()
    if not devices or not names:
        return None
    try:
        optix = bool(ctypes.CDLL("libnvoptix.so.1"))
    except OSError:
        optix = False
    return Gpu(len(names), *devices[0], optix)


@functools.cache
def _devices() -> list[tuple[str, tuple[int, int]]]:
    """The driver's version and the compute capability of each GPU; empty without a driver that responds."""
    words = ["nvidia-smi", "--query-gpu=driver_version,compute_cap", "--format=csv,noheader"]
    try:
        listed = subprocess.run(words, capture_output=True, text=True, timeout=30).stdout
    except (OSError, subprocess.TimeoutExpired):
        return []
    found = re.findall(r"^([\d.]*).*, (\d+)\.(\d+)$", listed, re.MULTILINE)
    return [(driver, (int(major), int(minor))) for driver, major, minor in found]


def obstacle(gpu: Gpu | None) -> str | None:
    """Why the renderer cannot run on a GPU, with the remedy; None if it can."""
    if gpu is None:
        return "no NVIDIA GPU with a driver was found"
    if not gpu.optix:
        return (
            "the driver's OptiX (libnvoptix.so.1) is missing: install libnvidia-gl, or start the container "
            "with NVIDIA_DRIVER_CAPABILITIES=compute,utility,graphics"
        )
    release = int(gpu.driver.split(".")[0]) if gpu.driver else None
    if release is not None and (release < _LEAST_DRIVER or release in _BROKEN_DRIVERS):
        return f"driver {gpu.driver}: {_LEAST_DRIVER} or newer is needed, other than 565 to 569"
    if gpu.capability < _LEAST_CAPABILITY:
        return f"compute capability {'.'.join(map(str, gpu.capability))}: 7.5 or more is needed"
    return None
