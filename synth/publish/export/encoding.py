"""Encoding of pictures and arrays as files."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from synth.arrays import Array

PICTURES = ("rgb", "rgb_right")  # fields that are pictures


def as_png(picture: Array) -> bytes:
    """A PNG of (H, W, 3) uint8, (H, W) uint8 or uint16, or of a mask (H, W) bool: 0 and 255."""
    from PIL import Image

    file = io.BytesIO()
    values = 255 * picture.astype(np.uint8) if picture.dtype == bool else picture
    Image.fromarray(values).save(file, "PNG", compress_level=3)
    return file.getvalue()


def write_png(path: Path, picture: Array) -> None:
    """Writes a picture (H, W) or (H, W, 3) as PNG, see `as_png`; creates its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(as_png(picture))


def write_exr(path: Path, radiance: NDArray[np.floating]) -> None:
    """Linear light (H, W, 3) as an OpenEXR file in float16; creates its folder."""
    import OpenEXR

    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": np.ascontiguousarray(radiance, np.float16)}) as file:
        file.write(str(path))


def as_npy(values: Array) -> bytes:
    """The bytes of an .npy file of an array (...)."""
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()
