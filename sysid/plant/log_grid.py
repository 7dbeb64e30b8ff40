"""Logs as a model takes them: its signals in its units, on an even grid, cut where the input is unknown.

With the grid t_k = t_0 + k dt of a stretch, an input is the exact mean of its held value over [t_k, t_k +
dt).  A plant (:func:`cut_stretches`) has a grid of its own step; readings stay at their own times, and the
outputs of the model are interpolated to them.  For a black box (:func:`make_grid`) a reading is the mean of
the line through the samples over [t_k - dt/2, t_k + dt/2]; one lost while the input is known stays NaN.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.limits import MOST_BYTES
from thermogrip.datasets.log_files import NO_NUMBERS, Logs, as_logs
from thermogrip.datasets.roles import guess_role
from thermogrip.datasets.schema import Log, column, columns, log_name
from thermogrip.datasets.schema import gaps as gaps_of
from thermogrip.datasets.schema import names as names_of
from thermogrip.sysid.models.network_spec import SHARES

if TYPE_CHECKING:
    from thermogrip.sysid.models.model import GreyModel
    from thermogrip.sysid.plant.plant_data import PlantData

    Signals: TypeAlias = PlantData | GreyModel

BRIDGED = 5  # rows
MOVED = 0.01  # of an input's range: less is noise of its reading
_LONGEST_GAP = 1_000_000  # steps, behind which a plant is long at rest; a damaged clock may have centuries
_GRIDS = 4  # arrays of a run's size that are held at a time
_SLACK = 1e-9  # of a share of full scale beyond 1, by rounding


@dataclass(frozen=True, eq=False)
class Segment:
    """The signals of a model in a log, on an even grid where it is part of a :class:`Grid`."""

    time: Array  # (n,) times of the rows [s]
    y: Array  # (n, n_y) readings, NaN where lost
    u: Array  # (n, n_u) inputs, of a grid their means over the row
    d: Array  # (n, n_d) disturbances, likewise
    log: str  # name of the log

    def part(self, begin: int, end: int) -> Segment:
        """Return the rows begin to end (not included)."""
        rows = slice(begin, end)
        return replace(self, time=self.time[rows], y=self.y[rows], u=self.u[rows], d=self.d[rows])


@dataclass(frozen=True, eq=False)
class Rows(Segment):
    """The signals of a model in a whole log, row by row."""

    after: tuple[int, ...]  # which rows follow a gap

    @property
    def step(self) -> float:
        """The median time between rows [s]."""
        return float(np.median(np.diff(self.time)))

    @property
    def recorded(self) -> float:
        """The time [s] that the rows cover, without the gaps."""
        in_gaps = np.diff(self.time)[np.array(self.after, dtype=int) - 1]
        return float(np.ptp(self.time) - in_gaps.sum())

    def from_row_on(self) -> Rows:
        """Return inputs that were applied up to their rows as inputs that are applied from them on."""
        return replace(self, u=np.concatenate([self.u[1:], self.u[-1:]]))


def rows_of(log: Log, inputs: Sequence[str], outputs: Sequence[str], disturbances: Sequence[str]) -> Rows:
    """Return the columns of a log by role."""
    u, d, y = (columns(log, group) for group in (inputs, disturbances, outputs))
    after = tuple(row + 1 for row, _, _ in gaps_of(log))
    return Rows(np.asarray(log["time"].values, dtype=float), y, u, d, log_name(log), after)


@dataclass(frozen=True, eq=False)
class Stretch(Segment):
    """A part of a log without a gap: readings at times (n,) since its first row, inputs (N, n_u) and
    disturbances (N, n_d) on an even grid from there on."""

    rows: slice  # its rows in the log
    gap: float  # seconds between the row before and the first row, at most _LONGEST_GAP steps; 0 at the start


@dataclass(frozen=True, eq=False)
class Grid:
    """Segments of several logs on one grid."""

    inputs: tuple[str, ...]  # names of the columns
    disturbances: tuple[str, ...]
    outputs: tuple[str, ...]
    switches: tuple[str, ...]  # inputs, beside others, that are only ever 0 or 1
    dt: float  # step [s]
    segments: tuple[Segment, ...]
    native: float  # sample time of the logs before averaging [s]
    units: dict[str, str]  # unit of each signal
    why: str = ""  # where the step comes from, in words
    ends: bool = False  # whether an input was applied up to the row of the log that holds it, not from it on

    @property
    def logs(self) -> tuple[str, ...]:
        """Names of the logs, each once."""
        return tuple(dict.fromkeys(segment.log for segment in self.segments))

    def of(self, logs: Sequence[Log], *, average: float | None = None, ends: bool = False) -> Grid:
        """Return logs on a grid like this one, of its step or of ``average`` [s]."""
        u, y, d = self.inputs, self.outputs, self.disturbances
        return make_grid(logs, inputs=u, outputs=y, disturbances=d, average=average or self.dt, ends=ends)

    def output_spread(self) -> Array:
        """Return the standard deviation (n_y,) of the readings over all segments."""
        return np.asarray(np.nanstd(np.concatenate([segment.y for segment in self.segments]), axis=0))

    def ranges(self) -> dict[str, tuple[float, float]]:
        """Return the least and greatest value of each signal."""
        rows = np.concatenate([np.hstack([segment.u, segment.d, segment.y]) for segment in self.segments])
        ends = zip(np.nanmin(rows, axis=0).tolist(), np.nanmax(rows, axis=0).tolist())
        return dict(zip((*self.inputs, *self.disturbances, *self.outputs), ends))


def make_grid(
    logs: Sequence[Log],
    *,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    disturbances: Sequence[str] | None = None,
    average: float | None = None,
    min_rows: int = 20,
    ends: bool = False,
) -> Grid:
    """Return the logs on one even grid; ``ends``: inputs were applied up to their rows."""
    if not logs:
        raise UserError("no log to identify from", hint="give at least one")
    u, y, d = signals(logs, inputs=inputs, outputs=outputs, disturbances=disturbances)
    rows = [rows_of(log, u, y, d) for log in logs]
    rows = [rows_of_log.from_row_on() for rows_of_log in rows] if ends else rows
    native = float(np.median([rows_of_log.step for rows_of_log in rows]))
    step, why = _chosen_step(rows, y, native) if average is None else (float(average), "asked for")
    if step < native * 0.999:
        problem = f"averaging over {step:g} s is shorter than the sample time {native:g} s"
        raise UserError(problem, hint="average longer")
    segments = [
        segment
        for rows_of_log in rows
        for segment in _segments(rows_of_log, step, native)
        if len(segment.time) >= min_rows
    ]
    if not segments:
        raise UserError(
            f"the logs are too short: no segment between gaps has {min_rows} rows of {step:g} s",
            file=rows[0].log,
            hint="give a longer log, one with fewer gaps, or a shorter step with --average S",
        )
    units = {name: str(logs[0][name].attrs.get("units", "1")) for name in (*u, *d, *y)}
    moves = np.concatenate([rows_of_log.u for rows_of_log in rows]).T
    switches = tuple(n for n, on in zip(u, moves) if units[n] == "1" and np.isin(on, (0.0, 1.0)).all())
    switches = () if len(switches) == len(u) else switches  # a heater that is only on or off is what drives
    return Grid(u, d, y, switches, step, tuple(segments), native, units, why, ends)


def cut_stretches(plant: PlantData, log: Log, *, gaps: str = "restart") -> list[Stretch]:
    """Return the stretches of a log, which is in the plant's units, on the plant's grid."""
    rows = rows_of(log, plant.inputs, plant.outputs, plant.disturbances)
    _check_known(log, (*plant.inputs, *plant.disturbances))

    def steps(seconds: float) -> int:
        n = max(1, int(np.ceil(seconds / plant.dt - 1e-9)))
        n_signals = len(plant.inputs) + len(plant.disturbances) + len(plant.outputs)
        if 8 * n * n_signals > MOST_BYTES // _GRIDS:  # refused before its grid is made
            hint = "cut the log, or use a plant of a longer step"
            raise UserError(f"would be simulated in {n} steps of {plant.dt:g} s", file=rows.log, hint=hint)
        return n

    # logs of a rig that says of an input what was applied up to the row are moved by one row
    rows = rows.from_row_on() if plant.inputs_end_at_row else rows
    for name, step in plant.model.command_steps.items():
        # a driver drops what lies behind a multiple of its step
        command = rows.u[:, plant.inputs.index(name)]
        command[:] = np.trunc(command / step + 1e-9 * np.sign(command)) * step
    rows = replace(rows, after=()) if gaps == "hold" else rows
    # an ambient's sensor is slow and coarse; what is no temperature, such as a lamp, acts when it changes
    smooth = [plant.model.smooth if plant.units.get(n, "degC") == "degC" else 0.0 for n in plant.disturbances]
    return list(_stretches(rows, step=plant.dt, steps=steps, smooth=smooth))


def held_means(time: Array, values: Array, edges: Array) -> Array:
    """Return the means of the staircases (n_time, n) over the cells between the edges."""
    # with U(t) the integral of the held input up to t, which is piecewise linear, its mean over [a, b) is
    # exactly (U(b) - U(a)) / (b - a), whatever the jitter of the rows
    area = np.zeros_like(values)
    np.cumsum(values[:-1] * np.diff(time)[:, None], axis=0, out=area[1:])
    row = np.clip(np.searchsorted(time, edges, side="right") - 1, 0, None)
    integral = area[row] + values[row] * (edges - time[row])[:, None]
    return np.asarray(np.diff(integral, axis=0) / np.diff(edges)[:, None], dtype=float)


def _stretches(
    rows: Rows, *, step: float, steps: Callable[[float], int], smooth: Sequence[float] = ()
) -> Iterator[Stretch]:
    """Yield stretches of two rows or more on a grid of ``step`` [s], ``steps(length [s])`` each, the first
    disturbances smoothed over so many seconds."""
    for begin, end in pairwise([0, *rows.after, rows.time.size]):
        in_stretch, t = slice(begin, end), rows.time[begin:end]
        n = steps(t[-1] - t[0])
        if n < 1:
            continue
        edges = t[0] + step * np.arange(n + 1)
        input_means = held_means(t, rows.u[in_stretch], edges)
        disturbance_means = held_means(t, rows.d[in_stretch], edges)
        for k, seconds in enumerate(smooth):
            if seconds > step:
                disturbance_means[:, k] = _smooth(t, rows.d[in_stretch, k : k + 1], edges, seconds)[:, 0]
        gap = min(float(t[0] - rows.time[begin - 1]), _LONGEST_GAP * step) if begin else 0.0
        y = rows.y[in_stretch]
        yield Stretch(t - t[0], y, input_means, disturbance_means, rows.log, in_stretch, gap)


def at_rows(stretch: Stretch, run: Array, dt: float) -> Array:
    """Interpolate a run (B, N + 1, n_y) on the grid to the stretch's rows: (B, n, n_y)."""
    place = np.clip(stretch.time / dt, 0.0, run.shape[1] - 1)
    cell_before = np.minimum(place.astype(int), run.shape[1] - 2)
    share = (place - cell_before)[None, :, None]
    # in place: a run may be long, and a batch large
    out, after = run[:, cell_before], run[:, cell_before + 1]
    out *= 1 - share
    after *= share
    out += after
    return np.asarray(out)


