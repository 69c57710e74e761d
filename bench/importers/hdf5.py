"""HDF5 files, whose array names differ between labs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.importers.importer_registry import MOST_FRAMES, ROLES, Intake, choose_name
from synth.errors import UserError
from synth.system.checked_file import refuse_large

_LARGEST_CHUNK = 1 << 30

_COMMON_NAMES = {
    "frames": ("frames", "images", "image", "rgb", "video", "color"),
    "frame_time": ("frame_time", "frame_times", "frame_timestamps", "timestamps", "timestamp", "time", "t"),
    "force": ("force", "forces", "wrench", "ft"),
    "force_time": ("force_time", "force_times", "force_timestamps", "ft_time", "wrench_time"),
}


def read_source(source: Path, use: dict[str, str]) -> Intake:
    """Opens a file: frames (T, H, W[, C]), times (T,), force (N, 3 or 6), its times (N,) or the frames'.

    Arrays are found by common names, or named by `use`. UserError if one is missing, ambiguous or misshapen.
    """
    import h5py

    file = h5py.File(source, "r")
    arrays: dict[str, Any] = {}
    file.visititems(
        lambda name, item: arrays.update({name: item}) if isinstance(item, h5py.Dataset) else None
    )
    by_role = {role: _choose(role, use, arrays) for role in ROLES}
    frames, times = by_role["frames"], by_role["frame_time"]
    if frames is None or times is None:
        missing = "frames" if frames is None else "frame_time"
        listing = ", ".join(sorted(arrays)) or "no arrays"
        raise UserError(f"{source}: no {missing} found; name them with --use; the file has {listing}")
    for role, array in by_role.items():
        if array is not None:
            _refuse_odd(source, role, array)
    if frames.ndim not in (3, 4) or not all(frames.shape):
        raise UserError(f"{source}: frames of shape {frames.shape}, expected (T, height, width[, channels])")
    refuse_large(frames.shape[2], frames.shape[1])
    times_s = np.asarray(times[:], np.float64).ravel()
    if len(times_s) != len(frames):
        raise UserError(f"{source}: {len(frames)} frames, {len(times_s)} frame times")
    intake = Intake(times_s, lambda: (np.asarray(frames[k]) for k in range(len(frames))))
    if by_role["force"] is not None:
        force = np.asarray(by_role["force"][:], np.float64)
        if force.ndim != 2 or force.shape[1] not in (3, 6):
            raise UserError(f"{source}: force of shape {force.shape}, expected (N, 3) or (N, 6)")
        clock = by_role["force_time"]
        force_s = times_s if clock is None else np.asarray(clock[:], np.float64).ravel()
        intake = replace(intake, force_s=force_s, force=force[:, :3])
    return intake


def _refuse_odd(source: Path, role: str, array: Any) -> None:
    """UserError for an array in other files, without numbers or too long, before it is read."""
    if array.external or array.is_virtual:
        raise UserError(f"{source}: {array.name} is stored in other files, which are not opened")
    if array.dtype.kind not in "fiu" or array.ndim == 0:
        raise UserError(f"{source}: {array.name}, {array.shape} {array.dtype}, is not an array of numbers")
    chunk = int(np.prod(array.chunks or (1,), dtype=object)) * array.dtype.itemsize
    if chunk > _LARGEST_CHUNK or (role != "frames" and array.size > 6 * MOST_FRAMES):
        raise UserError(f"{source}: {array.name} is too large to read")


def _choose(role: str, use: dict[str, str], arrays: dict[str, Any]) -> Any:
    """The array for a role: the one named, else the first under a common name; None without."""
    if role in use:
        return arrays[choose_name(role, use[role].strip("/"), sorted(arrays), "array") or ""]
    matches = [
        [name for name in arrays if name.rsplit("/", 1)[-1].lower() == common_name]
        for common_name in _COMMON_NAMES[role]
    ]
    return arrays.get(choose_name(role, None, next(filter(None, matches), []), "array") or "")
