"""What a reader may repair in a log; each function returns the values and one line a finding.

An output is never filled.  A lost input is held from the last row, since that is what an actuator does; a
lost disturbance is interpolated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise, takewhile
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.errors import UserError

#: Values that are no readings, in degC, and whose they are.
SENSOR_CODES = {
    85.0: "DS18B20 after a power glitch",  # its data sheet: the register's value at power-on
    -127.0: "DS18B20 not connected",  # DEVICE_DISCONNECTED_C of the DallasTemperature library
    -242.02: "MAX31865 shorted",  # the PT100 equation at a resistance of 0
    988.79: "MAX31865 open",  # the same at the end of the converter's range
    1023.75: "MAX6675 open",  # twelve ones of a quarter of a degree
    2000.0: "thermocouple open",
    -273.15: "absolute zero",
    **dict.fromkeys((999.9, 999.0, 9999.0, -999.0, -9999.0), "a logger's mark of a lost value"),
    **dict.fromkeys((3276.7, -3276.8, 32767.0, -32768.0, 6553.5, 65535.0), "the end of a 16-bit number"),
}
_CODE_JUMP, _STUCK_CHANCE = 5.0, 1e-3  # times what other rows rarely move; of a sound reading that stays
SPIKE_FLOOR_K = 0.6  # the least deviation of a temperature that can be a spike
SPIKE_WINDOW = 21  # samples of the running median
SPIKE_LENGTH = 3  # samples at most of a spike
_SLOW_ROWS = 60.0  # s, in which a plant moves and comes back by itself
GAP_SECONDS = 10.0  # of the least gap
GAP_STEPS = 5.0  # median steps of the rows, of the least gap
_REPEATED = 32  # rows with moves in most of them, that are not alike by chance
_MOST_LEVELS = 20  # of an input that is set
_FEWEST_HELD = 4  # rows, of a standstill
_FEWEST_ALIKE, _MOST_TO_AND_FRO = 3, 0.4  # moves of an input; share of them
_OTHER_STEP = 1.5  # times as long: no jitter, another step
_FEW = 0.05  # share of rows that may be without a time, or otherwise than the others


class Doubt(str):
    """A finding that decides what a fit sees and that nothing else confirms."""


class ClockDoubt(Doubt):
    """One that a stated step (``--dt``) settles."""


class OrderedRows(NamedTuple):
    """Rows in the order of time."""

    time: Array  # strictly increasing
    rows: NDArray[np.int64]  # that the times belong to
    repairs: list[str]


def order_rows(time: Array, lines: NDArray[np.int64], file: str, *clock: str) -> OrderedRows:
    """Return rows of increasing times, of these columns; UserError where many are missing or run backward."""
    rows, repairs = np.arange(time.size), []
    lost = ~np.isfinite(time)
    if lost.mean() > _FEW:
        row = int(lines[lost.argmax()])
        hint = f"give a time to {lost.sum()} rows, or remove them"
        raise UserError("has no time", file=file, row=row, column=", ".join(clock) or "time", hint=hint)
    if lost.any():
        rows = rows[~lost]
        repairs.append(f"{lost.sum()} row{_s(lost.sum())} without a time dropped ({name_rows(lines[lost])})")
    steps = np.diff(time[rows])
    if (steps < 0).any():
        at = int(np.argmax(steps < 0))
        problem = f"time runs back from {time[rows[at]]:g} s to {time[rows[at + 1]]:g} s"
        hint = "cut the file there in two, sort its rows, or give the step with --dt where a run goes on"
        raise UserError(problem, file=file, row=int(lines[rows[at + 1]]), hint=hint)
    first = np.append(True, steps > 0)
    starts, repeats = np.flatnonzero(first), int((~first).sum())
    if repeats > 0.25 * rows.size and starts.size > 1:  # a coarse clock
        stamps, counts = time[rows[starts]], np.diff(starts)
        counts = counts[1:] if counts.size > 1 else counts
        between, apart = np.median(np.diff(stamps)), np.median(np.diff(stamps)) / np.median(counts)
        # the log may begin and end within a stamp: of its rows some are there, as far apart as the others
        begin = max(stamps[0], stamps[1] - apart * starts[1])
        end = stamps[-1] + min(between, apart * (rows.size - starts[-1]))
        nodes = np.append(starts, rows.size), np.concatenate([[begin], stamps[1:], [end]])
        says = f"time has {starts.size} stamps for {rows.size} rows: rows spread evenly between them"
        even = starts.size > 2 and np.ptp(counts) <= 2
        repairs.append(says if even else ClockDoubt(f"{says}, {counts.min()} to {counts.max()} each"))
        return OrderedRows(np.interp(np.arange(rows.size), *nodes), rows, repairs)
    if repeats:
        which = name_rows(lines[rows[~first]])
        says = f"{repeats} repeated time stamp{_s(repeats)} dropped ({which})"
        # where a clock stood still nobody knows how long
        stood = np.diff(np.append(starts, rows.size)).max() > _FEWEST_HELD
        repairs.append(ClockDoubt(f"time stands still: {says}") if stood else says)
    return OrderedRows(time[rows[first]], rows[first], repairs)


def describe_steps(time: Array) -> list[str]:
    """Return a line if the time stamps are uneven by more than 2 % of their median step."""
    step = np.diff(time)
    median = float(np.median(step))
    quarter = step.size // 4 + 1
    first, last = (float(np.median(part)) for part in (step[:quarter], step[-quarter:]))
    if not 1 / _OTHER_STEP < last / first < _OTHER_STEP:
        says = f"rows are {first:.4g} s apart at first and {last:.4g} s at last"
        return [ClockDoubt(f"{says}: is the unit the same? cut the log there, or average it")]
    usual = step[step <= max(GAP_SECONDS, GAP_STEPS * median)]
    low, high = float(usual.min()), float(usual.max())
    says = f"median step {median:.4g} s, {low:.4g} to {high:.4g} s; kept as they are"
    return [f"time stamps are uneven: {says}"] if high - low > 0.02 * median else []


def gap_rows(time: Array) -> NDArray[np.int64]:
    """Return the rows after which the log has a gap: longer than 10 s and than five median steps."""
    step = np.diff(time)
    if not step.size:
        return np.empty(0, dtype=np.int64)
    return np.flatnonzero((step > GAP_SECONDS) & (step > GAP_STEPS * np.median(step)))


def unknown_rows(values: Array, time: Array) -> Mask:
    """Return the rows of an input before its first value, and of holes longer than a gap, where it is written
    in each row and not only as it changes."""
    filled = np.isfinite(values)
    unknown = ~np.logical_or.accumulate(filled)
    is_written_in_each = 2 * np.count_nonzero(filled[1:] & filled[:-1]) > np.count_nonzero(filled)
    for row in gap_rows(time[filled]).tolist() if is_written_in_each else ():
        before, after = np.flatnonzero(filled)[row : row + 2]
        unknown[before + 1 : after] = True
    return unknown


def describe_gaps(time: Array, inputs: dict[str, Array]) -> list[str]:
    """Return a line a gap, with the inputs before and after it; of many the first ones and their number."""
    repairs = []
    for row in (rows := gap_rows(time))[:5]:
        before, after = time[row : row + 2]
        moved = ", ".join(f"{name} {u[row]:g} before, {u[row + 1]:g} after" for name, u in inputs.items())
        says = f"gap of {after - before:.2f} s from {before:.2f} to {after:.2f} s"
        repairs.append(f"{says} ({moved})" if moved else says)
    if rows.size > 5:
        repairs.append(f"{rows.size - 5} more gaps, the longest {np.diff(time)[rows[5:]].max():.2f} s")
    return repairs


def find_spikes(values: Array, *, floor: float | None) -> Mask:
    """Return which samples (n,) are spikes; ``floor`` is the least one, None: by the channel's range."""
    spikes = np.zeros(values.shape, dtype=bool)
    finite_rows = np.flatnonzero(np.isfinite(values))
    if finite_rows.size < SPIKE_WINDOW:
        return spikes
    from scipy.ndimage import median_filter

    good = values[finite_rows]
    deviation = good - median_filter(good, size=SPIKE_WINDOW, mode="nearest")
    # |d| > max(floor, 6 s), d the deviation from the median, s = 1.4826 median |d| over the whole channel, or
    # the noise of its converter, whose readings go to and fro by a count
    usual = 1.4826 * float(np.median(np.abs(deviation)))
    if floor is None:  # 2 % of the channel's 1-99 % range, and at least five of its smallest increments
        floor = max(0.02 * float(np.ptp(np.percentile(good, [1, 99]))), 5 * _smallest_step(good))
    steps = np.diff(np.unique(good))  # between most levels of a coarse reading a count
    if steps.size >= _FEWEST_ALIKE and np.isclose(np.median(steps), steps.min()):
        usual = max(usual, float(steps.min()) / np.sqrt(12))
    threshold = max(floor, 6 * usual)
    is_far = np.abs(deviation) > threshold
    entered = np.concatenate([[False], np.abs(np.diff(good)) > threshold])
    for start in np.flatnonzero(is_far & entered).tolist():
        # a stretch up to the end is none: the last sample is its own median
        stops = takewhile(lambda stop: is_far[stop - 1], range(start + 1, start + SPIKE_LENGTH + 1))
        stop = next((stop for stop in stops if _leaves_and_returns(good, start, stop, threshold)), start)
        spikes[finite_rows[start:stop]] = True
    return spikes


