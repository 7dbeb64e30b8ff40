r"""A controller against a plant that is not its model, and what came of it in an operator's terms.

The true plant runs on its own step, finer than the controller's sample, with its own parameters (a draw of
the posterior) in a room and behind sensors that the controller does not know: noise, a quantum of 1/16 degC
as thermocouple amplifiers have it, an offset on any sensor.  What counts is the temperature that the sensor
would read without noise and quantum: an offset of a sensor is not something that a controller could see.

Of a session on hardware :class:`RecordedController` keeps what its log lacks: status, advice and step times.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.schema import Log, column, names
from thermogrip.media.rendering import Shown
from thermogrip.mpc.design.relays import Relay, Switches
from thermogrip.mpc.interface import Controller, Move, Readings, Regulator, Target
from thermogrip.mpc.plant.prediction import drive_range, held_start, prediction_model

if TYPE_CHECKING:
    from thermogrip.mpc.controllers.loop_monitor import LoopMonitor
    from thermogrip.sysid.plant.plant import Plant


@dataclass(frozen=True)
class Surroundings:
    """What the controller does not know."""

    ambient: float = 25.0  # of the room [degC]
    noise: float = 0.04  # standard deviation of a reading [degC]
    noises: dict[str, float] = field(default_factory=dict)  # the same of outputs that have another, by name
    quantum: float = 0.0625  # step of a reading [degC]; 0 is none
    # the same of sensors that have another, by name, ambient included [degC]
    quanta: dict[str, float] = field(default_factory=dict)
    # what a sensor reads too much, by name, ambient included [degC]
    offset: dict[str, float] = field(default_factory=dict)
    move_delay_s: float = 0.0  # time between a reading and the moment its move is applied [s]
    sensor_lag_s: float = 0.0  # by how much every sensor is slower than the plant's outputs [s]
    drive_share: float = 1.0  # share of a drive, counted from the one that holds the start, that acts
    # outputs that drives have held at the start for long, drives that the controller knows; else all is as
    # warm
    held: tuple[str, ...] = ()
    # measured disturbances by name; where absent, what the plant has where nobody reads them
    disturbances: dict[str, float] = field(default_factory=dict)
    relays: dict[str, Relay] = field(default_factory=dict)  # of drives that are switched
    # what a load adds to the outputs (n, n_y), at the plant's own steps from the start on; its last row stays
    load: Array | None = field(default=None, compare=False)

    def noises_of(self, names: tuple[str, ...]) -> Array:
        """Return the standard deviation of a reading of each of these sensors (n,) [degC]."""
        return np.array([self.noises.get(name, self.noise) for name in names], dtype=float)

    def steps_of(self, names: tuple[str, ...]) -> Array:
        """Return the step of a reading of each of these sensors (n,) [degC]."""
        return np.array([self.quanta.get(name, self.quantum) for name in names], dtype=float)


@dataclass(frozen=True)
class Segment:
    """One target, one controlled output."""

    output: str
    start: float  # where it began, where it should go [degC]
    target: float
    begin_s: float  # of the segment [s]
    end_s: float
    settle_s: float  # time until it stays inside the band [s]; NaN where it never does
    overshoot: float  # largest excursion beyond the target, on the far side from where it began [degC]
    bias: float  # mean error of the last 120 s, or the last fifth of a shorter segment
    sd: float  # of the same last seconds
    energy_s: float  # of all drives together, in fractions of full drive
    travel: float  # sum of the drives' changes, that to the first one included
    full_share: float  # share of the time until settling at the limit of the drive, 0 to 1


@dataclass(frozen=True, repr=False)
class ClosedLoop(Shown):
    """The record of one run: n of the plant's own steps, k calls of the controller."""

    time: Array  # (n,), the plant's own steps [s]
    outputs: dict[str, Array]  # (n,), what the sensors would read without noise and quantum [degC]
    sample_time: Array  # (k,), when the controller was called [s]
    readings: dict[str, Array]  # (k,), what it was given [degC]
    drive: dict[str, Array]  # (k,), what it answered
    target: dict[str, Array]  # (k,) [degC]
    status: tuple[str, ...]  # its k statuses
    advice: tuple[str, ...]  # its k advices
    seconds: Array  # (k,), time of each step [s]
    band: float  # half width, for settling [degC]
    drive_range: dict[str, tuple[float, float]]
    segments: tuple[Segment, ...]

    def _facts(self) -> dict[str, object]:
        """Return how well each target was reached, and whether all were."""
        facts: dict[str, object] = {
            f"{s.output} to {s.target:.4g}": f"from {s.start:.4g}: settles in {s.settle_s:.4g} s (nan: not), "
            f"overshoot {s.overshoot:.3g}, bias {s.bias:.3g}, {s.energy_s:.4g} s at full drive"
            for s in self.segments
        }
        answered = f"{self.status.count('ok')} of {len(self.status)} are ok"
        return facts | {"steps": answered, "verdict": "settled" if self.settled else "not settled"}

    @property
    def settled(self) -> bool:
        """Whether every segment settled."""
        return all(np.isfinite(segment.settle_s) for segment in self.segments)


