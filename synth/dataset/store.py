"""Writer and reader of sequences: one Zarr v3 group each, written as `.part`, then sealed and renamed."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.codecs import BloscCodec, Crc32cCodec

from synth.arguments import checked
from synth.arrays import Array
from synth.dataset import fast_read, location, provenance
from synth.dataset.attributes import FORMAT, LARGEST_BYTES, check_attributes
from synth.errors import InvalidValue, NotFinite, UserError, did_you_mean
from synth.fields import FIELDS, Field
from synth.formats import STORE, motion_version
from synth.job import identity
from synth.job.schema import Job
from synth.system import packages

_SHARD_BYTES = 16 << 20  # uncompressed size of a file (shard) of several frames (chunks)

# Vector fields, and the attribute in `summary` for their greatest length.
_PEAKS = {"flow": "peak_flow_px", "traction": "peak_traction_kpa", "force": "peak_force_mn"}

# Attributes that may differ between two runs with the same sequence.
_NOT_CONTENT = {"timings", "versions", "content_hash", "seal_hash"}


class Writer:
    """Writes one sequence, frames in order. The store gets its final name in `seal`."""

    def __init__(self, folder: Path, index: int, *, frames: int, size: tuple[int, int], job: Job) -> None:
        """Begins the store of sequence `index` in a dataset; `size`: (height, width) of the picture [px]."""
        self.path = location.store(folder, index)
        self._part = self.path.with_name(f"{self.path.name}.part")
        self._frames, self._size = frames, size
        if self.path.exists():
            raise UserError(f"{self.path}: exists already")
        if self._part.exists():
            shutil.rmtree(self._part)
        self._group = zarr.create_group(str(self._part), zarr_format=3)
        self._writers: dict[str, _FieldWriter] = {}
        self._wanted = job.stored_fields
        self._half = job.store.flow == "float16"
        self._attributes = {
            "format": FORMAT,
            "format_version": STORE,
            "index": index,
            "frames": frames,
            "size": [size[1], size[0]],
            "fps": job.fps,
            "seed": job.seed,
            "flow_backend": job.flow.backend,
            "job": identity.identify_job(job),
        }

    @property
    def job_identity(self) -> str:
        """Identity of its job, by the job's files as they are now."""
        return str(self._attributes["job"])

    def wants(self, name: str) -> bool:
        """Whether the job stores that field; `put` ignores others."""
        return _field(name).name in self._wanted

    def put(self, name: str, array: Array) -> None:
        """Writes a whole field, of the shape in the field table for this sequence.

        Raises ValueError for another shape or type, NotFinite if a value is NaN or infinite.
        """
        if not self.wants(name):
            return
        if _field(name).framed:
            for t, frame in enumerate(array):
                self._writer(name).append(t, frame)
        else:
            self._writer(name).write(array)

    def put_frame(self, name: str, t: int, array: Array) -> None:
        """Writes frame `t` of a field, without its first axis; frames must be in order. Raises as `put`."""
        if self.wants(name):
            self._writer(name).append(t, array)

    def seal(self, **attributes: Any) -> Path:
        """Finishes the store: checks that every field is complete, adds attributes and hashes, renames it.

        `attributes`: JSON-ready; only `timings` may differ between equal sequences. Returns the final path.
        """
        for name in self._wanted:
            writer = self._writers.get(name)
            if writer is None or writer.filled != writer.shape[0]:
                raise ValueError(f"{name}: only {writer.filled if writer else 0} frames were written")
        hashes = {name: self._writers[name].hash.hexdigest() for name in FIELDS if name in self._writers}
        peaks = {key: self._writers[name].largest for name, key in _PEAKS.items() if name in self._writers}
        summary: dict[str, Any] = peaks
        if self._half:
            summary["rounding_px"] = {
                k: writer.rounding for k, writer in self._writers.items() if FIELDS[k].half
            }
        attrs = {
            **self._attributes,
            **attributes,
            "summary": summary,
            "field_hashes": hashes,
            "versions": packages.versions()
            | {"generator": provenance.fingerprint(), "motion": motion_version()},
        }
        attrs = json.loads(identity.canonical(attrs))  # as it is read back
        attrs["content_hash"] = content_hash(attrs)
        attrs["seal_hash"] = seal_hash(attrs)
        self._group.attrs.update(attrs)
        self._part.rename(self.path)
        return self.path

    def _writer(self, name: str) -> _FieldWriter:
        if name not in self._writers:
            field = _field(name)
            shape = field.shape(self._frames, self._size)
            self._writers[name] = _FieldWriter(self._group, field, shape, self._half and field.half)
        return self._writers[name]