def bridge(y: Array) -> Array:
    """Return readings (n, n_y) whose inner holes of up to :data:`BRIDGED` rows lie on a line."""
    out = y.copy()
    for i in range(y.shape[1]):
        read_rows = np.flatnonzero(np.isfinite(y[:, i]))
        for before, after in pairwise(read_rows.tolist()):
            if after - before <= BRIDGED + 1:
                out[before : after + 1, i] = np.linspace(y[before, i], y[after, i], after - before + 1)
    return out


def whole_readings(segments: Sequence[Segment], deep: int) -> list[Array]:
    """Return each segment's readings, bridged only where less than half of the windows of ``deep`` rows are
    whole, for a bridge is a guess; elsewhere the rest is left out."""
    whole = total = 0
    for segment in segments:
        lost = np.cumsum(np.append(0, ~np.isfinite(segment.y).all(axis=1)))
        in_window = lost[deep:] - lost[:-deep]
        whole, total = whole + int((in_window == 0).sum()), total + in_window.size
    return [segment.y if 2 * whole >= total else bridge(segment.y) for segment in segments]


class SignalNames(NamedTuple):
    """Names of the columns that are used."""

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    disturbances: tuple[str, ...]


def signals(
    logs: Sequence[Log],
    *,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    disturbances: Sequence[str] | None = None,
) -> SignalNames:
    """Return the names of inputs, outputs and disturbances, checked to stand in every log."""
    u, y, d = (
        tuple(names_of(logs[0], role)) if wanted is None else tuple(wanted)
        for wanted, role in ((inputs, "input"), (outputs, "output"), (disturbances, "disturbance"))
    )
    if inputs is not None or outputs is not None:  # what was named explicitly is not a disturbance as well
        d = tuple(name for name in d if name not in (*u, *y))
    for log in logs:
        for name in y:
            if not np.isfinite(column(log, name)).any():
                raise UserError("has no reading", file=log_name(log), column=name, hint="leave the log out")
        _check_known(log, (*u, *d))
    for name in y:
        readings = np.concatenate([column(log, name) for log in logs])
        if not np.nanmax(readings) > np.nanmin(readings):
            raise UserError(
                f"reads {np.nanmin(readings):g} whenever it reads: there is nothing to explain",
                file=log_name(logs[0]),
                column=name,
                hint="check the sensor, or leave it out with --outputs",
            )
    lacking = [role for role, chosen in (("input", u), ("output", y)) if not chosen]
    if lacking:
        moving = [str(name) for name, item in logs[0].items() if np.nanmax(item) > np.nanmin(item)]
        options = " and ".join(f"--{role}s" for role in lacking)
        of_columns = ", ".join(moving) or "a run in which they move"
        hint = f"name {'it' if len(lacking) == 1 else 'them'} with {options}, of {of_columns}"
        still = [str(name) for name in logs[0] if name not in moving]
        hint += f"; never moved: {', '.join(still)}" if still else ""
        hint += moved_before(logs[0]) if "input" in lacking else ""
        problem = " and ".join(f"no {role}" for role in lacking) + " among the columns"
        said = str(logs[0].attrs.get("role_doubts", "")).splitlines()
        problem += "".join(f"; {doubt}" for doubt in said if NO_NUMBERS in doubt)
        raise UserError(problem, file=log_name(logs[0]), hint=hint)
    return SignalNames(u, y, d)


