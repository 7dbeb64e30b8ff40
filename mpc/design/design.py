r"""What a controller is made of, beside its plant: one frozen record in the user's units, and its file.

The cost over the horizon of N samples, with blocks b of the plan v, r the target, span the width of a drive:

    J = track sum_k |y_k - r|^2 + terminal |y_N - r|^2 + move sum_b |(v_b - v_b-1)/span|^2
        + drive sum_k |u_k/span|^2 + soft penalties.

Temperatures count in degC, so ``move = 1`` means: one whole range in one sample costs as much as 1 degC
for one sample.  ``default_design`` takes everything from the plant: sample time and horizon from its delay
and lag, blocks that double from one sample on, and one move weight that the tuner then improves.

**PI loops** follow Skogestad's rule (:func:`simc`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field, Strict, TypeAdapter, ValidationError

from thermogrip.datasets.errors import UserError, known_names
from thermogrip.datasets.limits import LARGEST
from thermogrip.mpc.design.relays import Relay, pairs_of_drives, two_signed
from thermogrip.mpc.estimator.observer import (
    DRIFT,
    NOISE,
    Observer,
    ObserverNoise,
    choose_disturbances,
    reading_noise,
)
from thermogrip.mpc.plant.prediction import (
    PredictionModel,
    drive_names,
    drive_range,
    sample_time,
    step_response,
    unit_of,
)

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant


def _rising(ends: tuple[float, float]) -> tuple[float, float]:
    if not ends[0] < ends[1]:
        raise ValueError(f"{ends[0]:g} to {ends[1]:g} is empty")
    return ends


Finite = Annotated[float, Strict(), Field(ge=-LARGEST, le=LARGEST, allow_inf_nan=False)]
Positive = Annotated[float, Strict(), Field(gt=0, le=LARGEST, allow_inf_nan=False)]
NotNegative = Annotated[float, Strict(), Field(ge=0, le=LARGEST, allow_inf_nan=False)]
Share = Annotated[float, Strict(), Field(ge=0, le=1)]
Range = Annotated[tuple[Finite, Finite], AfterValidator(_rising)]
Room = Annotated[float, Strict(), Field(ge=-60, le=150)]  # degC: no room is beyond


@dataclass(frozen=True)
class PILoop:
    """One loop."""

    drive: str  # what it moves and what it controls
    output: str
    Kc: Finite  # gain [drive units per degC]
    Ti: Positive  # integral time [s]
    setpoint: Share = 1.0  # share of a change of the target that Kc answers to


def simc(plant: Plant, drive: str, output: str, *, tau_c: float | None = None) -> PILoop:
    """Return SIMC settings of one loop for a closed-loop time constant tau_c [s], by default the apparent
    delay; a drive that does not move the output is a ValueError."""
    answer = step_response(plant, drive, output)
    if answer.gain == 0:
        raise ValueError(f"drive {drive} does not move {output}")
    delay = max(answer.delay, plant.dt)
    closed = max(delay, 2 * plant.dt) if tau_c is None else tau_c
    low, high = drive_range(plant, drive)
    # Kc = T / (k (tau_c + L)) and Ti = min(T, 4 (tau_c + L)), tau_c = L: S. Skogestad, "Simple analytic rules
    # for model reduction and PID controller tuning", Journal of Process Control 13(4), 2003
    Kc = (high - low) * answer.lag / (answer.gain * (closed + delay))
    Ti = min(answer.lag, 4 * (closed + delay))
    return PILoop(drive, output, Kc, Ti)


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


#: Samples of a horizon, and block values of a plan; more are hours of work a sample, not a better loop.
LONGEST_HORIZON, MOST_UNKNOWNS = 1000, 200

_COARSE = 1.0  # range of an output below which the filter's numbers, made for degC, are too coarse
# steps of a plant, below which its apparent delay is none
_SEEN = 0.1
# of a bias of an output in a default design, in its unit per sqrt(sample)
_OUTPUT_DRIFT = 0.03
# beyond a target, in units of its output, and in standard deviations of a reading, which alone leave no such
# band in a thousand samples
_BAND, _NOISES = 0.15, 3.0


def check_design(design: Design, plant: Plant) -> Design:
    """Return the design as it is, or raise :class:`UserError` naming the field that cannot be."""
    _validated(asdict(design))
    _check_names(design, plant)
    steps, unknowns = design.dt / plant.dt, len(design.blocks) * len(drive_names(plant))
    no_multiple = abs(steps - round(steps)) > 1e-6 * steps
    _refuse(no_multiple, f"dt is {design.dt:g} s, no multiple of the plant's step of {plant.dt:g} s")
    N = sum(design.blocks)
    _refuse(N > LONGEST_HORIZON, f"blocks sum to {N} samples, more than the {LONGEST_HORIZON} of a horizon")
    size = f"{len(design.blocks)} blocks of {len(drive_names(plant))} drives"
    _refuse(unknowns > MOST_UNKNOWNS, f"{size} are more than {MOST_UNKNOWNS} unknowns")
    for name, (low, high) in design.drive_range.items():
        least, most = drive_range(plant, name)
        beyond = f"is {low:g} to {high:g}, beyond the drive's {least:g} to {most:g}"
        _refuse(low < least - 1e-9 or high > most + 1e-9, f"drive_range of {name} {beyond}")
        safe = design.safe_drive.get(name, low)
        _refuse(not low <= safe <= high, f"safe_drive of {name} is {safe:g}, beyond its {low:g} to {high:g}")
        both = name in design.energy_price and low < 0
        _refuse(both, f"energy_price: {name} goes both ways, its energy is no multiple of it: write drive")
    bare = ", ".join(name for name in design.controlled if name not in design.zones)
    _refuse(
        design.energy_price and bare,
        f"energy_price without zones of {bare} would hold them off their targets",
    )
    return design


def _refuse(wrong: object, problem: str) -> None:
    """Raise the problem where there is one."""
    if wrong:
        raise UserError(problem, hint="correct the spec or tune again")


def _check_names(design: Design, plant: Plant) -> None:
    """Refuse what names nothing of the plant, or one thing twice."""
    drives = drive_names(plant)
    no_output = "the plant has no output {}"
    no_drive = "the plant has no drive {}"
    not_regulated = "{} is not regulated"
    accepted: dict[str, tuple[Sequence[str] | Mapping[str, Any], str]] = {
        "controlled": (plant.outputs, no_output),
        "limits": (plant.outputs, no_output),
        "drive_range": (drives, no_drive),
        "slew_per_s": (drives, no_drive),
        "energy_price": (drives, no_drive),
        "safe_drive": (drives, no_drive),
        "relays": (drives, no_drive),
        "weights": (design.controlled, not_regulated),
        "zones": (design.controlled, not_regulated),
        "ramp_per_s": (design.controlled, not_regulated),
        "hard": (design.limits, "{} has no limits"),
    }
    for key, (names, problem) in accepted.items():
        for name in getattr(design, key):
            _refuse(name not in names, f"{key}: {problem.format(name)}")
    for name in design.controlled:
        _refuse(design.controlled.count(name) > 1, f"controlled names {name} twice")
    _check_relays(design, plant)
    for name in drives:
        missing = name not in design.drive_range or name not in design.slew_per_s
        _refuse(missing, f"drive_range, slew_per_s: nothing for drive {name}")
    for k, loop in enumerate(design.loops):
        pair = f"loops: {loop.output} by {loop.drive} is"
        no_pair = loop.drive not in drives or loop.output not in design.controlled
        _refuse(no_pair, f"{pair} no pair of a regulated output and a drive")
        twice = any(loop.drive == other.drive or loop.output == other.output for other in design.loops[:k])
        _refuse(twice, f"{pair} there twice")


def _check_relays(design: Design, plant: Plant) -> None:
    """Refuse relays that cannot be those of their drives."""
    relays, signed = design.relays, two_signed(design.relays)
    for name, relay in relays.items():
        low, _ = design.drive_range[name]
        wrong = f"relays: {name} is from {low:g} up: a drive has a cooler where it goes below 0"
        _refuse((low < 0) != (name in signed), wrong)
        _refuse(relay.dead_s and not relay.cooler, f"relays: dead_s of {name} is between it and a cooler")
    pairs = pairs_of_drives(relays)
    for pair in pairs.items():
        gains = [[step_response(plant, drive, y).gain for drive in pair] for y in design.controlled]
        opposed = any(heats * cools < 0 for heats, cools in gains)
        _refuse(not opposed, f"relays: {' and '.join(pair)} move no output in opposite directions")
        others = [*pairs, *pairs.values()]
        _refuse(others.count(pair[1]) > 1, f"relays: {pair[1]} is in two pairs of a heater and a cooler")


def _validated(content: Mapping[str, Any]) -> Design:
    """Return the design of plain values; a missing or wrong field is a :class:`UserError` that names it."""
    try:
        return TypeAdapter(Design).validate_python(content)
    except ValidationError as error:
        raise UserError(problem_of(error), hint="correct the spec or tune again") from error


def problem_of(error: ValidationError) -> str:
    """Return the first thing that pydantic found wrong, behind the key where it is."""
    # of a value with several forms, what is wrong within one says more than that it is not another
    first = min(error.errors(), key=lambda found: found["type"].endswith("_type"))
    key = ".".join(str(step) for step in first["loc"] if not str(step).startswith(_TAGS))
    text = first["msg"].removeprefix("Value error, ")
    if first["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        text = "no such key"
    return f"{key}: {text[0].lower()}{text[1:]}" if key else text


_TAGS = (
    "tuple[",
    "dict[",
    "list[",
    "constrained-",
    "function-",
    "str",
)  # pydantic's names for one of several forms
SCHEMA = "thermogrip.controller"


@dataclass(frozen=True)
class Design:
    """Everything that a controller is, but the plant."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    dt: Annotated[Positive, Field(le=3600)]  # sample time [s]
    controlled: Annotated[tuple[str, ...], Field(min_length=1)]  # outputs with a target
    # samples in each block of the plan; their sum is the horizon
    blocks: Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)]
    drive_range: dict[str, Range]  # what may be commanded, in the drive's units; hard
    slew_per_s: dict[str, Positive]  # largest change of a drive [units per s]; hard
    loops: tuple[PILoop, ...] = ()  # the PI controller that takes over when the optimiser fails
    track: Positive = 1.0  # weight of the squared error of each sample [degC^-2]
    terminal: NotNegative = 10.0  # weight of that of the last one besides [degC^-2]
    # factor on the errors of an output; 1 where absent
    weights: dict[str, Positive] = field(default_factory=dict)
    move: Positive = 1.0  # weight of the squared change of a drive a block, in shares of its range
    drive: NotNegative = 0.0  # weight of a squared drive a sample, in shares of its range
    # band beyond the target that the prediction keeps out of, on the far side [degC]; soft
    overshoot: NotNegative = 0.15
    # ranges of outputs, e.g. the tank's [degC]; soft
    limits: dict[str, Range] = field(default_factory=dict)
    # half width about the target of an output within which nothing is charged [its unit]
    zones: dict[str, Positive] = field(default_factory=dict)
    hard: tuple[str, ...] = ()  # outputs whose limits give way last
    # cost of a sample at full drive, beside the squared error of a sample; of drives on one side of 0
    energy_price: dict[str, NotNegative] = field(default_factory=dict)
    ramp_per_s: dict[str, Positive] = field(default_factory=dict)  # fastest change of a target [units per s]
    safe_drive: dict[str, Finite] = field(default_factory=dict)  # where a failing loop goes; 0 where absent
    relays: dict[str, Relay] = field(default_factory=dict)  # of drives that are switched
    # programs a sample: above 1 until the plan stays
    iterations: Annotated[int, Strict(), Field(ge=1, le=50)] = 1
    price: NotNegative = 25.0  # weight of the square of what exceeds a soft limit [degC^-2]
    noise: ObserverNoise = field(default_factory=ObserverNoise)
    ambient: Room = 25.0  # room temperature where none is measured [degC]
    deadline_s: NotNegative = 1.0  # time allowed to a step [s]
    # how long the plan is followed without a reading, or with a failing solver, before the next fallback [s];
    # of several controlled outputs, how long the model replaces one that is lost
    patience_s: NotNegative = 10.0

    def observer(self, model: PredictionModel) -> Observer:
        """Return the filter of this design for a plant at its sample time."""
        chosen = choose_disturbances(model, self.controlled, ambient=self.ambient)
        return Observer(model, chosen, self.noise, ambient=self.ambient)

    def to_dict(self) -> dict[str, Any]:
        """Return the design as plain JSON."""
        return json.loads(json.dumps(asdict(self)))  # type: ignore[no-any-return]  # a dict stays a dict

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Design:
        """Return the design that :meth:`to_dict` wrote; a missing or wrong field is a :class:`UserError`."""
        return _validated(content)


