r"""PI loops from a step response: Skogestad's rule (SIMC) and the pairing of drives with outputs.

With gain k, delay L and lag T of the step response,

    Kc = T / (k (tau_c + L)),   Ti = min(T, 4 (tau_c + L)),   tau_c = L   [1]_.

References
----------
.. [1] S. Skogestad, "Simple analytic rules for model reduction and PID controller tuning", Journal of Process
   Control 13(4), 2003.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from thermogrip.mpc.plant.drives import drive_names
from thermogrip.mpc.plant.prediction import PredictionModel, step_response

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant

__all__ = ["PILoop", "default_controlled", "pair_loops", "simc"]


@dataclass(frozen=True)
class PILoop:
    """One loop.

    Attributes
    ----------
    drive, output : str
        What it moves and what it controls.
    Kc : float
        Gain [drive units per degC].
    Ti, Tt : float
        Integral and anti-windup times [s].
    feedforward : float
        Share of the holding drive that is fed forward, 0 to 1.
    """

    drive: str
    output: str
    Kc: float
    Ti: float
    Tt: float
    feedforward: float = 1.0

    def to_dict(self) -> dict[str, Any]:
        """Return the loop as plain JSON."""
        return asdict(self)


def simc(plant: Plant, drive: str, output: str, *, tau_c: float | None = None) -> PILoop:
    """Return the SIMC tuning of one loop from the plant's step response.

    Parameters
    ----------
    plant : Plant
    drive, output : str
    tau_c : float, optional
        Wanted closed-loop lag [s]; the delay where absent, at least two steps of the plant.

    Raises
    ------
    ValueError
        If the drive does not move the output.

    Examples
    --------
    A heater with 40 K, 100 s and two steps of 5 s of delay: Kc is near 100 / (40 (10 + 10)) = 0.125:

    >>> import numpy as np
    >>> from thermogrip.sysid import Plant
    >>> from thermogrip.sysid.models.state_space import StateSpaceModel
    >>> a = float(np.exp(-0.05))
    >>> A = [[a, 0, 40 * (1 - a)], [0, 0, 0], [0, 1, 0]]
    >>> B, C = [[0], [1], [0]], [[1.0, 0, 0]]
    >>> block = StateSpaceModel(("q",), (), ("t",), A=A, B=B, C=C, dt=5.0, y0=[25.0])
    >>> loop = simc(Plant(block, {}, dt=5.0, units={"q": "1"}, valid={"q": (0.0, 1.0)}), "q", "t")
    >>> round(loop.Kc, 3), round(loop.Ti, 1)
    (0.132, 79.5)
    """
    model = PredictionModel(plant, dt=plant.dt)
    answer = step_response(plant, drive, output)
    if answer.gain == 0:
        raise ValueError(f"drive {drive} does not move {output}")
    delay = max(answer.delay, plant.dt)
    closed = max(delay, 2 * plant.dt) if tau_c is None else tau_c
    span = float(model.span[model.drives.index(drive)])
    Kc = span * answer.lag / (answer.gain * (closed + delay))
    Ti = min(answer.lag, 4 * (closed + delay))
    return PILoop(drive, output, Kc, Ti, Tt=Ti)


def default_controlled(plant: Plant) -> tuple[str, ...]:
    """Return what to control where nobody said: the skin, else the last outputs, one for each drive."""
    n_u = len(drive_names(plant))
    if n_u == 1 and "t_surface" in plant.outputs:
        return ("t_surface",)
    return tuple(plant.outputs[-n_u:])


def pair_loops(plant: Plant, controlled: tuple[str, ...]) -> tuple[PILoop, ...]:
    """Return one SIMC loop for each controlled output, on the drive of largest gain that is still free."""
    free = list(drive_names(plant))
    loops = []
    for output in controlled:
        gains = {drive: abs(step_response(plant, drive, output).gain) for drive in free}
        if not gains or max(gains.values()) == 0:
            continue
        drive = max(gains, key=lambda name: gains[name])
        free.remove(drive)
        loops.append(simc(plant, drive, output))
    return tuple(loops)
