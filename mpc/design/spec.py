"""What is wanted from a controller, in the user's units; read from TOML, every key with a default.

The template in :data:`SPEC_TEMPLATE` is the documentation: ``thermogrip init spec`` writes it.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from thermogrip.datasets.errors import UserError, known_names
from thermogrip.datasets.files import read_toml
from thermogrip.datasets.limits import LARGEST
from thermogrip.mpc.design.design import (
    Design,
    Finite,
    NotNegative,
    Positive,
    Range,
    check_design,
    default_controlled,
    default_design,
    problem_of,
)
from thermogrip.mpc.design.relays import Relay, pairs_of_drives
from thermogrip.mpc.plant.prediction import drive_names, drive_range, step_response

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant

SPEC_TEMPLATE = (files(__package__) / "spec.toml").read_text(encoding="utf-8")

#: Of a tank of water [degC]: 2 K inside of where the firmware switches off, for readings scatter about it.
_WATER = (4.0, 58.0)
_SAMPLES = 5  # of a step, at least
_LEAST_SEEN = 1.0  # range of the logs [degC] within which steps would be lost in the noise

Deviation = Annotated[float, Field(ge=-50, le=50, allow_inf_nan=False)]
Temperature = Annotated[float, Field(ge=-20, le=150, allow_inf_nan=False)]


def _both_ends(value: Any) -> Any:
    """Return both ends of a limit that may have one: ``{ max = 60 }``."""
    if not isinstance(value, dict):
        return value
    if not value or set(value) - {"min", "max"}:
        raise ValueError("write [low, high], { min = low } or { max = high }")
    return value.get("min", -LARGEST), value.get("max", LARGEST)


Ends = Annotated[Range, BeforeValidator(_both_ends)]


_SETTLED_BY = 0.75  # of a step that is simulated
_LONGEST_S = 36000.0  # of one


class Spec(BaseModel):
    """What is wanted of a controller; the defaults are those of :data:`SPEC_TEMPLATE`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    # start and target of each step that is simulated [degC]
    steps: Annotated[list[tuple[Finite, Finite]], Field(min_length=1, max_length=20)] = [
        (28.0, 38.0),
        (28.0, 18.0),
        (18.0, 43.0),
    ]
    settle_within_s: Positive = 450.0  # how soon a step must have settled
    band_degC: Positive = 0.25  # half width of the settling band
    overshoot_degC: Positive = 0.3  # largest
    bias_degC: Positive = 0.05  # largest mean error at the end
    hold_s: Annotated[float, Field(ge=10, le=_LONGEST_S)] = 600.0  # how long a step is simulated
    energy_weight: NotNegative = 0.0  # seconds of settling that are worth one second at full drive
    moves_weight: NotNegative = 0.002  # share of the minimum time that is worth one move by a full drive less
    # times the moves of the default design, beyond which moves are charged as overshoot is; 0: no limit
    moves_limit: NotNegative = 1.5
    # between moves; taken from the plant where absent, like the next ones
    sample_time_s: Positive | None = None
    slew_per_s: Positive | dict[str, Positive] | None = None  # largest change of a drive [its units per s]
    drive_limits: Range | dict[str, Range] | None = None  # narrower range of a drive, in its units
    patience_s: NotNegative | None = None  # how long the model replaces a lost reading
    output: str | Annotated[list[str], Field(min_length=1)] | None = None  # what is regulated
    ambient_degC: Temperature = 25.0  # of the simulations' room
    # a measured disturbance there, and where nobody reads it: the median of the logs, or the room's
    disturbances: dict[str, Finite] | None = None
    noise_degC: Annotated[Deviation, Field(ge=0)] = 0.04  # of a reading there
    sensor_offset_degC: Deviation = 0.2  # by how much sensors are off there
    search_draws: Annotated[int, Field(ge=1, le=50)] = 2  # of the plant, in the search
    check_draws: Annotated[int, Field(ge=1, le=200)] = 5  # of the plant, in the final comparison
    evaluations: Annotated[int, Field(ge=1, le=10000)] = 40  # designs of each kind that the search may try
    # what the plant may have that the model lacks, for which the design is chosen as well: a lag of every
    # sensor and a delay of the drives, in its apparent delays, and a share of the drives that does nothing
    extra_lag: Annotated[NotNegative, Field(le=10)] = 0.0
    extra_delay: Annotated[NotNegative, Field(le=10)] = 0.0
    lost_gain: Annotated[NotNegative, Field(lt=1)] = 0.0
    limits: dict[str, Ends] | None = None  # soft limits of outputs [degC]
    weights: dict[str, Positive] | None = None  # factor on the errors of an output
    zones: dict[str, Positive] | None = None  # half width about a target in which an output may be anywhere
    hard: list[str] | None = None  # outputs whose limits give way last
    energy_price: NotNegative | dict[str, NotNegative] | None = None  # of a sample at full drive [degC^2]
    ramp_per_s: Positive | dict[str, Positive] | None = None  # fastest change of a target [degC per s]
    safe_drive: Finite | dict[str, Finite] | None = None  # where a drive goes without its loop, in its units
    iterations: Annotated[int, Field(ge=1, le=50)] = 1  # programs a sample, until the plan stays
    relays: dict[str, Relay] | None = None  # of drives that are switched, with their least times

    @model_validator(mode="after")
    def _agree(self) -> Spec:
        for start, target in self.steps:
            if abs(start - target) <= self.band_degC:
                raise ValueError(f"steps: {start:g} -> {target:g} stays inside the band")
        if isinstance(self.output, list) and len(set(self.output)) < len(self.output):
            raise ValueError("output: names one twice")
        if "settle_within_s" in self.model_fields_set and self.settle_within_s > self.hold_s:
            too_long = f"longer than each step is simulated (hold_s, {self.hold_s:g} s)"
            raise ValueError(f"settle_within_s: {self.settle_within_s:g} s is {too_long}")
        return self

    @model_validator(mode="before")
    @classmethod
    def _held_until_settled(cls, content: Any) -> Any:
        settle_s = content.get("settle_within_s") if isinstance(content, Mapping) else None
        if not isinstance(settle_s, int | float) or "hold_s" in content:
            return content
        held_s = max(settle_s / _SETTLED_BY, cls.model_fields["hold_s"].default)
        return {"hold_s": min(held_s, _LONGEST_S), **content}

    def completed(self, plant: Plant) -> Spec:
        """Return the spec with what is wanted of this plant (:meth:`of`) in place of what nobody said."""
        usual = Spec.of(plant)
        content = {key: getattr(usual, key) for key in usual.model_fields_set}
        given = {key: getattr(self, key) for key in self.model_fields_set}
        if "hold_s" in given:
            content["settle_within_s"] = min(usual.settle_within_s, _SETTLED_BY * self.hold_s)
        return Spec(**content | given)

    @classmethod
    def of(cls, plant: Plant) -> Spec:
        """Return what is wanted where nobody said: of a skin the defaults, else what the logs showed."""
        usual = default_controlled(plant)
        if usual == ("t_surface",):
            return cls()
        times = _own_times(plant)
        while times:
            logged = [plant.valid.get(name, (0.0, 0.0)) for name in times]
            low, high = max(ends[0] for ends in logged), min(ends[1] for ends in logged)
            if high - low > _LEAST_SEEN:
                break
            times.popitem()
        else:
            return cls()
        digits = 1 - math.floor(math.log10(0.4 * (high - low)))  # those of a hundredth of the step
        below, above = (round(low + share * (high - low), digits) for share in (0.3, 0.7))
        wanted: dict[str, Any] = {"steps": [(below, above), (above, below)]}
        if {*times} != {*usual}:
            wanted["output"] = list(times)
        for key, share in (("band_degC", 0.025), ("overshoot_degC", 0.05), ("bias_degC", 0.01)):
            least = cls.model_fields[key].default
            wanted[key] = float(f"{max(least, share * (above - below)):.2g}")
        wanted["settle_within_s"] = float(f"{np.clip(3 * max(times.values()), 7.5, 27000):.2g}")
        wanted["hold_s"] = float(f"{wanted['settle_within_s'] / _SETTLED_BY:.2g}")
        if plant.room is not None:
            wanted["ambient_degC"] = round(min(max(plant.room, -20.0), 150.0), 1)
        return cls(**wanted)

    def in_toml(self) -> str:
        """Return the template with these values."""
        text = SPEC_TEMPLATE
        for key in sorted(self.model_fields_set):
            line = f"{key} = {json.dumps(getattr(self, key))} ".ljust(27)
            text = re.sub(rf"(?m)^(?:# )?{key} = [^#\n]*", line, text)
        return re.sub(r"(?m) +$", "", text)

    def widened(self, plant: Plant) -> Plant:
        """Return the plant with the spec's ranges of drives and its measured disturbances."""
        problem = "disturbances: the plant has no measured disturbance {}"
        _check_known(self.disturbances, plant.disturbances, problem)
        plant = replace(plant, nominal=plant.nominal | (self.disturbances or {}))
        ranges = dict(plant.valid)
        for name, (low, high) in _by_drive("drive_limits", self.drive_limits, drive_names(plant)).items():
            (least, most), unit = drive_range(plant, name), plant.units.get(name, "1")
            of_unit = unit in ("percent", "0_255") or (unit == "1" and -1.0 <= least < most <= 1.0)
            if not of_unit:  # only the logs showed how wide it is
                ranges[name] = (min(low, least), max(high, most))
        return replace(plant, valid=ranges)

    def surroundings_in_words(self, plant: Plant) -> str:
        """Return what measured disturbances but the room's are taken for in the trials."""
        plant, sentences = self.widened(plant), []
        usual = plant.undisturbed(self.ambient_degC).tolist()
        for name, value in zip(plant.disturbances, usual, strict=True):
            whence = "the middle of the logs" if name in plant.valid else "the plant does not say what it was"
            whence = "the logs' median" if name in plant.nominal else whence
            whence = "the spec" if name in (self.disturbances or {}) else whence
            if not plant.is_room(name) or whence == "the spec":
                sentences.append(f"{name} is taken as {value if np.isfinite(value) else 0.0:.4g} ({whence})")
        return "; ".join(sentences)

    def design(self, plant: Plant, **changes: Any) -> Design:
        """Return the plant's default design under this spec; a key that does not fit it is a UserError."""
        wanted = [self.output] if isinstance(self.output, str) else self.output
        _check_known(wanted, plant.outputs, "output: the plant has no output {}")
        _check_sample(self, plant)
        design = default_design(
            plant,
            controlled=None if wanted is None else tuple(wanted),
            dt=self.sample_time_s,
            ambient=self.ambient_degC,
        )
        _check_length(self, design.dt)
        drives = drive_names(plant)
        slews = {**design.slew_per_s, **_by_drive("slew_per_s", self.slew_per_s, drives)}
        values: dict[str, Any] = {"drive_range": _spec_drive_ranges(self, design), "slew_per_s": slews}
        if self.patience_s is not None:
            values["patience_s"] = self.patience_s
        # what may be is not what is wanted: with half of a wide one for its band an espresso boiler is off by
        # 101 degC s after a draw, with the default's by 85
        band = min(design.overshoot, 0.5 * self.overshoot_degC)
        values |= {"limits": _soft_limits(self, plant, design), "overshoot": band}
        _check_known(self.weights, design.controlled, "weights: {} is not regulated")
        for name, half in (self.zones or {}).items():
            for key in ("band_degC", "overshoot_degC", "bias_degC"):
                most = getattr(self, key)
                if half > most:
                    narrow = f"{half:g} about {name} is wider than {key}, {most:g}"
                    raise UserError(f"zones: {narrow}", hint="steps are judged by it: widen it too")
        weights = self.weights or {}
        counted = {name: weights.get(name, 1.0) * design.weights.get(name, 1.0) for name in design.controlled}
        values["weights"] = {name: weight for name, weight in counted.items() if weight != 1.0}
        values |= {"zones": dict(self.zones or {}), "hard": tuple(self.hard or ())}
        for name, relay in (self.relays or {}).items():
            least = relay.on_s + relay.off_s + relay.dead_s
            if least > self.settle_within_s:
                slow = f"relays: {name} goes on and off in {least:g} s, longer than settle_within_s"
                raise UserError(slow, hint="ask for less, or for shorter times")
        values |= {"iterations": self.iterations, "relays": dict(self.relays or {})}
        values["energy_price"] = _by_drive("energy_price", self.energy_price, drives)
        values["safe_drive"] = _by_drive("safe_drive", self.safe_drive, drives)
        ramp = self.ramp_per_s or {}
        values["ramp_per_s"] = ramp if isinstance(ramp, dict) else dict.fromkeys(design.controlled, ramp)
        design = check_design(replace(design, **values, **changes), plant)
        pairs = pairs_of_drives(design.relays)
        if not pairs:
            return design
        # Both at once heat and cool for nothing, and their relays wait for each other: two chambers are off
        # by .8 to 1.1 K (rms), and by .06 to .16 where a drive costs as much as a move.  At rest that costs
        # an offset of the cost times the share over the gain: at most half of what is allowed.
        ends = {*pairs, *pairs.values()}
        gains = [abs(step_response(plant, drive, y).gain) for drive in ends for y in design.controlled]
        return replace(design, drive=min(design.move, 0.5 * self.bias_degC * min(filter(None, gains))))


