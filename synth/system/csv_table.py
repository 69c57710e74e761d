"""Reader of numeric CSV files with a header; errors name the line."""

from __future__ import annotations

import codecs
import csv
import re
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from synth.arrays import Floats
from synth.errors import UserError
from synth.system import checked_file

_LARGEST_BYTES = 512 << 20
_NOTHING = {"", "nan", "na", "n/a", "#n/a", "#value!", "null", "none", "-", "--", "---"}
_PLAIN = re.compile(r"[-+]?[0-9][0-9.,]*|[-+]?[.,][0-9]+")  # a number's digits and marks
_FORTRAN = re.compile(r"([0-9.,])[dD]([-+]?[0-9]+)")
_SPACES = re.compile("(?<=[0-9])['’\u00a0\u2009\u202f](?=[0-9]{3})")  # thousands of other countries
_GROUPS = re.compile(r"[-+]?[1-9][0-9]{0,2}([.,])[0-9]{3}(\1[0-9]{3})*")


def read_csv(path: Path, required: Sequence[str], optional: Sequence[str] = ()) -> dict[str, Floats]:
    """Columns by name, float64, in the file's order of rows; empty cells and `nan` are NaN.

    Dates of ISO 8601 are seconds since 1970, in UTC unless they state a zone. `path`: with comma or tab, or
    semicolon and then also decimal commas, in UTF-8, or UTF-16 with BOM. `required`: present exactly once.
    UserError: unreadable, too large, a missing column, no rows, a cell that is not a number, or one such as
    "1,482" in a table that doesn't show whether it is a thousand.
    """
    header, rows = _split(path)
    missing = [name for name in required if header.count(name) != 1]
    if missing:
        header_text = ", ".join(header)[:200]
        raise UserError(f"{path}:1: missing column {', '.join(missing)}; the header is {header_text!r}")
    names = [name for name in (*required, *optional) if name in header]
    columns = [header.index(name) for name in names]
    cells: list[list[str]] = [[] for _ in names]
    lines: list[int] = []
    try:
        for row in rows:
            if "".join(row).strip():
                has_extra = "." not in "".join(row) and "".join(row[len(header) :]).strip()
                if has_extra or len(row) <= max(columns):
                    why = "decimal commas? use points" if has_extra else "cut off?"
                    raise ValueError(f"{len(row)} cells, {len(header)} expected ({why})")
                lines.append(rows.line_num)
                for column, k in zip(cells, columns, strict=True):
                    column.append(row[k])
    except (ValueError, csv.Error) as error:
        raise UserError(f"{path}:{rows.line_num}: {str(error)[:100]}") from None
    if not lines:
        raise UserError(f"{path}: a header but no rows")
    return dict(zip(names, parse_columns(path, cells, lines), strict=True))


def read_header(path: Path) -> list[str]:
    """Column names, in lower case. UserError if the file is unreadable or too large."""
    return _split(path)[0]