def drop_codes(name: str, values: Array) -> tuple[Array, list[str]]:
    """Return a column with what is no reading but a sensor's code as NaN, and a line for each code."""
    repairs = []
    rounding = min(_smallest_step(values) / 2, 0.5) + 1e-6  # of a logger with few digits
    for code, whose in SENSOR_CODES.items():
        rows = _rows_beyond_jumps(values, np.abs(values - code) < rounding)
        if rows.any():
            values = np.where(rows, np.nan, values)
            says = f"of {code:g} left empty, no reading ({whose})"
            repairs.append(f"{name}: {rows.sum()} row{_s(rows.sum())} {says}")
    return values, repairs


def doubt_readings(name: str, values: Array, inputs: Sequence[Array], time: Array) -> str:
    """Return the doubt on a reading's order, codes, standstills or largest jump, empty without one."""
    moves = np.abs(np.diff(values))
    if values.size < SPIKE_WINDOW or not np.nansum(moves):
        return ""
    # alike where all is noise; a coarse reading goes to and fro by one step
    to_and_fro = np.nanmean(moves) > 2 * np.nanmean(np.abs(values[2:] - values[:-2]))
    if to_and_fro and np.nanmean(moves) > 1.5 * _smallest_step(values):
        return f"{name} goes to and fro from row to row: are its rows of two logs?"
    for end in (np.nanmin(values), np.nanmax(values)):
        rows = _rows_beyond_jumps(values, values == end)
        edges = np.flatnonzero(np.diff(rows.astype(int)))
        driven = [any(np.ptp(u[max(edge - SPIKE_LENGTH, 0) : edge + 2]) for u in inputs) for edge in edges]
        if rows.any() and 2 * sum(driven) <= edges.size:
            says = f"{name} jumps to {end:g} and stays in {rows.sum()} row(s) while no input moves"
            return f"{says}: if that is a sensor's code, leave those cells empty"
    value, held = _longest_standstill(values, moves)
    if held >= SPIKE_WINDOW:
        return f"{name} is held at {value:g} for {held} rows, as where a sensor ends: leave those cells empty"
    row = int(np.nanargmax(moves))
    before, after = values[max(row - SPIKE_WINDOW, 0) : row + 1], values[row + 1 : row + 1 + SPIKE_WINDOW]
    stays = np.abs(np.nanmedian(after) - np.nanmedian(before)) > moves[row] / 2
    in_gap = time[row + 1] - time[row] > GAP_STEPS * np.median(np.diff(time))
    beyond_jump = _rows_beyond_jumps(values, np.arange(values.size) > row).any()
    if not stays or in_gap or not beyond_jump:
        return ""
    problem = f"{name} jumps from {values[row]:g} to {values[row + 1]:g} and stays there, as nowhere else"
    return f"{problem}: if its sensor or unit changed there, cut the log: LOG@{time[row + 1] - time[0]:g}:"


