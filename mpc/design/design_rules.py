"""What a design must be before it may close a loop: every field, against the plant that it is for.

A controller's file can be edited, cut short, or written for another plant.  Whatever is in it, either the
loop does what the file says or one line says which field cannot be: nothing is rounded, clipped or left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from numbers import Real
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.limits import LARGEST
from thermogrip.mpc.plant.drives import drive_names, drive_range

if TYPE_CHECKING:
    from thermogrip.mpc.design.design import Design
    from thermogrip.sysid.plant.plant import Plant

__all__ = ["LONGEST_HORIZON", "MOST_UNKNOWNS", "check_design"]

#: Samples of a horizon, and block values of a plan; more are hours of work a sample, not a better loop.
LONGEST_HORIZON, MOST_UNKNOWNS = 1000, 200

_LONGEST_SAMPLE = 3600.0  # s
_MOST_NOISE = 1e6  # of a state, a reading or a bias, in any unit
_ROOMS = (-60.0, 150.0)  # degC: no room is beyond


def check_design(design: Design, plant: Plant) -> Design:
    """Return the design as it is, or raise :class:`UserError` naming the field that cannot be.

    Parameters
    ----------
    design : Design
    plant : Plant
        Whose names, ranges and step it must fit.

    Examples
    --------
    >>> from dataclasses import replace
    >>> from thermogrip.mpc.design.design import default_design
    >>> from thermogrip.sysid import Plant
    >>> from thermogrip.sysid.models.state_space import StateSpaceModel
    >>> model = StateSpaceModel(("q",), (), ("t",), A=[[0.95]], B=[[2.0]], C=[[1.0]], dt=5.0, y0=[25.0])
    >>> plant = Plant(model, {}, dt=5.0, units={"q": "1"}, valid={"q": (0.0, 1.0)})
    >>> design = default_design(plant)
    >>> try:
    ...     check_design(replace(design, dt=7.0), plant)
    ... except UserError as error:
    ...     print(error.problem)
    dt is 7 s, no multiple of the plant's step of 5 s
    """
    drives = drive_names(plant)
    for what, values in _numbers_of(design):
        for value in values:
            if isinstance(value, bool) or not isinstance(value, Real) or not np.isfinite(float(value)):
                _refuse(f"{what} must be a finite number, not {value!r}")
            if abs(float(value)) > LARGEST:
                _refuse(f"{what} is {float(value):g}, beyond {LARGEST:g}")
    _check_time(design, plant)
    _check_outputs(design, plant)
    _check_drives(design, plant, drives)
    _check_loops(design, drives)
    _check_weights(design)
    return design


def _refuse(problem: str) -> NoReturn:
    raise UserError(problem, mend="mend the spec or tune again")


def _numbers_of(design: Design) -> Iterator[tuple[str, Sequence[Any]]]:
    """Yield each field that holds numbers, with them."""
    single = ("dt", "track", "terminal", "move", "drive", "overshoot", "price", "ambient")
    for name in (*single, "deadline_s", "patience_s"):
        yield name, (getattr(design, name),)
    for name, ends in design.drive_range.items():
        yield f"drive_range of {name}", ends
    for name, ends in design.limits.items():
        yield f"limits of {name}", ends
    for name, value in design.slew_per_s.items():
        yield f"slew_per_s of {name}", (value,)
    for loop in design.loops:
        yield f"the PI of {loop.output}", (loop.Kc, loop.Ti, loop.Tt, loop.feedforward)
    for name, value in vars(design.noise).items():
        yield f"noise: {name}", (value,)


def _check_time(design: Design, plant: Plant) -> None:
    steps = design.dt / plant.dt
    if not design.dt > 0 or abs(steps - round(steps)) > 1e-6 * steps:
        _refuse(f"dt is {design.dt:g} s, no multiple of the plant's step of {plant.dt:g} s")
    if design.dt > _LONGEST_SAMPLE:
        _refuse(f"dt is {design.dt:g} s, longer than the {_LONGEST_SAMPLE:g} s of a sample")
    if not design.blocks or min(design.blocks) < 1:
        _refuse("blocks must be whole numbers from 1")
    if sum(design.blocks) > LONGEST_HORIZON:
        _refuse(f"blocks sum to {sum(design.blocks)} samples, more than the {LONGEST_HORIZON} of a horizon")
    if design.move_delay not in (0, 1):
        _refuse("move_delay must be 0 or 1")
    if not isinstance(design.offset_free, bool):
        _refuse("offset_free must be true or false")
    if min(design.deadline_s, design.patience_s) < 0:
        _refuse("deadline_s and patience_s must be >= 0")
    if not _ROOMS[0] <= design.ambient <= _ROOMS[1]:
        _refuse(f"ambient is {design.ambient:g} degC, which is no room")


def _check_outputs(design: Design, plant: Plant) -> None:
    if not design.controlled:
        _refuse("controlled names no output")
    for name in design.controlled:
        if name not in plant.outputs:
            _refuse(f"controlled: the plant has no output {name}")
        if design.controlled.count(name) > 1:
            _refuse(f"controlled names {name} twice")
    for name, (low, high) in design.limits.items():
        if name not in plant.outputs:
            _refuse(f"limits: the plant has no output {name}")
        if not low < high:
            _refuse(f"limits of {name} are {low:g} to {high:g}, which is empty")


def _check_drives(design: Design, plant: Plant, drives: Sequence[str]) -> None:
    if len(design.blocks) * len(drives) > MOST_UNKNOWNS:
        _refuse(f"{len(design.blocks)} blocks of {len(drives)} drives are more than {MOST_UNKNOWNS} unknowns")
    for key, given in (("drive_range", design.drive_range), ("slew_per_s", design.slew_per_s)):
        unknown = [name for name in given if name not in drives]
        if unknown:
            _refuse(f"{key}: the plant has no drive {unknown[0]}")
    for name in drives:
        if name not in design.drive_range or name not in design.slew_per_s:
            _refuse(f"drive_range, slew_per_s: nothing for drive {name}")
        low, high = design.drive_range[name]
        if not low < high:
            _refuse(f"drive_range of {name} is {low:g} to {high:g}, which is empty")
        least, most = drive_range(plant, name)
        if low < least - 1e-9 or high > most + 1e-9:
            _refuse(f"drive_range of {name} is {low:g} to {high:g}, beyond the drive's {least:g} to {most:g}")
        if not design.slew_per_s[name] > 0:
            _refuse(f"slew_per_s of {name} must be > 0")


def _check_loops(design: Design, drives: Sequence[str]) -> None:
    for at, loop in enumerate(design.loops):
        if loop.drive not in drives or loop.output not in design.controlled:
            _refuse(f"loops: {loop.output} by {loop.drive} is no pair of a regulated output and a drive")
        if any(loop.drive == other.drive or loop.output == other.output for other in design.loops[:at]):
            _refuse(f"loops: {loop.output} by {loop.drive} is there twice")
        if loop.Ti <= 0 or loop.Tt <= 0:
            _refuse(f"loops: Ti and Tt of {loop.output} must be > 0")


def _check_weights(design: Design) -> None:
    if min(design.track, design.move) <= 0 or min(design.terminal, design.drive, design.price) < 0:
        _refuse("weights: track and move must be > 0, the others >= 0")
    if design.overshoot < 0:
        _refuse("overshoot must be >= 0")
    if min(vars(design.noise).values()) < 0:
        _refuse("noise: a standard deviation must be >= 0")
    if max(vars(design.noise).values()) > _MOST_NOISE:
        _refuse(f"noise: a standard deviation must be <= {_MOST_NOISE:g}")
