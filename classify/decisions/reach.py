"""How long a gripper takes to another temperature, by its identified plant.

Full drive in either direction, pump on, from rest at the present temperature: the plant's free run says when
the skin first passes a temperature.  A controller that settles takes a little longer; one that is tuned for
time comes close (the tuning report shows both).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, make_log

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant

__all__ = ["by_plant"]

Floats = NDArray[np.float64]

_REST = 10.0  # s at the present temperature, of which the plant takes its state


def by_plant(
    plant: Plant, now: float, *, t_ambient: float, output: str = "t_surface", longest: float = 900.0
) -> Callable[[float], float]:
    """Return the time [s] from temperature ``now`` to another, for ``choose_next_touch(seconds=...)``.

    Parameters
    ----------
    plant : Plant
        Its inputs are ``drive``, between the limits that it is valid in, and switches, which are on.
    now, t_ambient : float
        Of the skin and of the room [degC].
    output : str, optional
        The skin's sensor.
    longest : float, optional
        What takes longer is never reached: infinity [s].

    Raises
    ------
    UserError
        If the plant has no such output, or no input ``drive``.
    """
    for name, there in ((output, plant.outputs), ("drive", plant.inputs)):
        if name not in there:
            raise UserError(f"the plant has no {name!r}", hint=f"it has {', '.join(there)}")
    low, high = plant.valid.get("drive", (-1.0, 1.0))
    up, down = (_passed(plant, now, t_ambient, output, longest, drive) for drive in (high, low))

    def seconds(there: float) -> float:
        time, skin = up if there > now else down
        past = skin >= there if there > now else skin <= there
        if abs(there - now) < 1e-9:
            return 0.0
        return float(time[int(past.argmax())]) if past.any() else np.inf

    return seconds


def _passed(
    plant: Plant, now: float, t_ambient: float, output: str, longest: float, drive: float
) -> tuple[Floats, Floats]:
    """Return times [s] and the skin's temperature under one drive."""
    run = plant.simulate(_log(plant, now, t_ambient, longest, drive), warmup=_REST)
    time = np.asarray(run["time"].values, dtype=float) - _REST
    after = time >= 0
    return time[after], np.asarray(run[output].values, dtype=float)[after]


def _log(plant: Plant, now: float, t_ambient: float, longest: float, drive: float) -> Log:
    time = np.arange(0.0, _REST + longest, max(plant.dt, 0.5))
    rest = time < _REST
    columns: dict[str, Any] = {}
    for name in plant.inputs:
        values = np.where(rest, 0.0, drive) if name == "drive" else np.ones(time.size)
        columns[name] = (values, "1", "input")
    for name in plant.disturbances:
        columns[name] = (np.full(time.size, t_ambient), "degC", "disturbance")
    for name in plant.outputs:
        columns[name] = (np.full(time.size, now), "degC", "output")
    return make_log(time, columns, name="reach")
