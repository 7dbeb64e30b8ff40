"""The fault table: what goes wrong, what the controller says in which order, and where the skin goes.

Each row is a closed loop on a plant that is not the model: it settles at 34 degC, the fault comes and goes,
the loop goes on.  Each runs in Python and in C: the same drives, statuses and words.
Every drive is finite, in range and within the slew limit, every status but ok has an advice, and the
temperatures stay inside the tank's limits; after the fault the skin comes back without an offset.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from thermogrip.mpc.closed_loop.simulate import Surroundings, Truth
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.reference import ReferenceController
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.interface import STATUSES, Move
from thermogrip.mpc.native.runtime import compiler
from thermogrip.mpc.optimiser.rti import Outcome
from thermogrip.mpc.plant.prediction import PredictionModel

NAN = float("nan")
DT, SLEW = 2.0, 0.5  # s, and what the drive may change in a sample
BEFORE = 60  # samples before the fault
HOLD = 34.0  # degC
LIMITS = {"t_tank": (8.0, 50.0)}

PATHS = ["Python", "C"]
Reading = dict[str, Any]


@dataclass(frozen=True)
class Fault:
    """One row."""

    said: list[str]  # statuses while it lasts, in the order of their first appearance
    samples: int = 30  # how long it lasts
    # (samples since it began, reading, last good reading) -> what the controller is given
    reading: Callable[[int, Reading, Reading], Reading] = lambda k, now, before: now
    target: float = HOLD  # while it lasts [degC]
    advice: str = ""  # a pattern that some advice fits while it lasts
    world: str = "other"  # what the plant is: see ``worlds``
    meanwhile: str = ""  # what it is while it lasts
    broken: str = ""  # ``"solver"`` or ``"clock"`` fails while it lasts
    asleep: int = 0  # samples in which nobody calls the controller, from the beginning
    back: float = 0.05  # how far the mean skin may be from its target at the end [degC] ...
    after: int = 110  # ... so many samples after the fault


def given(**change: Any) -> Callable[[int, Reading, Reading], Reading]:
    """Return a reading in which these stand instead."""
    return lambda k, now, before: {**now, **change}


def without(name: str) -> Callable[[int, Reading, Reading], Reading]:
    return lambda k, now, before: {key: value for key, value in now.items() if key != name}


def more(name: str, by: float) -> Callable[[int, Reading, Reading], Reading]:
    return lambda k, now, before: {**now, name: now[name] + by}


def frozen(name: str) -> Callable[[int, Reading, Reading], Reading]:
    return lambda k, now, before: {**now, name: before[name]}


def at_time(time: Callable[[int, float], float]) -> Callable[[int, Reading, Reading], Reading]:
    return lambda k, now, before: {**now, "time_s": time(k, now["time_s"])}


def lost_later(k: int, now: Reading, before: Reading) -> Reading:
    return {**now, "t_surface": NAN} if k >= 20 else now


LOST, GONE, NO_READING = ["fallback_plan"], ["fallback_plan", "off"], "no usable reading"

FAULTS: Mapping[str, Fault] = {
    "nothing": Fault(["ok"]),
    # readings
    "the skin's reading is NaN for 4 samples": Fault(LOST, 4, given(t_surface=NAN), advice=NO_READING),
    "the skin's reading is NaN for a minute": Fault(GONE, 30, given(t_surface=NAN), advice=NO_READING),
    "the skin's reading is infinite": Fault(LOST, 4, given(t_surface=math.inf), advice=NO_READING),
    "the skin's reading is absurd": Fault(LOST, 2, given(t_surface=900.0), advice=NO_READING),
    "the skin's reading is missing": Fault(LOST, 4, without("t_surface"), advice=NO_READING),
    "all readings are missing": Fault(
        GONE, 20, lambda k, now, before: {"time_s": now["time_s"]}, advice=NO_READING
    ),
    "the tank's reading is NaN": Fault(["ok"], 30, given(t_tank=NAN), advice=NO_READING),
    "the room's reading is NaN": Fault(["ok"], 30, given(t_ambient=NAN), advice=NO_READING),
    "the skin's reading jumps for 3 samples": Fault(LOST, 3, more("t_surface", 12.0), advice=NO_READING),
    "the tank's reading jumps and stays": Fault(
        ["ok"], 60, more("t_tank", 12.0), advice=NO_READING + "|sensor"
    ),
    "the skin's sensor is stuck while the target moves": Fault(
        ["ok", "fallback_plan", "off"], 60, frozen("t_surface"), target=42.0, advice="stuck"
    ),
    "the skin's sensor is stuck while it rests": Fault(["ok"], 60, frozen("t_surface"), back=0.05),
    "the tank's sensor is stuck while the target moves": Fault(
        ["ok"], 60, frozen("t_tank"), target=42.0, advice="stuck", after=150
    ),
    # time
    "the reading has no time": Fault(["ok"], 20, without("time_s")),
    "the reading is stale": Fault(
        LOST, 4, at_time(lambda k, t: 2.0 * (BEFORE - 1)), advice="stale|no usable|lost"
    ),
    "the reading is stale for a minute": Fault(
        GONE, 30, at_time(lambda k, t: 2.0 * (BEFORE - 1)), advice="no reading|no usable|lost"
    ),
    "time goes backwards": Fault(
        LOST, 3, at_time(lambda k, t: t - 100.0 - 10.0 * k), advice="stale|no usable|lost"
    ),
    "the reading comes 8 s late": Fault(["ok"], 10, asleep=4),
    "nobody calls for 80 s": Fault(["ok"], 60, asleep=40, advice="started again"),
    # what is asked
    "the target is NaN": Fault(["infeasible"], 10, target=NAN, advice="target"),
    "the target is absurd": Fault(["infeasible"], 10, target=900.0, advice="target"),
    "the drive is at its end for ever on a plant that loses five times the heat": Fault(
        ["ok"], 150, target=47.0, world="leaky"
    ),
    "the drive that was applied is out of range": Fault(
        ["infeasible"], 3, given(drive=1.4), advice="out of range"
    ),
    "the drive that was applied is another": Fault(["ok"], 3, given(drive=0.0)),
    # inside
    "the deadline is 0 ms": Fault(["late"], 60, broken="clock", advice="deadline"),
    "the solver fails for 4 samples": Fault(LOST, 4, broken="solver", advice="optimiser"),
    "the solver fails: plan first, PI next": Fault(
        ["fallback_plan", "fallback_pi"], 60, broken="solver", advice="optimiser"
    ),
    "the solver fails, then the reading: plan first, PI next, off last": Fault(
        ["fallback_plan", "fallback_pi", "off"], 40, lost_later, broken="solver", advice="no reading"
    ),
    # the plant
    "the pump stops and the rig reports it": Fault(
        ["off"], 30, given(pump=0), meanwhile="stopped", advice="pump is off"
    ),
    "the pump stops and nobody reports it": Fault(["ok"], 75, meanwhile="stopped", back=0.4),
    "the plant has 30 % less power": Fault(["ok"], 60, world="less power", target=38.0),
    "the plant has 30 % more power": Fault(["ok"], 60, world="more power", target=38.0),
    "the delay is 30 % longer": Fault(["ok"], 60, world="longer delay", target=38.0),
    "the delay is 30 % shorter": Fault(["ok"], 60, world="shorter delay", target=38.0),
}


@pytest.fixture(scope="module")
def worlds(tank_maker) -> dict[str, Any]:
    """Plants by name; the model is ``tank_maker()``."""
    other = tank_maker(heat=0.1, loss=1 / 600, skin=13.5, delay=9)
    A, E = other.model.A.copy(), other.model.E.copy()
    A[2:] = np.eye(len(A))[2:]  # water stays in the tube, and the skin is left to the room
    A[1], E[1] = 0.0, 0.0
    A[1, 1], E[1, 0] = math.exp(-1 / 400), 1 - math.exp(-1 / 400)
    return {
        "other": other,
        "stopped": replace(other, model=replace(other.model, A=A, E=E)),
        "less power": tank_maker(heat=0.077),
        "more power": tank_maker(heat=0.143),
        "longer delay": tank_maker(delay=11),
        "shorter delay": tank_maker(delay=5),
        "leaky": tank_maker(heat=0.14, loss=1 / 150),  # 45.6 degC at most
    }


class Driver:
    """A controller in Python or in C; what fails is broken and mended here."""

    def __init__(self, plant, path: str) -> None:
        design = default_design(plant, dt=DT, limits=LIMITS, deadline_s=1e9)
        self.now, self.ticks = 0.0, 0.0
        self.c = None
        if path == "Python":
            self.controller = ReferenceController(plant, design, clock=self.clock)
            self.solve = self.controller.optimiser.solve
        else:
            self.controller = Controller(plant, design, clock=self.clock)
            self.c = self.controller.c
            assert self.c is not None

    def clock(self) -> float:
        self.now += self.ticks
        return self.now

    def breaks(self, what: str) -> None:
        if what == "clock":
            self.ticks = 1e12
        elif what == "solver" and self.c is not None:
            self.c.design.iteration_limit = -1
        elif what == "solver":
            bad = Outcome(np.full((1, 1), NAN), np.zeros((1, 2)), "iteration limit", {}, np.ones(1))
            self.controller.optimiser.solve = lambda *args, **kwargs: bad

    def mends(self) -> None:
        self.ticks = 0.0
        if self.c is not None:
            self.c.design.iteration_limit = 500
        else:
            self.controller.optimiser.solve = self.solve


@dataclass
class Record:
    """What came of a row."""

    status: list[str] = field(default_factory=list)
    advice: list[str] = field(default_factory=list)
    drive: list[float] = field(default_factory=list)
    skin: list[float] = field(default_factory=list)
    tank: list[float] = field(default_factory=list)


@pytest.fixture(scope="module")
def drivers(tank_maker) -> Callable[[str], Driver]:
    made: dict[str, Driver] = {}

    def driver(path: str) -> Driver:
        if path not in made:
            made[path] = Driver(tank_maker(), path)
        return made[path]

    return driver


def run(driver: Driver, fault: Fault, worlds: dict[str, Any]) -> tuple[Record, slice]:
    """Return the record of a row, and where in it the fault was."""
    around = Surroundings(offset={"t_tank": 0.15, "t_ambient": 0.3})
    truth = Truth(worlds[fault.world], DT, around, 28.0, 7)
    working, record = truth.model, Record()
    broken = PredictionModel(worlds[fault.meanwhile], dt=1.0) if fault.meanwhile else working
    last = truth.reading()
    driver.controller.reset(last)
    move, before = Move(0.0), 0.0
    for k in range(BEFORE + fault.samples + fault.after):
        since = k - BEFORE
        during = 0 <= since < fault.samples
        truth.model = broken if during else working
        if since == 0:
            driver.breaks(fault.broken)
        if since == fault.samples:
            driver.mends()
        reading = truth.reading()
        if not (0 <= since < fault.asleep):
            shown = fault.reading(since, reading, last) if during else reading
            move = driver.controller.step(shown, fault.target if during else HOLD)
            if "drive" in shown:
                before = min(max(shown["drive"], -1.0), 1.0)
            legal(move, before)
            before = move.drive
        last = last if during else reading
        truth.apply(move)
        record.status.append(move.status)
        record.advice.append(move.advice)
        record.drive.append(move.drive)
        record.skin.append(float(truth.y[-1][1]))
        record.tank.append(float(truth.y[-1][0]))
    return record, slice(BEFORE + fault.asleep, BEFORE + fault.samples)


def legal(move: Move, before: float) -> None:
    assert math.isfinite(move.drive)
    assert -1.0 <= move.drive <= 1.0
    assert abs(move.drive - before) <= SLEW + 1e-9
    assert move.status in STATUSES
    assert move.pump in (0, 1)
    assert move.advice or move.status == "ok"


@pytest.mark.parametrize("row", FAULTS)
def test_fault(row, drivers, worlds):
    fault, first = FAULTS[row], None
    for path in PATHS if compiler() else PATHS[:1]:
        record, during = run(drivers(path), fault, worlds)
        assert list(dict.fromkeys(record.status[during])) == fault.said
        assert any(re.search(fault.advice, text) for text in record.advice[during])
        assert min(record.skin + record.tank) > LIMITS["t_tank"][0]
        assert max(record.skin + record.tank) < LIMITS["t_tank"][1] + 1.0
        assert record.status[-1] == "ok"
        assert not record.advice[-1]
        assert abs(np.mean(record.skin[-30:]) - HOLD) < fault.back
        first = first or record
        assert record.status == first.status
        assert record.advice == first.advice
        np.testing.assert_allclose(record.drive, first.drive, atol=1e-9, err_msg=path)