def _longest_standstill(values: Array, moves: Array) -> tuple[float, int]:
    """Return the value at which a reading stops in most rows, and their number, where it does not settle."""
    least = 2 * float(moves[moves > 0].min())
    ends = np.flatnonzero(np.append(moves != 0, True))
    rows_at: dict[float, int] = {}
    runs = np.column_stack([np.append(0, ends[:-1] + 1), ends + 1])
    for start, stop in runs[np.ptp(runs, axis=1) > _FEWEST_HELD].tolist():
        earlier = moves[max(start - SPIKE_WINDOW, 0) : max(start - 1, 0)]
        moving = np.count_nonzero(earlier) > SPIKE_WINDOW / 2 and np.nansum(earlier) > least * earlier.size
        if moving:
            rows_at[values[start]] = rows_at.get(values[start], 0) + stop - start
    return max(rows_at.items(), key=lambda item: item[1], default=(np.nan, 0))


def doubt_full_scale(name: str, values: Array, unit: str) -> str:
    """Return the doubt on an input that in percent goes beyond its full scale, or to a hundredth of that."""
    highest = float(np.max(np.abs(values)))
    if unit != "percent" or highest == 0 or 1 < highest <= 100 * (1 + _FEW):
        return ""
    return f"{name} goes to {highest:g} percent: if it is none, name it {name}_0_255 or without a unit"