class _FieldWriter:
    """Writes one field: checks and hashes frames, and collects them into shards."""

    def __init__(self, group: zarr.Group, field: Field, shape: tuple[int, ...], half: bool) -> None:
        self._field, self.shape, self.filled = field, shape, 0
        self._dtype = dtype = np.dtype("float16" if half else field.dtype)
        self.hash = field_hasher(field.name, dtype, shape)
        self._pending: list[Array] = []
        self.largest = self.rounding = 0.0
        chunk, shard = shape, None
        if field.framed:
            frame_bytes = int(np.prod(shape[1:])) * dtype.itemsize
            self._shard_frames = int(np.clip(_SHARD_BYTES // frame_bytes, 1, shape[0]))
            chunk, shard = (1, *shape[1:]), (self._shard_frames, *shape[1:])
        self._array = group.create_array(
            field.name,
            shape=shape,
            dtype=dtype,
            chunks=chunk,
            shards=shard,
            filters=None,
            compressors=[
                # Against zstd at level 3: a ninth of the time in writing, half in reading, 8% more bytes.
                BloscCodec(cname="lz4", clevel=5, shuffle="shuffle", typesize=dtype.itemsize),
                Crc32cCodec(),
            ],
            dimension_names=field.dims,
            attributes={"unit": field.unit, "meaning": field.meaning},
            # With every chunk on disk, a missing file is detected as damage and not read as zeros.
            config={"write_empty_chunks": True},
        )

    def append(self, t: int, frame: Array) -> None:
        if not self._field.framed:
            raise ValueError(f"{self._field.name}: is not stored by frame")
        if t != self.filled:
            raise ValueError(f"{self._field.name}: frame {t} after {self.filled} frames")
        self._pending.append(self._accept(frame, self.shape[1:], f", frame {t}"))
        self.filled += 1
        if len(self._pending) == self._shard_frames or self.filled == self.shape[0]:
            self._array[self.filled - len(self._pending) : self.filled] = np.stack(self._pending)
            self._pending.clear()

    def write(self, array: Array) -> None:
        self._array[...] = self._accept(array, self.shape, "")
        self.filled = self.shape[0]

    def _accept(self, array: Array, shape: tuple[int, ...], suffix: str) -> Array:
        """A checked copy of a frame or field, as stored; adds it to the hash and the greatest length."""
        name, dtype = self._field.name, self._dtype
        array = np.asarray(array)
        if array.shape != shape:
            raise ValueError(f"{name}{suffix}: shape {array.shape}, the field table has {shape}")
        if not np.can_cast(array.dtype, dtype, "same_kind"):
            raise ValueError(f"{name}{suffix}: {array.dtype}, the field table has {dtype}")
        # A copy, since the caller may reuse its buffer before the shard is full.
        copy = np.array(array, dtype, order="C")
        if dtype.kind == "f" and not np.isfinite(copy).all():
            raise NotFinite(f"{name}{suffix}: not finite, first at {np.argwhere(~np.isfinite(copy))[0]}")
        if self._field.half and copy.dtype != array.dtype:
            self.rounding = max(self.rounding, float(np.abs(copy - array).max()))
        self.hash.update(copy.data)
        if name in _PEAKS:
            squared = np.einsum("...k,...k->...", copy, copy, dtype=np.result_type(copy, np.float32))
            self.largest = max(self.largest, float(np.sqrt(squared.max())))
        return copy


class FieldReader:
    """A field of a sealed sequence, read when indexed. UserError, with store and field, if it is damaged."""

    def __init__(self, array: zarr.Array[Any], dtype: np.dtype[Any], label: str, folder: Path) -> None:
        self._array, self._label = array, label
        self._shards = fast_read.open_frames(array, folder)
        self.shape: tuple[int, ...] = array.shape
        self.stored: np.dtype[Any] = array.dtype  # type on disk; values are returned in the table's type
        self.dtype: np.dtype[Any] = dtype
        self.attrs: dict[str, Any] = dict(array.attrs)
        self.dims: tuple[str, ...] = tuple(array.metadata.dimension_names or ())

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, selection: Any) -> Array:
        single = isinstance(selection, (int, np.integer))
        try:
            values = self._shards[int(selection)] if single and self._shards else self._array[selection]
            return np.asarray(values, self.dtype)
        except IndexError:
            raise
        except Exception as error:  # Zarr, its codecs and the file system raise various errors for damage
            raise UserError(f"{self._label}: cannot be read, the store is damaged ({error})") from error

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        return np.asarray(self[...], dtype)


class Sequence:
    """One sealed sequence: `sequence["rgb"][t]`, `sequence.attrs["young_kpa"]`."""

    def __init__(self, path: Path, group: zarr.Group) -> None:
        self.path, self._group = path, group
        self.attrs = dict(group.attrs)

    @property
    def index(self) -> int:
        return int(self.attrs["index"])

    @property
    def frames(self) -> int:
        return int(self.attrs["frames"])

    @property
    def size(self) -> tuple[int, int]:
        """Height, width [px]."""
        width, height = self.attrs["size"]
        return int(height), int(width)

    @property
    def stages_cpu_s(self) -> dict[str, float]:
        """CPU time of its creation by stage [s]; empty if unknown."""
        timings = self.attrs.get("timings", {})
        return {name: stage.get("cpu_s", 0.0) for name, stage in timings.items() if isinstance(stage, dict)}

    @property
    def recovered_by(self) -> str:
        """Estimator and version of its recovered motion, as `name_motion`; empty if unknown."""
        version = self.attrs.get("versions", {}).get("motion", "0")
        return f"{self.attrs['flow_backend']} {version}" if "flow_backend" in self.attrs else ""

    @property
    def fields(self) -> list[str]:
        """Names of its fields, in the table's order."""
        return [name for name in FIELDS if name in self]

    def __contains__(self, name: str) -> bool:
        return name in self.attrs["field_hashes"]

    def is_sealed(self) -> bool:
        """Whether the attributes, including the hashes of fields, are unchanged since the seal."""
        try:
            return bool(self.attrs["seal_hash"] == seal_hash(self.attrs))
        except (ValueError, RecursionError):  # NaN in an unchecked attribute, or unlimited nesting
            return False

    def read_whole(self, name: str) -> Array:
        """A field without a frame axis, as `read_sealed`."""
        (values,) = self.read_sealed(name)
        return values

    def read_sealed(self, name: str) -> Iterator[Array]:
        """Yields a field frame by frame, or as a whole if it has no frame axis.

        Raises:
            UserError: a value is outside the table's limits or not finite; or, after the last frame, the
            values have changed since the seal.
        """
        field, reader = _field(name), self[name]
        label = f"{self.path}: {name}"
        hasher = field_hasher(name, reader.stored, reader.shape)
        selections: Any = range(len(reader)) if field.framed else [...]
        for selection in selections:
            values = np.ascontiguousarray(reader[selection])
            if values.dtype.kind == "f" and values.size:
                low, high = float(values.min()), float(values.max())  # both are NaN where one value is
                if not np.isfinite(low + high):
                    raise UserError(f"{label}: contains values that are not finite")
                if (field.low is not None and low < field.low) or (
                    field.high is not None and high > field.high
                ):
                    raise UserError(f"{label}: values from {low:g} to {high:g} {field.unit} are out of range")
            hasher.update(values.astype(reader.stored, copy=False).data)
            yield values
        if hasher.hexdigest() != self.attrs["field_hashes"][name]:
            raise UserError(f"{label}: values were changed after the seal; run `synth verify`")

    def __getitem__(self, name: str) -> FieldReader:
        field, label = _field(name), f"{self.path}: {name}"
        if name not in self:
            hint = "; it was made without mechanics.force" if name in ("force", "traction") else ""
            raise UserError(f"{label}: the sequence has no such field{hint}")
        try:
            array = self._group[name]
        except Exception as error:  # as in FieldReader
            raise UserError(f"{label}: cannot be opened, the store is damaged ({error})") from error
        expected, dtype = field.shape(self.frames, self.size), np.dtype(field.dtype)
        types = (dtype, np.dtype("float16")) if field.half else (dtype,)
        if not isinstance(array, zarr.Array) or array.shape != expected or array.dtype not in types:
            raise UserError(f"{label}: is not {field.dtype} {expected}, the store is damaged")
        rest = "/0" * (len(expected) - 1)
        for k in range(-(-expected[0] // (array.shards or array.chunks)[0])):
            # Zarr reads a missing or empty file as zeros.
            if not _size(self.path / f"{name}/c/{k}{rest}"):
                raise UserError(f"{label}: file c/{k}{rest} is missing or empty, the store is damaged")
        return FieldReader(array, dtype, label, self.path / name)


class Dataset:
    """The sealed sequences of a folder, sorted by name, with `len`, iteration and indexing."""

    @checked
    def __init__(self, root: Path | str) -> None:
        self.root = Path(root)
        if not self.root.is_dir():
            raise UserError(f"{self.root}: no such folder")
        self.paths = sorted(path for path in self.root.glob("[0-9]*.zarr") if path.is_dir())
        if not self.paths:
            raise UserError(f"{self.root}: contains no finished sequence")

    def __len__(self) -> int:
        return len(self.paths)

    @checked
    def __getitem__(self, position: int) -> Sequence:
        return open_sequence(self.paths[position])

    def __iter__(self) -> Iterator[Sequence]:
        return (self[position] for position in range(len(self)))


@checked
def open_sequence(path: Path | str, *, sealed: bool = True) -> Sequence:
    """Opens a sealed sequence.

    Args:
        path: of the store.
        sealed: refuse a store whose attributes were changed after the seal.

    Raises:
        UserError: the store is missing, unfinished, not a sequence, truncated or edited.
    """
    path = Path(path)
    if path.suffix == ".part":
        raise UserError(f"{path}: is an unfinished sequence")
    if not path.is_dir():
        raise UserError(f"{path}: no such sequence")
    if _size(path / "zarr.json") > LARGEST_BYTES:
        raise UserError(f"{path}: its metadata is larger than {LARGEST_BYTES:,} bytes")
    try:
        sequence = Sequence(path, zarr.open_group(path, mode="r", zarr_format=3, use_consolidated=False))
    except Exception as error:  # as in FieldReader
        raise UserError(f"{path}: is not a Zarr v3 group, or its metadata is damaged") from error
    check_attributes(sequence.attrs, str(path))
    if sealed and not sequence.is_sealed():
        raise UserError(f"{path}: its attributes were changed after the seal; run `synth verify`")
    return sequence


def field_hasher(name: str, stored: np.dtype[Any], shape: tuple[int, ...]) -> hashlib.blake2b:
    """A hasher that has been fed the stored name, type and shape, for the values in C order."""
    header = identity.canonical([name, str(stored), list(shape)])
    return hashlib.blake2b(header, digest_size=16)


def content_hash(attrs: Mapping[str, Any]) -> str:
    """The identity of a sequence: hash of field hashes and attributes, without timings and versions."""
    return identity.digest({key: value for key, value in attrs.items() if key not in _NOT_CONTENT})


def seal_hash(attrs: Mapping[str, Any]) -> str:
    """Hash of all root attributes except itself, timings included, to detect edits."""
    return identity.digest({key: value for key, value in attrs.items() if key != "seal_hash"})


def _size(file: Path) -> int:
    """Bytes of a file; 0 if it is missing."""
    return file.stat().st_size if file.is_file() else 0


def _field(name: str) -> Field:
    if name not in FIELDS:
        raise InvalidValue(f"{name}: is not in the field table{did_you_mean(str(name), FIELDS)}")
    return FIELDS[name]
