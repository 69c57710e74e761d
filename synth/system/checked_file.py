"""Files: others' are read within limits and run no code, ours are there whole or not at all."""

from __future__ import annotations

import json
import os
import shutil
import stat
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader, BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from ruamel.yaml import YAML
from ruamel.yaml.constructor import SafeConstructor
from ruamel.yaml.error import MarkedYAMLError

from synth.errors import UserError, as_user_error, first_line

LARGEST_JSON, LARGEST_PICTURE, LARGEST_YAML, LARGEST_STORAGE = 64 << 20, 512 << 20, 200_000, 1 << 20
"""Bytes of a file of that kind that is read."""
LARGEST_PIXELS = 40_000_000
"""Of a still or of a frame of a video."""
_LARGEST_ARRAYS = 64 << 30
PART = ".part"
"""How the names of files end that are being written, `.NAME.RANDOM.part`."""


def open_file(path: Path, largest: int) -> BufferedReader:
    """A regular file of at most `largest` bytes, open for reading. UserError for anything else."""
    try:  # without waiting for a pipe's other end
        file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")
    except (OSError, ValueError) as error:
        why = str(getattr(error, "strerror", None) or error).lower()
        raise UserError(f"{path}: {why}") from None
    about = os.fstat(file.fileno())
    if stat.S_ISREG(about.st_mode) and about.st_size <= largest:
        return file
    file.close()
    raise UserError(f"{path}: is no regular file of at most {largest / 1e6:.3g} MB")


def check_file(path: Path, largest: int) -> None:
    """`open_file`, for a library that opens it by its name."""
    open_file(path, largest).close()


def read_bytes(path: Path, largest: int) -> bytes:
    """What is in a file. Raises as `open_file`."""
    with open_file(path, largest) as file:
        return file.read(largest)


def read_text(path: Path, largest: int, encoding: str = "utf-8") -> str:
    """The text of a file. UserError for what is none."""
    data = read_bytes(path, largest)
    with as_user_error(f"{path}: is no text"):
        return data.decode(encoding)


