"""Checks that run before any fit: what the data can and cannot say.

Every finding has a verdict (``ok``, ``warn``, ``fail``) and a consequence in words.  **Excitation** is the
order n up to which an input is persistently exciting, the rank of the covariance of n successive values.
**Feedback** from output to input: with u[k] regressed on its own past, does the past of y help?  An F test in
which only rows count at which the input moves.  A relay is asked whether it is switched at the same readings;
of one that is on for a share of even windows the shares are tested.  In closed loop the noise is in the input
too, and equation-error fits are biased.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from scipy.stats import f as f_distribution

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.log_files import Logs, as_logs
from thermogrip.datasets.repair import GAP_SECONDS, GAP_STEPS
from thermogrip.datasets.roles import FOLLOWED, IS_SET_POINT, explain_role
from thermogrip.datasets.schema import Log, column, gaps, log_name
from thermogrip.sysid.plant.log_grid import Grid, Rows, make_grid, quantum
from thermogrip.sysid.plant.plant import Plant

Verdict = Literal["ok", "warn", "fail"]


@dataclass(frozen=True)
class CheckSettings:
    """Limits of the checks."""

    fewest_readings: int = 50  # fewer say nothing of their noise
    held_share: float = 0.05  # of rows with a move, below which an output is constant but for jumps
    no_noise: float = 1e-6  # of the range of an output
    own_lags: tuple[int, ...] = (3, 6, 12, 24, 48)  # rows of an input's own past, to test it for feedback
    # Of the moves of an input the 5 % largest are a set point's.  Of the others the past of the outputs
    # explains 33 to 99 % in 20 closed loops with a set point in steps, at most 34 % (few moves) in open ones.
    usual_moves: float = 0.95
    explained_between: float = 0.25
    # Median of differences over ranges: at most 0.08 in ten thermostats, 0.14 to 1 in 60 relays of any course
    same_reading: float = 0.1
    fewest_switchings: int = 10
    rows_a_window: int = 3  # fewer have no shares beside none, half and all
    even_windows: float = 0.9  # share of a relay's switchings, within a row of a whole number of windows
    small_drive: float = 0.05  # of an input's range: that is no drive
    thin_minutes: float = 15.0  # below either, a side of the drive is thinly covered
    thin_share: float = 0.15


_CHECKS = CheckSettings()
_IN_CLOSED_LOOP = "noise is in the input too, so trust simulation-error fits and not one-step fits"


@dataclass(frozen=True)
class Finding:
    """One check of one channel of one log."""

    check: str  # quantum, noise, jitter, gaps, lost, excitation or feedback
    log: str  # where; empty where it concerns all
    channel: str
    value: float  # the measured number
    unit: str  # its unit
    verdict: Verdict
    says: str  # the finding and its consequence, in words


@dataclass(frozen=True)
class DataCheck:
    """All findings."""

    findings: tuple[Finding, ...]

    def of(self, check: str) -> tuple[Finding, ...]:
        """Return the findings of one check."""
        return tuple(f for f in self.findings if f.check == check)


def check_data(
    logs: Logs,
    *,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    disturbances: Sequence[str] | None = None,
    average: float | None = None,
) -> DataCheck:
    """Check logs before a fit.

    Parameters
    ----------
    logs : Log, DataFrame, str, Path, or sequence of them
    inputs, outputs, disturbances : sequence of str, optional
        Names of the signals; by role where absent.
    average : float, optional
        Step [s] of the grid for the dynamic checks; chosen from quantum and time constant where absent.

    Returns
    -------
    DataCheck
        Its ``findings``, and ``of(check)`` for those of one check.

    Raises
    ------
    UserError
        If a signal is missing or every stretch is too short.

    Examples
    --------
    An input that never moves cannot be identified from:

    >>> from thermogrip.datasets.schema import make_log
    >>> t = np.arange(200.0)
    >>> y = 25 + np.sin(t / 30)
    >>> log = make_log(t, {"q": (np.full(200, 0.5), "1", "input"), "t": (y, "degC", "output")})
    >>> found = check_data([log], average=1.0).of("excitation")[0]
    >>> found.verdict, found.says
    ('fail', 'q never moves: nothing can be learnt about it')
    """
    logs = as_logs(logs, inputs, outputs, disturbances)
    grid = make_grid(logs, inputs=inputs, outputs=outputs, disturbances=disturbances, average=average)
    u, y = grid.inputs, grid.outputs
    findings: list[Finding] = []
    for log in logs:
        steps = np.diff(log["time"].values)
        usual = float(np.median(steps))
        findings += _step_findings(log_name(log), steps, usual, gaps(log))
        averaged = grid.dt if grid.dt > 1.5 * usual else None
        for name in y:
            unit = str(log[name].attrs.get("units", "1"))
            channel = _Channel(log_name(log), name, unit, column(log, name))
            findings += [_quantum(channel, averaged), _lost(channel), _sensorless_output(channel)]
    findings += _excitation(grid)
    for place, name in enumerate(u):
        findings += _feedback_to(name, place, grid, logs)
    findings += [finding for log in logs for finding in _set_points(log)]
    return DataCheck(tuple(findings))


class _Channel(NamedTuple):
    """A column of a log."""

    log: str
    name: str
    unit: str
    values: Array

    def found(self, check: str, value: float, unit: str, verdict: Verdict, says: str) -> Finding:
        return Finding(check, self.log, self.name, value, unit, verdict, says)


def _step_findings(
    log: str, steps: Array, usual: float, holes: Sequence[tuple[int, float, float]]
) -> list[Finding]:
    """Return how even the steps between rows are, and the gaps."""
    jitter = float(np.std(steps[steps < 3 * usual]) / usual)
    says, even = f"rows are {usual:.3g} s apart, within {100 * jitter:.1f} %", jitter < 0.2
    if not even:
        says += ": time stamps are uncertain, fast dynamics cannot be trusted"
    evenness = Finding("jitter", log, "time", jitter, "1", "ok" if even else "warn", says)
    if not holes:
        return [evenness, Finding("gaps", log, "time", 0.0, "s", "ok", "no gap longer than 10 s")]
    longest = max(after - before for _, before, after in holes)
    says = f"{len(holes)} gap(s), the longest {longest:.0f} s: the input is unknown there"
    return [evenness, Finding("gaps", log, "time", longest, "s", "warn", says)]


def _quantum(channel: _Channel, averaged: float | None) -> Finding:
    """Return the step of the converter; ``averaged`` is that of the fits [s], where it is longer."""
    q, name = quantum(channel.values), channel.name
    coarse = q > 0.05 * float(np.nanstd(channel.values))
    says = (
        f"{name} moves in steps of {q:.3g}{_unit_suffix(channel.unit)}"
        if q
        else f"{name} shows no quantisation"
    )
    if averaged is not None:
        says += f"; averaged over {averaged:g} s before the fits"
    if coarse:
        says += ": coarse, equation-error fits are unreliable at the log's own rate"
    return channel.found("quantum", q, channel.unit, "warn" if coarse else "ok", says)


def _sensorless_output(channel: _Channel) -> Finding:
    """Question an output that no sensor reads: one that is constant but for jumps, or has no noise at all."""
    values = channel.values[np.isfinite(channel.values)]
    unit, name = channel.unit, channel.name
    spread, moves = float(np.ptp(values)), np.diff(values)
    if values.size < _CHECKS.fewest_readings or not spread:
        return channel.found("noise", 0.0, unit, "ok", f"{name}: too few readings to see noise")
    # third differences, of which a smooth course has little, have 20 times the variance of white noise
    noise = float(np.median(np.abs(np.diff(values, 3)))) / 0.6745 / np.sqrt(20.0)
    jumps = int(np.count_nonzero(moves))
    # a coarse sensor moves by one step of its converter, to and fro
    if (
        jumps < _CHECKS.held_share * values.size
        and np.abs(moves).max() > 1.5 * np.abs(moves[moves != 0]).min()
    ):
        says = f"{name} is constant but for {jumps} jumps in {values.size} rows: is it a set point?"
    elif noise < _CHECKS.no_noise * spread and jumps > 0.5 * values.size:
        says = f"{name} has no noise: is it computed or smoothed, no reading?"
    else:
        return channel.found(
            "noise", noise, unit, "ok", f"{name} has noise of {noise:.2g}{_unit_suffix(unit)}"
        )
    return channel.found("noise", noise, unit, "warn", says + " Leave it out with --outputs")


def _lost(channel: _Channel) -> Finding:
    share = float(np.mean(~np.isfinite(channel.values)))
    verdict: Verdict = "ok" if share < 0.02 else "warn" if share < 0.3 else "fail"
    says = f"{100 * share:.2g} % of {channel.name} is lost"
    return channel.found(
        "lost", share, "1", verdict, says + ("" if share < 0.02 else ": fits leave these rows out")
    )


_MOST_ALIKE = 1e4  # condition of the inputs' correlation


def _excitation(grid: Grid, most: int = 6) -> list[Finding]:
    """Rank of the covariance of successive input values: each input alone, then all together."""
    out = []
    rows = np.concatenate([segment.u for segment in grid.segments])
    moves = np.ptp(rows, axis=0) > 1e-9 * np.abs(rows).max(axis=0)  # averages round
    for place, name in enumerate(grid.inputs):
        if not moves[place]:
            says = f"{name} never moves: nothing can be learnt about it"
            verdict: Verdict = "warn" if name in grid.switches else "fail"
            out.append(Finding("excitation", "", name, 0.0, "orders", verdict, says))
            continue
        successive = [np.lib.stride_tricks.sliding_window_view(s.u[:, place], most) for s in grid.segments]
        size = np.linalg.svd(np.cov(np.concatenate(successive).T), compute_uv=False)
        order = int(np.sum(size > 1e-6 * size[0]))
        count = sum(int(np.count_nonzero(np.abs(np.diff(s.u[:, place])) > 1e-9)) for s in grid.segments)
        good = order >= 3 and (count >= 4 or name in grid.switches)
        says = f"{name} moves {count} times and excites {order} of {most} orders"
        says += "" if good else ": too little for more than a gain"
        out.append(Finding("excitation", "", name, float(order), "orders", "ok" if good else "warn", says))
    moving = np.flatnonzero(moves).tolist()
    if len(moving) > 1:
        correlation = np.corrcoef(rows[:, moving].T)
        condition = float(np.linalg.cond(correlation))
        alike, says = condition > _MOST_ALIKE, "inputs move apart"
        if alike:  # any one of these, left out, lets the effects of the others be estimated; else all
            without = [np.delete(np.delete(correlation, k, 0), k, 1) for k in range(len(moving))]
            among = [place for place, rest in zip(moving, without) if np.linalg.cond(rest) <= _MOST_ALIKE]
            names = " and ".join(grid.inputs[place] for place in among or moving)
            says = f"{names} move together: their effects cannot be separated"
        out.append(Finding("excitation", "", "all inputs", condition, "1", "fail" if alike else "ok", says))
    return out


def _feedback(grid: Grid, at: int, name: str, lags: int = 3) -> Finding:
    """F test: does the past of the outputs help to predict the input beyond its own past?"""
    # a smooth input is predicted by many of its own rows: with few of them, outputs that filter it would help
    own_lags = min(_CHECKS.own_lags, key=lambda n: _bic(*_effect_regression(grid, at, own=n, others=0)))
    (X, v), (Z, _) = (_effect_regression(grid, at, own=own_lags, others=n) for n in (0, lags))
    steps = np.abs(v - X[:, 0]) if len(v) else np.zeros(1)  # X[:, 0] is u[k-1]
    moves = int(np.count_nonzero(steps > 1e-9 * np.ptp(v))) if len(v) else 0
    if moves < 3 * Z.shape[1]:
        says = f"{name} moves too seldom to be tested for feedback"
        return Finding("feedback", "", name, float("nan"), "1", "ok", says)
    explained, chance = _helped(X, Z, v, moves)
    closed = chance < 1e-4 and explained > 0.02
    # the steps of a set point hide what a controller does between them
    usual = (steps > 1e-9 * np.ptp(v)) & (steps <= np.quantile(steps[steps > 0], _CHECKS.usual_moves))
    if not closed and usual.sum() >= 3 * Z.shape[1]:
        explained, chance = _helped(X[usual], Z[usual], v[usual], int(usual.sum()))
        closed = chance < 1e-4 and explained > _CHECKS.explained_between
    says = f"no sign that {name} was driven by the outputs"
    if closed:
        says = f"{name} follows the outputs ({100 * explained:.0f} % of its moves): recorded in closed loop; "
        says += _IN_CLOSED_LOOP
    return Finding("feedback", "", name, explained, "1", "warn" if closed else "ok", says)


def _helped(X: Array, Z: Array, v: Array, moves: int) -> tuple[float, float]:
    """Return the share of v that Z explains beyond X, and the chance of it if it did not."""
    less, more = (_squares(W, v) for W in (X, Z))
    extra, degrees_of_freedom = Z.shape[1] - X.shape[1], moves - Z.shape[1]
    ratio = (less - more) / extra / max(more / degrees_of_freedom, 1e-300)
    return 1 - more / max(less, 1e-300), float(f_distribution.sf(ratio, extra, degrees_of_freedom))


def _relay_feedback(grid: Grid, at: int, name: str) -> Finding:
    """Tell whether a relay is switched where an output reaches the same reading again."""
    least, switchings = np.inf, 0
    lengths: set[int] = set()
    for output in range(len(grid.outputs)):
        ratios = []
        for segment in grid.segments:
            y, edges = segment.y[:, output], np.flatnonzero(np.diff(segment.u[:, at])) + 1
            lengths |= {*np.diff(edges).tolist()}
            for first, last in zip(edges[:-2], edges[2:]):
                between_edges = y[first : last + 1]
                if np.isfinite(between_edges).all() and np.ptp(between_edges) > 0:
                    ratios.append(abs(between_edges[-1] - between_edges[0]) / np.ptp(between_edges))
        if len(ratios) >= _CHECKS.fewest_switchings:
            least, switchings = min(least, float(np.median(ratios))), len(ratios)
    closed = least <= _CHECKS.same_reading and len(lengths) > 2  # the holds of a clock are all alike
    says = f"no sign that {name} was driven by the outputs"
    if closed:
        says = f"{name} is switched at the same readings {switchings} times: recorded in closed loop; "
        says += _IN_CLOSED_LOOP
    return Finding("feedback", "", name, least, "1", "warn" if closed else "ok", says)


def _feedback_to(name: str, at: int, grid: Grid, logs: Sequence[Log]) -> list[Finding]:
    """Return whether an input was driven by the outputs; nothing of a switch that is no relay's."""
    window = _window(logs, name)
    if any((s.time[-1] - s.time[0]) > max(_CHECKS.own_lags) * window > 0 for s in grid.segments):
        first = [int(np.argmax(np.diff(column(log, name)) > 0)) + 1 for log in logs]
        begun = [log.isel(time=slice(row, None)) for log, row in zip(logs, first)]
        shares = _feedback(grid.of(begun, average=window), at, name)
        if shares.verdict == "warn":
            return [shares]
    if window or all(np.unique(segment.u[:, at]).size <= 2 for segment in grid.segments):
        return [_relay_feedback(grid, at, name)]
    return [] if name in grid.switches else [_feedback(grid, at, name)]