def make_blocks(horizon: int, count: int) -> tuple[int, ...]:
    """Return the lengths of count blocks that sum to horizon samples, growing from 1."""
    count = max(1, min(count, horizon))
    low, high = 1.0, 10.0
    for _ in range(60):  # the ratio of a geometric series with this sum
        ratio = 0.5 * (low + high)
        low, high = (ratio, high) if sum(ratio**k for k in range(count)) < horizon else (low, ratio)
    ends = np.round(np.cumsum([low**k for k in range(count)])).astype(int)
    ends[-1] = horizon
    lengths = np.diff(np.concatenate([[0], np.maximum.accumulate(ends)]))
    return tuple(sorted(int(length) for length in lengths if length > 0))


def _in_units(plant: Plant, controlled: Sequence[str]) -> dict[str, Any]:
    """Return the weights, the band and its price that count errors in each output's unit
    (:func:`thermogrip.mpc.plant.prediction.unit_of`); the band is no narrower than what noise shows."""
    ranges = [plant.valid.get(name, (0.0, 0.0)) for name in controlled]
    units = unit_of(np.array([high - low for low, high in ranges]))
    noises = [reading_noise(plant, name) or 0.0 for name in controlled]
    band = max(max(_BAND * unit, _NOISES * sd) for unit, sd in zip(units.tolist(), noises))
    others = {name: unit**-2 for name, unit in zip(controlled, units.tolist()) if unit != 1.0}
    return {"weights": others, "overshoot": band, "price": Design.price / float(units.max()) ** 2}


