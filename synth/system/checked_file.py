"""File access: untrusted files are read within limits and run no code; writing is atomic."""

from __future__ import annotations

import glob
import json
import math
import os
import shutil
import stat
import tempfile
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from io import BufferedReader, BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from ruamel.yaml import YAML
from ruamel.yaml.constructor import SafeConstructor
from ruamel.yaml.error import MarkedYAMLError

from synth.errors import Caution, UserError, as_user_error, first_line
from synth.system.resources import refuse_excess

LARGEST_MESH, LARGEST_PICTURE, LARGEST_YAML = 1 << 30, 512 << 20, 200_000  # bytes
LARGEST_INSTRUMENT = 64 << 20  # bytes of a mesh that is posed in every frame
LARGEST_PIXELS = 40_000_000  # of a still image or a frame of a video
_LARGEST_ARRAYS = 64 << 30
_LARGEST_HEAD = 10_000  # bytes of an array's header, NumPy's own limit
PART = ".part"  # suffix of files that are being written, `.NAME.RANDOM.part`


def open_file(path: Path, largest: int) -> BufferedReader:
    """A regular file of at most `largest` bytes, open for reading. UserError for anything else."""
    try:  # without waiting for a pipe's other end
        file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")
    except (OSError, ValueError) as error:
        why = str(getattr(error, "strerror", None) or error).lower()
        raise UserError(f"{path}: {why}") from None
    status = os.fstat(file.fileno())
    if stat.S_ISREG(status.st_mode) and status.st_size <= largest:
        return file
    file.close()
    raise UserError(f"{path}: is no regular file of at most {largest / 1e6:.3g} MB")


def check_file(path: Path, largest: int) -> None:
    """Raises as `open_file`; for libraries that open a file by its path."""
    open_file(path, largest).close()


def read_bytes(path: Path, largest: int) -> bytes:
    """The bytes of a file. Raises as `open_file`."""
    with open_file(path, largest) as file:
        return file.read(os.fstat(file.fileno()).st_size)  # `read` allocates what it is given


def read_text(path: Path, largest: int, encoding: str = "utf-8") -> str:
    """The text of a file. UserError if it is not text of that encoding."""
    data = read_bytes(path, largest)
    with as_user_error(f"{path}: is not text"):
        return data.decode(encoding)


def read_json(path: Path, largest: int = 64 << 20) -> Any:
    """The values of a JSON file. UserError if it is not JSON."""
    text = read_text(path, largest)
    with as_user_error(f"{path}: is not JSON"):
        return json.loads(text)


class ArrayFile(Mapping[str, NDArray[Any]]):
    """The arrays of an .npz by name, numbers or Booleans of any shape (A, ...), each read when it is indexed.

    UserError, here and on reading: it is no .npz, an array is of another type, or has another size than its
    header states, or than the memory holds.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.shapes = path, dict[str, tuple[int, ...]]()
        self.types = dict[str, np.dtype[Any]]()
        label = as_user_error(f"{path}: cannot be read as .npz")
        with open_file(path, _LARGEST_ARRAYS) as file, label, zipfile.ZipFile(file) as archive:
            for entry in archive.infolist():
                name = entry.filename.removesuffix(".npy")
                self.shapes[name], self.types[name] = _read_head(archive, entry)

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name not in self.shapes:
            raise KeyError(name)
        with open_file(self.path, _LARGEST_ARRAYS) as file, as_user_error(f"{self.path}: cannot be read"):
            refuse_excess(math.prod(self.shapes[name]) * self.types[name].itemsize)
            with np.load(file, allow_pickle=False) as archive:
                array = np.asarray(archive[name])
            if array.shape != self.shapes[name]:
                raise ValueError(f"{name} has changed meanwhile")
            return array

    def __iter__(self) -> Iterator[str]:
        return iter(self.shapes)

    def __len__(self) -> int:
        return len(self.shapes)


def _read_head(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and type of an .npy in an archive; ValueError if it is none, or its size is not as it states."""
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{entry.filename} is compressed in another way than by NumPy")
    with archive.open(entry) as file:
        start = file.read(12)
    version, size = (
        tuple(start[6:8]),
        int.from_bytes(start[8:10] if start[6:7] == b"\1" else start[8:], "little"),
    )
    if start[:6] != b"\x93NUMPY" or version not in ((1, 0), (2, 0)) or size > _LARGEST_HEAD:
        raise ValueError(f"{entry.filename} is not an array of numbers")
    with archive.open(entry) as file:
        np.lib.format.read_magic(file)
        read_header = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        shape, _, dtype = read_header(file)
    if dtype.kind not in "biuf":
        raise ValueError(f"{entry.filename.removesuffix('.npy')} is not an array of numbers")
    stated_bytes = (10 if version == (1, 0) else 12) + size + math.prod(shape) * dtype.itemsize
    if min(shape, default=0) < 0 or stated_bytes != entry.file_size:
        raise ValueError(f"{entry.filename} has {entry.file_size} bytes, its header states {stated_bytes}")
    return shape, dtype


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """All arrays of an .npz by name. UserError as of `ArrayFile`."""
    return dict(ArrayFile(path))


def read_picture(path: Path, flags: int = 1) -> NDArray[np.generic]:
    """A picture by OpenCV: (H, W, 3) uint8 BGR, upright, or as of `flags`. UserError: none, or too large."""
    data = read_bytes(path, LARGEST_PICTURE)
    with as_user_error(f"{path}: not a readable picture"):
        return decode_picture(data, flags)


