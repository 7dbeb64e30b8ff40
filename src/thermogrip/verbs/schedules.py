"""A schedule that fits a plant: its drives, ranges and time constants, and temperatures that stay in bounds.

The amplitude is the largest share of each drive's range, about a mean that holds the plant in the middle of
the allowed temperatures, for which the simulated outputs stay inside; it is found by bisection, since
hotter means more drive.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import column, make_log

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermogrip.datasets.schema import Log
    from thermogrip.sysid.plant import Plant

__all__ = ["schedule_for"]

ROOM = 25.0  # degC
HALVINGS = 12


def schedule_for(
    plant: Plant, kind: str, minutes: float, *, lowest: float, highest: float, seed: int
) -> tuple[Log, float]:
    """Return a schedule for every drive of the plant, and the share of the drives' ranges that it uses.

    Parameters
    ----------
    plant : Plant
    kind : str
        As for :func:`thermogrip.sysid.excite.excite`.
    minutes : float
    lowest, highest : float
        Where every output must stay in simulation from a room of 25 degC [degC].
    seed : int

    Raises
    ------
    UserError
        If not even a fiftieth of the range stays inside.
    """
    from thermogrip.mpc.prediction import drive_range, step_response
    from thermogrip.sysid.excite import excite

    switches = tuple(plant.model.switches)
    drives = [name for name in plant.inputs if name not in switches]
    ranges = {name: drive_range(plant, name) for name in drives}
    shapes: dict[str, NDArray[np.float64]] = {}
    time = np.zeros(0)
    for k, name in enumerate(drives):
        answers = [step_response(plant, name, output) for output in plant.outputs]
        best = max(answers, key=lambda answer: abs(answer.gain))
        fast = max(best.delay, best.lag / 20, 2 * plant.dt)
        slow = max(best.lag, 2 * fast)
        log = excite(kind, minutes, dt=plant.dt, tau_fast=fast, tau_slow=slow, seed=seed + k)
        shapes[name], time = column(log, "drive"), np.asarray(log["time"].values, dtype=float)
    share, drive = _largest(plant, shapes, ranges, time, lowest, highest)
    variables = {name: (drive[name], plant.units.get(name, "1"), "input") for name in drives}
    variables |= {name: (np.ones(time.size), "1", "input") for name in switches}
    return make_log(time, variables, name=f"{kind} schedule"), share


def _largest(
    plant: Plant,
    shapes: dict[str, NDArray[np.float64]],
    ranges: dict[str, tuple[float, float]],
    time: NDArray[np.float64],
    lowest: float,
    highest: float,
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
        y = _outputs(plant, scaled(share), time.size)
        return bool(np.all(np.isfinite(y)) and y.min() >= lowest and y.max() <= highest)

    low, high = 0.0, 1.0
    if stays(1.0):
        return 1.0, scaled(1.0)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stays(middle) else (low, middle)
    if low < 0.02:
        raise UserError(
            f"no schedule keeps the plant from {lowest:g} to {highest:g} degC",
            mend="widen --lowest and --highest",
        )
    return low, scaled(low)


def _outputs(plant: Plant, drive: dict[str, NDArray[np.float64]], n: int) -> NDArray[np.float64]:
    """Return the simulated outputs (n + 1, n_y), from rest in the room, switches on."""
    u = np.ones((1, n, len(plant.inputs)))
    for k, name in enumerate(plant.inputs):
        if name in drive:
            u[0, :, k] = drive[name]
    room = np.full(len(plant.disturbances), ROOM)
    still = np.where([name in drive for name in plant.inputs], 0.0, 1.0)
    start = plant.model.rest(np.full(len(plant.outputs), ROOM), still, room, plant.p)
    d = np.broadcast_to(room, (1, n, room.size))
    y, _ = plant.model.rollout(start[None], u, np.ascontiguousarray(d), plant.p[None], plant.dt)
    return np.asarray(y[0])