@dataclass(frozen=True)
class LoadSettings:
    """What the filter of a default design takes a load for, of which a log without loads says nothing.

    Measured on eight plants of other trades in two noises (``benchmarks/control/eight_plants.py``).
    """

    # share of the overshoot band that noise, taken for a load, may move an output by: with .1 a laser's mount
    # with a quiet sensor settles in 1.12 of the best's time, with .3 an espresso boiler swings after a draw
    wander: float = 0.15
    # the most that a load drifts by in a sample, in ranges: what a kiln's log shows beyond is what its model
    # lacks, and its drive moves 1.57 times as much as do-mpc's (1.03 with the limit)
    drift: float = 0.01
    # theta that a load drifts for to go as far as it jumps in a sample: without jumps a boiler swings
    # (IAE 1.12 of the best, .92 with 2), with 3 an extruder does (1.23 for .96)
    jumps: float = 2.0
    most: float = 0.03  # jump in ranges: with .07 a kiln's drive moves 1.65 times as much as do-mpc's


LOADS = LoadSettings()


def default_noise(plant: Plant, controlled: Sequence[str], dt: float) -> ObserverNoise:
    """Return the noise that the filter of a plant assumes, see :mod:`thermogrip.mpc.estimator.observer`."""
    model, record = PredictionModel(plant, dt=dt), plant.scores.innovations
    unit = dict(zip(model.outputs, model.unit.tolist()))
    drifts, jumps = {}, {}
    for drive, span in zip(model.drives, model.span.tolist()):
        answers = {output: step_response(plant, drive, output) for output in controlled}
        moved = max(answers, key=lambda output: abs(np.nan_to_num(answers[output].gain)) / unit[output])
        answer, noise = answers[moved], reading_noise(plant, moved) or NOISE * unit[moved]
        delayed = answer.delay > _SEEN * plant.dt
        # A log without loads says nothing of loads.  Of an output that a drive of gain k raises at the rate
        # k / T, with readings of noise r each dt, the filter of a bias that drifts by q in a second has the
        # bandwidth omega^2 = q k / (T r sqrt(dt)) (Anderson and Moore, "Optimal Filtering", 1979: two
        # integrators, one reading): a load is known soon after the loop can answer it from omega = 1 / theta
        # on.  A model without a delay does not say how soon its plant answers: then by its lag.
        theta = dt + (answer.delay if delayed else answer.lag)
        drift = noise * dt**0.5 * answer.lag / (abs(answer.gain) * theta**2) if answer.gain else 0.0
        if delayed:
            # noise that is taken for a load is a bias of q / sqrt(omega), and moves the output for theta
            # before that is seen, by r (omega theta)^(3/2) sqrt(dt / theta): a quiet sensor lets it be larger
            quiet = (LOADS.wander * _BAND * unit[moved] / noise) ** (2 / 3) * (theta / dt) ** (1 / 3)
            drift *= max(1.0, float(quiet)) ** 2
        elif record is None:
            drift = DRIFT  # nothing says more
        seen = record.input.get(drive, 0.0) / span if record else 0.0
        most = LOADS.drift / dt**0.5
        # a load jumps, too: white noise on the drive's way to the states, as large as the drift of some
        # theta.  It damps: with a bias alone all that a reading shows of a load comes an integration late
        drifts[drive] = float(np.nan_to_num(min(most, max(seen, drift)), nan=DRIFT))
        jumps[drive] = min(LOADS.most, LOADS.jumps * theta * drifts[drive] / dt**0.5) if delayed else 0.0
    state = record.state if record else ObserverNoise.state
    return ObserverNoise(state, drifts, _OUTPUT_DRIFT / dt**0.5, load=jumps)


