"""Fast reading of single frames of a local field in the writer's layout: Zarr adds milliseconds to each.

A file of frames, each compressed by Blosc and followed by its CRC-32C, ends with an index
(zarr-specs.readthedocs.io, sharding codec 1.0).
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import google_crc32c
import numcodecs
import numpy as np
import zarr
from numpy.typing import NDArray

from synth.arrays import Array, Pixels

_CODECS = ["BytesCodec", "BloscCodec", "Crc32cCodec"]
_MISSING = 2**64 - 1


class ShardReader:
    """Frames of one field, `reader[t]`. ValueError or OSError if a file is damaged."""

    def __init__(self, folder: Path, shape: tuple[int, ...], shard_frames: int, dtype: np.dtype[Any]) -> None:
        self._folder, self._shape, self._dtype = folder, shape[1:], dtype
        self._shard_frames, self._length = shard_frames, shape[0]
        self._unpack = numcodecs.Blosc()
        self._entries: dict[int, NDArray[np.uint64]] = {}

    def __getitem__(self, t: int) -> Array:
        """Frame `t`; negative `t` count from the end."""
        if not -self._length <= t < self._length:
            raise IndexError(t)
        shard, k = divmod(t % self._length, self._shard_frames)
        path = self._folder / "c" / os.path.join(str(shard), *("0" for _ in self._shape))
        with path.open("rb", buffering=0) as file:
            if shard not in self._entries:
                self._entries[shard] = self._index(file.fileno())
            start, length = (int(number) for number in self._entries[shard][k])
            if _MISSING in (start, length):
                raise ValueError(f"frame {t} was never written")
            packed = _strip_checksum(os.pread(file.fileno(), length, start), length)
        values = np.empty(self._shape, self._dtype)
        # Blosc's header has the unpacked size in bytes 4 to 7; a shorter frame would leave the rest unset.
        if len(packed) < 16 or int(packed[4:8].view("<u4")[0]) != values.nbytes:
            raise ValueError(f"frame {t} has another size than expected")
        self._unpack.decode(packed, values)
        return values

    def _index(self, descriptor: int) -> NDArray[np.uint64]:
        """(frames, 2): start of each frame in the file, and its length in bytes."""
        length = 16 * self._shard_frames + 4
        end = os.fstat(descriptor).st_size
        if end < length:
            raise ValueError("the file is truncated")
        data = _strip_checksum(os.pread(descriptor, length, end - length), length)
        return np.frombuffer(data, "<u8").reshape(-1, 2)


def open_frames(array: zarr.Array[Any], folder: Path) -> ShardReader | None:
    """A fast reader of the frames of `array`, stored in `folder`; None for another layout."""
    codecs = [type(codec).__name__ for codec in (*array.filters, array.serializer, *array.compressors)]  # type: ignore[list-item]
    if array.shards is None or array.chunks != (1, *array.shape[1:]) or codecs != _CODECS:
        return None
    if array.shards[1:] != array.shape[1:] or np.dtype(array.dtype).byteorder == ">":
        return None
    return ShardReader(folder, array.shape, array.shards[0], np.dtype(array.dtype))


def _strip_checksum(data: bytes, length: int) -> Pixels:
    if len(data) != length or length < 4:
        raise ValueError("the file is truncated")
    payload, checksum = np.frombuffer(data, np.uint8)[:-4], int.from_bytes(data[-4:], "little")
    if google_crc32c.value(payload) != checksum:
        raise ValueError("a checksum does not match")
    return payload