def _window(logs: Sequence[Log], name: str) -> float:
    """Return the window [s] of a relay that is on for a share of even windows; 0 of any other input."""
    if any(np.unique(column(log, name)).size > 2 for log in logs):
        return 0.0
    on = [np.diff(log["time"].values[1:][np.diff(column(log, name)) > 0]) for log in logs]
    between = np.concatenate(on)
    if between.size < _CHECKS.fewest_switchings:
        return 0.0
    row = max(float(np.median(np.diff(log["time"].values))) for log in logs)
    window = float(np.median(between))  # two of them where the relay stays on, or off, for a whole one
    even = np.abs(between - window * np.rint(between / window)) <= row
    return window if window > _CHECKS.rows_a_window * row and np.mean(even) >= _CHECKS.even_windows else 0.0


def _set_points(log: Log) -> list[Finding]:
    """Return a finding for each column of a log that is a set point by its name, or by what follows it."""
    units = {str(name): str(item.attrs.get("units", "1")) for name, item in log.items()}
    by_course = [
        line.partition(": ")[0] for line in log.attrs.get("guesses", "").splitlines() if FOLLOWED in line
    ]
    set_points = [
        n for n, unit in units.items() if explain_role(n, unit)[1] == IS_SET_POINT or n in by_course
    ]
    nothing = float("nan")
    says = f"recorded in closed loop, if its controller was on; {_IN_CLOSED_LOOP}"
    return [
        Finding("feedback", log_name(log), name, nothing, "1", "warn", f"{name} is a set point: {says}")
        for name in set_points
    ]


