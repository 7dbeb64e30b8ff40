"""The input schedule that shrinks a plant's posterior most, inside its limits.

Schedules are lists of cells of equal length, one level per input in each.  Starting from the best constant, a
search exchanges one block of cells of random length after the other, for one level or for two in turn, and
keeps what gains information (:mod:`thermogrip.sysid.experiment.information`) without leaving the limits.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

import numpy as np

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.parallel import Progress
from thermogrip.datasets.schema import Log, column, make_log
from thermogrip.sysid.experiment.information import ExperimentForecast, interval_widths
from thermogrip.sysid.experiment.schedules import REST
from thermogrip.sysid.plant.plant import Plant

EVALUATIONS = 1500


@dataclass(frozen=True)
class SearchSettings:
    """The grid and the margins of the search."""

    most_cells: int = 240  # of a schedule
    steps: int = 800  # of a simulation, about
    margin: float = 0.2  # [K] inside the limits while the step is coarse
    halvings: int = 10  # of a schedule that leaves the limits: to 0.1 %
    coarse_halvings: int = 5  # of the ones to begin with: to 3 %
    switch_hold_s: float = 30.0  # in each position: a pump is not made to stutter


SEARCH = SearchSettings()


@dataclass(frozen=True, eq=False)
class Expectation:
    """Expected information of schedules, before any is run."""

    bits: dict[str, float]  # gain of information by schedule; 0 for ``now``
    widths: dict[str, dict[str, float]]  # of each parameter's 90 % interval in natural units, by schedule

    def narrower(self, kind: str, than: str) -> float:
        """Return the factor by which intervals are expected to narrow, a geometric mean over directions."""
        n = len(self.widths[than])
        return float(2.0 ** ((self.bits[kind] - self.bits[than]) / n))


def expect(plant: Plant, schedules: Mapping[str, Log]) -> Expectation:
    """Return what each schedule is expected to leave of a plant's uncertainty, from rest at 25 degC; a
    UserError where the plant has no covariance, or a schedule, on the plant's step, lacks an input."""
    forecast = ExperimentForecast(plant, draws=0)
    inputs = {name: inputs_of(plant, log) for name, log in schedules.items()}
    bits = {"now": 0.0} | {name: forecast.bits(u) for name, u in inputs.items()}
    covariance = np.asarray(plant.covariance)
    widths = {"now": interval_widths(plant, covariance)}
    widths |= {name: interval_widths(plant, forecast.covariance(u)) for name, u in inputs.items()}
    return Expectation(bits, widths)


def inputs_of(plant: Plant, log: Log) -> Array:
    """Return the inputs (N, n_u) of a schedule in the plant's order, a switch that is absent on."""
    out = np.ones((log.sizes["time"], len(plant.inputs)))
    for k, name in enumerate(plant.inputs):
        if name in log:
            out[:, k] = column(log, name)
        elif name not in plant.model.switches:
            raise UserError("the schedule has no such input", column=name, hint="make it for this plant")
    return out


def optimal_schedule(
    plant: Plant,
    minutes: float,
    *,
    ranges: Mapping[str, tuple[float, float]],
    shortest: float = 10.0,
    lowest: float = -np.inf,
    highest: float = np.inf,
    slew: float = np.inf,
    hold: Collection[str] = (),
    seed: int = 0,
    evaluations: int | None = None,
    progress: Progress | None = None,
) -> Log:
    """Return the schedule expected to gain most information, a row every ``plant.dt``.

    ``ranges``, ``shortest`` seconds between changes of an input, ``slew`` shares of its range in a second and
    the outputs' ``lowest`` and ``highest``, of the plant and of eight draws, are hard. Inputs on ``hold``
    stay as at the start, in a room of 25 degC: a switch on, any other at 0 or what is nearest to it.
    """
    if set(plant.inputs) <= set(hold) or not set(hold) <= set(plant.inputs):
        raise UserError(
            f"cannot hold {', '.join(hold)}", hint=f"leave one of {', '.join(plant.inputs)} to move"
        )
    frame = _Frame(plant, minutes, ranges, shortest, slew, hold)
    report = progress or (lambda fraction, what: None)
    fine = ExperimentForecast(plant, lowest=lowest, highest=highest)
    coarse = ExperimentForecast(plant, lowest=lowest, highest=highest, dt=frame.dt)
    cells = _search_cells(frame, coarse, seed, evaluations or EVALUATIONS, report)
    report(0.97, "checking the limits")
    # limits kept at the search's step are checked at the plant's own: shrunk towards the start's level until
    # they are
    within, _ = _shrunk(
        frame, lambda cells: fine.evaluate(frame.inputs(cells, coarse=False)), cells, SEARCH.halvings
    )
    best = frame.inputs(within, coarse=False)
    if not fine.stays(best):
        raise UserError(
            f"no schedule keeps the plant and {fine.n_draws} draws of it from {lowest:g} to {highest:g} degC",
            hint="widen --lowest and --highest",
        )
    report(1.0, "found")
    time = plant.dt * np.arange(frame.n)
    columns = {name: (best[:, k], plant.units.get(name, "1"), "input") for k, name in enumerate(plant.inputs)}
    return make_log(time, columns, name="optimal schedule")


