"""Tables of a force sensor as devices and spreadsheets write them: head lines, units, clocks, one axis or
three."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from bench.recording import clock_text
from synth.arrays import Floats
from synth.errors import UserError
from synth.system import csv_table

G = 9.80665e-3  # N of a gram, by standard gravity
POUND = 453.59237 * G
_NEWTONS = {
    **dict.fromkeys(("n", "newton", "newtons"), 1.0),
    **dict.fromkeys(("mn", "millinewton", "millinewtons"), 1e-3),
    **dict.fromkeys(("un", "µn", "μn", "micronewton", "micronewtons"), 1e-6),
    **{"cn": 1e-2, "kn": 1e3, "dyn": 1e-5, "dyne": 1e-5, "dynes": 1e-5},
    **dict.fromkeys(("g", "gf", "grf", "gram", "grams", "gram-force", "grams-force", "gramforce"), G),
    **dict.fromkeys(("kg", "kgf", "kp", "kilogram", "kilograms", "kilogram-force"), 1000 * G),
    **{"mg": G / 1000, "mgf": G / 1000},
    **dict.fromkeys(("lb", "lbs", "lbf", "pound", "pounds", "pound-force", "pounds-force"), POUND),
    **dict.fromkeys(("oz", "ozf", "ounce", "ounces"), POUND / 16),
}
_SECONDS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "msecs", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "µs", "μs", "usec", "microsecond", "microseconds"), 1e-6),
    **dict.fromkeys(("ns", "nsec", "nanosecond", "nanoseconds"), 1e-9),
    **dict.fromkeys(("min", "mins", "minute", "minutes"), 60.0),
    **dict.fromkeys(("h", "hr", "hour", "hours"), 3600.0),
    **dict.fromkeys(("d", "day", "days"), 86400.0),
}
_WORDS = "|".join(sorted(map(re.escape, {*_NEWTONS, *_SECONDS}), key=len, reverse=True))
_UNIT = re.compile(rf"(.*?)(?:\s*[\[({{<]\s*([^\])}}>]*?)\s*[\])}}>]|[ _.,]+({_WORDS}))")
# Names without "%", "_" or "/" in front, with "." for "/", and without a unit.
_AXIS = r"(?:f[ _.]?{0}|(?:force|kraft)[ _.]?{0}|{0}[ _.]?force)(?:[ _.](?:axis|component))?"
_SHEAR = r"(?:shear|tangential|lateral)[ _.]?(?:force|load|f)"
_SIZE = (
    r"(?:(?:normal|axial|total|resultant|measured|contact|tip|tool)[ _.])?(?:force|load|load ?cell|kraft|f)"
    r"(?:[ _.](?:magnitude|norm|size|total|resultant))?"
)
_TIME = (
    r"(?:(?:elapsed|relative|sample|host|local|utc|system)[ _.]?)?(?:t|time|zeit|uhrzeit|time[ "
    "_]?stamp|stamp|elapsed|clock)"
    r"|x_value|date[ _.]?time|time of day"
)
_CLOCKS = ("", "-", "utc", "gmt", "local", "unix", "epoch", "posix")  # in a unit's place: the size tells
_STAMP, _NANOSECONDS = r"(?:.*\.)?(?:header\.stamp|stamp\.secs?)", r"(?:.*\.)?stamp\.n(?:ano)?secs?"
_HEAD_UNIT = re.compile(r"force[ _]units?\W+([\w-]+)|y_unit_label\W+([\w-]+)", re.IGNORECASE)
_HEAD_RATE = re.compile(r"sampl\w*[ _](?:rate|freq\w*)", re.IGNORECASE)
_HEAD_STEP = re.compile(r"delta_x", re.IGNORECASE)
_HEAD_NUMBER = re.compile(r"[-+]?(?:\d[\d.,'’\u00a0\u2009\u202f]*|\.\d+)(?:[eEdD][-+]?\d+)?")
_PER_SECOND = re.compile(r"\b1 ?/ ?s(?:ec\w*)?\b|\bs ?\^? ?[-−] ?1\b", re.IGNORECASE)
_TWO_NUMBERS = re.compile(r"\d+,[1-9]\d{3,}")
_FASTEST_HZ = 1e5  # of force sensors; beyond, a comma parts two rates
_OF_TIME = re.compile(r"\b(?:[mnuµμ]s|m?sec|min)\b", re.IGNORECASE)
_BRACKETS = re.compile(r"\([^)]*\)|\[[^\]]*\]")
SINCE_1970_S, _LATEST_S = 0.9e9, 5e9  # of the years 1998 to 2128
_DAYS = 30_000.0, 70_000.0  # of spreadsheets, from 1899-12-30, in the years 1982 to 2091
_DAYS_TO_1970 = 25_569.0
_FASTEST_S = 2e-5  # a sensor's median step, read as seconds, that shows days
_HEAD_LINES = 500
_COMMENT = ("#", "%", "//", "***")
_BIAS = 1.0  # share of the range of sizes that the least one may be, without being a bias; by hand
_LEAST_BLOCK, _BLOCK_SPREAD = 1.5, 0.3  # median length of runs of one stamp, and its relative spread


@dataclass(frozen=True)
class Readings:
    """Samples of a table."""

    time_s: Floats  # (N,)
    force: Floats  # (N, 3) newtons if `in_newtons`; 0 in axes that the table lacks, NaN where it has no value
    axes: str  # which are measured: some of "xyz", or "" for a size, in the first component
    in_newtons: bool  # whether the table states its unit
    notes: tuple[str, ...] = ()
    gravity: Floats | None = None  # (N, 3), columns gx, gy, gz


@dataclass(frozen=True)
class SensorTable:
    """A table, split into cells."""

    path: Path
    names: list[str]  # of the columns, plain
    units: list[str]  # of the columns as written in names or in a row below; empty: not stated
    rows: list[list[str]]
    lines: list[int]  # of the rows in the file
    head: list[str] = field(default_factory=list)  # lines before the header

    def columns(self, *chosen: int) -> list[list[str]]:
        """The cells of columns. UserError: a row ends before one of them."""
        least = max(chosen, default=-1) + 1
        for line, row in zip(self.lines, self.rows, strict=True):
            if len(row) < least:
                raise UserError(
                    f"{self.path}:{line}: {len(row)} cells, {len(self.names)} expected (cut off?)"
                )
        return [[row[k] for row in self.rows] for k in chosen]

    def numbers(self, *chosen: int) -> list[Floats]:
        """The numbers of columns. UserError as `columns` and `csv_table.parse_columns`."""
        return csv_table.parse_columns(self.path, self.columns(*chosen), self.lines)

    def error(self, fault: str) -> UserError:
        return UserError(f"{self.path}: {fault}")


def read_forces(path: Path, columns: str = "", since_1970: bool = False) -> Readings:
    """Times and forces of a table; `columns`: its columns' names in order, `-` for others, instead of a
    header.

    `since_1970`: whether a clock that counts from 1970 is preferred to one that counts from a start, if it
    has both. Known are three axes, one, or a size; units in names, in a row below or in the head.
    UserError: no such columns, a unit that is none of force, or a cell that can't be read.
    """
    table = _split_by_names(path, columns) if columns else _split_by_header(path, _count_forces)
    notes = list[str]()
    if table.head and not columns:
        notes.append(f"{path}: {len(table.head)} lines before the header are left out")
    column_by_axis = find_force_columns(table)
    values = table.numbers(*column_by_axis.values())
    for name, k, column in zip(column_by_axis, column_by_axis.values(), values, strict=True):
        column[~np.isfinite(column)] = np.nan
        if np.isnan(column).all():
            raise table.error(f"column {table.names[k] or name} holds no number")
    factors = [_newtons(table, k) for k in column_by_axis.values()]
    if len({factor is None for factor in factors}) > 1:
        raise table.error(
            "some of the columns of force state a unit, others don't: name them by --use columns="
        )
    force = np.zeros((len(table.rows), 3))
    for axis, column, factor in zip(column_by_axis, values, factors, strict=True):
        force[:, "xyz".find(axis) if axis in ("x", "y", "z") else 0] = column * (factor or 1.0)
    axes = "".join(axis for axis in column_by_axis if axis in "xyz") if "size" not in column_by_axis else ""
    if axes != "xyz":
        description = (
            f"force along {' and '.join(axes)} alone" if axes else "a size of force without a direction"
        )
        names = ", ".join(table.names[k] for k in column_by_axis.values())
        notes.append(f"{path}: holds {description} ({names}): only the size is scored")
    stated_units = {
        table.units[k] or "its head"
        for k, f in zip(column_by_axis.values(), factors, strict=True)
        if f not in (None, 1)
    }
    if stated_units:
        notes.append(f"{path}: converted to newtons from {', '.join(sorted(stated_units))}")
    if factors[0] is None:
        notes.append(
            f"{path}: states no unit of force: it is taken for newtons unless --newtons says otherwise"
        )
    time_s = read_times(table, since_1970, notes)
    gravity_columns = [table.names.index(name) for name in ("gx", "gy", "gz") if table.names.count(name) == 1]
    gravity = np.stack(table.numbers(*gravity_columns), axis=1) if len(gravity_columns) == 3 else None
    return Readings(time_s, force, axes, factors[0] is not None, tuple(notes), gravity)


def find_bias(force: Floats) -> str:
    """The size that a force (N, 3) never falls below, in words, if it is large beside its changes; else
    empty."""
    size = np.linalg.norm(force[np.isfinite(force).all(axis=1)], axis=1)
    if not len(size):
        return ""
    low, high = np.percentile(size, (2, 98))
    if low <= _BIAS * (high - low) or low <= 0:
        return ""
    return (
        f"the force is never below {low:.3g} of at most {size.max():.3g}: without a span in sensor.free_s in "
        "meta.yaml, in which nothing is touched, its constant part is scored as a load"
    )


def find_force_columns(table: SensorTable) -> dict[str, int]:
    """Column of each axis, `x`, `y`, `z`, or of `size`. UserError: none, or several."""
    for prefix in ("", r"(?:.*\.)", r"(?:.*[._ ])"):
        columns = {}
        for axis in "xyz":
            matches = [
                k for k, name in enumerate(table.names) if re.fullmatch(prefix + _AXIS.format(axis), name)
            ]
            if len(matches) > 1:
                names = ", ".join(table.names[k] for k in matches)
                raise table.error(
                    f"several columns of force along {axis} ({names}): name one by --use columns="
                )
            if matches:
                columns[axis] = matches[0]
        if columns:
            return columns
    sizes = [k for k, name in enumerate(table.names) if re.fullmatch(_SIZE, name)]
    shears = [k for k, name in enumerate(table.names) if re.fullmatch(_SHEAR, name)]
    if len(sizes) == 1 and len(shears) == 1 and "normal" in table.names[sizes[0]]:
        return {"x": shears[0], "z": sizes[0]}
    if len(sizes) == 1 and not shears:
        return {"size": sizes[0]}
    if sizes or shears:
        names = ", ".join(table.names[k] for k in (*sizes, *shears))
        raise table.error(f"several columns of force ({names}): name one by --use columns=, - for the others")
    raise _no_columns(table.path, table.names)


def read_times(table: SensorTable, since_1970: bool, notes: list[str]) -> Floats:
    """Times (N,) s: the header's stamps if there are any, else the column of times. UserError: none."""
    stamps = [k for k, name in enumerate(table.names) if re.fullmatch(_STAMP, name)]
    if len(stamps) > 1:
        raise table.error(f"several stamps: {', '.join(table.names[k] for k in stamps)}")
    candidates = {}
    if stamps:
        (values,) = table.numbers(stamps[0])
        if np.nanmax(values, initial=0.0) > 0:
            nanoseconds = [k for k, name in enumerate(table.names) if re.fullmatch(_NANOSECONDS, name)]
            fraction_s = 1e-9 * table.numbers(nanoseconds[0])[0] if nanoseconds else 0.0
            candidates[table.names[stamps[0]]] = (
                values if nanoseconds else _to_seconds(values, "")
            ) + fraction_s
    columns = [k for k, name in enumerate(table.names) if re.fullmatch(_TIME, name)]
    counters, unknown = list[str](), list[str]()
    for k in columns if not candidates else ():
        unit = table.units[k].lower()
        if unit not in (*_CLOCKS, *_SECONDS) and not clock_text.is_clock(*table.columns(k)):
            unknown.append(f"{table.names[k]} is in {table.units[k]!r}, which is no unit of time")
            continue
        values = _clock(table, k, notes)
        is_counter = bool((np.diff(values) == 1).all() and (values == np.round(values)).all())
        (counters.append(table.names[k]) if is_counter and not table.units[k] else None)
        candidates[table.names[k]] = values
    for name in [*dict.fromkeys(counters)][: len(candidates) - 1]:
        candidates.pop(name)  # the number of a row, next to a clock
    if unknown and not candidates:
        raise table.error(f"{unknown[0]}: name the columns by --use columns=t_s,fx_n,... or convert it")
    if not candidates:
        return _even_times(table, notes)
    preferred = [
        name
        for name, values in candidates.items()
        if (np.nanmax(values, initial=0) > SINCE_1970_S) == since_1970
    ]
    name = next(iter(preferred or candidates))
    others = [table.names[k] for k in (*stamps, *columns) if table.names[k] != name]
    if others:
        notes.append(f"{table.path}: times are those of {name}, not {', '.join(others)}")
    return spread_blocks(candidates[name], table.path, notes)