def _effect_regression(grid: Grid, at: int, *, own: int, others: int) -> tuple[Array, Array]:
    """Return (regressors, input) of the rows that have ``max(_CHECKS.own_lags)`` rows before them."""
    first = max(_CHECKS.own_lags)
    rows, target = [], []
    for segment in grid.segments:
        u, n = segment.u[:, at], len(segment.time)
        if n <= first:
            continue
        past = [u[first - i : n - i, None] for i in range(1, own + 1)] + [np.ones((n - first, 1))]
        # a controller sees the reading of the row itself before it acts; a mean over the row's seconds has
        # seen what the input did in them
        late = int(grid.dt > 1.5 * grid.native)
        past += [segment.y[first - i : n - i] for i in range(late, late + others)]
        whole = np.all([np.isfinite(segment.y[first - i : n - i]).all(axis=1) for i in range(4)], axis=0)
        rows.append(np.hstack(past)[whole])
        target.append(u[first:][whole])
    if not rows:
        return np.empty((0, 1)), np.empty(0)
    return np.concatenate(rows), np.concatenate(target)


def _squares(X: Array, v: Array) -> float:
    return float(np.sum((v - X @ np.linalg.lstsq(X, v, rcond=None)[0]) ** 2))


def _bic(X: Array, v: Array) -> float:
    """Return the Bayesian information criterion of a regression; infinite where rows are too few."""
    n, k = X.shape
    return float(n * np.log(max(_squares(X, v) / n, 1e-300)) + k * np.log(n)) if n > 3 * k else np.inf


