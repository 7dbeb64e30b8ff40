"""The time of each row of a log: which column is its clock, in what unit, and where it wraps or starts again.

A clock is known by its name, else by its behaviour: it rises from row to row in steps that are nearly even.
Its unit is that of its header; of a header without one, the numbers show it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.repair import GAP_SECONDS, GAP_STEPS, name_rows
from thermogrip.datasets.tables import STAMP, Table
from thermogrip.datasets.units import Header, any_unit, to_record_unit

_TIME_UNITS = ("1", "s", "ms", "min")
_TIME_NAME = re.compile(
    r"(?i)((elapsed|rel|relative|abs|unix|epoch|utc|local|system|log|sample|test|run|date|last)_?)*"
    r"(time(_?stamp)?|date|zeit|uhrzeit|datum|tijd|sec(ond)?s?|milli(second)?s|micros|minutes"
    r"|hours?|days|weeks|(day|hour|minute|second)s?_of_(the_)?(year|day)"
    r"|x_value|epoch|clock|uptime|elapsed|changed|updated|t|ts|ms|us)(_(utc|local|stamp|elapsed|abs|rel))?"
)
_COUNTER = re.compile(r"(?i)x|n|k|i|no|nr|id|index|idx|samples?|rows?|steps?|count(er)?|unnamed.*")
_IN_SECONDS = re.compile(r"(?i)(.*_)?(s|secs?|seconds?|sekunden|x_value|uptime)")  # X_Value is LabVIEW's
_PART = re.compile(
    r"(?P<year>(?i:y{2,4}|years?))|(?P<month>MM|(?i:mon|months?))|(?P<day>(?i:dd|days?))"
    r"|(?P<hour>(?i:hh|hr|hours?))|(?P<minute>mm|(?i:mi|mins?|minutes?))|(?P<second>(?i:ss|secs?|seconds?))"
)
_PARTS = {"year": 2001.0, "month": 1.0, "day": 1.0, "hour": 0.0, "minute": 0.0, "second": 0.0}  # if absent
_COUNTERS = {
    2.0**bits * count: f"a counter of {bits} bits wrapped"
    for bits, count in product((16, 32), (1.0, 1e-3, 1e-6))  # the file may have it in s already
}
_PERIODS = {86400.0 * n: f"{n:.3g} day(s) ended" for n in (1 / 24, 1, 7, 28, 29, 30, 31, 365, 366)}  # [s]
EPOCH = (946684800.0, 4102444800.0)  # s since 1970 of the years 2000 and 2100


@dataclass(frozen=True)
class ClockSettings:
    """Limits of the rules."""

    monotone_share: float = 0.9  # of a clock's steps that do not run backward, and that are nearly even
    evenness: float = 0.2  # of their median, by which nearly even steps differ: loops of a board jitter so
    counts_apart: float = 20.0  # of a board's counter: 50 rows a second in ms, which no plant here needs
    microseconds_apart: float = 1e5  # 100 ms in us, or 100 s in ms
    late: float = 0.03  # of its step, by which a loop is late at most
    piece_rows: int = 20  # of a part of a log that stands alone
    days_apart: float = 1 / 24  # rows of a plant are closer than an hour, seconds so late in a day are not


CLOCK = ClockSettings()
_ELAPSED = " as minutes and seconds"  # how times of two numbers are taken that begin at 00:00 or pass 23
_MONTH_NAMES = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_MONTHS = {month: str(number) for number, month in enumerate(_MONTH_NAMES, 1)}


@dataclass(frozen=True)
class _Counts:
    """What the numbers of a clock mean."""

    seconds: float  # a count
    zero: float = 0.0  # of the counts [s since 1970]
    calendar: str = ""  # whose days they are
    doubt: str = ""  # what is a guess

    def has(self, count: float) -> bool:
        """Tell whether a count is a date between 2000 and 2100."""
        return EPOCH[0] <= count * self.seconds + self.zero <= EPOCH[1]


_DATES = (
    *(_Counts(seconds) for seconds in (1.0, 1e-3, 1e-6, 1e-9)),  # since 1970
    _Counts(1e-7, -11_644_473_600.0),  # FILETIME of Windows, since 1601
    _Counts(1e-7, -62_135_596_800.0),  # ticks of .NET, since the year 1
    _Counts(86400.0, -25569 * 86400.0, "a spreadsheet"),  # since 30 December 1899
    _Counts(86400.0, -719529 * 86400.0, "MATLAB"),  # datenum
    _Counts(86400.0, -2440587.5 * 86400.0, "astronomers"),  # Julian
)
_SINCE_1970 = _DATES[:4]


@dataclass(frozen=True)
class Clock:
    """The time of each row of a table."""

    seconds: Array  # (n_row,), NaN where a row has none
    columns: frozenset[str]  # the headers that it was read from, or stands in place of
    notes: tuple[str, ...] = ()  # what was taken for it and what was repaired, a line each
    zero: float = np.nan  # of ``seconds`` on the file's own clock [s]; NaN where it has none
    doubt: str = ""  # what is a guess, and how to state it


def clock_of(table: Table, read: Mapping[str, Header], dt: float | None) -> Clock:
    """Return the clock of a table; ``read`` is what its headers say, ``dt`` the stated step [s]."""
    parts = _of_parts(table, read)
    of_parts = parts.columns if parts is not None else frozenset[str]()
    names = {h: column.name for h, column in read.items() if column.unit in _TIME_UNITS and h not in of_parts}
    named = [header for header, name in names.items() if _TIME_NAME.fullmatch(name)]
    # a clock that starts again with each cycle comes after one that does not
    back = {h for h in named if h in table.numbers and (np.diff(table.numbers[h]) < 0).any()}
    named.sort(key=lambda header: (header in back, read[header].name != "time"))
    others = [h for h in table.text if h not in named and read_clock(table.text[h][:20]) is not None]
    unnamed = {h: v for h, v in table.numbers.items() if h in names and h not in named}
    others += [header for header, values in unnamed.items() if _behaves_as_clock(header, values)]
    if dt is not None:
        instead = [*named, *(of_parts or others[:1])]
        place = f" in place of {', '.join(instead)}" if instead else ""
        rows = np.arange(len(table.lines), dtype=float)
        return Clock(rows * dt, frozenset(instead), (f"time: rows are {dt:g} s apart, as asked{place}",))
    clocks = [
        _of_text(header, table) if header in table.text else _of_numbers(header, table, read[header])
        for header in [*named, *others]
    ] + [parts]
    likely = [clock for clock in clocks if clock is not None]
    if known := [clock for clock in likely if not clock.doubt and np.unique(clock.seconds).size > 1]:
        first, *others_known = known
        usual = _seconds_a_row(first)
        for clock in others_known:
            if abs(_seconds_a_row(clock) - usual) > CLOCK.late * usual:
                both = (", ".join(sorted(c.columns)) for c in (first, clock))
                steps = f"{_seconds_a_row(clock):.4g} s a row, not {usual:.4g}"
                doubt = "{} is taken as the time of all columns, and {} goes ".format(*both) + steps
                return replace(first, doubt=doubt)
        return replace(first, columns=frozenset[str]().union(*(clock.columns for clock in known)))
    if likely:
        return likely[0]
    step = float(table.meta.get("dt", 1.0))  # a file may have it beside its columns
    note = f"no time column: rows are taken {step:g} s apart; --dt S sets another step"
    doubt = "" if "dt" in table.meta else "no column is a clock: rows are taken 1 s apart"
    return Clock(step * np.arange(len(table.lines), dtype=float), frozenset(), (note,), doubt=doubt)


def _seconds_a_row(clock: Clock) -> float:
    """Return the mean step of a clock between the first and last row that have a time [s]."""
    rows = np.flatnonzero(np.isfinite(clock.seconds))
    return float(np.ptp(clock.seconds[rows])) / max(int(np.ptp(rows)), 1)


def _behaves_as_clock(header: str, values: Array) -> bool:
    """Tell whether a column that is not named as a time rises in nearly even steps, as only a clock does."""
    values = values[np.isfinite(values)]  # a table beside may end earlier
    steps = np.diff(_unwrapped(values, np.arange(values.size))[0])
    enough = 4 if re.fullmatch(r"c1", header) or _COUNTER.fullmatch(header) else CLOCK.piece_rows
    if steps.size < enough or (header != "c1" and np.any(steps < 0)):
        return False
    # however uneven: nothing else is so large, and rises; of those in seconds a counter may be
    if any(date.has(values[0]) and date.has(values[-1]) for date in _SINCE_1970[1:]):
        return bool(values[-1] > values[0])
    # the first column of a file without names is the clock where any column is: a loop that waits for its
    # sensors is as uneven, may begin with some rows of one stamp, and starts again
    uneven = 1.0 if header == "c1" else CLOCK.evenness
    usual = float(np.median(steps))
    even = (steps > 0) & (np.abs(steps - usual) <= uneven * usual)
    return bool((header == "c1" or np.all(steps > 0)) and even.mean() >= CLOCK.monotone_share)


def _of_text(header: str, table: Table) -> Clock | None:
    """Return the clock in a column of dates or times of day, of which a second column may have the hours."""
    cells, headers = table.text[header], [header]
    if ":" not in cells[0]:
        with_hours = [h for h in table.text if ":" in table.text[h][0]]
        headers += [h for h in with_hours if read_clock(table.text[h][:20]) is not None][:1]
        cells = [" ".join(row) for row in zip(*(table.text[h] for h in headers))]
    read = read_clock(cells)
    if read is None:
        return None
    seconds, how = read
    zero = float(seconds[np.isfinite(seconds).argmax()])
    note = f"time: {' and '.join(headers)} counted from the first row, {cells[0]}{how}"
    doubt = f"{header} is taken{how}; --dt S sets another step" if how == _ELAPSED else ""
    return Clock(seconds - zero, frozenset(headers), (note,), zero, doubt)


def _of_parts(table: Table, read: Mapping[str, Header]) -> Clock | None:
    """Return the clock of which two or more parts (year ... second) that follow each other are columns."""
    matches = {header: _PART.fullmatch(read[header].name) for header in table.numbers}
    headers = {str(match.lastgroup): header for header, match in matches.items() if match is not None}
    parts = [part for part in _PARTS if part in headers]
    if len(parts) < 2 or "-".join(parts) not in "-".join(_PARTS):
        return None
    values = {part: table.numbers[headers[part]] for part in parts}
    finest, coarser = (np.diff(values[part]) for part in parts[:-3:-1])
    if not (finest < 0).any() and coarser.any():
        return None  # they are totals
    absent = {part: np.full(len(table.lines), first) for part, first in _PARTS.items()}
    year, month, day, hour, minute, second = (absent | values).values()
    seconds = 86400 * _days(year, month, day) + 3600 * hour + 60 * minute + second
    seconds = _unwrapped(seconds, table.lines, _PERIODS)[0]
    moves = np.diff(seconds[np.isfinite(seconds)])
    if not moves.any() or np.mean(moves >= 0) < CLOCK.monotone_share:
        return None
    zero, columns = float(np.nanmin(seconds)), [headers[part] for part in parts]
    note = f"time: {', '.join(columns)} counted from the first row"
    return Clock(seconds - zero, frozenset(columns), (note,), zero if "year" in parts else np.nan)


def _of_numbers(header: str, table: Table, read: Header) -> Clock | None:
    """Return the clock in a column of numbers; None where it does not rise."""
    counts, (name, unit, scale) = table.numbers[header], read
    # without a unit the first word may be one: millis, hours, day_of_year
    first = name.split("_")[0]
    plural = first if len(first) < 3 else f"{first.rstrip('s')}s"
    of_size, multiple = any_unit(plural) if unit == "1" else (unit, scale)
    size = multiple * {"s": 1.0, "ms": 1e-3, "min": 60.0}.get(of_size, np.nan)
    counts, notes = _unwrapped(counts, table.lines, _COUNTERS | {s / size: w for s, w in _PERIODS.items()})
    finite = counts[np.isfinite(counts)]
    stated = name == "time" and unit != "1"
    repeats = 1 - CLOCK.monotone_share if _PART.fullmatch(name) else 1.0  # a part alone is no time
    rising = np.mean(np.diff(finite) >= 0) >= CLOCK.monotone_share if np.unique(finite).size > 1 else False
    if not stated and (not rising or np.mean(np.diff(finite) == 0) > repeats):
        return None
    meant = _what_counts_mean(name, finite, size, wrapped=bool(notes)) if unit == "1" else _Counts(scale)
    scale, doubt = meant.seconds, meant.doubt
    seconds = to_record_unit(counts if scale == 1 else counts * scale, unit)[0] + meant.zero
    of_start = name.lower() in ("x_value", "uptime")  # of LabVIEW and Klipper: each start is a part
    seconds, restarts = _in_pieces(seconds, table.lines, 2 if of_start else CLOCK.piece_rows)
    if stated and scale == 1:
        taken = f"time: converted from {unit} to s" if unit != "s" else ""
    else:
        factor = "" if scale == 1 else f", times {scale:g}"
        taken = f"time: {header} is taken as the time in {unit if unit != '1' else 's'}{factor}"
    note = f"{taken}; --dt S sets another step" if doubt else taken
    return Clock(seconds, frozenset([header]), tuple(filter(None, [note, *notes, *restarts])), 0.0, doubt)


def _what_counts_mean(name: str, counts: Array, word: float, *, wrapped: bool) -> _Counts:
    """Return what the counts of a clock without a unit mean; ``word`` is the size of that in its name."""
    steps = np.diff(counts)
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    whole = bool(np.all(counts == np.rint(counts)))
    likely = (date for date in _DATES if not date.calendar or (not whole and usual <= CLOCK.days_apart))
    dates = next((date for date in likely if date.has(float(counts[0]))), None)
    of_board = whole and usual >= CLOCK.counts_apart and not np.all(steps % 60 == 0)
    if dates is not None and dates.calendar:
        apart = f"so that rows are {usual * dates.seconds:.3g} s apart"
        return replace(dates, doubt=f"{name} is taken as the time in days of {dates.calendar}, {apart}")
    # a board's counter may be as large
    if dates is not None and (dates.seconds != 1.0 or not (of_board or np.isfinite(word))):
        return dates
    # with decimals, less than 20 apart, or in steps of whole minutes they are likely seconds;
    # 32 bits of microseconds last for 72 minutes, of milliseconds for 50 days
    fine = usual >= CLOCK.microseconds_apart or (wrapped and counts[-1] > 2**32)
    scale = word if np.isfinite(word) else 1.0 if not of_board else 1e-6 if fine else 1e-3
    in_seconds = not of_board and (_IN_SECONDS.fullmatch(name) or _of_loop(steps))
    if _TIME_NAME.fullmatch(name) if np.isfinite(word) else in_seconds:
        return _Counts(scale)
    # a guess, as is a time that counts rows: it is reported as a doubt, with the option that settles it
    unit = {1.0: "seconds", 1e-3: "milliseconds", 1e-6: "microseconds"}.get(scale, f"{scale:g} s")
    guess = f"{name} has no unit: taken as {unit}, so that rows are {usual * scale:g} s apart"
    return _Counts(scale, doubt=guess)


def _of_loop(steps: Array) -> bool:
    """Tell whether steps jitter as a program's loop does, and are round in seconds alone, or not at all."""
    usual = float(np.median(steps))
    off = steps[np.abs(steps - usual) <= CLOCK.evenness * usual] - usual
    if usual < 0.095 or np.unique(np.round(off, 9)).size < 5 or off.std() < 5e-4 * usual:
        return False
    in_seconds, *in_others = (usual * 10.0 ** -np.floor(np.log10(usual * n)) * n for n in (1, 60, 3600))
    is_round = [any(abs(step / one - 1) < CLOCK.late for one in (1, 1.5, 2, 3, 5, 10)) for step in in_others]
    return any(abs(in_seconds / one - 1) < CLOCK.late for one in (1, 2, 5, 10)) or not any(is_round)