def doubt_moves(name: str, values: Array) -> str:
    """Return the doubt on an input that goes from one level to another as no drive does."""
    bounds = np.concatenate([[0], np.flatnonzero(np.diff(values)) + 1, [values.size]])
    holds = np.flatnonzero(np.diff(bounds) > _FEWEST_HELD)
    count, to_and_fro = 0, 0
    ramps: dict[int, list[float]] = {}  # size of those of as many rows
    for before, after in pairwise(holds.tolist()):
        move = values[bounds[before + 1] - 1 : bounds[after] + 1]
        if move[0] == move[-1]:
            continue
        count += 1
        rows, size = move.size - 1, float(abs(move[-1] - move[0]))
        if 1 < rows <= 2 * _FEWEST_HELD and np.isin(move, move[[0, -1]]).all():
            to_and_fro += 1
        straight = np.linspace(move[0], move[-1], move.size)
        if rows >= _FEWEST_HELD and np.abs(move - straight).max() <= _FEW * size:
            ramps.setdefault(rows, []).append(size)
    # of 150 drives of sound logs a quarter of the moves at most, of rows shuffled in fives half and more
    if to_and_fro > max(_MOST_TO_AND_FRO * count, _FEWEST_ALIKE):
        return f"{name} goes to and fro in {to_and_fro} of its {count} moves: are its rows in order?"
    # of those drives none did so once; one of a limited rate takes longer for a longer way
    rows, sizes = max(ramps.items(), key=lambda ramp: len(ramp[1]), default=(0, [0.0]))
    if len(sizes) >= _FEWEST_ALIKE and np.ptp(sizes) > _FEW * max(sizes):
        return f"{name} goes straight between levels in {rows} rows, {len(sizes)} times: is it an average?"
    return ""


def _goes_on(values: Array) -> dict[str, Mask]:
    """Return which rows but the last go on as before: held, or straight within the column's steps."""
    moves = np.diff(values)
    turns = np.abs(np.diff(moves, prepend=np.nan))
    return {"held": moves == 0, "drawn straight": turns < 1.5 * _smallest_step(values)}  # half for rounding


def _smallest_step(values: Array) -> float:
    moves = np.abs(np.diff(values))
    return float(moves[moves > 0].min(initial=np.inf))