def _unit_suffix(unit: str) -> str:
    """Return what follows a number."""
    return "" if unit == "1" else f" {unit}"


def reading_excess(logs: Sequence[Rows], outputs: Sequence[str], seconds: float) -> dict[str, float]:
    """Return by how much a reading lies off the mean of its bin by noise alone, by output, in its unit; in
    bins of infinite length that is its white noise."""
    within = [max(0.0, 1.0 - rows.step / seconds) for rows in logs]
    out = {}
    for k, name in enumerate(outputs):
        second_differences = []
        for rows, share in zip(logs, within):
            steps = np.diff(rows.time)
            even = steps < 1.5 * np.median(steps)  # readings that follow each other without a gap
            second_differences.append(share * np.diff(rows.y[:, k], n=2)[even[1:] & even[:-1]] ** 2)
        squares = np.concatenate(second_differences)
        squares = squares[np.isfinite(squares)]
        out[name] = float(np.sqrt(squares.mean() / 6)) if squares.size else 0.0
    return out


@dataclass(frozen=True)
class Evidence:
    """What the logs of a fit cover."""

    ranges: dict[str, tuple[float, float]]  # of inputs and outputs in the logs (1st and 99th percentile)
    minutes: dict[str, float]  # minutes of each kind of drive, such as ``"drive < 0"`` or ``"pump off"``
    total: float  # minutes of all logs together
    thin: tuple[str, ...]  # the kinds that rest on little

    def sentence(self, units: dict[str, str]) -> str:
        """Return it in words, for a verdict."""
        ranges = ", ".join(
            f"{name} between {low:.3g} and {high:.3g} {units.get(name, '1')}".removesuffix(" 1")
            for name, (low, high) in self.ranges.items()
        )
        clauses = [f"The logs cover {ranges} (98 % of the readings)"]
        for kind in self.thin:
            minutes = self.minutes[kind]
            clauses.append(
                f"{kind} rests on {minutes:.0f} of {self.total:.0f} minutes"
                if minutes
                else f"{kind} never occurs"
            )
        return "; ".join(clauses)


