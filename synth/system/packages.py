"""Versions of the installed packages that shape a sequence."""

from __future__ import annotations

import platform
from importlib import metadata

_SHAPING = (
    "sulcus",
    "mitsuba",
    "drjit",
    "numpy",
    "scipy",
    "opencv-contrib-python-headless",
    "torch",
    "zarr",
    "numba",
    "llvmlite",
)


def versions() -> dict[str, str]:
    """`{package: version}` of the installed packages that shape a sequence, and of Python."""
    found = {"python": platform.python_version()}
    for name in _SHAPING:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue  # optional here, or run from a checkout that is not installed
    return found
