"""Pictures of others: their size is read from the head of the file, before anything is decoded."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from synth.errors import UserError
from synth.system import foreign_file

LARGEST_PIXELS = 40_000_000
"""Of a still or of a frame of a video."""


def read_picture(path: Path, flags: int = cv2.IMREAD_COLOR) -> NDArray[np.generic]:
    """A still as OpenCV has it: (H, W, 3) uint8 BGR, upright, or as `flags` (cv2.IMREAD_...) ask.

    Raises:
        UserError: no regular file, no picture, or one beyond 40 megapixels.
    """
    try:
        return decode_picture(foreign_file.read_bytes(path, foreign_file.LARGEST_PICTURE), flags)
    except ValueError as error:
        raise UserError(f"{path}: not a readable picture ({error})") from None


def decode_picture(data: bytes, flags: int = cv2.IMREAD_COLOR) -> NDArray[np.generic]:
    """The same (H, W, 3) from the bytes of a file. ValueError for what is none, or too large."""
    width, height = _stated_size(data)
    refuse_large(width, height)
    try:
        found = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise ValueError(str(error.err or "it is damaged")) from None
    if found is None:
        raise ValueError("it is damaged")
    return np.asarray(found)


def refuse_large(width: int, height: int) -> None:
    """ValueError for a picture of no pixels, or of more than 40 million."""
    if width < 1 or height < 1:
        raise ValueError(f"{width} x {height} pixels")
    if width * height > LARGEST_PIXELS:
        raise ValueError(f"{width} x {height} pixels are too many, at most 40 million are read")


def _stated_size(data: bytes) -> tuple[int, int]:
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow's own limit is above ours
            with Image.open(io.BytesIO(data)) as picture:
                return picture.size
    except Image.DecompressionBombError:
        raise ValueError("its pixels are too many, at most 40 million are read") from None
    except Exception as error:  # each format's reader raises what it likes: SyntaxError, struct.error, ...
        raise ValueError("its head is none of a picture's") from error