def spread_blocks(time_s: Floats, path: Path, notes: list[str]) -> Floats:
    """Times (N,) s of samples of which equally many share each stamp, spread evenly up to it; else as
    given."""
    known = np.flatnonzero(np.isfinite(time_s))
    stamps = time_s[known]
    ends = np.append(np.flatnonzero(np.diff(stamps)), len(stamps) - 1)
    lengths = np.diff(np.append(-1, ends))[1:-1]
    if len(lengths) < 2 or np.median(lengths) < _LEAST_BLOCK:
        return time_s
    median = float(np.median(lengths))
    if np.abs(lengths - median).mean() > _BLOCK_SPREAD * median or (np.diff(stamps[ends]) <= 0).any():
        return time_s
    step = (stamps[ends[-2]] - stamps[ends[0]]) / (ends[-2] - ends[0])
    # The last of a block is at its stamp; the first and the last block may not be whole.
    knots, knots_s = ends[:-1], stamps[ends[:-1]]
    positions = np.arange(len(stamps))
    even_s = np.interp(positions, knots, knots_s)
    even_s = np.where(positions < knots[0], knots_s[0] + (positions - knots[0]) * step, even_s)
    even_s = np.where(positions > knots[-1], knots_s[-1] + (positions - knots[-1]) * step, even_s)
    out = time_s.copy()
    out[known] = even_s
    notes.append(
        f"{path}: {median:g} samples share each stamp: spread evenly up to it; they may be "
        f"{1000 * median * step:.3g} ms early or late"
    )
    return out