def _check_known(log: Log, driven: Sequence[str]) -> None:
    for name in driven:
        if not np.isfinite(column(log, name)).all():
            problem, hint = "is unknown in some rows", "fill or cut them"
            raise UserError(problem, file=log_name(log), column=name, hint=hint)


def moved_before(log: Log) -> str:
    """Return a repair, to be added to another one, of a log with a drive by name that was likely moved just
    before its first row: its readings alone change."""
    for name, item in log.items():
        level = float(column(log, str(name))[0])
        drive = guess_role(str(name), str(item.attrs.get("units", "1"))) == "input"
        if drive and level and not np.ptp(item.values):
            return f"; if {name} was not {level:g} before, write a row with its value of then above the first"
    return ""


def quantum(values: Array) -> float:
    """Return the step of the converter behind a channel, 0 where its values are not discrete."""
    finite = values[np.isfinite(values)]
    levels = np.unique(np.round(finite, 9))
    if levels.size < 3 or levels.size > 0.5 * finite.size:
        return 0.0
    # writing with three decimals moves even steps by up to 0.001: the median survives that
    return float(np.round(np.median(np.diff(levels)), 6))


def dominant_time(logs: Sequence[Rows]) -> float:
    """Return the time constant [s] that dominates the outputs, from a first-order model at a coarse step; a
    twentieth of the longest log where the data give no stable answer."""
    longest = max(rows.recorded for rows in logs)
    native = max(rows.step for rows in logs)
    steps = [max(step, native) for step in (longest / 400, longest / 150)]
    segments = [
        (segment, step) for step in steps for rows in logs for segment in _segments(rows, step, native)
    ]
    time_constants = [time for segment, step in segments for time in _first_order_times(segment, step)]
    return float(np.median(time_constants)) if time_constants else longest / 20