def _own_times(plant: Plant) -> dict[str, float]:
    """Return the output that each drive moves most, of those that are left, with its delay and lag [s]."""
    times: dict[str, float] = {}
    for drive in drive_names(plant):
        answers = {name: step_response(plant, drive, name) for name in plant.outputs if name not in times}
        name = max(answers, key=lambda each: abs(answers[each].gain), default="")
        if name and answers[name].gain:
            times[name] = answers[name].delay + answers[name].lag
    return times


def _check_sample(spec: Spec, plant: Plant) -> None:
    """Refuse a sample time that the plant's step does not divide: another one would be taken in silence."""
    if spec.sample_time_s is None:
        return
    _check_length(spec, spec.sample_time_s)
    steps = spec.sample_time_s / plant.dt
    nearest_s = max(1, round(steps)) * plant.dt
    if abs(nearest_s - spec.sample_time_s) > 1e-6 * nearest_s:
        wrong = f"{spec.sample_time_s:g} s is no multiple of the plant's step of {plant.dt:g} s"
        raise UserError(
            f"sample_time_s: {wrong}", hint=f"write {nearest_s:g}, or identify the plant from a faster log"
        )


def _check_length(spec: Spec, dt: float) -> None:
    """Refuse a simulation of a few samples: nothing could be evaluated in it."""
    if _SAMPLES * dt > spec.hold_s:
        raise UserError(
            f"hold_s: {spec.hold_s:g} s are less than {_SAMPLES} samples of {dt:g} s",
            hint="simulate each step for longer, or give a shorter sample_time_s",
        )