def _clock(table: SensorTable, k: int, notes: list[str]) -> Floats:
    """Times (N,) s of a column: numbers in its unit, days, dates or times of day."""
    (cells,) = table.columns(k)
    dates = [j for j, name in enumerate(table.names) if name in ("date", "day", "datum")]
    if not clock_text.is_clock(cells):
        return _to_seconds(table.numbers(k)[0], table.units[k])
    if dates and not any(re.search(r"\d[-/.]\d+[-/.]\d", cell) for cell in cells[:1]):
        (days,) = table.columns(dates[0])
        cells = [
            f"{day.strip()} {cell.strip()}" if day.strip() else cell
            for day, cell in zip(days, cells, strict=True)
        ]
    return clock_text.parse_clock(table.path, cells, table.lines, notes)


def _to_seconds(values: Floats, unit: str) -> Floats:
    """Numbers of a clock as seconds: by a stated unit, else by those that are since 1970, or days."""
    if (factor := _SECONDS.get(unit.lower())) is not None:
        return values * factor
    earliest, latest = SINCE_1970_S, _LATEST_S
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    steps = np.abs(np.diff(values[np.isfinite(values)]))
    if (
        _DAYS[0] < largest < _DAYS[1]
        and len(steps)
        and 0 < np.median(steps[steps > 0] if steps.any() else steps) < _FASTEST_S
    ):
        return (values - _DAYS_TO_1970) * 86400.0
    return values * next(
        (unit_s for unit_s in (1.0, 1e-3, 1e-6, 1e-9) if earliest < largest * unit_s < latest), 1.0
    )


