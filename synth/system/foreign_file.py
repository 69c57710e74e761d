"""Files of others: regular ones, of a bounded size. A pipe, a device or a hole of a terabyte is a line."""

from __future__ import annotations

import json
import os
import stat
from io import BufferedReader
from pathlib import Path
from typing import Any

from synth.errors import UserError

LARGEST_JSON = 64 << 20
"""Bytes of a JSON file that is read."""
LARGEST_PICTURE = 512 << 20
"""Bytes of a still; its pixels are limited too (`synth.system.foreign_picture`)."""
_LONG = 500


def check_file(path: Path, largest: int) -> None:
    """That `path` is a regular file of at most `largest` bytes, for a library that opens it by its name.

    Raises:
        UserError: it isn't, or it can't be opened.
    """
    open_file(path, largest).close()


def open_file(path: Path, largest: int) -> BufferedReader:
    """A regular file of at most `largest` bytes, open for reading; links are followed.

    Raises:
        UserError: there is none, it is a folder, pipe or device, it is larger, or may not be read.
    """
    name = str(path) if len(str(path)) < _LONG else f"{str(path)[:_LONG]}..."
    try:
        # Opening a pipe would wait for its other end.
        number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        raise UserError(f"{name}: no such file") from None
    except OSError as error:
        raise UserError(f"{name}: cannot be read ({error.strerror})") from None
    except ValueError:
        raise UserError(f"{name!r}: is no name of a file") from None
    about = os.fstat(number)
    if stat.S_ISREG(about.st_mode) and about.st_size <= largest:
        return os.fdopen(number, "rb")
    os.close(number)
    if stat.S_ISREG(about.st_mode):
        raise UserError(f"{name}: {_amount(about.st_size)} is too large, at most {_amount(largest)} are read")
    if stat.S_ISDIR(about.st_mode):
        raise UserError(f"{name}: is a folder, a file is needed")
    raise UserError(f"{name}: is no regular file (a pipe or device?)")


def read_bytes(path: Path, largest: int) -> bytes:
    """What is in a file. Raises as `open_file`."""
    with open_file(path, largest) as file:
        return file.read(largest)


def read_text(path: Path, largest: int, encoding: str = "utf-8") -> str:
    """The text of a file. Raises as `open_file`, and UserError for what is no such text."""
    try:
        return read_bytes(path, largest).decode(encoding)
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: unreadable, no UTF-8 text (byte {error.start})") from None


def read_json(path: Path, largest: int = LARGEST_JSON) -> Any:
    """What a JSON file holds. Raises as `read_text`, and UserError for what is no JSON or nested too deep."""
    text = read_text(path, largest)
    try:
        return json.loads(text)
    except RecursionError:
        raise UserError(f"{path}: is nested too deep") from None
    except ValueError as error:
        raise UserError(f"{path}: is damaged ({error})") from None


def _amount(size: int) -> str:
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.3g} MB"
