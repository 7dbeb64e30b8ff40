"""Schedules that fit a plant: its drives, ranges and time constants, and temperatures that stay in bounds.

The amplitude of a plain schedule is the largest share of each drive's range, about a mean that holds the
plant in the middle of the allowed temperatures, for which the simulated outputs of the plant and of draws
of its parameters stay inside; it is found by bisection, since hotter means more drive.  The optimal one
starts from these.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

import numpy as np

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import column, make_log

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermogrip.datasets.schema import Log
    from thermogrip.report.console import Progress
    from thermogrip.sysid.experiment.information import ExperimentForecast
    from thermogrip.sysid.experiment.optimal import Expectation
    from thermogrip.sysid.plant.plant import Plant

__all__ = ["expected_rows", "optimal_for", "schedule_for"]

HALVINGS = 12


def schedule_for(
    plant: Plant, kind: str, minutes: float, *, lowest: float, highest: float, seed: int
) -> tuple[Log, float]:
    """Return a schedule for every drive of the plant, and the share of the drives' ranges that it uses.

    Parameters
    ----------
    plant : Plant
    kind : str
        As for :func:`thermogrip.sysid.experiment.schedules.excite`.
    minutes : float
    lowest, highest : float
        Where every output in degC must stay in simulation from a room of 25 degC, also with eight draws
        of the parameters where the plant knows their uncertainty [degC].
    seed : int

    Raises
    ------
    UserError
        If not even a fiftieth of the range stays inside.
    """
    from thermogrip.sysid.experiment.information import ExperimentForecast
    from thermogrip.sysid.experiment.schedules import excite

    ranges = _ranges(plant)
    shapes: dict[str, NDArray[np.float64]] = {}
    time = np.zeros(0)
    for k, (name, (fast, slow)) in enumerate(_time_constants(plant).items()):
        log = excite(kind, minutes, dt=plant.dt, tau_fast=fast, tau_slow=slow, seed=seed + k)
        shapes[name], time = column(log, "drive"), np.asarray(log["time"].values, dtype=float)
    forecast = ExperimentForecast(plant, lowest=lowest, highest=highest)
    share, drive = _largest(forecast, shapes, ranges, time)
    variables = {name: (drive[name], plant.units.get(name, "1"), "input") for name in ranges}
    variables |= {name: (np.ones(time.size), "1", "input") for name in plant.model.switches}
    return make_log(time, variables, name=f"{kind} schedule"), share


def optimal_for(
    plant: Plant,
    minutes: float,
    *,
    lowest: float,
    highest: float,
    slew: float,
    hold: Collection[str] = (),
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[Log, Expectation, list[str]]:
    """Return the most informative schedule, what it and the plain ones are expected to tell, and notes.

    Parameters
    ----------
    plant : Plant
        With a covariance.
    minutes, lowest, highest, seed
        As for :func:`schedule_for`.
    slew : float
        Greatest change of a drive in a second, in its unit; the plain schedules are compared without it.
    hold : collection of str, optional
        Inputs that do not move.
    progress : callable, optional

    Raises
    ------
    UserError
        If the plant has no covariance, or no schedule keeps the limits.
    """
    from thermogrip.sysid.experiment.optimal import expect, optimal_schedule
    from thermogrip.sysid.experiment.schedules import KINDS

    if plant.covariance is None:
        raise UserError(
            "the plant has no covariance, so no schedule can be called the best for it",
            hint="identify a network, or start from its priors with --network",
        )
    plain: dict[str, Log] = {}
    notes = []
    for kind in KINDS:
        try:
            plain[kind], _ = schedule_for(plant, kind, minutes, lowest=lowest, highest=highest, seed=seed)
        except UserError as error:
            notes.append(f"no {kind} to compare with: {error.problem}")
    ranges = _ranges(plant)
    narrowest = min(high - low for low, high in ranges.values())
    best = optimal_schedule(
        plant,
        minutes,
        ranges=ranges,
        begin=plain if not np.isfinite(slew) else None,
        shortest=min(fast for fast, _ in _time_constants(plant).values()),
        lowest=lowest,
        highest=highest,
        slew=slew / narrowest,
        hold=hold,
        seed=seed,
        progress=progress,
    )
    return best, expect(plant, plain | {"optimal": best}), notes


def expected_rows(plant: Plant, expected: Expectation) -> tuple[list[str], list[list[object]]]:
    """Return head and rows of the table of interval widths before and after each schedule; last the range of
    the last."""
    kinds = list(expected.widths)
    ranges = expected.ranges.get(kinds[-1], {})
    head = ["parameter", "unit", "value", *kinds, *(["from", "to"] if ranges else [])]
    rows: list[list[object]] = []
    for name in plant.free:
        widths = [expected.widths[kind][name] for kind in kinds]
        rows.append([name, plant.units.get(name, "1"), plant.values[name], *widths, *ranges.get(name, ())])
    return head, rows


def _ranges(plant: Plant) -> dict[str, tuple[float, float]]:
    from thermogrip.mpc.plant.prediction import drive_names, drive_range

    return {name: drive_range(plant, name) for name in drive_names(plant)}


def _time_constants(plant: Plant) -> dict[str, tuple[float, float]]:
    """Return the fast and the slow time constant [s] to excite by each drive."""
    from thermogrip.mpc.plant.prediction import step_response

    out = {}
    for name in _ranges(plant):
        answers = [step_response(plant, name, output) for output in plant.outputs]
        best = max(answers, key=lambda answer: abs(answer.gain))
        fast = max(best.delay, best.lag / 20, 2 * plant.dt)
        out[name] = (fast, max(best.lag, 2 * fast))
    return out


def _largest(
    forecast: ExperimentForecast,
    shapes: dict[str, NDArray[np.float64]],
    ranges: dict[str, tuple[float, float]],
    time: NDArray[np.float64],
) -> tuple[float, dict[str, NDArray[np.float64]]]:
    """Return the largest share whose simulated outputs stay inside, and the drives."""

    def scaled(share: float) -> dict[str, NDArray[np.float64]]:
        out = {}
        for name, (low, high) in ranges.items():
            # a drive that cannot go below zero swings about half of its share, one of both signs about zero
            middle = share * 0.5 * (low + high) if low >= 0 else 0.0
            reach = share * 0.5 * (high - low) if low >= 0 else share * min(-low, high)
            out[name] = middle + reach * shapes[name]
        return out

    def stays(share: float) -> bool:
        drive = scaled(share)
        u = np.ones((time.size, len(forecast.plant.inputs)))
        for k, name in enumerate(forecast.plant.inputs):
            if name in drive:
                u[:, k] = drive[name]
        return forecast.stays(u)

    low, high = 0.0, 1.0
    if stays(1.0):
        return 1.0, scaled(1.0)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stays(middle) else (low, middle)
    if low < 0.02:
        raise UserError(
            f"no schedule keeps the plant from {forecast.lowest:g} to {forecast.highest:g} degC",
            hint="widen --lowest and --highest",
        )
    return low, scaled(low)
