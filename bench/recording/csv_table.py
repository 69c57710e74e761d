"""Reader of numeric CSV files with a header; errors name the line."""

from __future__ import annotations

import csv
from array import array
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from synth.arrays import Floats
from synth.errors import UserError
from synth.system import checked_file

_LARGEST_BYTES = 512 << 20


def read_csv(path: Path, required: Sequence[str], optional: Sequence[str] = ()) -> dict[str, Floats]:
    """Columns by name, float64, in the file's order of rows; empty cells and `nan` are NaN.

    Args:
        path: the CSV; comma, or semicolon and then also decimal commas; UTF-8 with or without BOM.
        required: columns that must be present exactly once.
        optional: columns returned if present.

    Raises:
        UserError: unreadable, too large, a missing column, no rows, a cell that is not a number.
    """
    header, rows = _split(path)
    missing = [name for name in required if header.count(name) != 1]
    if missing:
        there = ", ".join(header)[:200]
        raise UserError(f"{path}:1: missing column {', '.join(missing)}; the header is {there!r}")
    wanted = [name for name in (*required, *optional) if name in header]
    columns, values = [header.index(name) for name in wanted], array("d")
    try:
        for row in rows:
            if "".join(row).strip():
                over = "." not in "".join(row) and "".join(row[len(header) :]).strip()
                if over or len(row) <= max(columns):
                    why = "decimal commas? use points" if over else "cut off?"
                    raise ValueError(f"{len(row)} cells, {len(header)} expected ({why})")
                values.extend(float(row[k].strip().replace(",", ".") or "nan") for k in columns)
    except (ValueError, csv.Error) as error:
        raise UserError(f"{path}:{rows.line_num}: {str(error)[:100]}") from None
    if not values:
        raise UserError(f"{path}: a header but no rows")
    return dict(zip(wanted, np.array(values).reshape(-1, len(wanted)).T, strict=True))


def read_header(path: Path) -> list[str]:
    """Column names, in lower case. UserError if the file is unreadable or too large."""
    return _split(path)[0]


def _split(path: Path) -> tuple[list[str], Any]:
    """Column names, and the csv.reader of the rows."""
    lines = checked_file.read_text(path, _LARGEST_BYTES, "utf-8-sig").splitlines()
    first = lines[0] if lines else ""
    rows = csv.reader(lines, delimiter=";" if first.count(";") > first.count(",") else ",", strict=True)
    try:
        return [name.strip().lower() for name in next(rows, [])], rows
    except csv.Error as error:
        raise UserError(f"{path}:1: {error}") from None