def _unwrapped(
    counts: Array, lines: NDArray[np.int64], periods: Mapping[float, str] = _COUNTERS
) -> tuple[Array, list[str]]:
    """Return counts that go on where they began again after a period, and a line for each time."""
    notes: list[str] = []
    steps = np.diff(counts)
    back = np.flatnonzero(steps < 0)
    usual = float(np.median(np.abs(steps)[steps != 0])) if 0 < back.size < steps.size / 2 else 0.0
    # what counts from its own start does not begin again with a day, as a counter does that is full
    periods = _COUNTERS if back.size and counts[0] <= 2 * usual else periods
    for row in back if usual else ():
        # where the time runs back by a period but for one step, it goes on
        for period in [period for period in periods if 0 < steps[row] + period <= 2 * usual][:1]:
            counts = counts + np.where(np.arange(counts.size) > row, period, 0.0)
            notes.append(f"time: {periods[period]} in row {lines[row + 1]}: it goes on")
    return counts, notes


def _in_pieces(seconds: Array, lines: NDArray[np.int64], fewest_rows: int) -> tuple[Array, list[str]]:
    """Return times that go on after a gap where the clock started again, and a line for each restart."""
    back = np.flatnonzero(np.diff(seconds) < 0) + 1
    pieces = np.split(seconds, back)
    if not back.size:
        return seconds, []
    usual = float(np.nanmedian(np.diff(seconds)))
    whole = [piece.size >= fewest_rows and piece[1] - piece[0] <= GAP_STEPS * usual for piece in pieces]
    if not all(whole):
        return seconds, []  # a stamp that is wrong begins no part that goes on as a clock does
    # both parts rise on their own: a board was reset, and for how long it was off is not known
    gap = 1.0 + max(GAP_SECONDS, GAP_STEPS * usual)
    seconds = seconds.copy()
    for row in back:
        seconds[row:] += seconds[row - 1] + gap - seconds[row]
    where = name_rows(lines[back])
    return seconds, [f"time: the clock starts again in {where}: new segments, after gaps of unknown length"]


