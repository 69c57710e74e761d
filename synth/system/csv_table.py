"""Reader of numeric CSV files with a header; errors name the line."""

from __future__ import annotations

import codecs
import csv
from array import array
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from synth.arrays import Floats
from synth.errors import UserError
from synth.system import checked_file

_LARGEST_BYTES = 512 << 20


def read_csv(path: Path, required: Sequence[str], optional: Sequence[str] = ()) -> dict[str, Floats]:
    """Columns by name, float64, in the file's order of rows; empty cells and `nan` are NaN.

    Dates of ISO 8601 are seconds since 1970, in UTC unless they state a zone. `path`: with comma or tab, or
    semicolon and then also decimal commas, in UTF-8, or UTF-16 with BOM. `required`: present exactly once.
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
                values.extend(_number(row[k].strip().replace(",", ".") or "nan") for k in columns)
    except (ValueError, csv.Error) as error:
        raise UserError(f"{path}:{rows.line_num}: {str(error)[:100]}") from None
    if not values:
        raise UserError(f"{path}: a header but no rows")
    return dict(zip(wanted, np.array(values).reshape(-1, len(wanted)).T, strict=True))


def read_header(path: Path) -> list[str]:
    """Column names, in lower case. UserError if the file is unreadable or too large."""
    return _split(path)[0]


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        if "-" not in cell[1:]:
            raise
        date = datetime.fromisoformat(cell)
        return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()


def _split(path: Path) -> tuple[list[str], Any]:
    """Column names, and the csv.reader of the rows."""
    with checked_file.open_file(path, _LARGEST_BYTES) as file:
        wide = file.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    lines = checked_file.read_text(path, _LARGEST_BYTES, "utf-16" if wide else "utf-8-sig").splitlines()
    first = lines[0] if lines else ""
    rows = csv.reader(lines, delimiter=max(",;\t", key=first.count), strict=True)
    try:
        return [name.strip().lower() for name in next(rows, [])], rows
    except csv.Error as error:
        raise UserError(f"{path}:1: {error}") from None