def _chosen_step(logs: Sequence[Rows], outputs: Sequence[str], native: float) -> tuple[float, str]:
    """Return the averaging step [s], a whole multiple of the sample time, and which of the rules set it."""
    slow = dominant_time(logs)
    longest = max(rows.recorded for rows in logs)
    most = min(slow / 10, longest / 200)  # whatever the time constant, rows must be left to fit
    needed = max(native, slow / 100)  # finer steps cost time and add nothing
    why = "the logs' own" if needed == native else f"a hundredth of the dominant time constant, {slow:.3g} s"
    # Once the output moves less than the quantum of its converter in one step of the grid, most of what an
    # equation-error fit sees is rounding: the step is the longest in which it does (rms).
    for k, name in enumerate(outputs):
        q = max(quantum(rows.y[:, k]) for rows in logs)
        for times in (1, 2, 3, 4, 5, 6, 8, 10, 12, 15, 20, 25, 30, 40, 50):
            moves = np.array([_rms_move(rows.time, rows.y[:, k], times * native) for rows in logs])
            moves = moves[np.isfinite(moves)]
            if not moves.size or np.sqrt(np.mean(np.square(moves))) >= q:
                break
            if times * native > needed:
                needed = times * native
                why = f"{name} moves less than its converter's {q:.3g} in shorter steps"
    if needed > max(native, most):
        why += f"; held at {max(native, most):.3g} s, so that the dynamics keep their rows"
    step = min(needed, max(native, most))
    return native * max(1, round(step / native)), why


