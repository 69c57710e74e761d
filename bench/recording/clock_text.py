"""Dates and times of day in the cells of a table, as seconds."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import date, datetime
from pathlib import Path

import numpy as np

from synth.arrays import Floats
from synth.errors import UserError

_DAY_S = 86400.0
_TIME = re.compile(r"(\d{1,2}):(\d{2}):(\d{2})(?:([.,:])(\d+))?\s*([ap]\.?m\.?)?", re.IGNORECASE)
_MINUTES = re.compile(r"(\d{1,3}):(\d{2})[.,](\d+)")
_YEAR_FIRST = re.compile(r"(\d{4})([-/.])(\d{1,2})\2(\d{1,2})")
_YEAR_LAST = re.compile(r"(\d{1,2})([-/.])(\d{1,2})\2(\d{4}|\d{2})")
_MONTH_NAMED = re.compile(r"(\d{1,2})[-/ ]([a-z]{3})[a-z]*[-/ ](\d{4})", re.IGNORECASE)
_MONTHS = ["jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec"]
_EPOCH = date(1970, 1, 1).toordinal()
_EMPTY_CELLS = ("", "nan", "n/a", "-", "--")


def is_clock(cells: Sequence[str]) -> bool:
    """Whether the first filled cell of a column is a date or a time of day."""
    first = next((cell.strip() for cell in cells if cell.strip().lower() not in _EMPTY_CELLS), "")
    return bool(re.search(r"\d:\d\d|\d[-/]\d+[-/]\d|\d\.\d+\.\d{2,4}\b|\d[- ][A-Za-z]{3}", first))


def parse_clock(path: Path, cells: Sequence[str], lines: Sequence[int], notes: list[str]) -> Floats:
    """Seconds (N,) of a column: since 1970 with a date, else since midnight or the full hour; NaN if empty.

    Times without a date may pass midnight, or the hour. UserError: a cell is none, or the order of day and
    month can't be told and matters.
    """
    seconds, days = np.full(len(cells), np.nan), np.full(len(cells), np.nan)
    date_rows: list[tuple[int, int, int, int]] = []  # row, first, second, year: day and month in either order
    period_s, has_meridiem = _DAY_S, False
    for k, (cell, line) in enumerate(zip(cells, lines, strict=True)):
        text = cell.strip().replace("T", " ").rstrip("Z")
        if text.lower() in _EMPTY_CELLS:
            continue
        try:
            if (match := _YEAR_FIRST.match(text)) is not None:
                if re.search(r"[+-]\d\d:?\d\d$", text[match.end() :]):  # with a zone
                    seconds[k], days[k] = datetime.fromisoformat(text).timestamp(), 0.0
                    continue
                days[k] = date(int(match[1]), int(match[3]), int(match[4])).toordinal() - _EPOCH
            elif (match := _MONTH_NAMED.match(text)) is not None:
                month = _MONTHS.index(match[2].lower()) + 1
                days[k] = date(int(match[3]), month, int(match[1])).toordinal() - _EPOCH
            elif (match := _YEAR_LAST.match(text)) is not None:
                year = int(match[4]) + 2000 * (len(match[4]) == 2)
                if match[2] == ".":
                    days[k] = date(year, int(match[3]), int(match[1])).toordinal() - _EPOCH
                else:
                    date_rows.append((k, int(match[1]), int(match[3]), year))
            rest = text[match.end() :].strip(" ,") if match else text
            seconds[k], with_meridiem, row_period_s = _time_of_day(rest)
            period_s, has_meridiem = min(period_s, row_period_s), has_meridiem or with_meridiem
        except ValueError:
            raise UserError(f"{path}:{line}: {cell.strip()!r} is no date or time that can be read") from None
    if date_rows:
        days = _resolve_order(path, date_rows, days, has_meridiem, notes)
    if np.isfinite(days).any():
        return seconds + _DAY_S * days
    drops = np.flatnonzero(np.diff(seconds[np.isfinite(seconds)]) < -period_s / 2)
    if len(drops):
        notes.append(f"{path}: times pass {'midnight' if period_s == _DAY_S else 'the full hour'}")
        known = np.flatnonzero(np.isfinite(seconds))
        for drop in drops:
            seconds[known[drop + 1] :] += period_s
    origin = "midnight" if period_s == _DAY_S else "the full hour"
    notes.append(f"{path}: times of day are seconds since {origin}")
    return seconds


def _time_of_day(text: str) -> tuple[float, bool, float]:
    """Seconds, whether with AM or PM, and after how many seconds they begin anew. ValueError: none."""
    if match := _TIME.fullmatch(text):
        hours, minutes, seconds, separator, digits, meridiem = match.groups()
        if separator == ":" and len(digits) < 3:
            raise ValueError("a time code in frames")
        if int(minutes) > 59 or int(seconds) > 60 or int(hours) > (12 if meridiem else 24):
            raise ValueError("no time of day")
        hour = int(hours) if not meridiem else int(hours) % 12 + 12 * (meridiem[0].lower() == "p")
        fraction = float(f"0.{digits}") if digits else 0.0
        return 3600.0 * hour + 60 * int(minutes) + int(seconds) + fraction, bool(meridiem), _DAY_S
    if match := _MINUTES.fullmatch(text):
        if int(match[2]) > 59:
            raise ValueError("no minutes and seconds")
        return 60.0 * int(match[1]) + int(match[2]) + float(f"0.{match[3]}"), False, 3600.0
    raise ValueError("no time")


def _resolve_order(
    path: Path,
    date_rows: Sequence[tuple[int, int, int, int]],
    days: Floats,
    has_meridiem: bool,
    notes: list[str],
) -> Floats:
    """Days since 1970 (N,) of dates with day and month in either order. UserError: it can't be told."""

    def ordinals(day_first: bool) -> list[int] | None:
        try:
            return [
                date(year, *((b, a) if day_first else (a, b))).toordinal() - _EPOCH
                for _, a, b, year in date_rows
            ]
        except ValueError:
            return None

    choices = [dates for day_first in (False, True) if (dates := ordinals(day_first)) is not None]
    if not choices:
        raise UserError(f"{path}: its dates have neither the day nor the month first")
    if len(choices) == 2 and choices[0] != choices[1]:
        candidates = [dates for dates in choices if np.ptp(dates) <= 1]
        if has_meridiem:
            candidates = choices[:1]  # AM and PM are written where the month comes first
            notes.append(
                f"{path}: day or month may come first in its dates: the month is taken as first, as where AM "
                "and PM are written; else write them as 2026-11-28"
            )
        elif len({row[1:] for row in date_rows}) == 1:
            notes.append(
                f"{path}: day or month may come first in its dates: times count from that day's start"
            )
            candidates = [[0] * len(date_rows)]
        elif len(candidates) != 1:
            raise UserError(f"{path}: day or month may come first in its dates: write them as 2026-11-28")
        choices = candidates
    resolved = days.copy()
    resolved[[row[0] for row in date_rows]] = choices[0]
    return resolved
