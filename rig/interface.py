"""The interface of every rig: the twin, a TCLab and our firmware behind one protocol.

A rig has a clock of its own (``Reading.time_s``); nothing above it sleeps or asks the computer's clock, so a
session runs on the twin much faster than on hardware, with the same lines.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

from thermogrip.datasets.errors import UserError

#: What a drive may be, by its unit.
UNIT_RANGES = {"1": (-1.0, 1.0), "percent": (0.0, 100.0), "0_255": (0.0, 255.0)}


def range_of(unit: str, seen: tuple[float, float] | None) -> tuple[float, float] | None:
    """Return what a drive may be: by its unit, else what the logs showed; a column without a unit may have
    been in percent."""
    usual = UNIT_RANGES.get(unit)
    if usual is not None and (unit != "1" or seen is None or -1.05 <= seen[0] <= seen[1] <= 1.05):
        return usual
    return seen


def known_range(name: str, unit: str, seen: tuple[float, float] | None, *, hint: str) -> tuple[float, float]:
    """Return what a drive may be, as of :func:`range_of`; UserError where nothing says it."""
    ends = range_of(unit, seen)
    if ends is None:
        raise UserError(f"the range of {name} [{unit}] is unknown", hint=hint)
    return ends


class DeviceRefusedError(Exception):
    """The device refuses a request: a code of the protocol's refusals, and the latched faults."""

    def __init__(self, code: str, reason: str, faults: tuple[str, ...] = ()) -> None:
        self.code, self.faults = code, faults
        latched = f" ({', '.join(faults)})" if faults else ""
        super().__init__(f"the device refuses: {reason}{latched}")


@dataclass(frozen=True)
class Reading:
    """One sample of every sensor.

    Attributes
    ----------
    time_s : float
        The rig's clock [s].
    values : mapping of str to float
        Temperatures by name [degC], e.g. ``t_tank``, ``t_surface``, ``t_ambient``; NaN where a sensor is
        lost.
    drive : mapping of str to float
        The drive that is applied, by input.
    pump : int
        1 running, 0 off.
    mean_drive : mapping of str to float, optional
        What was applied on average since the reading before, by input that is switched between two readings;
        None where none is.
    """

    time_s: float
    values: Mapping[str, float]
    drive: Mapping[str, float]
    pump: int
    mean_drive: Mapping[str, float] | None = None

    def as_controller_reading(self) -> dict[str, float]:
        """Return the flat dict that a controller's ``step`` takes."""
        return {"time_s": self.time_s, **self.values}


@dataclass(frozen=True)
class Event:
    """Something that happened: when [s, the rig's clock], of which kind, in words, and as data (JSON).

    Of the line or the device: ``link``, ``reset``, ``latched``, ``expired``, ``damaged``, ``repeated`` ...
    """

    time_s: float
    kind: str
    text: str
    data: Mapping[str, Any] = field(default_factory=dict)


def check_order(drive: Mapping[str, float], pump: int, ranges: Mapping[str, tuple[float, float]]) -> None:
    """Raise ValueError for an unknown input, a value outside its range, or a pump that is neither 0 nor 1."""
    if set(drive) != set(ranges):
        raise ValueError(f"drive has {sorted(drive)}, the rig's inputs are {sorted(ranges)}")
    for name, (low, high) in ranges.items():
        if not low <= drive[name] <= high:  # also false for NaN
            raise ValueError(f"{name} = {drive[name]:g} is outside {low:g} to {high:g}")
    if pump not in (0, 1):
        raise ValueError(f"pump = {pump} is neither 0 nor 1")


@runtime_checkable
class Rig(Protocol):
    """A rig that can be driven and read.  ``close`` switches everything off and may be called twice."""

    @property
    def units(self) -> Mapping[str, str]:
        """Units of the driven inputs, by name: ``"1"`` (-1...1), ``"percent"``, ``"0_255"``."""

    @property
    def expires_s(self) -> float:
        """How long a drive that is not renewed lasts on the device [s]; infinite where nothing ends it."""

    @property
    def has_pump(self) -> bool:
        """Whether there is a pump to switch; where there is none, none is recorded."""

    def read(self) -> Reading:
        """Return the newest sample."""

    def apply(self, drive: Mapping[str, float], pump: int) -> None:
        """Set drive (inside the input's range, else it raises) and pump until the next call, or for as long
        as a drive lives on the device (``expires_s``)."""

    def wait(self, seconds: float) -> None:
        """Let time pass; the twin simulates it, hardware waits."""

    def grasp(self, material: str, t_object: float) -> None:
        """Close the gripper on an object; time 0 of the grasp is now."""

    def release(self) -> None:
        """Open the gripper."""

    def notices(self) -> list[Event]:
        """Return what happened since the last call, and forget it."""

    def close(self) -> None:
        """Switch all power off and let the rig go."""