def _segments(rows: Rows, step: float, native: float) -> list[Segment]:
    """Return a log's stretches of two steps or more with the readings on the grid."""

    def steps(seconds: float) -> int:
        n = int((seconds + native) / step + 1e-9)
        return n if n > 1 else 0

    out = []
    is_native = abs(step - native) < 1e-6 * native
    for stretch in _stretches(rows, step=step, steps=steps):
        t = rows.time[stretch.rows]
        if is_native and np.ptp(np.diff(t)) < 0.02 * native:  # the samples stand as they are
            out.append(Segment(t, stretch.y, rows.u[stretch.rows], rows.d[stretch.rows], stretch.log))
        else:
            # the mean about a row, so that it is not shifted in time
            grid = t[0] + step * np.arange(len(stretch.u))
            out.append(Segment(grid, _line_mean(t, stretch.y, grid, step), stretch.u, stretch.d, stretch.log))
    return out


def _smooth(time: Array, values: Array, edges: Array, seconds: float) -> Array:
    """Return means (N, n_d) over ``seconds`` (the step, if longer) about the middle of each step."""
    middle = (edges[1:] + edges[:-1]) / 2
    half = max(seconds, edges[1] - edges[0]) / 2
    low, high = np.maximum(middle - half, edges[0]), np.minimum(middle + half, edges[-1])
    ends, place = np.unique(np.concatenate([low, high]), return_inverse=True)
    integrals = held_means(time, values, ends) * np.diff(ends)[:, None]
    area = np.vstack([np.zeros(integrals.shape[1]), np.cumsum(integrals, axis=0)])[place]
    return np.asarray((area[len(low) :] - area[: len(low)]) / (high - low)[:, None])