def _slew(plant: Plant, name: str, dt: float, span: float) -> float:
    """Return the largest change of a drive [its unit per s]: what its logs show, else an eighth of its range;
    never more than its range in a sample."""
    record = plant.scores.innovations
    fastest = record.fastest.get(name, 0.0) if record else 0.0
    return min(max(fastest, 0.125 * span), span / dt)


def default_design(
    plant: Plant, *, controlled: tuple[str, ...] | None = None, dt: float | None = None, **changes: Any
) -> Design:
    """Return a design with the plant's numbers.

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

    Raises
    ------
    UserError
        If an output is none of the plant's, is no temperature, or is moved by no drive, or a field cannot be.

    Examples
    --------
    >>> from thermogrip.sysid import Plant, load_network
    >>> kit = load_network("tclab")
    >>> p, heaters = dict(zip(kit.parameters, kit.prior)), dict.fromkeys(kit.inputs, (0.0, 100.0))
    >>> plant = Plant(kit, p, dt=kit.dt, units=kit.units, valid=heaters)
    >>> design = default_design(plant, controlled=("t1",))
    >>> design.dt, design.blocks
    (2.0, (1, 1, 2, 2, 3, 4, 5, 6, 8, 11))
    """
    controlled = default_controlled(plant) if controlled is None else tuple(controlled)
    for name in controlled:
        if name not in plant.outputs:
            raise UserError(
                f"the plant has no output {name}", hint=known_names(name, plant.outputs, "it has {}")
            )
        low, high = plant.valid.get(name, (-np.inf, np.inf))
        if high - low < _COARSE:
            moves = f"{name} moves by {high - low:.2g} {plant.units.get(name, 'degC')} in the logs"
            raise UserError(
                f"{moves}, and a controller counts tenths of a unit",
                hint="log it in a smaller unit: cm instead of m",
            )
    dt = max(1, round((sample_time(plant) if dt is None else dt) / plant.dt)) * plant.dt
    drives = drive_names(plant)
    ranges = {name: drive_range(plant, name) for name in drives}
    slews = {name: _slew(plant, name, dt, high - low) for name, (low, high) in ranges.items()}
    lengths = []
    for output in controlled:
        answers = [step_response(plant, drive, output) for drive in drives]
        best = max(answers, key=lambda answer: abs(answer.gain))
        if not np.isfinite(best.gain) or best.gain == 0:
            how = "moves" if np.isfinite(best.gain) else "has a finite effect on"
            raise UserError(
                f"no drive {how} {output}",
                hint="identify it with logs that move the drive, or take another model",
            )
        lengths.append(min(8 * best.delay, best.delay + 3 * best.lag))
    horizon = int(np.clip(np.ceil(max(lengths) / dt), 20, 80))
    values: dict[str, Any] = {
        "dt": dt,
        "controlled": controlled,
        "blocks": make_blocks(horizon, 10),
        "drive_range": ranges,
        "slew_per_s": slews,
        "loops": pair_loops(plant, controlled),
        "noise": default_noise(plant, controlled, dt),
        **_in_units(plant, controlled),
        "deadline_s": 0.5 * dt,
        "patience_s": max(10.0, 5 * dt),
    }
    return check_design(replace(Design(**values), **changes), plant)