def _spec_drive_ranges(spec: Spec, design: Design) -> dict[str, Range]:
    """Return the range of each drive under a spec."""
    ranges = dict(design.drive_range)
    for name, (low, high) in _by_drive("drive_limits", spec.drive_limits, tuple(ranges)).items():
        least, most = ranges[name]
        if low < least - 1e-9 or high > most + 1e-9:
            problem = f"drive_limits: {low:g} to {high:g} of {name} leaves its range"
            raise UserError(problem, hint=f"stay in {least:g} to {most:g}")
        safe = _by_drive("safe_drive", spec.safe_drive, tuple(ranges))
        if least <= 0 <= most and not low <= 0 <= high and name not in safe:
            problem = f"drive_limits: {low:g} to {high:g} of {name} leaves out 0, where a failing loop goes"
            raise UserError(problem, hint="let them contain 0, or write safe_drive")
        ranges[name] = (low, high)
    return ranges


def _soft_limits(spec: Spec, plant: Plant, design: Design) -> dict[str, Range]:
    """Return the soft limits of outputs under a spec; a target must not lie beyond its output's own."""
    if spec.limits is None:
        free = "t_tank" in plant.outputs and "t_tank" not in design.controlled
        return {"t_tank": _WATER} if free else {}
    _check_known(spec.limits, plant.outputs, "limits: the plant has no output {}")
    for name, (low, high) in spec.limits.items():
        beyond = [target for _, target in spec.steps if not low <= target <= high]
        if name in design.controlled and beyond:
            wrong = f"{name} is to stay in {low:g} to {high:g} degC, and a step goes to {beyond[0]:g}"
            raise UserError(f"limits: {wrong}", hint="widen the limits, or choose another step")
    return dict(spec.limits)