def simulate_closed_loop(
    controller: Regulator,
    plant: Plant,
    schedule: Sequence[tuple[Target, float]],
    *,
    start: float | None = None,
    surroundings: Surroundings | None = None,
    band: float = 0.25,
    seed: int = 0,
) -> ClosedLoop:
    """Return the record of a controller that is run against a plant.

    Parameters
    ----------
    controller : Regulator
        It is reset first.
    plant : Plant
        The truth; a draw of the controller's plant, or another plant of the same signals.
    schedule : sequence of (target, seconds)
        A target is degC, or degC by output name.
    start : float, optional
        Temperature at which the whole plant rests at first [degC]; the room's where absent.
    surroundings : Surroundings, optional
    band : float, optional
        Half width of the settling band [degC].
    seed : int, optional
        Of the noise.

    Examples
    --------
    >>> from thermogrip.sysid import Plant, load_network
    >>> kit = load_network("tclab")
    >>> p, heaters = dict(zip(kit.parameters, kit.prior)), dict.fromkeys(kit.inputs, (0.0, 100.0))
    >>> plant = Plant(kit, p, dt=kit.dt, units=kit.units, valid=heaters)
    >>> from thermogrip.mpc import design_controller
    >>> run = simulate_closed_loop(design_controller(plant, dt=5.0), plant, [(40.0, 300.0)])
    >>> [(segment.output, segment.settle_s) for segment in run.segments]
    [('t1', 64.0), ('t2', 75.0)]
    """
    around = Surroundings() if surroundings is None else surroundings
    truth = Truth(plant, controller.dt, around, start, seed)
    controlled = tuple(controller.controlled)
    begun = truth.begun()
    controller.reset(truth.reading() | begun)
    targets: list[list[float]] = []
    readings: list[list[float]] = []
    moves: list[Move] = []
    ends: list[int] = []
    for target, seconds in schedule:
        wanted = dict(target) if isinstance(target, Mapping) else dict.fromkeys(controlled, float(target))
        for _ in range(max(1, round(seconds / controller.dt))):
            reading = truth.reading()
            move = controller.step(reading if moves else reading | begun, target)
            truth.apply(move)
            targets.append([wanted[name] for name in controlled])
            readings.append([reading[name] for name in truth.sensors])
            moves.append(move)
        ends.append(len(moves))
    calls = Calls(
        np.array(targets),
        np.array(readings),
        np.array([move.drives(truth.model.drives) for move in moves]),
        tuple(move.status for move in moves),
        tuple(move.advice for move in moves),
        np.array([move.seconds for move in moves]),
    )
    return record_loop(truth, controlled, calls, ends, band)