def _line_mean(t: Array, values: Array, grid: Array, step: float) -> Array:
    """Mean over [t_k - step/2, t_k + step/2] of the line through the finite samples, NaN without any."""
    from scipy.interpolate import make_interp_spline  # slow to import, and a network does without

    out = np.full((grid.size, values.shape[1]), np.nan)
    for i in range(values.shape[1]):
        is_read = np.isfinite(values[:, i])
        s, v = t[is_read], values[is_read, i]
        if s.size < 2:
            continue
        half = np.minimum(step / 2, np.maximum(np.minimum(grid - s[0], s[-1] - grid), 0))
        area, mean = make_interp_spline(s, v, k=1).antiderivative(), np.interp(grid, s, v)
        wide = half > 0
        mean[wide] = (area((grid + half)[wide]) - area((grid - half)[wide])) / (2 * half[wide])
        count = np.searchsorted(s, grid + step * 0.501) - np.searchsorted(s, grid - step * 0.501)
        out[count > 0, i] = mean[count > 0]
    return out


def _rms_move(time: Array, values: Array, step: float) -> float:
    """Root mean square change of a reading over ``step`` seconds, of means; NaN of a log too short."""
    coarse = max(step, 8 * float(np.median(np.diff(time))))  # the slope over a longer stretch, scaled down
    grid = np.arange(time[0], time[-1], coarse)
    mean = _line_mean(time, values[:, None], grid, coarse)[:, 0]
    moves = np.diff(mean)
    moves = moves[np.isfinite(moves)]
    return float(np.sqrt(np.mean(moves**2)) * step / coarse) if moves.size else np.nan


def _first_order_times(part: Segment, step: float) -> list[float]:
    """Time constants of y[k+1] = a y[k] + b u[k] + c, by instruments, one an output."""
    out = []
    for i in range(part.y.shape[1]):
        now, after = part.y[1:-1, i], part.y[2:, i]
        x = np.column_stack([now, part.u[1:-1], np.ones(now.size)])
        z = np.column_stack([part.u[:-2], part.u[1:-1], np.ones(now.size)])
        good = np.isfinite(now) & np.isfinite(after)
        if good.sum() < 20:
            continue
        fitted, *_ = np.linalg.lstsq(z[good], x[good], rcond=None)
        pole = float(np.linalg.lstsq(z[good] @ fitted, after[good], rcond=None)[0][0])
        if 0.02 < pole < 0.9999:
            out.append(-step / np.log(pole))
    return out


def roles_of(model: Signals) -> dict[str, str]:
    """Return the role of each signal of a model."""
    groups = (("input", model.inputs), ("disturbance", model.disturbances), ("output", model.outputs))
    return {name: role for role, group in groups for name in group}


def misfit(model: Signals, log: Log) -> UserError | None:
    """Return why the model cannot take this log (a signal that is absent, a unit), None where it can."""
    off = inputs_off(model, log)
    lost = [f"{role} {name}" for name, role in roles_of(model).items() if name not in log and name not in off]
    if lost:
        have = ", ".join(str(name) for name in log.data_vars)
        return UserError(f"has no {', no '.join(lost)}", file=log_name(log), hint=f"its columns are {have}")
    try:
        match_logs(model, [log])
    except UserError as error:
        return error
    return None