class _Frame:
    """How cells become inputs: n steps of the plant, cells of ``cell`` coarse steps, the ranges."""

    def __init__(
        self,
        plant: Plant,
        minutes: float,
        ranges: Mapping[str, tuple[float, float]],
        shortest: float,
        slew: float,
        hold: Collection[str],
    ) -> None:
        self.n, self.slew = round(60.0 * minutes / plant.dt), slew
        self.rest = int(np.ceil(REST / plant.dt))  # steps of the plant before the first cell
        if self.n < self.rest + 10:
            least = (self.rest + 10) * plant.dt / 60
            raise UserError(f"{minutes:g} min are too short", hint=f"take {least:.1f}")
        cell = max(shortest, 60.0 * minutes / SEARCH.most_cells, plant.dt)
        self.ratio = max(1, min(self.n // SEARCH.steps, int(cell / plant.dt / 2)))  # of the plant in a step
        self.dt = self.ratio * plant.dt  # of the search [s]
        self.cell = max(1, round(cell / self.dt))  # steps of the search in a cell
        self.n_cell = max(1, -(-(self.n - self.rest) // (self.ratio * self.cell)))
        switch = np.array([name in plant.model.switches for name in plant.inputs])
        ends = [(0.0, 1.0) if s else ranges[name] for name, s in zip(plant.inputs, switch)]
        low, high = np.array(ends, dtype=float).T
        self.still = np.where(switch, 1.0, np.clip(0.0, low, high))
        is_held = np.array([name in hold for name in plant.inputs])
        self.low, self.high = np.where(is_held, self.still, low), np.where(is_held, self.still, high)
        self.switch: Mask = switch & ~is_held
        if not np.any(self.low < self.high):
            raise UserError("no input has a range to move in", hint="give limits that differ")
        # cells that change as one, by input
        self.together = np.where(
            self.switch, max(1, int(np.ceil(SEARCH.switch_hold_s / (self.cell * self.dt)))), 1
        )

    def inputs(self, cells: Array, *, coarse: bool) -> Array:
        """Return the inputs (N, n_u) of cells (n_cell, n_u), on the search's step or on the plant's."""
        steps_each, rest_steps = (1, -(-self.rest // self.ratio)) if coarse else (self.ratio, self.rest)
        n = -(-self.n // self.ratio) if coarse else self.n
        rows = np.repeat(cells, self.cell * steps_each, axis=0)
        u = np.vstack([np.tile(self.still, (rest_steps, 1)), rows])[:n]
        if np.isfinite(self.slew):
            most = self.slew * self.dt / steps_each * np.where(self.switch, np.inf, self.high - self.low)
            for k in range(1, len(u)):
                u[k] = u[k - 1] + np.clip(u[k] - u[k - 1], -most, most)
        return u


def _search_cells(
    frame: _Frame, forecast: ExperimentForecast, seed: int, evaluations: int, report: Progress
) -> Array:
    """Return the best cells found."""

    def evaluate(cells: Array) -> float:
        return forecast.evaluate(frame.inputs(cells, coarse=True), margin=SEARCH.margin)

    # coordinate exchange of D-optimal design: R. K. Meyer, C. J. Nachtsheim, "The coordinate-exchange
    # algorithm for constructing exact optimal experimental designs", Technometrics 37(1), 1995
    rng = np.random.default_rng(seed)
    best, gain = np.tile(frame.still, (frame.n_cell, 1)), -np.inf
    # square waves beside these gained 1 % of the bits of two plants, and nothing of two
    for ends in (frame.still, frame.high, np.where(frame.switch, 1.0, frame.low)):
        shrunk, value = _shrunk(frame, evaluate, np.tile(ends, (frame.n_cell, 1)), SEARCH.coarse_halvings)
        if value > gain:
            best, gain = shrunk, value
    for k in range(evaluations):
        trial = _exchanged(frame, best, rng)
        value = evaluate(trial)
        if value > gain:
            best, gain = trial, value
        if k % 10 == 0:
            report(0.97 * k / evaluations, f"exchanging blocks, {gain:.1f} bits")
    return best


def _shrunk(
    frame: _Frame, evaluate: Callable[[Array], float], cells: Array, halvings: int
) -> tuple[Array, float]:
    """Return the cells, drawn towards rest as far as the limits ask, and their value; -inf if none do."""
    value = evaluate(cells)
    low = 0.0
    high = 1.0
    best = cells
    if np.isfinite(value):
        return cells, value
    for _ in range(halvings):
        share = 0.5 * (low + high)
        trial = np.where(frame.switch, cells, frame.still + share * (cells - frame.still))
        trial_value = evaluate(trial)
        if np.isfinite(trial_value):
            low = share
            best = trial
            value = trial_value
        else:
            high = share
    return best, value


def _exchanged(frame: _Frame, cells: Array, rng: np.random.Generator) -> Array:
    """Return the cells with one block of one input exchanged for one level, or for two in turn."""
    out, n = cells.copy(), frame.n_cell
    i = int(rng.choice(np.flatnonzero(frame.low < frame.high)))
    unit = int(frame.together[i])
    length = unit * int(np.ceil(np.exp(rng.uniform(0.0, np.log(max(n / (2 * unit), 1.0))))))
    first = unit * int(rng.integers(-(-n // unit)))
    block = np.arange(first, min(first + length, n))
    period = unit * int(rng.integers(1, max(2, block.size // (2 * unit)) + 1))
    levels = _random_level(frame, i, rng), _random_level(frame, i, rng)
    in_turn = rng.integers(3) == 0  # copies, shifts and stretched swings beside these two gained no bits
    out[block, i] = np.where(in_turn & ((block - first) // period % 2 == 1), levels[1], levels[0])
    return out


def _random_level(frame: _Frame, i: int, rng: np.random.Generator) -> float:
    """Return one end of the range more often than something between."""
    low, high = float(frame.low[i]), float(frame.high[i])
    if frame.switch[i]:
        return float(rng.integers(2))
    share = rng.choice([0.0, 1.0, 0.5, rng.random()], p=[0.35, 0.35, 0.1, 0.2])
    return low + float(share) * (high - low)