def read_json(path: Path, largest: int = LARGEST_JSON) -> Any:
    """What a JSON file holds. UserError for what is none."""
    text = read_text(path, largest)
    with as_user_error(f"{path}: is no JSON"):
        return json.loads(text)


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of an .npz by name, of any shape (A, ...), numbers and truth values only. UserError else."""
    with open_file(path, _LARGEST_ARRAYS) as file, as_user_error(f"{path}: cannot be read as .npz"):
        with np.load(file, allow_pickle=False) as held:
            found = {name: held[name] for name in held.files}
        for name, array in found.items():
            if array.dtype.kind not in "biuf":
                raise ValueError(f"{name} is no array of numbers")
        return found


def read_picture(path: Path, flags: int = 1) -> NDArray[np.generic]:
    """A still as OpenCV has it: (H, W, 3) uint8 BGR, upright, or as `flags` (cv2.IMREAD_...) ask.

    Raises:
        UserError: no regular file, no picture, or one beyond 40 megapixels.
    """
    data = read_bytes(path, LARGEST_PICTURE)
    with as_user_error(f"{path}: not a readable picture"):
        return decode_picture(data, flags)


def decode_picture(data: bytes, flags: int = 1) -> NDArray[np.generic]:
    """The same (H, W, 3) from the bytes of a file; its size is read before it is decoded. ValueError."""
    import cv2
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow's own limit is above ours
            with Image.open(BytesIO(data)) as picture:
                refuse_large(*picture.size)
        found = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except Exception as error:  # each format's reader raises what it likes: SyntaxError, struct.error, ...
        raise ValueError(f"no picture that is read: {first_line(error)}") from error
    if found is None:
        raise ValueError("it is damaged")
    return np.asarray(found)


def refuse_large(width: int, height: int) -> None:
    """ValueError for a picture of no pixels, or of more than 40 million."""
    if width < 1 or height < 1 or width * height > LARGEST_PIXELS:
        raise ValueError(f"{width} x {height} pixels, at most {LARGEST_PIXELS // 10**6} million are read")


def read_storage(path: Path, largest: int = LARGEST_STORAGE) -> dict[str, Any]:
    """Matrices (float64 arrays) and numbers at the top of an OpenCV FileStorage: YAML, XML or JSON.

    UserError for what is none.
    """
    import cv2

    text = read_text(path, largest)
    with as_user_error(f"{path}: is no OpenCV calibration"):
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = storage.root()  # it and its nodes live as long as the storage
        nodes = {key: root.getNode(key) for key in root.keys()}  # noqa: SIM118 - a FileNode is no dictionary
        return {
            key: node.mat() if node.isMap() else node.real()
            for key, node in nodes.items()
            if node.isMap() or node.isInt() or node.isReal()
        }


def read_yaml(path: Path) -> Any:
    """The values of a YAML file. Raises as `read_text` and `load_yaml`."""
    return load_yaml(read_text(path, LARGEST_YAML), str(path))


def load_yaml(text: str, label: str, *, places: bool = False) -> Any:
    """The values of YAML 1.2, a date as its text; with `places`: `ruamel.yaml`'s tree, comments too.

    Raises:
        UserError: `label:line:column: not YAML: ...`.
    """
    yaml = YAML(typ="rt" if places else "safe", pure=True)
    if not places:
        yaml.Constructor = _Plain
    try:
        return yaml.load(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"{label}:{mark.line + 1}:{mark.column + 1}" if mark else label
        raise UserError(f"{where}: not YAML: {first_line(error.problem or error.context)}") from None
    except Exception as error:  # the reader raises bare ValueErrors and others for odd scalars and tags
        raise UserError(f"{label}: not YAML: {first_line(error)}") from error


class _Plain(SafeConstructor):
    """Values whose dates stay text."""


_Plain.add_constructor("tag:yaml.org,2002:timestamp", SafeConstructor.construct_yaml_str)


def folder_bytes(path: Path) -> int:
    """What the files under a folder take on disk."""
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())


def write_whole(path: Path, text: str | bytes, *, durable: bool = True) -> None:
    """Writes a small file so that it is there in full or not at all; `durable`: after a power failure too."""
    with part_of(path) as part, part.open("wb") as file:
        file.write(text.encode() if isinstance(text, str) else text)
        if durable:
            file.flush()
            os.fsync(file.fileno())


def write_picture(path: Path, picture: NDArray[np.uint8]) -> None:
    """Writes (H, W, 3) sRGB in the format that the name ends with. UserError where that can't be."""
    import cv2

    if not cv2.haveImageWriter(path.name):
        raise UserError(f"{path}: cannot be written as a picture (.png or .jpg)")
    with as_user_error(f"{path}: cannot be written as a picture"):
        _, data = cv2.imencode(path.suffix, picture[..., ::-1])
        write_whole(path, data.tobytes(), durable=False)


@contextmanager
def part_of(path: Path) -> Iterator[Path]:
    """A new file beside `path` to write, which takes its name when the block ends well and else is gone.

    It is created exclusively: no link that lies there is followed. One that lies at `path` is replaced.
    """
    part = _part_name(path)
    part.touch(exist_ok=False)
    with _replacing(path, part):
        yield part


@contextmanager
def folder_of(path: Path) -> Iterator[Path]:
    """The same for a new folder. UserError if something is at `path`, or its own folder can't be made."""
    if os.path.lexists(path):
        raise UserError(f"{path}: exists already")
    make_folder(path.absolute().parent)
    part = _part_name(path)
    part.mkdir()
    with _replacing(path, part):
        yield part


@contextmanager
def _replacing(path: Path, part: Path) -> Iterator[None]:
    try:
        yield
        part.replace(path)
    except BaseException:
        if part.is_dir():
            shutil.rmtree(part, ignore_errors=True)
        else:
            part.unlink(missing_ok=True)
        raise


def make_folder(path: Path, room_bytes: int = 0) -> None:
    """Makes a folder. UserError if it can't be, can't be written, or its disk has not that much room."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path) as file:
            if room_bytes:
                os.posix_fallocate(file.fileno(), 0, room_bytes)  # quotas count too
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror})") from None


@contextmanager
def made_folder(path: Path, room_bytes: int = 0) -> Iterator[None]:
    """`make_folder`; what it made and the block left empty is gone again if the block fails."""
    fresh = [one for one in (path, *path.parents) if not os.path.lexists(one)]
    try:
        make_folder(path, room_bytes)
        yield
    except BaseException:
        with suppress(OSError):
            for one in fresh:
                one.rmdir()
        raise


def _part_name(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.urandom(4).hex()}{PART}")