def inputs_off(model: Signals, log: Log) -> list[str]:
    """Return the model's inputs that a log lacks and that may be taken as 0 throughout: the log has another
    of its inputs, and none beside them that could be this one by another name; a switch may as well be on."""
    if set(names_of(log, "input")) - set(model.inputs) or not any(name in log for name in model.inputs):
        return []
    ranges: dict[str, tuple[float, float]] = dict(getattr(model, "valid", {}))
    inner: Any = getattr(model, "model", model)
    if (network := getattr(inner, "network", None)) is not None:
        ranges |= {name: item.range for name, item in network.inputs.items()}
    absent = [name for name in model.inputs if name not in log and name in ranges]
    return [n for n in absent if n not in inner.switches and ranges[n][0] <= 0 <= ranges[n][1]]


def moved_beside(model: Signals, log: Log) -> list[str]:
    """Return the inputs of a log, by its own guess, that move in it and that the model does not have."""
    others = [name for name in names_of(log, "input") if name not in roles_of(model)]
    return [name for name in others if np.ptp(column(log, name)) > 0]


def match_logs(model: Signals, logs: Logs, *, keep_others: bool = False) -> tuple[list[Log], list[str]]:
    """Return logs in the model's roles and units (one that fits is returned itself), and what was converted
    or taken as 0, a line a column."""
    role_of, conversions = roles_of(model), list[str]()
    logs = as_logs(logs, known=role_of)
    for index, log in enumerate(logs):
        for name in inputs_off(model, log):
            unit = model.units.get(name, "1")
            attrs = {"units": unit, "role": "input"}
            logs[index] = logs[index].assign({name: ("time", np.zeros(log.sizes["time"]), attrs)})
            shown = "" if unit == "1" else f" {unit}"
            conversions.append(f"{name}: no such column, taken as 0{shown} throughout")
    matched = list(logs)
    largest = {
        name: max((float(np.nanmax(np.abs(column(log, name)), initial=0.0)) for log in logs), default=0.0)
        for name in role_of
    }
    for index, log in enumerate(logs):
        changed = {}
        for name in role_of:
            conversion = _converted(
                model, name, log[name].attrs.get("units", "1"), largest[name], log_name(log)
            )
            if conversion is not None:
                changed[name] = column(log, name) * conversion[0]
                conversions.append(conversion[1])
        roles = {str(n): str(item.attrs.get("role")) if keep_others else "other" for n, item in log.items()}
        roles |= role_of
        if changed or any(item.attrs.get("role") != roles[str(n)] for n, item in log.items()):
            matched[index] = log.copy()
            for name, role in roles.items():
                attrs = log[name].attrs | {"role": role}
                attrs |= {"units": model.units[name]} if name in changed else {}
                matched[index][name] = ("time", changed.get(name, log[name].values), attrs)
    return matched, list(dict.fromkeys(conversions))


def _converted(model: Signals, name: str, unit: str, largest: float, log: str) -> tuple[float, str] | None:
    """Return a signal's factor to the model's unit and a note (None where it is in it), given the ``largest``
    size of its values in all logs; refuse another unit."""
    # Shares of full scale come as 1 (-1 to 1), percent or 0_255 and are converted; values beyond 1 tell a
    # column without a unit to be in the model's own.  Any other difference of units is refused.
    want = model.units.get(name)
    if want is None or unit == want:
        return None
    if unit == "1" and want not in SHARES:
        return 1.0, f"{name}: has no unit, taken as {want}"
    low, high = getattr(model, "valid", {}).get(name, (0.0, 0.0))  # of what a plant was fitted to
    if unit not in SHARES or want not in SHARES or (want == "1" and max(-low, high) > 1 + _SLACK):
        raise UserError(
            f"is in {unit!r}, the plant's is in {want!r}",
            file=log,
            column=name,
            hint="convert it" if want != "1" else "convert it, or leave the unit away if it is the same",
        )
    if unit == "1" and largest > 1 + _SLACK:
        return 1.0, f"{name}: has no unit and values up to {largest:g}, taken as {want}"
    return SHARES[want] / SHARES[unit], f"{name}: converted from {unit} to {want}"
