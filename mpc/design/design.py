r"""What a controller is made of, beside its plant: one frozen record in the user's units, and its file.

The cost over the horizon of N samples, with blocks b of the plan v, r the target, span the width of a drive:

    J = track sum_k |y_k - r|^2 + terminal |y_N - r|^2 + move sum_b |(v_b - v_b-1)/span|^2
        + drive sum_k |u_k/span|^2 + soft prices.

Temperatures count in degC, so ``move = 1`` means: one whole range in one sample costs as much as 1 degC
for one sample.  ``default_design`` reads everything off the plant: sample time and horizon from its delay
and lag, blocks that double from one sample on, and one move weight that the tuner then improves.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermogrip.datasets.errors import UserError
from thermogrip.mpc.controllers.pi import PILoop, default_controlled, pair_loops
from thermogrip.mpc.design.design_rules import check_design
from thermogrip.mpc.estimator.observer import ObserverNoise
from thermogrip.mpc.plant.drives import drive_names, drive_range
from thermogrip.mpc.plant.prediction import sample_time, step_response

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant

__all__ = ["Design", "check_design", "default_design", "make_blocks"]

SCHEMA, VERSION = "thermogrip.controller", 1


@dataclass(frozen=True)
class Design:
    """Everything that a controller is, but the plant.

    Attributes
    ----------
    dt : float
        Sample time [s].
    controlled : tuple of str
        Outputs with a target.
    blocks : tuple of int
        Samples in each block of the plan; their sum is the horizon.
    drive_range : dict of str to (float, float)
        What may be commanded, in the drive's units; hard.
    slew_per_s : dict of str to float
        Largest change of a drive [units per s]; hard.
    loops : tuple of PILoop
        The PI controller that stands in when the optimiser fails.
    track, terminal, move, drive : float
        Weights of the cost.
    overshoot : float
        Band beyond the target that the prediction keeps out of, on the far side [degC]; soft.
    limits : dict of str to (float, float)
        Ranges of outputs, e.g. the tank's [degC]; soft, at ``price`` per degC and per degC^2.
    price : float
    noise : ObserverNoise
    offset_free : bool
        Whether disturbance states are estimated; without them the loop ends off its target.
    move_delay : int
        Samples between a reading and the moment its move is applied: 0, or 1 where the computer is slow.
    ambient : float
        Room temperature where none is measured [degC].
    deadline_s : float
        Time allowed to a step [s].
    patience_s : float
        How long the plan is followed without a reading, or with a failing solver, before the next fallback
        [s]; of several controlled outputs, how long the model stands in for one that is lost.
    """

    dt: float
    controlled: tuple[str, ...]
    blocks: tuple[int, ...]
    drive_range: dict[str, tuple[float, float]]
    slew_per_s: dict[str, float]
    loops: tuple[PILoop, ...] = ()
    track: float = 1.0
    terminal: float = 10.0
    move: float = 1.0
    drive: float = 0.0
    overshoot: float = 0.15
    limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    price: float = 50.0
    noise: ObserverNoise = field(default_factory=ObserverNoise)
    offset_free: bool = True
    move_delay: int = 0
    ambient: float = 25.0
    deadline_s: float = 1.0
    patience_s: float = 10.0

    @property
    def horizon_s(self) -> float:
        """How far the prediction looks [s]."""
        return self.dt * sum(self.blocks)

    def to_dict(self) -> dict[str, Any]:
        """Return the design as plain JSON."""
        return json.loads(json.dumps(asdict(self)))  # type: ignore[no-any-return]  # a dict stays a dict

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Design:
        """Return the design that :meth:`to_dict` wrote; a missing or wrong field is a :class:`UserError`."""
        try:
            known = {entry.name for entry in fields(cls)}
            unknown = sorted(set(content) - known)
            if unknown:
                raise UserError(f"the design has no field {unknown[0]}", mend="tune the controller again")
            values = dict(content)
            values["controlled"] = tuple(str(name) for name in content["controlled"])
            values["blocks"] = tuple(int(length) for length in content["blocks"])
            values["loops"] = tuple(PILoop(**loop) for loop in content["loops"])
            values["noise"] = ObserverNoise(**content["noise"])
            for key in ("drive_range", "limits"):
                values[key] = {str(k): (float(v[0]), float(v[1])) for k, v in content[key].items()}
            return cls(**values)
        except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
            if isinstance(error, UserError):
                raise
            problem = f"is not a whole controller ({type(error).__name__}: {error})"
            raise UserError(problem, mend="tune the controller again") from error


def make_blocks(horizon: int, count: int) -> tuple[int, ...]:
    """Return the lengths of count blocks that sum to horizon samples, growing from 1.

    Examples
    --------
    >>> make_blocks(30, 6)
    (1, 2, 2, 5, 7, 13)
    >>> make_blocks(4, 9)
    (1, 1, 1, 1)
    """
    count = max(1, min(count, horizon))
    low, high = 1.0, 10.0
    for _ in range(60):  # the ratio of a geometric series with this sum
        ratio = 0.5 * (low + high)
        low, high = (ratio, high) if sum(ratio**k for k in range(count)) < horizon else (low, ratio)
    ends = np.round(np.cumsum([low**k for k in range(count)])).astype(int)
    ends[-1] = horizon
    lengths = np.diff(np.concatenate([[0], np.maximum.accumulate(ends)]))
    return tuple(sorted(int(length) for length in lengths if length > 0))


def default_design(
    plant: Plant, *, controlled: tuple[str, ...] | None = None, dt: float | None = None, **changes: Any
) -> Design:
    """Return a design read off the plant.

    Parameters
    ----------
    plant : Plant
    controlled : tuple of str, optional
        By default the skin, see :func:`thermogrip.mpc.controllers.pi.default_controlled`.
    dt : float, optional
        Sample time [s], rounded to the plant's step; by default a quarter of the delay.
    **changes
        Any field of :class:`Design` but these.

    Returns
    -------
    Design
        Horizon: eight apparent delays, but no more than the delay and three lags, between 20 and 80 samples.
    """
    controlled = default_controlled(plant) if controlled is None else tuple(controlled)
    for name in controlled:
        if name not in plant.outputs:
            raise UserError(f"the plant has no output {name}", mend=f"it has {', '.join(plant.outputs)}")
        unit = plant.units.get(name, "degC")
        if unit != "degC":
            raise UserError(
                f"{name} is in {unit}, and controllers here regulate temperatures",
                mend="name an output in degC in the spec: output = ...",
            )
    dt = max(1, round((sample_time(plant) if dt is None else dt) / plant.dt)) * plant.dt
    drives = drive_names(plant)
    ranges = {name: drive_range(plant, name) for name in drives}
    slews = {name: 0.125 * (high - low) for name, (low, high) in ranges.items()}
    looks = []
    for output in controlled:
        answers = [step_response(plant, drive, output) for drive in drives]
        best = max(answers, key=lambda answer: abs(answer.gain))
        if not np.isfinite(best.gain) or best.gain == 0:
            raise _unmoved(plant, output, finite=bool(np.isfinite(best.gain)))
        looks.append(min(max(8 * best.delay, 20 * dt), best.delay + 3 * best.lag))
    horizon = int(np.clip(np.ceil(max(looks) / dt), 20, 80))
    values: dict[str, Any] = {
        "dt": dt,
        "controlled": controlled,
        "blocks": make_blocks(horizon, 10),
        "drive_range": ranges,
        "slew_per_s": slews,
        "loops": pair_loops(plant, controlled),
        "deadline_s": 0.5 * dt,
        "patience_s": max(10.0, 5 * dt),
    }
    return check_design(replace(Design(**values), **changes), plant)


def _unmoved(plant: Plant, output: str, *, finite: bool) -> UserError:
    """Return the error about an output that no drive moves, or none to a finite value."""
    how = "moves" if finite else "has a finite effect on"
    low, high = plant.valid.get(output, (-np.inf, np.inf))
    # a black box knows nothing beyond its logs
    beyond = not low - 5 <= 25.0 <= high + 5
    where = f" at rest at 25 degC, where no log was ({low:.0f} to {high:.0f} degC)" if beyond else ""
    mend = (
        "identify it with logs that begin at rest" if beyond else "identify it with logs that move the drive"
    )
    return UserError(f"no drive {how} {output}{where}", mend=f"{mend}, or take another model")