def decode_picture(data: bytes, flags: int = 1) -> NDArray[np.generic]:
    """As `read_picture`, from the bytes of a file; raises ValueError. The size is checked before decoding."""
    import cv2
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow's own limit is higher
            with Image.open(BytesIO(data)) as picture:
                refuse_large(*picture.size)
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except Exception as error:  # readers of formats raise anything: SyntaxError, struct.error, ...
        raise ValueError(f"unknown format: {first_line(error).split(' <_io')[0]}") from error
    if pixels is None:
        raise ValueError("it is damaged")
    return np.asarray(pixels)


def refuse_large(width: int, height: int) -> None:
    """Raises ValueError for a picture without pixels, or with more than 40 million."""
    if width < 1 or height < 1 or width * height > LARGEST_PIXELS:
        raise ValueError(f"{width} x {height} pixels, at most {LARGEST_PIXELS // 10**6} million are allowed")


def read_yaml(path: Path) -> Any:
    """The values of a YAML file. Raises as `read_text` and `load_yaml`."""
    return load_yaml(read_text(path, LARGEST_YAML), str(path))


def load_yaml(text: str, label: str, *, places: bool = False) -> Any:
    """The values of YAML 1.2, dates as text; with `places`, `ruamel.yaml`'s tree of them with their lines.

    UserError: `label:line:column: not YAML: ...`.
    """
    yaml = YAML(typ="rt" if places else "safe", pure=True)
    if not places:
        yaml.Constructor = _Plain
    try:
        return yaml.load(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f"{label}:{mark.line + 1}:{mark.column + 1}" if mark else label
        raise UserError(f"{place}: not YAML: {first_line(error.problem or error.context)}") from None
    except Exception as error:  # the parser raises ValueError and others for odd scalars and tags
        raise UserError(f"{label}: not YAML: {first_line(error)}") from error


class _Plain(SafeConstructor):
    """A constructor that leaves dates as text."""


_Plain.add_constructor("tag:yaml.org,2002:timestamp", SafeConstructor.construct_yaml_str)


def folder_bytes(path: Path) -> int:
    """Total size of the files below a folder [bytes]."""
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())


def write_whole(path: Path, text: str | bytes, *, durable: bool = True) -> None:
    """Writes a small file as a whole or not at all; `durable`: even after a power failure."""
    with part_of(path) as part, part.open("wb") as file:
        file.write(text.encode() if isinstance(text, str) else text)
        if durable:
            file.flush()
            os.fsync(file.fileno())


def write_picture(path: Path, picture: NDArray[np.uint8]) -> None:
    """Writes (H, W, 3) sRGB, or (H, W), in the format of the name's suffix. Raises UserError."""
    import cv2

    if not cv2.haveImageWriter(path.name):
        raise UserError(f"{path}: cannot be written as a picture (.png or .jpg)")
    with as_user_error(f"{path}: cannot be written as a picture"):
        _, data = cv2.imencode(path.suffix, picture[..., ::-1] if picture.ndim == 3 else picture)
        write_whole(path, data.tobytes(), durable=False)


@contextmanager
def part_of(
    path: Path, create: Callable[[Path], None] = lambda part: part.touch(exist_ok=False)
) -> Iterator[Path]:
    """A new file next to `path`, renamed to it if the block succeeds, else deleted; follows no link."""
    part = path.with_name(f".{path.name}.{os.urandom(4).hex()}{PART}")
    create(part)
    try:
        yield part
        part.replace(path)
    except BaseException:
        if part.is_dir():
            shutil.rmtree(part, ignore_errors=True)
        else:
            part.unlink(missing_ok=True)
        raise


@contextmanager
def folder_of(path: Path) -> Iterator[Path]:
    """As `part_of`, for a new folder. UserError if `path` exists, or its parent folder can't be created.

    What an earlier process left of it when it was killed is deleted.
    """
    if os.path.lexists(path):
        raise UserError(f"{path}: exists already")
    make_folder(path.absolute().parent)
    _sweep_parts(path)
    with part_of(path, Path.mkdir) as part:
        descriptor = os.open(part, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            _lock(descriptor)  # tells that a process writes to it
            yield part
        finally:
            os.close(descriptor)


def _sweep_parts(path: Path) -> None:
    """Deletes the unfinished folders of `path` that no process writes to any more."""
    for part in path.parent.glob(f".{glob.escape(path.name)}.????????{PART}"):
        if part.is_symlink() or not part.is_dir():
            continue
        with suppress(OSError):
            descriptor = os.open(part, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                acquired = _lock(descriptor)
                if acquired:
                    shutil.rmtree(part)
                elif acquired is None:  # no locks on this file system
                    message = f"{part}: was left by a process that was killed, or another one writes to it"
                    warnings.warn(f"{message}; delete it in the first case", Caution, stacklevel=1)
            finally:
                os.close(descriptor)


def _lock(descriptor: int) -> bool | None:
    """Whether no other process held the lock of a folder, which this one now holds; None without locks."""
    try:
        import fcntl  # not on Windows

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except (ImportError, OSError):
        return None
    return True


def make_folder(path: Path, space_bytes: int = 0) -> None:
    """Creates a folder. UserError if it is not writable, or its disk has less than `space_bytes` free."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path) as file:
            if space_bytes:
                os.posix_fallocate(file.fileno(), 0, space_bytes)  # respects quotas
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror})") from None


@contextmanager
def open_folder(path: Path, space_bytes: int = 0) -> Iterator[None]:
    """As `make_folder`; if the block fails, the created folders that are still empty are deleted."""
    created = [parent for parent in (path, *path.parents) if not os.path.lexists(parent)]
    try:
        make_folder(path, space_bytes)
        yield
    except BaseException:
        with suppress(OSError):
            for parent in created:
                parent.rmdir()
        raise