def doubt_lead(name: str, values: Array, drive: str, moved: Array, time: Array) -> str:
    """Return the doubt on a reading that bends before a drive moves, as under no plant and no controller."""
    rows = np.flatnonzero(np.diff(moved)) + 1
    if np.unique(moved).size > _MOST_LEVELS or rows.size < SPIKE_WINDOW // 2 or np.isnan(values).any():
        return ""
    hold = int(np.median(np.diff(rows)))
    half = max(hold // 4, 1)
    rows = rows[(rows > hold + half) & (rows < values.size - hold - half)]
    if rows.size < SPIKE_WINDOW // 2:
        return ""
    lags = np.arange(-hold, hold + 1)
    at = rows + lags[:, None]
    # what a reading bends by at each lag from a move, times the move: at its response all have one sign
    bends = (moved[rows] - moved[rows - 1]) * (values[at + half] - 2 * values[at] + values[at - half])
    size, scatter = np.abs(bends.sum(axis=1)), np.sqrt((bends**2).sum(axis=1))
    lead = int(np.argmax(size))
    # of a loop that swings, the bend of the last move is as large: no log of a loop, a thermostat or a rig
    # tried is beyond both limits, logs with readings ahead have 2 to 3.6 and 3.0 to 3.8
    largest_after = size[lags >= -1].max()
    if lags[lead] >= -1 or size[lead] < 1.5 * largest_after or size[lead] < 2.6 * scatter[lead]:
        return ""
    ahead = -float(lags[lead]) * float(np.median(np.diff(time)))
    return f"{name} moves {ahead:g} s before {drive} does: are their clocks alike?"


def doubt_rows(name: str, values: Array) -> str:
    """Return the doubt on an output that is read in n-th rows only, held or drawn straight between."""
    for between, goes_on in _goes_on(values).items():
        rows = np.flatnonzero(~goes_on)
        if rows.size < SPIKE_WINDOW or (n := int(np.median(np.diff(rows)))) < 2:
            continue
        if np.bincount(rows % n).max() > (1 - _FEW) * rows.size:
            return f"{name} is read in every {n}th row only, {between} in those between: average the log"
    return ""


def doubt_repeats(columns: Sequence[Array], lines: NDArray[np.int64]) -> list[str]:
    """Return a line where rows repeat others, cell for cell, in more rows than by chance."""
    rows = np.unique(np.nan_to_num(np.column_stack(columns)), axis=0, return_inverse=True)[1].ravel()
    if rows.size <= _REPEATED:
        return []
    weights = np.random.default_rng(0).integers(2**63, size=_REPEATED, dtype=np.uint64)
    of_windows = sliding_window_view(rows.astype(np.uint64), _REPEATED) @ weights  # alike where all rows are
    moves = sliding_window_view(np.diff(rows) != 0, _REPEATED - 1).sum(axis=1)
    places = np.flatnonzero(moves > _REPEATED / 2)
    first, inverse = np.unique(of_windows[places], return_index=True, return_inverse=True)[1:]
    earlier = places[first[inverse.ravel()]]
    again = np.flatnonzero(earlier < places)
    if not again.size:
        return []
    start, stop = places[again[0]], places[again[-1]] + _REPEATED - 1
    says = f"rows {lines[start]} to {lines[stop]} repeat those from {lines[earlier[again[0]]]} on"
    return [Doubt(f"{says}: cut the file there in two")]


def filled_rows(columns: Mapping[str, Array], roles: Mapping[str, str]) -> Mask:
    """Return the rows that a program filled, in all columns at once, with zeros, the last values or lines.

    A plant bends after its drive: no plant made rows in which all readings are drawn, and inputs too, or
    held, if at both ends a reading and another column bend in the same row.
    """
    readings = {n: v for n, v in columns.items() if roles[n] in ("output", "disturbance")}
    inputs = {n: v for n, v in columns.items() if roles[n] == "input"}
    filled = np.zeros(len(next(iter(columns.values()))), dtype=bool)
    are_zero = np.all([values == 0 for values in (readings | inputs).values()], axis=0)
    for values in readings.values():
        filled |= _rows_beyond_jumps(values, are_zero)
    for start, stop in _drawn_lines([*readings.values()]) if readings else ():
        moved = {n: u for n, u in inputs.items() if np.ptp(u[start - 2 : stop])}
        # a step in the first row would explain the run
        explained = any(u[start - 1] == u[stop] or not _is_line(u, start, stop) for u in moved.values())
        straight = {n: _goes_on(v)["drawn straight"] for n, v in (readings | moved).items()}
        bends = [[n for n in straight if not straight[n][row]] for row in (start - 1, stop)]
        if not explained and all(len(names) > 1 and readings.keys() & names for names in bends):
            filled[start:stop] = True
    return filled


def _drawn_lines(columns: Sequence[Array]) -> list[list[int]]:
    """Return start and stop of the rows in which all columns are on lines, more of them than by chance."""
    straight = np.all([_goes_on(values)["drawn straight"] for values in columns], axis=0)
    runs = np.flatnonzero(np.diff(straight.astype(int), prepend=0, append=0)).reshape(-1, 2)
    count = np.diff(runs).ravel()
    chance = (straight.sum() - count + 1) / (straight.size - count + 2)  # of one row, as in drop_stuck
    is_within = (runs[:, 0] > 1) & (runs[:, 1] < straight.size)
    runs = runs[is_within & (straight.size * chance**count < _STUCK_CHANCE)]
    return [[a, b] for a, b in runs.tolist() if all(_is_line(values, a, b) for values in columns)]


def _is_line(values: Array, start: int, stop: int) -> bool:
    """Tell whether rows lie on the line between those beside them, all of them rounded by half a step."""
    line = np.linspace(values[start - 1], values[stop], stop - start + 2)
    return bool(np.abs(values[start - 1 : stop + 1] - line).max() < 1.01 * _smallest_step(values))


def _rows_beyond_jumps(values: Array, rows: Mask) -> Mask:
    """Return those of the rows whose runs are entered and left by jumps as no other rows make."""
    moves = np.abs(np.diff(values))
    usual = moves[~(rows[1:] | rows[:-1]) & np.isfinite(moves)]
    # without a move it is no reading: it is held between levels, and the code may be one of them
    if values.size < SPIKE_WINDOW or not rows.any() or rows.all() or not usual.any():
        return np.zeros(values.size, dtype=bool)
    # beyond what it rarely moves where it does: a kettle that passes 85 degC does not jump there
    least = _CODE_JUMP * float(np.quantile(usual[usual > 0], 0.99))
    between, beyond_jumps = rows[1:] ^ rows[:-1], rows.copy()
    edges = np.flatnonzero(np.diff(rows.astype(int), prepend=0, append=0))
    for start, stop in edges.reshape(-1, 2).tolist():
        jumps = [moves[step] for step in (start - 1, stop - 1) if 0 <= step < moves.size and between[step]]
        beyond_jumps[start:stop] = all(jump > least or np.isnan(jump) for jump in jumps)
    return beyond_jumps


def drop_stuck(name: str, values: Array, inputs: Sequence[Array]) -> tuple[Array, list[str]]:
    """Return an output without the run in which it is held, or straight, while inputs move, and a line."""
    travel = np.zeros(values.size)  # of all inputs since the first row, in ranges
    for u in inputs:
        if (span := float(np.nanmax(u) - np.nanmin(u))) > 0:
            travel[1:] += np.cumsum(np.abs(np.nan_to_num(np.diff(u))) / span)
    ends = np.flatnonzero(np.append(np.diff(values) != 0, True))
    starts = np.append(0, ends[:-1] + 1)
    passed = travel[ends] - travel[starts]
    longest = int(np.argmax(passed))
    run, most = slice(int(starts[longest]), int(ends[longest]) + 1), float(passed[longest])
    # but for the first row of each run: its reading is from before its move
    first_moves = travel[np.minimum(starts + 1, ends)] - travel[starts]
    others = float(np.delete(passed - first_moves, longest).sum())
    # With M the moves of the inputs, in ranges, in the whole log, m those within the run that has most of
    # them and k those within all other runs, a sound reading, which may settle, is held through one with a
    # chance of about p = (k + 1) / (M - m + 2) (Laplace's rule); none where p^(m - 1) is under 1e-3.
    chance = (others + 1) / (travel[-1] - most + 2)
    likely = most <= 2 or chance >= 1 or chance ** (most - 1) > _STUCK_CHANCE
    # at its least or greatest value, as in other rows: so rests a drive that no name shows
    at_end = values[run.start] in (np.nanmin(values), np.nanmax(values))
    likely |= at_end and np.count_nonzero(values == values[run.start]) > values[run].size
    what = f"stuck at {values[run.start]:g}"
    if likely:
        drawn = [slice(a, b) for a, b in _drawn_lines([values]) if values[a - 1] != values[b]]
        run = next((rows for rows in drawn if np.ptp(travel[rows]) > 1), slice(0, 0))
        what = f"drawn straight from {values[run.start]:g} to {values[run.stop - 1]:g}"
    lost = np.isin(np.arange(values.size), np.arange(run.start, run.stop))
    problem = f"{name}: {what} for {lost.sum()} rows while the inputs move: left out"
    return np.where(lost, np.nan, values), [problem] if lost.any() else []


def reject_spikes(name: str, values: Array, time: Array, *, floor: float | None) -> tuple[Array, list[str]]:
    """Return the channel with its spikes as NaN, and what was found."""
    spikes = find_spikes(values, floor=floor)
    if spikes.any() and np.median(np.diff(time)) >= _SLOW_ROWS:  # spikes are beyond others by their range
        low, high = np.nanmin(values[~spikes]), np.nanmax(values[~spikes])
        spikes &= np.abs(values - (low + high) / 2) > 1.5 * (high - low)
    if not spikes.any():
        return values, []
    worst = ", ".join(f"{values[row]:g} at {time[row]:.2f} s" for row in np.flatnonzero(spikes)[:5])
    more = ", ..." if spikes.sum() > 5 else ""
    repairs = f"{name}: {spikes.sum()} spike sample{_s(int(spikes.sum()))} rejected ({worst}{more})"
    return np.where(spikes, np.nan, values), [repairs]


def fill_lost(name: str, values: Array, time: Array | None = None) -> tuple[Array, list[str]]:
    """Return a column with lost values interpolated in time, or without times held from the last row."""
    lost = ~np.isfinite(values)
    if not lost.any():
        return values, []
    if time is None:
        last = np.maximum.accumulate(np.where(lost, -1, np.arange(values.size)))
        filled, how = np.where(last >= 0, values[last], np.nan), "held from the row before"
    else:
        filled, how = np.interp(time, time[~lost], values[~lost]), "interpolated"
    return filled, [f"{name}: {lost.sum()} lost value{_s(int(lost.sum()))} {how}"]


def check_plausible(name: str, celsius: Array, file: str) -> list[str]:
    """Return a line if a temperature is likely in another unit; UserError if half is below absolute zero."""
    median = float(np.nanmedian(celsius))
    if median < -273.15:
        problem = f"median of {median:g} degC is below absolute zero"
        raise UserError(problem, file=file, column=name, hint="check the unit in the header")
    if 250 < median < 350:
        return [f"{name}: median of {median:.1f} degC; name the column {name}_K if this is kelvin"]
    return [f"{name}: median of {median:.1f} degC; is the column really in kelvin?"] if median < -150 else []


def _leaves_and_returns(values: Array, start: int, stop: int, threshold: float) -> bool:
    """Tell whether values[start:stop] is entered and left by jumps that nothing around it resembles."""
    enter, leave = values[start] - values[start - 1], values[stop] - values[stop - 1]
    half = SPIKE_WINDOW // 2
    before, after = values[max(0, start - half) : start], values[stop : stop + half]
    around = np.abs(np.concatenate([np.diff(before), np.diff(after)]))
    usual = float(np.quantile(around, 0.7)) if around.size else 0.0
    # a step is not left, the tip of a ramp is entered by increments like those around it
    return bool(enter * leave < 0 and min(abs(enter), abs(leave)) > max(threshold, 5 * usual))


def _s(count: int) -> str:
    return "" if count == 1 else "s"


def name_rows(lines: Sequence[int] | NDArray[np.int64], most: int = 8) -> str:
    """Return rows in words, the first few by their lines."""
    return f"row{_s(len(lines))} {', '.join(map(str, lines[:most]))}{', ...' if len(lines) > most else ''}"