def read_lines(path: Path) -> list[str]:
    """The lines of a table's text: UTF-8, UTF-16 with BOM, else of Windows in the West. UserError: none."""
    data = checked_file.read_bytes(path, _LARGEST_BYTES)
    if b"\0" in data[:4096] and data[:2] not in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        raise UserError(f"{path}: is no text: export the table as CSV")
    wide = data[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    for encoding in ("utf-16",) if wide else ("utf-8-sig", "cp1252"):
        try:
            return data.decode(encoding).splitlines()
        except UnicodeDecodeError:
            continue
    raise UserError(f"{path}: is not text")


def parse_columns(path: Path, columns: Sequence[Sequence[str]], lines: Sequence[int]) -> list[Floats]:
    """The numbers in the cells of columns, each (N,); `lines`: the file's line of each row, for messages.

    Decimal commas and thousands are told apart by each column's other cells, or else by other columns.
    UserError: a cell is no number, or may be one of two.
    """
    parsed, marks = [], []
    for cells in columns:
        values, unparsed = np.full(len(cells), np.nan), list[int]()
        for k, cell in enumerate(cells):
            try:
                values[k] = float(cell)
            except ValueError:
                unparsed.append(k)
        parsed.append((values, unparsed))
        with_commas = any("," in cells[k] for k in unparsed)
        marks.append(_decimal_mark(path, cells, lines) if with_commas else ".")
    certain = {mark for mark in marks if mark in (",", ";")}
    for cells, (values, unparsed), mark in zip(columns, parsed, marks, strict=True):
        if mark == "?":
            if len(certain) != 1:
                k = next(k for k in unparsed if "," in cells[k])
                raise UserError(
                    f"{path}:{lines[k]}: {cells[k].strip()} may be a thousand or have decimals: "
                    "write numbers "
                    "with points as decimal marks, and thousands without marks"
                )
            mark = certain.copy().pop()
        if mark == ",":  # points are then thousands
            unparsed = sorted({*unparsed, *(k for k, cell in enumerate(cells) if "." in cell)})
        for k in unparsed:
            try:
                values[k] = parse_number(cells[k], "," if mark == "," else ".")
            except ValueError as error:
                raise UserError(f"{path}:{lines[k]}: {str(error)[:100]}") from None
    return [values for values, _ in parsed]


def _decimal_mark(path: Path, cells: Sequence[str], lines: Sequence[int]) -> str:
    """What commas are in a column that has some: `,` decimal marks, `;` thousands, `?` either.

    UserError if cells contradict each other.
    """
    decimal, thousands, has_integers = 0, 0, False  # the last lines that show it
    for line, cell in zip(lines, cells, strict=True):
        text = re.split("[eEdD]", _SPACES.sub("", cell.strip()))[0]
        if not _PLAIN.fullmatch(text):
            continue
        if "," not in text:
            has_integers |= "." not in text
            if "." in text and not _GROUPS.fullmatch(text):
                thousands = line
        elif text.count(",") > 1 or -1 < text.find(",") < text.rfind("."):
            thousands = line
        elif "." in text or not _GROUPS.fullmatch(text):
            decimal = line
    if decimal and thousands:
        raise UserError(f"{path}: commas are decimal marks in line {decimal}, but thousands by {thousands}")
    if decimal or thousands:
        return "," if decimal else ";"
    # A column of whole numbers below and from a thousand: a program that writes three decimals writes them
    # all.
    small = all(
        len(re.sub("[^0-9]", "", c)) <= 3 for c in cells if "," not in c and _PLAIN.fullmatch(c.strip())
    )
    return ";" if has_integers and small else "?"


def parse_number(cell: str, decimal: str) -> float:
    """The number in a cell, or the seconds since 1970 of a date; NaN if empty.

    `decimal`: the decimal mark, "." or ","; the other one parts thousands. ValueError: it is neither.
    """
    text = cell.strip()
    if text.lower() in _NOTHING:
        return np.nan
    text = _FORTRAN.sub(r"\1e\2", _SPACES.sub("", text))
    group = "," if decimal == "." else "."
    head = re.split("[eE]", text)[0]
    if _PLAIN.fullmatch(head):
        integer, mark, _ = head.partition(decimal)
        if group in head and not (_GROUPS.fullmatch(integer) and group not in head[len(integer) :]):
            raise ValueError(f"{cell.strip()!r} is not a number with {decimal!r} as decimal mark")
        return float(text.replace(group, "").replace(decimal, ".") if mark else text.replace(group, ""))
    try:
        return float(text)
    except ValueError:
        if "-" not in text[1:]:
            raise
        date = datetime.fromisoformat(text)
        return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()


def _split(path: Path) -> tuple[list[str], Any]:
    """Column names, and the csv.reader of the rows."""
    lines = read_lines(path)
    first = lines[0] if lines else ""
    rows = csv.reader(lines, delimiter=max(",;\t", key=first.count), strict=True)
    try:
        return [name.strip().lower() for name in next(rows, [])], rows
    except csv.Error as error:
        raise UserError(f"{path}:1: {error}") from None