def _even_times(table: SensorTable, notes: list[str]) -> Floats:
    """Times by the rate that the head states. UserError: no column of times, and no rate, or several."""
    hertz = _find_head_number(table, _HEAD_RATE)
    if step_s := _find_head_number(table, _HEAD_STEP):
        hertz = 1 / step_s
    if not 0 < hertz < np.inf:
        raise table.error(
            f"no column of times; the columns are {_list_names(table.names)}: name it by --use "
            "columns=t_s,fx_n,..."
        )
    notes.append(f"{table.path}: no column of times: {hertz:g} samples per second, as its head states")
    return np.arange(len(table.rows)) / hertz


def _find_head_number(table: SensorTable, label: re.Pattern[str]) -> float:
    """The number that the head states after a label, a thousand times it if in kHz; 0: none.

    UserError: several numbers that differ, or one that can't be read.
    """
    values, lines = set[float](), list[str]()
    for line in table.head:
        if (match := label.search(line)) is None:
            continue
        text = _PER_SECOND.sub(" Hz ", line[match.end() :])
        name, *tail = re.split("[:=]", text, maxsplit=1)
        value = (tail[0] if tail else _BRACKETS.sub(" ", name)).lstrip(' "')
        # The comma of "rate,500,500" parts cells, that of "rate: 1,500 Hz" thousands.
        cells = next(csv.reader([value]), []) if value.startswith(",") else [value]
        numbers = [word.rstrip(".,'’") for cell in cells for word in _HEAD_NUMBER.findall(cell)]
        if not numbers:
            continue
        lines.append(line.strip()[:80])
        if label is _HEAD_RATE and _OF_TIME.search(text):
            raise table.error(f"a rate in a unit of time: {lines[-1]!r}: write it as 'Sampling rate: 500 Hz'")
        factor = 1000.0 if "khz" in text.lower() else 1.0
        try:
            stated_values = {number: factor * _parse_number(number) for number in numbers}
        except ValueError:
            raise table.error(f"{lines[-1]!r} states no number that can be read") from None
        for number, value in stated_values.items():
            # "500,500" and "500,1000" are two rates as well as one.
            if label is _HEAD_RATE and (_TWO_NUMBERS.fullmatch(number) or value > _FASTEST_HZ):
                raise table.error(f"{lines[-1]!r}: one rate or two? write it as 'Sampling rate: 500 Hz'")
        values |= set(stated_values.values())
    if len(values) > 1:
        raise table.error(f"which number is meant can't be told: {' | '.join(lines)}: leave one")
    return values.pop() if values else 0.0


