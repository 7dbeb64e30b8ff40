r"""Ten plants to be identified, tuned for and controlled, written for this alone: what closes the loop.

Nothing here is shared with the package.  Each :class:`Truth` has explicit equations, its inputs pass a delay
line, its sensors have noise, and each knows one unmeasured change that comes late in a run.  Temperatures are
degC, levels cm or percent, time s.

* rig: the skin behind two tubes of water of ``simulator.py``; then the skin loses more heat.
* tclab: two heaters with their sensors, and a board between them that no model has; then a draught.
* tanks: four tanks, two pumps that each feed two of them; then more water flows into the first.
* furnace: three windings, six thermocouples along the tube; then the end stands open.
* delay: a heated tube whose outlet is read a minute later; then the inflow is colder.
* integrator: a level between a valve and a pump of constant flow; then the pump draws more.
* reactor: an exothermic reaction, cooled through a jacket; identified without, run with a pocket of 6 s about
  the thermometer; then the feed is warmer.
* room: a day's weather, walls, clouds before the sun; then the sun comes in.
* hotend: 12 g of aluminium that radiate; then a fan blows at it.
* peltier: a cold plate, coldest at two thirds of the current; then 0.4 W of load.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import simulator
from numpy.typing import NDArray

Array = NDArray[np.float64]
Rates = Callable[[list[float], Sequence[float], Sequence[float], "Changes"], list[float]]


@dataclass
class Changes:
    """What changes during a run: whether the disturbance has come, and whether this is a run at all."""

    disturbed: bool = False
    running: bool = False  # not a log for identification
    sun: float = 0.0  # W, that nobody measures


@dataclass(frozen=True)
class Signal:
    """A column of a log."""

    name: str
    unit: str
    low: float = 0.0  # of an input
    high: float = 100.0
    noise: float = 0.0  # of a sensor


@dataclass(frozen=True)
class Case:
    """A plant with everything that its user writes down."""

    name: str
    about: str
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    make: Callable[[], Plant]
    log_dt: float  # s
    log_s: float  # s, of each of the logs
    hold: tuple[float, float]  # s, shortest and longest time that an input stays
    levels: tuple[tuple[float, float], ...]  # of each input, between which a log moves it
    rest: tuple[float, ...]  # inputs at which a log, and a run, begins
    spec: Mapping[str, object]
    targets: tuple[float, ...]  # of all controlled outputs; at the last comes the disturbance
    seconds: float  # of each
    band: float
    range: float  # of targets, of which overshoot may be half a percent
    pairs: tuple[tuple[str, str], ...]  # input and output of each PI loop
    disturbances: tuple[Signal, ...] = ()
    network: str | None = None
    switches: Mapping[str, float] = field(default_factory=dict)  # inputs that stay
    logs: int = 2


class Plant:
    """A truth that runs: ``read`` its sensors, ``run`` it under drives."""

    def __init__(
        self,
        rates: Rates,
        start: Sequence[float],
        shown: Sequence[int],
        *,
        step: float,
        delay: float = 0.0,
        weather: Callable[[float], float] | None = None,
        clouds: float = 0.0,
    ) -> None:
        self.rates, self.x, self.shown = rates, list(start), list(shown)
        self.step, self.weather, self.clouds = step, weather, clouds
        self.late = round(delay / step)
        self.line: deque[Sequence[float]] = deque()
        self.time, self.changes = 0.0, Changes()
        self.rng = np.random.default_rng(0)

    def read(self) -> Array:
        """Return what the sensors show, without noise."""
        return np.array([self.x[i] for i in self.shown])

    def outside(self) -> list[float]:
        """Return the measured disturbances."""
        return [] if self.weather is None else [self.weather(self.time)]

    def disturb(self) -> None:
        """Let the unmeasured change come."""
        self.changes.disturbed = True

    def settle(self, u: Sequence[float], seconds: float) -> None:
        """Come to rest; the clock starts then."""
        clouds, self.clouds = self.clouds, 0.0
        self.run(u, seconds)
        self.time, self.clouds = 0.0, clouds

    def run(self, u: Sequence[float], seconds: float) -> None:
        """Let so many seconds pass."""
        for _ in range(max(1, round(seconds / self.step))):
            self.line.append(tuple(u))
            while len(self.line) <= self.late:
                self.line.appendleft(tuple(u))
            given = self.line.popleft()
            if self.clouds:  # an hour's memory
                fade = self.step / 3600.0
                self.changes.sun += -fade * self.changes.sun
                self.changes.sun += self.clouds * (2 * fade) ** 0.5 * self.rng.standard_normal()
            rates = self.rates(self.x, given, self.outside(), self.changes)
            self.x = [x + self.step * rate for x, rate in zip(self.x, rates, strict=True)]
            self.time += self.step


class Rig(Plant):
    """``simulator.py``, with a drive of -1 to 1 and a pump that runs."""

    def __init__(self) -> None:
        self.own = simulator.Plant(simulator.Truth(room=24.0), start=24.0)
        self.time, self.changes, self.clouds = 0.0, Changes(), 0.0
        self.rng = np.random.default_rng(0)

    def read(self) -> Array:
        return self.own.read()[[1, 2]]

    def outside(self) -> list[float]:
        return [24.0]

    def disturb(self) -> None:
        self.own.numbers[simulator._LOSS] += 0.10  # W/K, where there were 0.15

    def settle(self, u: Sequence[float], seconds: float) -> None:
        self.own.run(5.0 * u[0], seconds)

    def run(self, u: Sequence[float], seconds: float) -> None:
        self.own.run(5.0 * u[0], seconds)
        self.time += seconds


SIGMA = 5.67e-8  # W/(m2 K4)


def _glow(a: float, b: float) -> float:
    return SIGMA * ((a + 273.15) ** 4 - (b + 273.15) ** 4)


def tclab() -> Plant:
    """Heaters of 4 g, sensors 14 s behind, a board of 8 J/K between them."""

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        a, b, board, s1, s2 = x
        air = 0.010 * (1.35 if c.disturbed else 1.0)
        cross = 0.003 * (a - b) + 1.8e-4 * 0.9 * _glow(a, b)
        lost = [air * (t - 22.0) + 9e-4 * 0.9 * _glow(t, 22.0) for t in (a, b)]
        return [
            (0.0095 * u[0] - lost[0] - cross - 0.012 * (a - board)) / 2.0,
            (0.0071 * u[1] - lost[1] + cross - 0.009 * (b - board)) / 2.0,
            (0.012 * (a - board) + 0.009 * (b - board) - 0.008 * (board - 22.0)) / 8.0,
            (a - s1) / 14.0,
            (b - s2) / 14.0,
        ]

    return Plant(rates, [22.0] * 5, [3, 4], step=0.25)


def tanks() -> Plant:
    """The minimum-phase setting of the quadruple tank, levels in cm, pumps in V."""

    def rates(h: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        out = [a * (2 * 981.0 * max(x, 0.0)) ** 0.5 for a, x in zip((0.071, 0.057, 0.071, 0.057), h)]
        extra = 3.0 if c.disturbed else 0.0
        return [
            (-out[0] + out[2] + 0.70 * 3.33 * u[0] + extra) / 28.0,
            (-out[1] + out[3] + 0.60 * 3.35 * u[1]) / 32.0,
            (-out[2] + 0.40 * 3.35 * u[1]) / 28.0,
            (-out[3] + 0.30 * 3.33 * u[0]) / 32.0,
        ]

    return Plant(rates, [12.0, 12.0, 1.5, 1.5], [0, 1], step=0.25)


def furnace() -> Plant:
    """Six zones of a tube, a winding over each pair."""

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        wire, zone = x[:3], x[3:]
        into = [1.2 * (wire[i // 2] - zone[i]) + 0.004 * 0.7 * _glow(wire[i // 2], zone[i]) for i in range(6)]
        heat = [(8.0 * u[j] - into[2 * j] - into[2 * j + 1]) / 90.0 for j in range(3)]
        along = [0.0, *(0.9 * (zone[i] - zone[i + 1]) for i in range(5)), 0.0]
        lost = [(0.9 + 0.5 * (i in (0, 5))) * (zone[i] - 23.0) for i in range(6)]
        lost[0] += 0.6 * (zone[0] - 23.0) if c.disturbed else 0.0
        size = (420.0, 400.0, 400.0, 400.0, 400.0, 440.0)
        return heat + [(into[i] + along[i] - along[i + 1] - lost[i]) / size[i] for i in range(6)]

    return Plant(rates, [23.0] * 9, range(3, 9), step=1.0)


def delay() -> Plant:
    """A minute of dead time."""

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        a, b = x
        feed = 20.0 - (3.0 if c.disturbed else 0.0)
        return [(feed + 0.6 * u[0] - a) / 120.0, (a - b) / 12.0]

    return Plant(rates, [38.0, 38.0], [1], step=1.0, delay=60.0)


def integrator() -> Plant:
    """A level in percent, 4 s behind its valve."""

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        _level, valve = x
        return [0.006 * (valve - 45.0 - (6.0 if c.disturbed else 0.0)), (u[0] - valve) / 4.0]

    return Plant(rates, [50.0, 45.0], [0], step=0.5)


def reactor() -> Plant:
    """100 L with a feed of 100 L/min; the coolant's valve moves the jacket's conductance."""

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        conc, temp, shown = x
        rate = 7.2e10 * np.exp(-8750.0 / (temp + 273.15)) * conc / 60.0  # mol/(L s)
        feed = 77.0 + (4.0 if c.disturbed else 0.0)
        cooled = (0.15 + 1.1 * u[0] / 100.0) / 60.0 * (temp - 15.0)
        lag = 6.0 if c.running else 0.2
        return [(1.0 - conc) / 60.0 - rate, (feed - temp) / 60.0 + 60.0 * rate - cooled, (temp - shown) / lag]

    return Plant(rates, [0.5, 60.0, 60.0], [2], step=0.1)


def room() -> Plant:
    """Air, furniture and walls; a radiator of 2 kW."""

    def rates(x: list[float], u: Sequence[float], d: Sequence[float], c: Changes) -> list[float]:
        air, wall, iron = x
        sun = max(0.0, 150.0 + c.sun) + (500.0 if c.disturbed else 0.0)
        warm = 45.0 * (iron - air)
        return [
            (warm - 120.0 * (air - wall) - 50.0 * (air - d[0]) + 0.6 * sun) / 4e5,
            (120.0 * (air - wall) - 40.0 * (wall - d[0]) + 0.4 * sun) / 6e6,
            (20.0 * u[0] - warm) / 3e4,
        ]

    def weather(t: float) -> float:
        return 4.0 + 4.0 * float(np.sin(2 * np.pi * (t / 86400.0 - 0.4))) + float(np.sin(t / 23000.0))

    return Plant(rates, [18.0, 15.0, 20.0], [0], step=30.0, weather=weather, clouds=80.0)


def hotend() -> Plant:
    """A heater of 40 W, a sensor 3 s behind."""

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        wire, block, shown = x
        lost = (0.10 + (0.05 if c.disturbed else 0.0)) * (block - 25.0) + 8e-4 * 0.5 * _glow(block, 25.0)
        return [
            (0.4 * u[0] - 1.2 * (wire - block)) / 3.0,
            (1.2 * (wire - block) - lost) / 11.0,
            (block - shown) / 3.0,
        ]

    return Plant(rates, [25.0] * 3, [2], step=0.1)


def peltier() -> Plant:
    """An element of 4 A at 100 percent, a heatsink that warms up; most is cooled at about two thirds."""

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        cold, sink, shown = x
        amp = 0.04 * u[0]
        joule = 0.5 * 2.2 * amp * amp
        pumped = 0.022 * amp * (cold + 273.15) - joule - 0.35 * (sink - cold)
        given = 0.022 * amp * (sink + 273.15) + joule - 0.35 * (sink - cold)
        load = 0.4 if c.disturbed else 0.0
        return [
            (-pumped + 0.12 * (24.0 - cold) + load) / 40.0,
            (given - 4.0 * (sink - 24.0)) / 250.0,
            (cold - shown) / 2.0,
        ]

    return Plant(rates, [24.0] * 3, [2], step=0.2)


def _heat(*names: str) -> tuple[Signal, ...]:
    return tuple(Signal(name, "percent") for name in names)


def _sensors(noise: float, *names: str, unit: str = "degC") -> tuple[Signal, ...]:
    return tuple(Signal(name, unit, noise=noise) for name in names)


CASES = (
    Case(
        "rig", "skin behind two tubes of water",
        (Signal("drive", "1", -1.0, 1.0), Signal("pump", "1", 0.0, 1.0)),
        _sensors(0.04, "t_tank", "t_surface"), Rig,
        0.5, 1800.0, (20.0, 120.0), ((-0.6, 0.3), (1.0, 1.0)), (0.0, 1.0),
        {"output": "t_surface", "steps": [(25.0, 38.0), (25.0, 18.0)], "settle_within_s": 300.0},
        (38.0, 20.0), 400.0, 0.25, 40.0, (("drive", "t_surface"),),
        disturbances=(Signal("t_ambient", "degC", noise=0.05),), network="gripper", switches={"pump": 1.0},
    ),
    Case(
        "tclab", "two heaters, two sensors, a board",
        _heat("q1", "q2"), _sensors(0.08, "t1", "t2"), tclab,
        1.0, 2400.0, (60.0, 400.0), ((0.0, 90.0), (0.0, 90.0)), (0.0, 0.0),
        {"output": ["t1", "t2"], "steps": [(22.0, 40.0), (40.0, 50.0)], "ambient_degC": 22.0,
         "settle_within_s": 600.0, "hold_s": 900.0},
        (40.0, 48.0), 900.0, 0.25, 60.0, (("q1", "t1"), ("q2", "t2")), network="tclab",
    ),
    Case(
        "tanks", "four tanks, two pumps",
        (Signal("v1", "V", 0.0, 10.0), Signal("v2", "V", 0.0, 10.0)),
        _sensors(0.03, "h1", "h2", unit="cm"), tanks,
        2.0, 3000.0, (60.0, 300.0), ((2.3, 3.7), (2.3, 3.7)), (3.0, 3.0),
        {"output": ["h1", "h2"], "steps": [(12.0, 14.0), (14.0, 11.0)], "band_degC": 0.1, "noise_degC": 0.03,
         "overshoot_degC": 0.1, "sensor_offset_degC": 0.0, "settle_within_s": 400.0,
         "drive_limits": {"v1": (0.0, 10.0), "v2": (0.0, 10.0)}},
        (14.0, 11.0), 600.0, 0.1, 20.0, (("v1", "h1"), ("v2", "h2")),
    ),
    Case(
        "furnace", "three windings, six thermocouples",
        _heat("p1", "p2", "p3"), _sensors(0.2, "t1", "t2", "t3", "t4", "t5", "t6"), furnace,
        5.0, 10800.0, (200.0, 1500.0), ((5.0, 60.0),) * 3, (0.0, 0.0, 0.0),
        {"output": ["t2", "t4", "t6"], "steps": [(100.0, 150.0), (150.0, 180.0)], "band_degC": 1.0,
         "overshoot_degC": 1.0, "noise_degC": 0.2, "bias_degC": 0.2, "sensor_offset_degC": 0.5,
         "settle_within_s": 2000.0, "hold_s": 3000.0, "ambient_degC": 23.0},
        (150.0, 180.0), 3000.0, 1.0, 250.0, (("p1", "t2"), ("p2", "t4"), ("p3", "t6")),
    ),
    Case(
        "delay", "a minute of dead time",
        _heat("valve"), _sensors(0.05, "t_out"), delay,
        5.0, 7200.0, (120.0, 600.0), ((10.0, 60.0),), (30.0,),
        {"output": "t_out", "steps": [(38.0, 44.0), (44.0, 35.0)], "settle_within_s": 600.0, "hold_s": 900.0},
        (44.0, 36.0), 900.0, 0.25, 60.0, (("valve", "t_out"),),
    ),
    Case(
        "integrator", "a level between valve and pump",
        _heat("valve"), _sensors(0.1, "level", unit="percent"), integrator,
        2.0, 3600.0, (30.0, 150.0), ((25.0, 65.0),), (45.0,),
        {"output": "level", "steps": [(50.0, 60.0), (60.0, 45.0)], "band_degC": 0.5, "noise_degC": 0.1,
         "overshoot_degC": 0.5, "sensor_offset_degC": 0.0, "settle_within_s": 300.0},
        (60.0, 45.0), 400.0, 0.5, 100.0, (("valve", "level"),),
    ),
    Case(
        "reactor", "an exothermic reaction; 6 s that the logs do not have",
        _heat("coolant"), _sensors(0.05, "t_reactor"), reactor,
        1.0, 3600.0, (30.0, 200.0), ((20.0, 80.0),), (50.0,),
        {"output": "t_reactor", "steps": [(58.0, 64.0), (64.0, 56.0)], "settle_within_s": 200.0,
         "hold_s": 400.0},
        (64.0, 56.0), 400.0, 0.25, 40.0, (("coolant", "t_reactor"),),
    ),
    Case(
        "room", "walls, weather, clouds",
        _heat("radiator"), _sensors(0.03, "t_room"), room,
        120.0, 4 * 86400.0, (3600.0, 6 * 3600.0), ((0.0, 100.0),), (50.0,),
        {"output": "t_room", "steps": [(19.0, 21.0), (21.0, 19.5)], "settle_within_s": 7200.0,
         "hold_s": 14400.0, "ambient_degC": 5.0, "noise_degC": 0.03},
        (21.0, 19.5), 14400.0, 0.25, 20.0, (("radiator", "t_room"),),
        disturbances=(Signal("t_out", "degC", noise=0.05),),
    ),
    Case(
        "hotend", "a nozzle that a fan blows at",
        _heat("heater"), _sensors(0.15, "t_nozzle"), hotend,
        0.5, 1800.0, (20.0, 180.0), ((0.0, 90.0),), (0.0,),
        {"output": "t_nozzle", "steps": [(150.0, 200.0), (200.0, 220.0)], "band_degC": 1.0,
         "overshoot_degC": 1.0, "bias_degC": 0.2, "noise_degC": 0.15, "settle_within_s": 120.0,
         "hold_s": 300.0},
        (200.0, 220.0), 300.0, 1.0, 250.0, (("heater", "t_nozzle"),),
    ),
    Case(
        "peltier", "a cold plate past its optimum",
        _heat("current"), _sensors(0.04, "t_plate"), peltier,
        1.0, 3600.0, (60.0, 400.0), ((0.0, 100.0),), (0.0,),
        {"output": "t_plate", "steps": [(20.0, 12.0), (12.0, 16.0)], "settle_within_s": 400.0,
         "ambient_degC": 24.0},
        (12.0, 10.0), 600.0, 0.25, 40.0, (("current", "t_plate"),),
    ),
)  # fmt: skip


def record(case: Case, seed: int) -> tuple[Array, dict[str, Array]]:
    """Return a log, times [s] and columns: inputs jump between levels, sensors are noisy."""
    rng, plant = np.random.default_rng([seed, len(case.name), *case.name.encode()]), case.make()
    plant.rng = rng
    plant.settle(case.rest, 40 * case.hold[1])
    n, dt = round(case.log_s / case.log_dt), case.log_dt
    u = np.array(case.rest, dtype=float)
    until = np.full(len(u), 2 * case.hold[0])  # a log begins at rest
    columns: list[list[float]] = []
    for k in range(n):
        for j, (low, high) in enumerate(case.levels):
            if k * dt >= until[j]:
                u[j] = np.round(rng.uniform(low, high), 3)
                until[j] = k * dt + rng.uniform(*case.hold)
        shown = plant.read()
        if case.name == "integrator":  # its operator keeps it in the tank
            u[0] = min(u[0], 42.0) if shown[0] > 75.0 else max(u[0], 48.0) if shown[0] < 25.0 else u[0]
        noisy = shown + [s.noise * rng.standard_normal() for s in case.outputs]
        around = [v + s.noise * rng.standard_normal() for v, s in zip(plant.outside(), case.disturbances)]
        columns.append([*u, *noisy, *around])
        plant.run(u, dt)
    names = [s.name for s in (*case.inputs, *case.outputs, *case.disturbances)]
    return dt * np.arange(n), dict(zip(names, np.array(columns).T, strict=True))
