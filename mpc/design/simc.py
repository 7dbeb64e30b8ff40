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

from thermogrip.mpc.plant.prediction import PredictionModel, drive_names, step_response

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant


@dataclass(frozen=True)
class PILoop:
    """One loop."""

    drive: str  # what it moves and what it controls
    output: str
    Kc: float  # gain [drive units per degC]
    Ti: float  # integral and anti-windup times [s]
    Tt: float
    feedforward: float = 1.0  # share of the holding drive that is fed forward, 0 to 1

    def to_dict(self) -> dict[str, Any]:
        """Return the loop as plain JSON."""
        return asdict(self)


def simc(plant: Plant, drive: str, output: str, *, tau_c: float | None = None) -> PILoop:
    """Return SIMC settings of one loop for a closed-loop time constant tau_c [s], by default the apparent
    delay; a drive that does not move the output is a ValueError.
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