class Truth:
    """The plant that closes the loop, with its sensors."""

    def __init__(self, plant: Plant, dt: float, around: Surroundings, start: float | None, seed: int) -> None:
        native = prediction_model(plant, plant.dt)
        self.model, self.around = native, around
        self.sub = max(1, round(dt / native.dt))
        self.dt = self.sub * native.dt
        if abs(self.dt - dt) > 1e-6 * dt:
            raise ValueError(f"the controller's {dt:g} s are not a multiple of the plant's {native.dt:g} s")
        d = dict(zip(native.disturbances, native.undisturbed(around.ambient).tolist(), strict=True))
        self.d = np.array([around.disturbances.get(name, d[name]) for name in d], dtype=float)
        warmth = around.ambient if start is None else start
        self.x = native.rest(np.full(native.n_y, warmth), self.d)
        holding_drive: Array | None = None
        if around.held:
            self.x, holding_drive = held_start(native, around.held, warmth, tuple(self.d.tolist()))
        self.known = holding_drive is not None  # whether there is a drive that holds the start
        self.moves: list[Array] = []
        self.before = native.neutral if holding_drive is None else holding_drive
        offsets = [plant.offsets.get(name, 0.0) + around.offset.get(name, 0.0) for name in native.outputs]
        self.offset = np.array(offsets, dtype=float)
        self.switches = Switches(around.relays, {name: drive_range(plant, name) for name in around.relays})
        for switch in self.switches.each:
            switch.since_s = np.inf  # it has rested, as all has
        self.rng = np.random.default_rng(seed)
        self.late = round(around.move_delay_s / native.dt)
        self.sees = native.dt / (native.dt + around.sensor_lag_s)  # share of a change that is shown at once
        self.y = [native.output(self.x) + self.offset]  # without the load
        self.time = 0.0

    @property
    def sensors(self) -> tuple[str, ...]:
        """What a reading holds beside its time."""
        return *self.model.outputs, *self.model.disturbances

    def loaded(self, steps: int) -> Array:
        """Return what the load adds to the outputs (steps, n_y) at so many of the plant's own steps."""
        if self.around.load is None:
            return np.zeros((steps, self.model.n_y))
        return np.asarray(self.around.load[np.minimum(np.arange(steps), len(self.around.load) - 1)])

    def begun(self) -> dict[str, float]:
        """Return the drives that hold the start by name, as a reading has them; none where none do."""
        return dict(zip(self.model.drives, self.before.tolist(), strict=True)) if self.known else {}

    def reading(self) -> dict[str, float]:
        """Return what the sensors show now."""
        noise = self.around.noises_of(self.model.outputs) * self.rng.standard_normal(self.model.n_y)
        values = self.y[-1] + noise
        if self.around.load is not None:
            values = values + self.around.load[min(len(self.y), len(self.around.load)) - 1]
        shown = dict(zip(self.model.outputs, values.tolist(), strict=True))
        for name, value in zip(self.model.disturbances, self.d, strict=True):
            shown[name] = float(value) + self.around.offset.get(name, 0.0)
        for key, step in zip(shown, self.around.steps_of(tuple(shown)).tolist(), strict=True):
            if step > 0:
                shown[key] = round(shown[key] / step) * step
        return {"time_s": self.time, **shown}

    def apply(self, move: Move) -> None:
        """Let one sample pass under this move."""
        first, drive_before = len(self.moves) * self.sub - self.late, self.before
        self.moves.append(np.array(move.drives(self.model.drives), dtype=float))
        moves_in_force = np.arange(first, first + self.sub) // self.sub
        u = np.stack([self.moves[k] if k >= 0 else drive_before for k in moves_in_force])
        for row in u if self.switches.each else ():
            row[:] = list(self.switches.mean(dict(zip(self.model.drives, row)), self.model.dt).values())
        y, x = self.model.run(
            self.x[None, :], (drive_before + self.around.drive_share * (u - drive_before))[None], self.d
        )
        self.x = x[0]
        for row in y[0, 1:] + self.offset:
            self.y.append(row if self.sees == 1 else self.y[-1] + self.sees * (row - self.y[-1]))
        self.time += self.dt


@dataclass(frozen=True)
class Calls:
    """What a controller was given and answered, k times."""

    target: Array  # (k, n_controlled) [degC]
    reading: Array  # (k, n_y + n_d) [degC]
    drive: Array  # (k, n_u)
    status: tuple[str, ...]
    advice: tuple[str, ...]
    seconds: Array  # (k,)


def record_loop(
    truth: Truth, controlled: tuple[str, ...], calls: Calls, stops: list[int], band: float
) -> ClosedLoop:
    """Return the record of a run, a segment, which ends at one of the calls ``stops``, for each stop and
    controlled output; ``band`` is that of settling [degC]."""
    model = truth.model
    y = np.stack(truth.y) + truth.loaded(len(truth.y))
    fine = np.asarray(model.dt * np.arange(y.shape[0]), dtype=np.float64)
    scaled, full = drive_shares(calls.drive, model.lowest, model.highest)
    before, _ = drive_shares(truth.before[None], model.lowest, model.highest)
    jumps = np.abs(np.diff(scaled, axis=0, prepend=before)).sum(axis=1)
    segments = []
    for first, last in zip([0, *stops[:-1]], stops):
        rows, calls_of_segment = slice(first * truth.sub, last * truth.sub + 1), slice(first, last)
        for k, name in enumerate(controlled):
            output, goal = y[rows, model.outputs.index(name)], float(calls.target[first, k])
            segment = segment_of(
                name, fine[rows], output, goal, scaled[calls_of_segment], full[calls_of_segment], band
            )
            segments.append(replace(segment, travel=float(jumps[calls_of_segment].sum())))
    return ClosedLoop(
        time=fine,
        outputs={name: y[:, i] for i, name in enumerate(model.outputs)},
        sample_time=np.asarray(truth.dt * np.arange(len(calls.drive)), dtype=np.float64),
        readings=dict(zip(truth.sensors, calls.reading.T)),
        drive=dict(zip(model.drives, calls.drive.T)),
        target=dict(zip(controlled, calls.target.T)),
        status=calls.status,
        advice=calls.advice,
        seconds=calls.seconds,
        band=band,
        drive_range={n: (float(a), float(b)) for n, a, b in zip(model.drives, model.lowest, model.highest)},
        segments=tuple(segments),
    )


def drive_shares(drives: Array, lowest: Array, highest: Array) -> tuple[Array, Mask]:
    """Return drives (n, n_u) in fractions of full drive, and at which samples (n,) one is at its limit."""
    full = np.any(np.isclose(drives, lowest) | np.isclose(drives, highest), axis=1)
    return drives / np.maximum(np.abs(lowest), np.abs(highest)), full