def read_clock(cells: Sequence[str]) -> tuple[Array, str] | None:
    """Return the seconds that dates and times of day mean (without a date from midnight on, UTC without an
    offset) and how they were taken; None if they are none."""
    import pandas as pd

    texts = pd.Series(list(cells), dtype=object).str.strip()
    fields = texts.str.extract(STAMP)
    if not fields[texts != ""][[1, 4]].notna().any(axis=1).mean() >= CLOCK.monotone_share:  # of none nan
        return None

    def numbers(key: int) -> Array:
        plain = fields[key].str.replace("[,:]", ".", regex=True)
        return np.asarray(pd.to_numeric(plain, errors="coerce"), dtype=float)

    hour, minute, second = (np.nan_to_num(numbers(key)) for key in (4, 5, 6))
    half = fields[7].str.lower()
    hour = np.where(half.notna() & (hour == 12), 0, hour) + 12.0 * (half == "pm").to_numpy()
    offset = fields[8].str.replace(r"([+-]\d\d):?(\d\d)", r"\1:\2:00", regex=True)
    minute = minute - np.nan_to_num(pd.to_timedelta(offset, errors="coerce") / pd.Timedelta(minutes=1))
    of_day = 3600 * hour + 60 * minute + second
    of_day[fields[[1, 4]].isna().all(axis=1)] = np.nan
    of_hour = (minute % 1).any() or hour.max() > 23 or not (hour[0] or minute[0])
    if fields[1].isna().all() and fields[6].isna().all() and of_hour:
        return 60 * hour + minute, _ELAPSED
    if fields[1].isna().all():
        steps = np.diff(of_day, prepend=of_day[0])
        return of_day + 86400.0 * np.cumsum(np.nan_to_num(steps) < -43200), ""
    months = fields[2].str.lower().map(_MONTHS)
    of_names, fields[2] = months.notna(), months.fillna(fields[2])
    by_day, by_month, by_year = ("day", "month", "year"), ("month", "day", "year"), ("year", "month", "day")
    orders = [by_month, by_day, by_year] if "/" in str(cells[0]) else [by_day, by_month, by_year]
    if of_names.any():
        orders = [by_day, by_year]
    triples = [numbers(key) for key in (1, 2, 3)]
    dates = {order: _days(**dict(zip(order, triples))) for order in orders}
    most = max(np.isfinite(days).sum() for days in dates.values())
    orders = [order for order in orders if np.isfinite(dates[order]).sum() == most]
    follow = (order for order in orders if (np.diff(np.unique(dates[order])) == 1).all())
    order = next(follow, orders[0])
    note = " (taken as month/day)" if order == by_month and len(orders) > 1 else ""
    if order != orders[0]:
        note = f" (taken as {'/'.join(order)}, in which the days follow each other)"
    return dates[order] * 86400.0 + of_day, note


def _days(year: Array, month: Array, day: Array) -> Array:
    """Return the days since 1970 of dates; NaN where there is no such date."""
    import pandas as pd

    year = np.where(year < 100, year + 2000, year)
    year[(year < 1900) | (year > 2200)] = np.nan  # beyond what pandas counts in nanoseconds
    dates = pd.to_datetime(pd.DataFrame({"year": year, "month": month, "day": day}), errors="coerce")
    return np.asarray((dates - pd.Timestamp(0)) / pd.Timedelta(days=1), dtype=float)