def _parse_number(text: str) -> float:
    """A number of a head, where commas are thousands if they can be. ValueError: it is none."""
    try:
        return csv_table.parse_number(text, ".")
    except ValueError:
        return csv_table.parse_number(text, ",")


def _newtons(table: SensorTable, k: int) -> float | None:
    """Newtons per unit of a column; None: not stated. UserError: it is none of force."""
    unit = table.units[k]
    if not unit and (match := _HEAD_UNIT.search("\n".join(table.head))):
        unit = match[1] or match[2]
    if not unit:
        return None
    factor = _NEWTONS.get(unit.lower())
    if factor is None:
        raise table.error(
            f"{table.names[k]} is in {unit!r}, which is no unit of force: calibrate it, or state "
            "the newtons per "
            "unit by --newtons and name the columns by --use columns=t_s,fx,fy,fz"
        )
    return factor


def read_clock(path: Path, notes: list[str]) -> tuple[Floats, Floats | None]:
    """Times (N,) s of a table of pictures, and its column `frame` (N,) if it has one. UserError: no times."""
    table = _split_by_header(path, _count_times)
    time_s = read_times(table, True, notes)
    frames = [k for k, name in enumerate(table.names) if name == "frame"]
    return time_s, table.numbers(frames[0])[0] if frames else None