def segment_of(
    name: str, time: Array, y: Array, goal: float, drive: Array, full: Mask, band: float
) -> Segment:
    """Return one target of a run: outputs y (n,) [degC] at times (n,) [s], drives (k, n_u) by sample in
    fractions of full drive, ``full`` (k,) where one is at its limit."""
    error = y - goal
    outside = np.flatnonzero(np.abs(error) > band)
    last = outside[-1] + 1 if outside.size else 0
    settle = float(time[last] - time[0]) if last < y.size else float("nan")
    length = float(time[-1] - time[0])
    tail = error[time >= time[-1] - (120.0 if length >= 240.0 else 0.2 * length)]
    side = np.sign(goal - y[0])
    busy = max(1, round((settle if np.isfinite(settle) else length) / length * full.size))
    return Segment(
        output=name,
        start=float(y[0]),
        target=float(goal),
        begin_s=float(time[0]),
        end_s=float(time[-1]),
        settle_s=settle,
        overshoot=float(max(0.0, np.max(error * side))) if side else float(np.max(np.abs(error))),
        bias=float(np.mean(tail)),
        sd=float(np.std(tail)),
        energy_s=float(np.sum(drive**2) * length / drive.shape[0]),
        travel=float(np.sum(np.abs(np.diff(drive, axis=0)))),
        full_share=float(np.mean(full[:busy])),
    )


class RecordedController:
    """A controller that keeps its ``moves``, beside a monitor whose words advise where one is ok."""

    def __init__(self, controller: Controller, monitor: LoopMonitor | None = None) -> None:
        self.controller, self.monitor, self.dt = controller, monitor, controller.dt
        # each with the time of its reading [s], counted in sample times where the reading has none
        self.moves: list[tuple[float, Move]] = []

    def reset(self, reading: Readings) -> None:
        """Let the controller forget the past; the moves are kept."""
        self.controller.reset(reading)
        if self.monitor is not None:
            self.monitor.forget()

    def __getattr__(self, name: str) -> Any:
        """Return what else the controller has."""
        return getattr(self.__dict__["controller"], name)

    def step(self, reading: Readings, target: Target) -> Move:
        """Return the controller's move, and keep it."""
        move = self.controller.step(reading, target)
        report = "" if self.monitor is None else self.monitor.note(reading, move, target)
        if report and move.status == "ok":
            move = replace(move, status="mismatch", advice=report)
        self.moves.append((float(reading.get("time_s", self.dt * len(self.moves))), move))
        return move


def session_loop(
    log: Log,
    moves: list[tuple[float, Move]],
    *,
    drive_range: Mapping[str, tuple[float, float]],
    band: float = 0.25,
    figures: Mapping[str, Mapping[str, float]] | None = None,
) -> ClosedLoop:
    """Return a session's log and the moves of its :class:`RecordedController` as a closed loop, up to the
    last move; ``figures`` of an output replace those of its readings sample by sample."""
    if len(moves) < 2:
        raise ValueError(f"{len(moves)} moves are no loop")
    logged = np.asarray(log["time"].values, dtype=float)
    rows = logged <= moves[-1][0] + 1e-6
    time = logged[rows] - logged[rows][0]
    targets = [str(name).removeprefix("target_") for name in log.data_vars if str(name).startswith("target_")]
    drives = {name: column(log, name)[rows] for name in drive_range}
    goal = {name: column(log, f"target_{name}")[rows] for name in targets}
    outputs = {name: column(log, name)[rows] for name in names(log, "output")}
    by_time = {round(time_s, 6): move for time_s, move in moves}
    # a reading that was rejected was not shown to the controller: its move was held
    answers = [by_time.get(round(float(time_s), 6)) for time_s in logged[rows]]
    lowest, highest = np.array([drive_range[name] for name in drives], dtype=float).T
    scaled, full = drive_shares(np.stack(list(drives.values()), axis=1), lowest, highest)
    segments = []
    for name, target in goal.items():
        segment = segment_of(name, time, outputs[name], float(target[0]), scaled, full, band)
        session_figures: Any = (figures or {}).get(name, {})
        segments.append(replace(segment, **session_figures))
    return ClosedLoop(
        time=time,
        outputs=outputs,
        sample_time=time,
        readings=outputs,
        drive=drives,
        target=goal,
        status=tuple("fallback_plan" if move is None else move.status for move in answers),
        advice=tuple("" if move is None else move.advice for move in answers),
        seconds=np.array([move.seconds for _, move in moves]),
        band=band,
        drive_range={name: (float(low), float(high)) for name, (low, high) in drive_range.items()},
        segments=tuple(segments),
    )
