"""The interface of every controller: readings in, one Move out.

This module imports nothing heavy, so that the PI baseline, a session and a robot's loop can share it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

#: One sample: ``{"time_s": .., "t_tank": .., "t_surface": .., "t_ambient": ..}``, degC.  Without ``time_s``
#: a call is one sample time.
Readings: TypeAlias = Mapping[str, float]
#: degC by output name; a single number is the target of every controlled output.
Target: TypeAlias = float | Mapping[str, float]
#: The same, or by name the target now and those of the samples ahead, of which the last stays.
Trajectory: TypeAlias = float | Mapping[str, float | Sequence[float]]

#: Newest version of a controller's file, by the kind of controller.
FILE_VERSIONS = {"MPC": 1, "PI": 2}

STATUSES = ("ok", "late", "infeasible", "fallback_plan", "fallback_pi", "off", "mismatch")


@dataclass(frozen=True)
class Move:
    """A controller's answer to one reading; ``drive`` is a number where the plant has one input, else a dict.

    Attributes
    ----------
    drive : float or dict of str to float
        What to apply until the next step, inside range and slew limit: a number where the plant has one
        input, else a number by input.
    pump : int
        1 running, 0 off.
    status : str
        One of :data:`STATUSES`.
    advice : str
        One clause for the operator; empty while all is well.
    seconds : float
        Time that the step took [s].
    """

    drive: float | dict[str, float]
    pump: int = 1
    status: str = "ok"
    advice: str = ""
    seconds: float = 0.0

    def drives(self, names: Sequence[str]) -> list[float]:
        """Return what to apply in the order of these inputs; a pump among them that is switched has its own
        field."""
        pump = float(self.pump)
        if isinstance(self.drive, dict):
            given = {"pump": pump} | self.drive
            return [given[name] for name in names]
        one = float(self.drive)
        return [pump if name == "pump" and len(names) > 1 else one for name in names]


class Controller(Protocol):
    """``reset`` once at rest, then ``step`` at any rate; it never raises in the loop, a status says."""

    @property
    def dt(self) -> float:
        """Sample time [s]."""
        ...

    def reset(self, reading: Readings) -> None:
        """Forget the past; the plant is at rest at this reading."""
        ...

    def step(self, reading: Readings, target: Target) -> Move:
        """Return the move for this sample."""
        ...


class Regulator(Controller, Protocol):
    """A controller whose targets are those of named outputs."""

    @property
    def controlled(self) -> tuple[str, ...]:
        """Outputs with a target."""
        ...


def target_now(target: Trajectory) -> Target:
    """Return a target without what is ahead."""
    if not isinstance(target, Mapping):
        return target
    lines: Mapping[str, Any] = target
    return {name: next(iter(v), float("nan")) if is_line(v) else v for name, v in lines.items()}


def is_line(value: object) -> bool:
    """Return whether the target of an output is those of several samples, an array too."""
    return bool(getattr(value, "ndim", isinstance(value, (list, tuple))))


def number(reading: Mapping[str, float], name: str) -> float:
    """Return a number of a reading, NaN where it is missing or none."""
    try:
        return float(reading[name])
    except (KeyError, TypeError, ValueError):
        return float("nan")
