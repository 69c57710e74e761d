"""Files and folders of ours, there whole or not at all, in places where others may have left links."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

from synth.errors import UserError

_END = ".part"


def write_whole(path: Path, text: str | bytes, *, durable: bool = True) -> None:
    """Writes a small file so that it is there in full or not at all; `durable`: after a power failure too."""
    with part_of(path) as part, part.open("wb") as file:
        file.write(text.encode() if isinstance(text, str) else text)
        if durable:
            file.flush()
            os.fsync(file.fileno())


@contextmanager
def part_of(path: Path) -> Iterator[Path]:
    """A new file beside `path` to write, which takes its name when the block ends well and else is gone.

    It is created exclusively: no link that lies there is followed. One that lies at `path` is replaced.
    """
    part = _new(path, lambda part: part.touch(exist_ok=False))
    try:
        yield part
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


@contextmanager
def folder_of(path: Path) -> Iterator[Path]:
    """A new folder beside `path` to fill, which takes its name when the block ends well and else is gone.

    Raises:
        UserError: something is at `path`, or its own folder can't be made.
    """
    if os.path.lexists(path):
        raise UserError(f"{path}: exists already")
    with made_folder(path.absolute().parent):
        part = _new(path, Path.mkdir)
        try:
            yield part
            part.rename(path)
        except BaseException:
            shutil.rmtree(part, ignore_errors=True)
            raise


@contextmanager
def made_folder(path: Path, room_bytes: int = 0) -> Iterator[None]:
    """`path` as a folder with so much room on its disk; what was made of it is gone again if the block fails.

    Raises:
        UserError: it, or one above it, is a file, may not be written, or the disk has not that much room.
    """
    made = [one for one in (path, *path.parents) if not os.path.lexists(one)]
    try:
        try:
            path.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=path) as file:
                if room_bytes:
                    os.posix_fallocate(file.fileno(), 0, room_bytes)  # quotas count too
        except (FileExistsError, NotADirectoryError):
            raise UserError(f"{path}: a file is in the way of this folder") from None
        except OSError as error:
            raise UserError(f"{path}: cannot be written ({error.strerror})") from None
        yield
    except BaseException:
        for one in made:
            try:
                one.rmdir()
            except FileNotFoundError:  # the block has done so
                continue
            except OSError:  # something else is in it by now, or it was never made
                break
        raise


def is_part(name: str, whole: str) -> bool:
    """Whether a file of that name is what an interrupted writing of `whole` left."""
    return name.startswith(f".{whole}.") and name.endswith(_END)


def sweep(folder: Path) -> None:
    """Removes what interrupted writings left in a folder that nobody else writes to."""
    for part in folder.glob(f".*{_END}"):
        if part.is_dir() and not part.is_symlink():
            shutil.rmtree(part)
        else:
            part.unlink()


def _new(path: Path, make: Callable[[Path], None]) -> Path:
    """The first name beside `path` at which `make` finds nothing in its way."""
    for k in count():
        part = path.with_name(f".{path.name}.{os.getpid()}-{k}{_END}")
        try:
            make(part)
            return part
        except FileExistsError:
            continue
    raise AssertionError
