"""Flow on disk: Middlebury `.flo`, KITTI 16-bit PNG, and NumPy's `.npz` with the confidence beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from synth.errors import UserError
from synth.system import foreign_arrays, foreign_file, foreign_picture
from synth.system.foreign_picture import LARGEST_PIXELS

_FORMATS = "{}: flow files are .flo (Middlebury), .png (KITTI) or .npz"
_UNKNOWN = 1e9  # px: Middlebury marks what isn't known by larger values

Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]


def read_flow(path: Path) -> tuple[Floats, Flags]:
    """Flow (H, W, 2) float32 px and where it is known (H, W); by suffix, `.flo`, `.png` or `.npz`.

    Raises:
        UserError: no such format, or a file that isn't what its name says.
    """
    readers = {".flo": _read_flo, ".png": _read_kitti, ".npz": _read_npz}
    if path.suffix.lower() not in readers:
        raise UserError(_FORMATS.format(path))
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    return readers[path.suffix.lower()](path)


def write_flow(
    path: Path, flow: Floats, known: Flags | None = None, confidence: Floats | None = None
) -> None:
    """Writes flow (H, W, 2) px; known: (H, W), everything by default. KITTI keeps 1/64 px and +-512 px.

    `confidence`: (H, W) in 0..1; only an `.npz` holds it.

    Raises:
        UserError: no such format, or displacements that KITTI's PNG can't hold.
    """
    known = np.ones(flow.shape[:2], bool) if known is None else known
    if path.suffix.lower() == ".flo":
        marked = np.where(known[..., None], flow, 10 * _UNKNOWN).astype(np.float32)
        cv2.writeOpticalFlow(str(path), marked)
    elif path.suffix.lower() == ".png":
        if known.any() and np.abs(flow[known]).max() >= 511.9:
            raise UserError(f"{path}: a displacement beyond 511 px does not fit KITTI's PNG; write .flo")
        coded = np.round(np.where(known[..., None], flow, 0) * 64 + 2**15).astype(np.uint16)
        # OpenCV's order is B, G, R: known, v, u.
        cv2.imwrite(str(path), np.dstack([known.astype(np.uint16), coded[..., 1], coded[..., 0]]))
    elif path.suffix.lower() == ".npz":
        sure = known.astype(np.float32) if confidence is None else confidence.astype(np.float32)
        np.savez_compressed(path, flow=flow.astype(np.float32), known=known, confidence=sure)
    else:
        raise UserError(_FORMATS.format(path))


def _read_flo(path: Path) -> tuple[Floats, Flags]:
    """Baker et al., IJCV 2011: magic number, width, height, then rows of u, v; little-endian floats."""
    data = foreign_file.read_bytes(path, 12 + 8 * LARGEST_PIXELS)
    width, height = np.frombuffer(data[4:12], "<i4") if data[:4] == b"PIEH" and len(data) >= 12 else (0, 0)
    if min(width, height) < 1 or len(data) != 12 + 8 * int(width) * int(height):
        raise UserError(f"{path}: not a whole Middlebury .flo file")
    flow = np.frombuffer(data, "<f4", offset=12).reshape(height, width, 2)
    known = np.all(np.abs(flow) < _UNKNOWN, axis=-1)
    return np.where(known[..., None], flow, 0).astype(np.float32), known


def _read_npz(path: Path) -> tuple[Floats, Flags]:
    """`flow` (H, W, 2) px, and `known` (H, W) if not all of it is."""
    found = foreign_arrays.read_arrays(path)
    if "flow" not in found:
        raise UserError(f"{path}: holds no array named flow")
    flow = found["flow"].astype(np.float32)
    known = np.asarray(found["known"] if "known" in found else np.isfinite(flow).all(axis=-1), bool)
    if flow.ndim != 3 or flow.shape[2] != 2 or known.shape != flow.shape[:2]:
        raise UserError(f"{path}: flow of shape {flow.shape}, expected (H, W, 2)")
    return np.where(known[..., None], flow, 0).astype(np.float32), known


def _read_kitti(path: Path) -> tuple[Floats, Flags]:
    """Geiger et al., CVPR 2012: 16-bit RGB PNG, u and v as (value - 2^15)/64, B 1 where known."""
    coded: NDArray[Any] = foreign_picture.read_picture(path, cv2.IMREAD_UNCHANGED)
    if coded.dtype != np.uint16 or coded.ndim != 3 or coded.shape[2] != 3:
        raise UserError(f"{path}: not a KITTI flow PNG (16 bits, three channels)")
    known = coded[..., 0] > 0
    flow = (coded[..., 2:0:-1].astype(np.float32) - 2**15) / 64
    return np.where(known[..., None], flow, 0).astype(np.float32), known