def read_spec(path: str | Path) -> Spec:
    """Return the spec in a TOML file.

    Parameters
    ----------
    path : str or Path
        A file like :data:`SPEC_TEMPLATE`.

    Raises
    ------
    UserError
        Naming the file and the key that is wrong.

    Examples
    --------
    >>> from tempfile import NamedTemporaryFile
    >>> with NamedTemporaryFile("w", suffix=".toml") as file:
    ...     _ = file.write("settle_within_s = 200"), file.flush()
    ...     read_spec(file.name).settle_within_s
    200.0
    """
    return spec_from_dict(read_toml(path, hint="'init spec' writes one to edit"), file=path)


def spec_from_dict(content: Mapping[str, Any], *, file: str | Path | None = None) -> Spec:
    """Return a spec from plain values by key; a wrong one is a :class:`UserError` that names key and file."""
    try:
        return Spec.model_validate(dict(content))
    except ValidationError as error:
        problem = problem_of(error)
        key = problem.partition(":")[0].partition(".")[0]
        hint = known_names(key, Spec.model_fields, "the template of 'init spec' shows every key")
        if key == "settling":  # of 0.2.0
            hint = "the requirement is of every output now; ramp_per_s slows the target of one"
        raise UserError(problem, file=file, hint=hint) from error


def _by_drive(key: str, value: Any, drives: tuple[str, ...]) -> dict[str, Any]:
    """Return a value by drive; a single one is that of all."""
    if value is None:
        return {}
    if not isinstance(value, dict):
        return dict.fromkeys(drives, value)
    _check_known(value, drives, f"{key}: the plant has no drive {{}}")
    return dict(value)


def _check_known(names: Iterable[str] | None, known: Sequence[str], problem: str) -> None:
    """Refuse a name that the plant does not know."""
    for name in names or ():
        if name not in known:
            raise UserError(problem.format(name), hint=known_names(name, known, "these are: {}"))
