r"""What a controller is made of, beside its plant: one frozen record in the user's units, and its file.

The cost over the horizon of N samples, with blocks b of the plan v, r the target, span the width of a drive:

    J = track sum_k |y_k - r|^2 + terminal |y_N - r|^2 + move sum_b |(v_b - v_b-1)/span|^2
        + travel sum_b |v_b - v_b-1|/span + drive sum_k |u_k/span|^2 + soft penalties.

Temperatures count in degC, so ``move = 1`` means: one whole range in one sample costs as much as 1 degC
for one sample.  ``default_design`` reads everything off the plant: sample time and horizon from its delay
and lag, blocks that double from one sample on, and one move weight that the tuner then improves.

**Checks.**  A controller's file can be edited, cut short, or written for another plant.  Whatever is in it,
either the loop does what the file says or one line says which field cannot be: nothing is rounded, clipped or
left out.

**PI loops** follow Skogestad's rule (SIMC), with gain k, delay L and lag T of the step response:

    Kc = T / (k (tau_c + L)),   Ti = min(T, 4 (tau_c + L)),   tau_c = L   [1]_.

References
----------
.. [1] S. Skogestad, "Simple analytic rules for model reduction and PID controller tuning", Journal of Process
   Control 13(4), 2003.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from numbers import Real
from typing import TYPE_CHECKING, Any

import numpy as np

from thermogrip.datasets.errors import UserError, known_names, reading
from thermogrip.datasets.limits import LARGEST
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
    graded_drives,
    sample_time,
    step_response,
    unit_of,
)

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant


@dataclass(frozen=True)
class PILoop:
    """One loop."""

    drive: str  # what it moves and what it controls
    output: str
    Kc: float  # gain [drive units per degC]
    Ti: float  # integral time [s]
    feedforward: float = 1.0  # share of the holding drive that is fed forward, 0 to 1
    setpoint: float = 1.0  # share of a change of the target that Kc answers to, 0 to 1


def simc(plant: Plant, drive: str, output: str, *, tau_c: float | None = None) -> PILoop:
    """Return SIMC settings of one loop for a closed-loop time constant tau_c [s], by default the apparent
    delay; a drive that does not move the output is a ValueError."""
    model = PredictionModel(plant, dt=plant.dt)
    answer = step_response(plant, drive, output)
    if answer.gain == 0:
        raise ValueError(f"drive {drive} does not move {output}")
    delay = max(answer.delay, plant.dt)
    closed = max(delay, 2 * plant.dt) if tau_c is None else tau_c
    span = float(model.span[model.drives.index(drive)])
    Kc = span * answer.lag / (answer.gain * (closed + delay))
    Ti = min(answer.lag, 4 * (closed + delay))
    return PILoop(drive, output, Kc, Ti)


def default_controlled(plant: Plant) -> tuple[str, ...]:
    """Return what to control where nobody said: the skin, else the last outputs, one for each drive."""
    n_u = len(graded_drives(plant))
    if n_u == 1 and "t_surface" in plant.outputs:
        return ("t_surface",)
    return tuple(plant.outputs[-n_u:])


def pair_loops(plant: Plant, controlled: tuple[str, ...]) -> tuple[PILoop, ...]:
    """Return one SIMC loop for each controlled output, on the drive of largest gain that is still free."""
    free = list(graded_drives(plant))
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

_LONGEST_SAMPLE = 3600.0  # s
_COARSE = 1.0  # range of an output below which the filter's numbers, made for degC, are too coarse
# steps of a plant, below which its apparent delay is none
_SEEN = 0.1
# of a bias of an output in a default design, in its unit per sqrt(sample)
_OUTPUT_DRIFT = 0.03
# beyond a target, in units of its output, and in standard deviations of a reading, which alone leave no such
# band in a thousand samples
_BAND, _NOISES = 0.15, 3.0
_MOST_NOISE = 1e6  # of a state, a reading or a bias, in any unit
_ROOMS = (-60.0, 150.0)  # degC: no room is beyond


def check_design(design: Design, plant: Plant) -> Design:
    """Return the design as it is, or raise :class:`UserError` naming the field that cannot be."""
    drives = drive_names(plant)
    for what, values in _numbers_of(design):
        for value in values:
            wrong = isinstance(value, bool) or not isinstance(value, Real) or not np.isfinite(float(value))
            _refuse(wrong, f"{what} must be a finite number, not {value!r}")
            _refuse(abs(float(value)) > LARGEST, f"{what} is {float(value):g}, beyond {LARGEST:g}")
    _check_time(design, plant)
    _check_outputs(design, plant)
    _check_drives(design, plant, drives)
    _check_loops(design, drives)
    _check_weights(design)
    _check_wishes(design, drives)
    return design


def _refuse(wrong: object, problem: str) -> None:
    """Raise the problem where there is one."""
    if wrong:
        raise UserError(problem, hint="correct the spec or tune again")


def _numbers_of(design: Design) -> Iterator[tuple[str, Sequence[Any]]]:
    """Yield each field that holds numbers, with them."""
    single = ("dt", "track", "terminal", "move", "travel", "drive", "overshoot", "price", "ambient")
    for name in (*single, "deadline_s", "patience_s"):
        yield name, (getattr(design, name),)
    for name, ends in design.drive_range.items():
        yield f"drive_range of {name}", ends
    for name, ends in design.limits.items():
        yield f"limits of {name}", ends
    for name, value in design.weights.items():
        yield f"weights of {name}", (value,)
    for key in ("slew_per_s", "zones", "energy_price", "ramp_per_s", "safe_drive"):
        for name, value in getattr(design, key).items():
            yield f"{key} of {name}", (value,)
    yield "tariff", [number for row in design.tariff for number in row]
    for loop in design.loops:
        yield f"the PI of {loop.output}", (loop.Kc, loop.Ti, loop.feedforward, loop.setpoint)
    noise = design.noise
    yield "noise", (noise.state, noise.output, *noise.drive.values(), *noise.reading.values())


def _check_time(design: Design, plant: Plant) -> None:
    steps = design.dt / plant.dt
    wrong = not design.dt > 0 or abs(steps - round(steps)) > 1e-6 * steps
    _refuse(wrong, f"dt is {design.dt:g} s, no multiple of the plant's step of {plant.dt:g} s")
    wrong = design.dt > _LONGEST_SAMPLE
    _refuse(wrong, f"dt is {design.dt:g} s, longer than the {_LONGEST_SAMPLE:g} s of a sample")
    _refuse(not design.blocks or min(design.blocks) < 1, "blocks must be whole numbers from 1")
    N = sum(design.blocks)
    _refuse(N > LONGEST_HORIZON, f"blocks sum to {N} samples, more than the {LONGEST_HORIZON} of a horizon")
    _refuse(design.move_delay not in (0, 1), "move_delay must be 0 or 1")
    _refuse(not isinstance(design.offset_free, bool), "offset_free must be true or false")
    _refuse(min(design.deadline_s, design.patience_s) < 0, "deadline_s and patience_s must be >= 0")
    wrong = not _ROOMS[0] <= design.ambient <= _ROOMS[1]
    _refuse(wrong, f"ambient is {design.ambient:g} degC, which is no room")


def _check_outputs(design: Design, plant: Plant) -> None:
    _refuse(not design.controlled, "controlled names no output")
    for name in design.controlled:
        _refuse(name not in plant.outputs, f"controlled: the plant has no output {name}")
        _refuse(design.controlled.count(name) > 1, f"controlled names {name} twice")
    for name, weight in design.weights.items():
        _refuse(name not in design.controlled, f"weights: {name} is not regulated")
        _refuse(not weight > 0, f"weights of {name} must be > 0")
    for name, (low, high) in design.limits.items():
        _refuse(name not in plant.outputs, f"limits: the plant has no output {name}")
        _refuse(not low < high, f"limits of {name} are {low:g} to {high:g}, which is empty")


def _check_drives(design: Design, plant: Plant, drives: Sequence[str]) -> None:
    n_b, n_u = len(design.blocks), len(drives)
    _refuse(n_b * n_u > MOST_UNKNOWNS, f"{n_b} blocks of {n_u} drives are more than {MOST_UNKNOWNS} unknowns")
    for key, given in (("drive_range", design.drive_range), ("slew_per_s", design.slew_per_s)):
        for name in given:
            _refuse(name not in drives, f"{key}: the plant has no drive {name}")
    for name in drives:
        wrong = name not in design.drive_range or name not in design.slew_per_s
        _refuse(wrong, f"drive_range, slew_per_s: nothing for drive {name}")
        low, high = design.drive_range[name]
        _refuse(not low < high, f"drive_range of {name} is {low:g} to {high:g}, which is empty")
        least, most = drive_range(plant, name)
        beyond = f"is {low:g} to {high:g}, beyond the drive's {least:g} to {most:g}"
        _refuse(low < least - 1e-9 or high > most + 1e-9, f"drive_range of {name} {beyond}")
        _refuse(not design.slew_per_s[name] > 0, f"slew_per_s of {name} must be > 0")


def _check_loops(design: Design, drives: Sequence[str]) -> None:
    for at, loop in enumerate(design.loops):
        wrong = loop.drive not in drives or loop.output not in design.controlled
        _refuse(wrong, f"loops: {loop.output} by {loop.drive} is no pair of a regulated output and a drive")
        wrong = any(loop.drive == other.drive or loop.output == other.output for other in design.loops[:at])
        _refuse(wrong, f"loops: {loop.output} by {loop.drive} is there twice")
        _refuse(loop.Ti <= 0, f"loops: Ti of {loop.output} must be > 0")
        wrong = not 0 <= loop.setpoint <= 1
        _refuse(wrong, f"loops: setpoint of {loop.output} must be 0 to 1")


def _check_weights(design: Design) -> None:
    others = design.terminal, design.travel, design.drive, design.price
    wrong = min(design.track, design.move) <= 0 or min(others) < 0
    _refuse(wrong, "weights: track and move must be > 0, the others >= 0")
    _refuse(design.overshoot < 0, "overshoot must be >= 0")
    noise = design.noise
    values = [noise.state, noise.output, *noise.drive.values(), *noise.reading.values()]
    _refuse(min(values) < 0, "noise: a standard deviation must be >= 0")
    wrong = max(values) > _MOST_NOISE
    _refuse(wrong, f"noise: a standard deviation must be <= {_MOST_NOISE:g}")


def _check_wishes(design: Design, drives: Sequence[str]) -> None:
    """Refuse what cannot be had together, a line each."""
    for key in ("zones", "ramp_per_s"):
        for name, value in getattr(design, key).items():
            _refuse(name not in design.controlled, f"{key}: {name} is not regulated")
            _refuse(not value > 0, f"{key} of {name} must be > 0")
    for name in design.hard:
        _refuse(name not in design.limits, f"hard: {name} has no limits")
    for key in ("energy_price", "safe_drive"):
        for name in getattr(design, key):
            _refuse(name not in drives, f"{key}: the plant has no drive {name}")
    for name, value in design.safe_drive.items():
        low, high = design.drive_range[name]
        _refuse(
            not low <= value <= high, f"safe_drive of {name} is {value:g}, beyond its {low:g} to {high:g}"
        )
    for name, value in design.energy_price.items():
        _refuse(value < 0, f"energy_price of {name} must be >= 0")
        both = design.drive_range[name][0] < 0
        _refuse(both, f"energy_price: {name} goes both ways, its energy is no multiple of it: write drive")
        bare = [output for output in design.controlled if output not in design.zones]
        _refuse(bare, f"energy_price without zones of {', '.join(bare)} would hold them off their targets")
    for name, numbers in design.on_off.items():
        _refuse(name not in drives, f"on_off: {name} is no on/off input that the controller switches")
        _refuse(min(numbers) < 0, f"on_off of {name} must be >= 0")
        short = 1 / design.dt > (1 + 1e-9) * design.slew_per_s[name]
        _refuse(short, f"slew_per_s of {name} must let it go over in a sample: it is on or off")
    _refuse(len(design.on_off) > 1, "on_off: one input is switched, not several")
    times = [second for second, _ in design.tariff]
    _refuse(design.tariff and not design.energy_price, "tariff: there is no energy_price that it multiplies")
    wrong = times != sorted(set(times)) or any(not 0 <= second < DAY for second in times)
    _refuse(wrong, f"tariff: seconds of the day must rise, from 0 to less than {DAY:g}")
    _refuse(any(factor < 0 for _, factor in design.tariff), "tariff: factors must be >= 0")
    whole = isinstance(design.iterations, int) and not isinstance(design.iterations, bool)
    wrong = not whole or not 1 <= design.iterations <= MOST_ITERATIONS
    _refuse(wrong, f"iterations must be a whole number from 1 to {MOST_ITERATIONS}")


SCHEMA = "thermogrip.controller"
DAY = 86400.0  # s
MOST_ITERATIONS = 50


@dataclass(frozen=True)
class Design:
    """Everything that a controller is, but the plant."""

    dt: float  # sample time [s]
    controlled: tuple[str, ...]  # outputs with a target
    blocks: tuple[int, ...]  # samples in each block of the plan; their sum is the horizon
    drive_range: dict[str, tuple[float, float]]  # what may be commanded, in the drive's units; hard
    slew_per_s: dict[str, float]  # largest change of a drive [units per s]; hard
    loops: tuple[PILoop, ...] = ()  # the PI controller that takes over when the optimiser fails
    track: float = 1.0  # weight of the squared error of each sample [degC^-2]
    terminal: float = 10.0  # weight of that of the last one besides [degC^-2]
    # how many times the errors of an output count; 1 where absent
    weights: dict[str, float] = field(default_factory=dict)
    move: float = 1.0  # weight of the squared change of a drive a block, in shares of its range
    # weight of the change itself: a drive whose move would win less stays where it is
    travel: float = 0.0
    drive: float = 0.0  # weight of a squared drive a sample, in shares of its range
    # band beyond the target that the prediction keeps out of, on the far side [degC]; soft
    overshoot: float = 0.15
    # ranges of outputs, e.g. the tank's [degC]; soft
    limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    # half width about the target of an output within which nothing is charged [its unit]
    zones: dict[str, float] = field(default_factory=dict)
    hard: tuple[str, ...] = ()  # outputs whose limits give way last
    # cost of a sample at full drive, beside the squared error of a sample; of drives on one side of 0
    energy_price: dict[str, float] = field(default_factory=dict)
    # (second of the day, how many times the price counts from then on), the last one from the day before
    tariff: tuple[tuple[float, float], ...] = ()
    ramp_per_s: dict[str, float] = field(default_factory=dict)  # fastest change of a target [units per s]
    safe_drive: dict[str, float] = field(default_factory=dict)  # where a failing loop goes; 0 where absent
    iterations: int = 1  # programs a sample: above 1 until the plan stays
    # drives that are on or off: least seconds on and off, and the cost of a sample while on
    on_off: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    price: float = 50.0  # weight of the square of what exceeds a soft limit [degC^-2]
    noise: ObserverNoise = field(default_factory=ObserverNoise)
    # whether disturbance states are estimated; without them the loop ends off its target
    offset_free: bool = True
    # samples between a reading and the moment its move is applied: 0, or 1 where the computer is slow
    move_delay: int = 0
    ambient: float = 25.0  # room temperature where none is measured [degC]
    deadline_s: float = 1.0  # time allowed to a step [s]
    # how long the plan is followed without a reading, or with a failing solver, before the next fallback [s];
    # of several controlled outputs, how long the model replaces one that is lost
    patience_s: float = 10.0

    @property
    def horizon_s(self) -> float:
        """Length of the prediction [s]."""
        return self.dt * sum(self.blocks)

    def observer(self, model: PredictionModel) -> Observer:
        """Return the filter of this design for a plant at its sample time."""
        count = None if self.offset_free else 0
        chosen = choose_disturbances(model, self.controlled, ambient=self.ambient, count=count)
        return Observer(model, chosen, self.noise, ambient=self.ambient)

    def to_dict(self) -> dict[str, Any]:
        """Return the design as plain JSON."""
        return json.loads(json.dumps(asdict(self)))  # type: ignore[no-any-return]  # a dict stays a dict

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Design:
        """Return the design that :meth:`to_dict` wrote; a missing or wrong field is a :class:`UserError`."""
        with reading("is not a whole controller", hint="tune the controller again"):
            known = {entry.name for entry in fields(cls)}
            unknown = sorted(set(content) - known)
            if unknown:
                raise UserError(f"the design has no field {unknown[0]}", hint="tune the controller again")
            values = dict(content)
            values["controlled"] = tuple(str(name) for name in content["controlled"])
            values["blocks"] = tuple(int(length) for length in content["blocks"])
            # an older file has an anti-windup time beside
            loops = [{key: of[key] for key in of if key != "Tt"} for of in content["loops"]]
            values["loops"] = tuple(PILoop(**loop) for loop in loops)
            values["noise"] = _noise_of(content["noise"], content["drive_range"])
            values["hard"] = tuple(str(name) for name in content.get("hard", ()))
            tariff = content.get("tariff", ())
            values["tariff"] = tuple((float(second), float(factor)) for second, factor in tariff)
            switches = content.get("on_off", {}).items()
            values["on_off"] = {str(k): (float(v[0]), float(v[1]), float(v[2])) for k, v in switches}
            for key in ("drive_range", "limits"):
                values[key] = {str(k): (float(v[0]), float(v[1])) for k, v in content[key].items()}
            return cls(**values)


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


def default_noise(plant: Plant, controlled: Sequence[str], dt: float) -> ObserverNoise:
    """Return the noise that the filter of a plant assumes, see :mod:`thermogrip.mpc.estimator.observer`."""
    model, record = PredictionModel(plant, dt=dt), plant.scores.innovations
    units = model.unit[[model.outputs.index(name) for name in controlled]]
    drifts = {}
    for name, span in zip(model.drives, model.span.tolist()):
        answers = [step_response(plant, name, output) for output in controlled]
        gains = np.array([answer.gain for answer in answers]) / units
        at = int(np.argmax(np.abs(np.nan_to_num(gains))))
        rate, delay = abs(answers[at].gain) / answers[at].lag, answers[at].delay
        # a model without a delay does not say how soon its plant answers: then by its lag
        theta = dt + (delay if delay > _SEEN * plant.dt else answers[at].lag)
        known = reading_noise(plant, controlled[at])
        noise = NOISE * units[at] if known is None else known
        sooner = noise * dt**0.5 / (rate * theta**2) if rate > 0 else 0.0
        if record is None and delay <= _SEEN * plant.dt:
            sooner = DRIFT  # nothing says more
        seen = record.input.get(name, 0.0) / span if record else 0.0
        drifts[name] = float(np.nan_to_num(max(seen, sooner), nan=DRIFT, posinf=DRIFT))
    output = _OUTPUT_DRIFT / dt**0.5
    return ObserverNoise(record.state if record else ObserverNoise.state, drifts, output)


def _slew(plant: Plant, name: str, dt: float, span: float, graded: bool) -> float:
    """Return the largest change of a drive [its unit per s]: what its logs show, else an eighth of its range;
    never more than its range in a sample."""
    record = plant.scores.innovations
    seen = record.fastest.get(name, 0.0) if record else 0.0
    return min(max(seen, 0.125 * span), span / dt) if graded else span / dt


def _noise_of(content: Mapping[str, Any], drives: Iterable[str]) -> ObserverNoise:
    """Return the noise of a file; of an older one every drive's was the same."""
    drive, reading = content["drive"], content.get("reading", {})
    return ObserverNoise(
        state=content["state"],
        drive=dict(drive) if isinstance(drive, dict) else dict.fromkeys(drives, drive),
        output=content["output"],
        reading=dict(reading) if isinstance(reading, dict) else {},
    )


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
    >>> design.dt, design.horizon_s, design.blocks
    (2.0, 86.0, (1, 1, 2, 2, 3, 4, 5, 6, 8, 11))
    """
    controlled = default_controlled(plant) if controlled is None else tuple(controlled)
    for name in controlled:
        if name not in plant.outputs:
            raise UserError(
                f"the plant has no output {name}", hint=known_names(name, plant.outputs, "it has {}")
            )
        low, high = plant.valid.get(name, (-np.inf, np.inf))
        if high - low < _COARSE:
            seen = f"{name} moves by {high - low:.2g} {plant.units.get(name, 'degC')} in the logs"
            raise UserError(
                f"{seen}, and a controller counts tenths of a unit",
                hint="log it in a smaller unit: cm instead of m",
            )
    dt = max(1, round((sample_time(plant) if dt is None else dt) / plant.dt)) * plant.dt
    drives = drive_names(plant)
    ranges = {name: drive_range(plant, name) for name in drives}
    if not (graded := graded_drives(plant)):
        hint = "an on/off input is switched beside a drive that can be graded"
        raise UserError("on_off leaves no other drive", hint=hint)
    slews = {name: _slew(plant, name, dt, b - a, name in graded) for name, (a, b) in ranges.items()}
    lengths = []
    for output in controlled:
        answers = [step_response(plant, drive, output) for drive in graded]
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