def _split_by_header(path: Path, count: Callable[[Sequence[str]], int]) -> SensorTable:
    """The table below the line, among the first, in which most names are known. UserError: there is none."""
    lines = csv_table.read_lines(path)
    best: tuple[int, int, Callable[[str], list[str]]] | None = None
    for k, line in enumerate(lines[:_HEAD_LINES]):
        for split in _splitters(line):
            names = [_name(cell)[0] for cell in _header_cells(line, split)]
            score = count(names)
            if score and score > (best[0] if best else 0) and _has_numbers_below(lines, k, split, names):
                best = (score, k, split)
    if best is None:
        first = next((line for line in lines if line.strip()), "")
        names = [cell for split in _splitters(first)[:1] for cell in split(first)]
        raise (
            _no_columns(path, names or [first])
            if count is _count_forces
            else UserError(f"{path}: no column of times; it begins with {_list_names(names or [first])}")
        )
    _, header, split = best
    pairs = [_name(cell) for cell in _header_cells(lines[header], split)]
    names, units = [name for name, _ in pairs], [unit for _, unit in pairs]
    rows, numbers = _rows(lines, header + 1, split)
    if rows and (below := _units_row(rows[0])) is not None:
        units = [label or unit for unit, label in zip(units, [*below, *[""] * len(units)], strict=False)]
        rows, numbers = rows[1:], numbers[1:]
    head = [line for line in lines[:header] if line.strip()]
    return _check_width(SensorTable(path, names, units, rows, numbers, head))


def _split_by_names(path: Path, columns: str) -> SensorTable:
    """A table with given names; rows before the first with numbers in the named columns are left out."""
    pairs = [("", "") if name.strip() == "-" else _name(name) for name in columns.split(",")]
    named_columns = [k for k, (name, _) in enumerate(pairs) if name]
    lines = csv_table.read_lines(path)
    for first, line in enumerate(lines[:_HEAD_LINES]):
        for split in _splitters(line):
            cells = split(line)
            if len(cells) >= len(pairs) and all(_is_value(cells[k]) for k in named_columns):
                rows, numbers = _rows(lines, first, split)
                names, units = [name for name, _ in pairs], [unit for _, unit in pairs]
                return _check_width(SensorTable(path, names, units, rows, numbers, lines[:first]))
    raise UserError(
        f"{path}: no row has numbers in the {len(named_columns)} columns named by --use columns={columns}"
    )


def _check_width(table: SensorTable) -> SensorTable:
    """The table. UserError: no rows, or one with more cells than names; `columns` refuses too few."""
    if not table.rows:
        raise table.error("a header but no rows")
    width = len(table.names)
    for line, row in zip(table.lines, table.rows, strict=True):
        excess = "." not in "".join(row) and "".join(row[width:]).strip()
        if excess:
            fault = f"{len(row)} cells, {width} expected (decimal commas? use points)"
            raise UserError(f"{table.path}:{line}: {fault}")
    return table


def _rows(
    lines: Sequence[str], first: int, split: Callable[[str], list[str]]
) -> tuple[list[list[str]], list[int]]:
    """Cells and line numbers of the rows from a line on, without blank ones and comments."""
    rows, numbers = list[list[str]](), list[int]()
    for number, line in enumerate(lines[first:], first + 1):
        if line.strip(' ,;\t"') and not line.lstrip().startswith(_COMMENT):
            rows.append(split(line))
            numbers.append(number)
    return rows, numbers


def _splitters(line: str) -> list[Callable[[str], list[str]]]:
    """Ways to split a line that give several cells; or one, if it holds no mark."""
    splitters: list[Callable[[str], list[str]]] = [_split_at(mark) for mark in ";\t,|" if mark in line]
    if not any(mark in line for mark in ";\t") and len(line.split()) > 1:
        splitters.append(_split_at_space)
    return splitters or [_split_at(",")]


