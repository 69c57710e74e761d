"""Small numeric CSV files with a header: read whole, checked, errors by line."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from synth.errors import UserError

_LARGEST_BYTES = 2 << 30


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
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise UserError(f"{path}: {path.stat().st_size / 1e9:.1f} GB is too large for a table; split it")
        with path.open(encoding="utf-8-sig", newline="") as file:
            first = file.readline()
            delimiter = ";" if first.count(";") > first.count(",") else ","
            header = [name.strip().lower() for name in next(csv.reader([first], delimiter=delimiter), [])]
            _check_header(path, header, required)
            wanted = [name for name in (*required, *optional) if name in header]
            columns = [header.index(name) for name in wanted]
            body = _body(path, file.read().splitlines(), delimiter, columns)
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: unreadable ({error})") from None
    return {name: body[:, k] for k, name in enumerate(wanted)}


def _check_header(path: Path, header: list[str], required: Sequence[str]) -> None:
    missing = [name for name in required if name not in header]
    if missing:
        raise UserError(
            f"{path}:1: missing column {', '.join(missing)}; the header has {', '.join(header) or 'nothing'}"
        )
    twice = sorted({name for name in required if header.count(name) > 1})
    if twice:
        raise UserError(f"{path}:1: column {', '.join(twice)} is there more than once")


def _body(path: Path, lines: list[str], delimiter: str, columns: list[int]) -> NDArray[np.float64]:
    rows = [line for line in lines if line.strip()]
    if not rows:
        raise UserError(f"{path}: a header but no rows")
    try:
        # loadtxt's C parser; the slow way only to name the line at fault.
        return np.loadtxt(
            rows, delimiter=delimiter, usecols=columns, ndmin=2, comments=None, dtype=np.float64
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
    cells = next(csv.reader([line], delimiter=delimiter))
    if len(cells) <= max(columns):
        raise UserError(f"{path}:{number}: {len(cells)} cells, {max(columns) + 1} expected (cut off?)")
    values = []
    for column in columns:
        text = cells[column].strip()
        try:
            values.append(float(text) if text else float("nan"))
        except ValueError:
            raise UserError(f"{path}:{number}: '{text[:40]}' is not a number") from None
    return values