def evidence(plant: Plant, logs: Sequence[Rows]) -> Evidence:
    """Return what ``logs``, in the plant's signals, cover: what is rare weighs little in its errors."""
    spent = []  # seconds that each row's input was held; beyond a gap it is unknown
    for rows in logs:
        until_next = np.append(np.diff(rows.time), rows.step)
        spent.append(np.minimum(until_next, max(GAP_SECONDS, GAP_STEPS * rows.step)))
    total = float(sum(seconds.sum() for seconds in spent)) / 60
    minutes: dict[str, float] = {}
    thin = []
    for k, name in enumerate(plant.inputs):
        values = [rows.u[:, k] for rows in logs]
        kinds = _kinds(name, values, on_off=name in plant.model.switches)
        for kind, chosen in kinds.items():
            minutes[kind] = float(sum(seconds[mask].sum() for seconds, mask in zip(spent, chosen))) / 60
            if minutes[kind] < min(_CHECKS.thin_minutes, _CHECKS.thin_share * total):
                thin.append(kind)
    ranges = {}
    u, y = (np.concatenate([getattr(rows, group) for rows in logs]) for group in ("u", "y"))
    for name, values in (*zip(plant.inputs, u.T), *zip(plant.outputs, y.T)):
        if name not in plant.model.switches:
            low, high = np.nanpercentile(values, [1, 99])
            ranges[name] = (float(low), float(high))
    return Evidence(ranges, minutes, total, tuple(thin))


def _kinds(name: str, values: Sequence[Array], *, on_off: bool) -> dict[str, list[Mask]]:
    """Return the kinds of drive of an input and which rows are of each."""
    if on_off:
        return {f"{name} on": [v > 0.5 for v in values], f"{name} off": [v <= 0.5 for v in values]}
    low, high = min(float(np.nanmin(v)) for v in values), max(float(np.nanmax(v)) for v in values)
    small = _CHECKS.small_drive * max(abs(low), abs(high))
    if low < -small:  # an input that goes both ways, such as a Peltier behind an H bridge
        return {f"{name} > 0": [v > small for v in values], f"{name} < 0": [v < -small for v in values]}
    middle = (low + high) / 2
    return {
        f"{name} above {middle:.3g}": [v > middle for v in values],
        f"{name} below {middle:.3g}": [v <= middle for v in values],
    }