def _split_at(mark: str) -> Callable[[str], list[str]]:
    def split(line: str) -> list[str]:
        try:
            return next(csv.reader([line], delimiter=mark, skipinitialspace=True), [])
        except csv.Error:
            return [line]

    return split


def _split_at_space(line: str) -> list[str]:
    return line.split()


def _header_cells(line: str, split: Callable[[str], list[str]]) -> list[str]:
    """The names in a header, which may be a comment; a unit in brackets belongs to the name before it."""
    text, joined = line.strip().lstrip("#%/ ") if line.lstrip().startswith(("#", "//")) else line, list[str]()
    for cell in split(text):
        if split is _split_at_space and joined and re.fullmatch(r"[\[(].*", cell):
            joined[-1] += cell
        else:
            joined.append(cell)
    return joined


def _name(cell: str) -> tuple[str, str]:
    """Plain name and unit of a header's cell."""
    plain = " ".join(cell.strip().strip("\"'").lower().lstrip("%_/# ").replace("/", ".").split())
    match = _UNIT.fullmatch(plain)
    if not match:
        return plain, ""
    unit = (match[2] if match[2] is not None else match[3]).strip()
    name = match[1].strip(" _.")
    is_time = re.fullmatch(_TIME, name)
    if is_time and unit not in _SECONDS:
        return name, match[2] or ""  # perhaps a format, as hh:mm:ss
    if not name or (match[3] and (unit in _SECONDS) != bool(is_time)):
        return plain, ""  # a name that ends as a unit does
    return name, unit


def _count_times(names: Sequence[str]) -> int:
    """How many names are of a time."""
    return sum(bool(re.fullmatch(f"{_TIME}|{_STAMP}", name)) for name in names)


def _count_forces(names: Sequence[str]) -> int:
    """How much of a force and its time names are of: 0 without a force."""
    axes = sum(
        any(re.fullmatch(r"(?:.*[._ ])?" + _AXIS.format(axis), name) for name in names) for axis in "xyz"
    )
    sizes = any(re.fullmatch(_SIZE, name) or re.fullmatch(_SHEAR, name) for name in names)
    times = any(re.fullmatch(f"{_TIME}|{_STAMP}", name) for name in names)
    return (2 * axes or sizes) and 2 * axes + sizes + times


def _has_numbers_below(
    lines: Sequence[str], header: int, split: Callable[[str], list[str]], names: Sequence[str]
) -> bool:
    """Whether one of the next rows has numbers where a header's columns of force are."""
    table = SensorTable(Path(), list(names), [""] * len(names), [], [])
    try:
        columns = [*find_force_columns(table).values()]
    except UserError:  # several, which is reported later
        columns = []
    rows = [
        line
        for line in lines[header + 1 : header + 20]
        if line.strip() and not line.lstrip().startswith(_COMMENT)
    ]
    return any(
        len(cells := split(line)) > max(columns, default=0) and all(_is_value(cells[k]) for k in columns)
        for line in rows[:3]
    )


def _units_row(cells: Sequence[str]) -> list[str] | None:
    """The units in a row below the header; None: it is no such row."""
    words = [cell.strip().strip("[]()").lower() for cell in cells]
    if any(_is_value(word) for word in words if word) or not any(word in _NEWTONS for word in words):
        return None
    return words


def _is_value(cell: str) -> bool:
    """Whether a cell may be a number, a time or empty."""
    text = cell.strip()
    return text.lower() in ("", "nan") or bool(re.fullmatch(r"[-+]?[.,]?\d.*", text))


def _no_columns(path: Path, names: Sequence[str]) -> UserError:
    return UserError(
        f"{path}: no column of force; it begins with {_list_names(names)}: name the columns in order by "
        "--use columns=t_s,fx_n,fy_n,fz_n (f_n for a size, - for others)"
    )


def _list_names(names: Sequence[str]) -> str:
    return ", ".join(names)[:160]
