"""Small numeric CSV files with a header: read whole, checked, errors by line."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from synth.errors import UserError
from synth.system import foreign_file

_LARGEST_BYTES = 512 << 20
_LONG = 200


def read_csv(
    path: Path, required: Sequence[str], optional: Sequence[str] = ()
) -> dict[str, NDArray[np.float64]]:
    """Columns by name, float64, in the file's order of rows; empty cells and `nan` are NaN.

    Args:
        path: the CSV; comma or semicolon, UTF-8 with or without BOM.
        required: columns that must be there.
        optional: columns returned when there.

    Raises:
        UserError: unreadable, too large, a column missing, no rows, a cell that is no number (with its line).
    """
    header, delimiter, lines = _split(path)
    _check_header(path, header, required)
    wanted = [name for name in (*required, *optional) if name in header]
    columns = [header.index(name) for name in wanted]
    body = _body(path, lines, delimiter, columns)
    return {name: body[:, k] for k, name in enumerate(wanted)}


def read_header(path: Path) -> list[str]:
    """Names of the columns, in lower case. UserError if it is unreadable or too large."""
    return _split(path)[0]


def _split(path: Path) -> tuple[list[str], str, list[str]]:
    """Names of the columns, what separates them, and the lines below."""
    first, *lines = foreign_file.read_text(path, _LARGEST_BYTES, "utf-8-sig").splitlines() or [""]
    delimiter = ";" if first.count(";") > first.count(",") else ","
    return [name.strip().lower() for name in _cells(path, 1, first, delimiter)], delimiter, lines


def _check_header(path: Path, header: list[str], required: Sequence[str]) -> None:
    missing = [name for name in required if name not in header]
    if missing:
        raise UserError(
            f"{path}:1: missing column {', '.join(missing)}; the header has {_listed(header) or 'nothing'}"
        )
    twice = sorted({name for name in required if header.count(name) > 1})
    if twice:
        raise UserError(f"{path}:1: column {', '.join(twice)} is there more than once")


def _listed(header: list[str]) -> str:
    names = ", ".join(header)
    return names if names.isprintable() and len(names) <= _LONG else f"{names[:_LONG]!r}..."


def _body(path: Path, lines: list[str], delimiter: str, columns: list[int]) -> NDArray[np.float64]:
    rows = [line for line in lines if line.strip()]
    if not rows:
        raise UserError(f"{path}: a header but no rows")
    try:
        # loadtxt's C parser; the slow way only to name the line at fault.
        return np.loadtxt(
            rows,
            delimiter=delimiter,
            usecols=columns,
            ndmin=2,
            comments=None,
            quotechar='"',
            dtype=np.float64,
        )
    except (ValueError, IndexError):
        return np.array(
            [
                _row(path, number, line, delimiter, columns)
                for number, line in enumerate(lines, 2)
                if line.strip()
            ]
        )


def _row(path: Path, number: int, line: str, delimiter: str, columns: list[int]) -> list[float]:
    cells = _cells(path, number, line, delimiter)
    if len(cells) <= max(columns):
        raise UserError(f"{path}:{number}: {len(cells)} cells, {max(columns) + 1} expected (cut off?)")
    values = []
    for column in columns:
        text = cells[column].strip()
        try:
            values.append(float(text) if text else float("nan"))
        except ValueError:
            raise UserError(f"{path}:{number}: {text[:40]!r} is not a number") from None
    return values


def _cells(path: Path, number: int, line: str, delimiter: str) -> list[str]:
    try:
        return next(csv.reader([line], delimiter=delimiter), [])
    except csv.Error as error:
        raise UserError(f"{path}:{number}: no line of a table ({error})") from None
