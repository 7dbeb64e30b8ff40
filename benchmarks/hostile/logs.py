"""Logs of plants that nobody has named, as their programs write them: are they read right, or asked about?

    python benchmarks/hostile/logs.py [--seed N] [--only WORD] [--fit] [--keep DIR]

Every file is simulated here (plants of first and second order with noise and a coarse sensor; rates, gains,
names and the order of columns are drawn from the seed) and is written with its right answer: which columns
are inputs, outputs and disturbances, the seconds between rows, and what has to be said about it.  It is then
read with no role given, and with --fit identified.

right   the roles and the clock are those of the simulation, and all that has to be said is said.
asked   refused with the option that would answer, or not "good", with a warning that names each column in
        question.
wrong   anything else: another role, another clock, or nothing said.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.log_files import read_log
from thermogrip.sysid.data.data_quality import check_data

Series = NDArray[np.float64]
Rng = np.random.Generator

CLOSED_LOOP = "closed loop|feedback"
APART = "told apart|always move together|estimated separately"
SAME_SIGNAL = "same signal|another unit|same readings"
STATES_ROLES = "--inputs|--outputs|--disturbances|--columns"


@dataclass(frozen=True)
class Case:
    """A file and its right answer; a column in `free` may have any role or none."""

    text: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    dt: float
    disturbances: tuple[str, ...] = ()
    free: tuple[str, ...] = ()
    says: tuple[str, ...] = ()  # regular expressions: all of them, for "right"
    asks: str = STATES_ROLES  # what a refusal has to name
    suffix: str = ".csv"


# ---- plants ----


def lag(drive: Series, dt: float, seconds: float, start: float = 0.0) -> Series:
    """Follow `drive`, held between rows, through one time constant."""
    keep = np.exp(-dt / seconds)
    out = np.empty(len(drive))
    state = start
    for row, value in enumerate(drive):
        out[row] = state
        state = keep * state + (1 - keep) * value
    return out


def steps(rng: Rng, rows: int, levels: list[float], shortest: int, longest: int) -> Series:
    """Hold one of `levels` for a random number of rows, then another one."""
    out: list[float] = []
    last = float("nan")
    while len(out) < rows:
        level = float(rng.choice([one for one in levels if one != last]))
        out += [level] * int(rng.integers(shortest, longest + 1))
        last = level
    return np.array(out[:rows])


def weather(rng: Rng, rows: int, dt: float) -> Series:
    """Return a day outdoors: a slow swing and a random walk."""
    period = rows * dt / rng.uniform(1.2, 2.5)
    t = np.arange(rows) * dt
    walk = np.cumsum(rng.normal(0, 0.02, rows))
    return rng.uniform(4, 12) + rng.uniform(3, 6) * np.sin(2 * np.pi * t / period + rng.uniform(0, 6)) + walk


def sensor(rng: Rng, truth: Series, noise: float, step: float) -> Series:
    """Read with noise, in steps of the sensor."""
    return np.round((truth + rng.normal(0, noise, len(truth))) / step) * step


def block(rng: Rng, drive: Series, dt: float, ambient: float, gain: float, seconds: float) -> Series:
    """Return a heated body behind its sensor: `gain` degC per unit of drive."""
    return ambient + lag(lag(gain * drive, dt, seconds), dt, seconds / rng.uniform(8, 15))


@dataclass
class Loop:
    """A controlled body: temperature, drive and what the controller computes, row by row."""

    temperature: Series
    drive: Series
    error: Series
    integral: Series


def under_pi(rng: Rng, target: Series, dt: float, ambient: float, gain: float, seconds: float) -> Loop:
    """Simulate a PI controller of 0 to 100 on a body of two time constants."""
    rows = len(target)
    temperature, drive, error, integral = (np.zeros(rows) for _ in range(4))
    body = skin = ambient
    total = 0.0
    for row in range(rows):
        temperature[row] = np.round((skin + rng.normal(0, 0.05)) / 0.0625) * 0.0625
        error[row] = target[row] - temperature[row]
        total += error[row] * dt * 4 / gain / seconds
        total = float(np.clip(total, 0, 100))
        integral[row] = total
        drive[row] = np.round(np.clip(6 / gain * error[row] + total, 0, 100), 1)
        body += dt / seconds * (ambient + gain * drive[row] - body)
        skin += dt / (seconds / 12) * (body - skin)
    return Loop(temperature, drive, error, integral)


def thermostat(rng: Rng, target: Series, dt: float, ambient: float, gain: float, seconds: float) -> Loop:
    """Simulate a relay with hysteresis of 0.4 degC."""
    rows = len(target)
    temperature, drive = np.zeros(rows), np.zeros(rows)
    body = skin = ambient
    on = 0.0
    for row in range(rows):
        temperature[row] = np.round((skin + rng.normal(0, 0.03)) / 0.0625) * 0.0625
        if temperature[row] < target[row] - 0.4:
            on = 1.0
        elif temperature[row] > target[row] + 0.4:
            on = 0.0
        drive[row] = on
        body += dt / seconds * (ambient + gain * on - body)
        skin += dt / (seconds / 15) * (body - skin)
    return Loop(temperature, drive, target - temperature, drive)


# ---- files ----


def number(value: float, digits: int, decimal: str = ".") -> str:
    """Write a number as a logger would; NaN is an empty cell."""
    return "" if np.isnan(value) else f"{value:.{digits}f}".replace(".", decimal)


def table(
    rng: Rng,
    columns: dict[str, tuple[Series | list[str], int]],
    *,
    separator: str = ",",
    decimal: str = ".",
    first: int = 1,
) -> str:
    """Write columns of (values, digits) as text; all but the `first` ones in random order."""
    names = list(columns)
    order = names[:first] + [names[first + k] for k in rng.permutation(len(names) - first)]
    cells = [
        values if isinstance(values, list) else [number(float(value), digits, decimal) for value in values]
        for values, digits in (columns[name] for name in order)
    ]
    return "\n".join([separator.join(order), *map(separator.join, zip(*cells, strict=True))]) + "\n"


def pick(rng: Rng, *names: str) -> str:
    """Choose a name."""
    return str(rng.choice(names))


def stamps(rng: Rng, rows: int, dt: float, form: str = "%Y-%m-%d %H:%M:%S") -> list[str]:
    """Return stamps of local time."""
    start = datetime(2023, int(rng.integers(1, 13)), 7, 6, 13, 20)
    return [(start + timedelta(seconds=row * dt)).strftime(form) for row in range(rows)]


def clock(rows: int, dt: float, rng: Rng, jitter: float = 0.0, start: float = 0.0) -> Series:
    """Return seconds with jitter, strictly rising."""
    return start + dt * np.arange(rows) + rng.uniform(0, jitter, rows) * dt


# ---- inputs that are nearly alike ----


def two_relays(rng: Rng) -> Case:
    """Two relays that know nothing of each other, two temperatures."""
    dt, rows = float(rng.choice([5, 10, 30])), 1400
    a, b = steps(rng, rows, [0, 1], 15, 70), steps(rng, rows, [0, 1], 15, 70)
    one = 20 + lag(14 * a + 3 * b, dt, 40 * dt)
    two = 20 + lag(4 * a - 9 * b, dt, 70 * dt)
    first, second = (
        pick(rng, "pump", "relais1", "SSR_A", "heater"),
        pick(rng, "fan", "relais2", "SSR_B", "chiller"),
    )
    columns = {
        "time_s": (clock(rows, dt, rng), 0),
        first: (a, 0),
        second: (b, 0),
        "kettle_degC": (sensor(rng, one, 0.05, 0.0625), 4),
        "pipe_degC": (sensor(rng, two, 0.05, 0.0625), 4),
    }
    return Case(table(rng, columns), (first, second), ("kettle", "pipe"), dt)


def three_relays(rng: Rng) -> Case:
    """Three relays as words, one temperature each, stamps of local time."""
    dt, rows = float(rng.choice([10, 60])), 1500
    relays = [steps(rng, rows, [0, 1], 12, 60) for _ in range(3)]
    mixed = [[12, 2, 1], [2, 9, 2], [1, 3, 15]]
    columns: dict[str, tuple[Series | list[str], int]] = {"time": (stamps(rng, rows, dt), 0)}
    words = [("off", "on"), ("OFF", "ON"), ("false", "true")][int(rng.integers(3))]
    for k, relay in enumerate(relays):
        columns[f"zone{k + 1}_valve"] = ([words[int(value)] for value in relay], 0)
        drive = sum(gain * other for gain, other in zip(mixed[k], relays, strict=True))
        truth = 18 + lag(np.asarray(drive), dt, (30 + 15 * k) * dt)
        columns[f"zone{k + 1}_temperature"] = (sensor(rng, truth, 0.04, 0.1), 1)
    names = [f"zone{k}" for k in (1, 2, 3)]
    return Case(
        table(rng, columns), tuple(f"{n}_valve" for n in names), tuple(f"{n}_temperature" for n in names), dt
    )


def relay_and_duty(rng: Rng) -> Case:
    """A relay of 0/1 beside a duty of 0 and 255 that moves on its own."""
    dt, rows = float(rng.choice([1, 2])), 1500
    relay, duty = steps(rng, rows, [0, 1], 20, 90), steps(rng, rows, [0, 255], 20, 90)
    truth = 22 + lag(lag(10 * relay + 0.12 * duty, dt, 60 * dt), dt, 5 * dt)
    a, b, y = (
        pick(rng, "valve", "solenoid"),
        pick(rng, "pwm", "heater_pwm"),
        pick(rng, "probe_degC", "oven_degC"),
    )
    columns = {
        "t_s": (clock(rows, dt, rng), 1),
        a: (relay, 0),
        b: (duty, 0),
        y: (sensor(rng, truth, 0.05, 0.05), 2),
    }
    return Case(table(rng, columns), (a, b), (y,), dt)


def elements_together(rng: Rng) -> Case:
    """Two elements that are always driven alike: their effects cannot be told apart."""
    dt, rows = 1.0, 1500
    u = steps(rng, rows, [0, 20, 50, 80, 100], 20, 110)
    truth = 24 + lag(0.5 * u, dt, 80) + lag(0.3 * u, dt, 190)
    columns = {
        "seconds": (clock(rows, dt, rng), 0),
        "element_left": (u, 0),
        "element_right": (u, 0),
        "oven_degC": (sensor(rng, truth, 0.1, 0.25), 2),
    }
    return Case(table(rng, columns), ("element_left", "element_right"), ("oven",), dt, says=(APART,))


def heater_and_cooler(rng: Rng) -> Case:
    """A fermenter under a controller of two relays that are never on at once."""
    dt, rows = 30.0, 2200
    target = steps(rng, rows, [10, 13, 16, 19, 21], 200, 420)
    beer, fridge, heat, cool = 16.0, 16.0, 0.0, 0.0
    logged = np.zeros((rows, 4))
    for row in range(rows):
        seen = round((beer + rng.normal(0, 0.02)) / 0.0625) * 0.0625
        air = round((fridge + rng.normal(0, 0.04)) / 0.0625) * 0.0625
        wanted = target[row] + 3 * (target[row] - seen)
        heat = float(air < wanted - (0.2 if heat else 0.8))
        cool = float(not heat and air > wanted + (0.2 if cool else 0.8))
        logged[row] = seen, air, heat, cool
        fridge += dt * ((19 - fridge) / 5000 + (beer - fridge) / 2200 + 0.006 * heat - 0.011 * cool)
        beer += dt * (fridge - beer) / 6000
    columns = {
        "Time": (stamps(rng, rows, dt), 0),
        "Beer Temp": (logged[:, 0], 2),
        "Beer Set": (target, 1),
        "Fridge Temp": (logged[:, 1], 2),
        "Heat": (logged[:, 2], 0),
        "Cool": (logged[:, 3], 0),
    }
    return Case(
        table(rng, columns),
        ("Heat", "Cool"),
        ("Beer Temp", "Fridge Temp"),
        dt,
        free=("Beer Set",),
        says=(CLOSED_LOOP, "Beer.?Set"),
    )


def states_in_words(rng: Rng) -> Case:
    """A fermenter whose drive is a word of three: one input for each of the two."""
    dt, rows = 60.0, 1600
    state = steps(rng, rows, [-1, 0, 1], 10, 50)
    truth = 18 + lag(np.where(state > 0, 9.0, np.where(state < 0, -12.0, 0.0)), dt, 45 * dt)
    words = {-1.0: "COOLING", 0.0: "IDLE", 1.0: "HEATING"}
    columns = {
        "timestamp": (stamps(rng, rows, dt), 0),
        "state": ([words[float(value)] for value in state], 0),
        "beer_temp": (sensor(rng, truth, 0.03, 0.0625), 2),
        "room_temp": (sensor(rng, 18 + lag(rng.normal(0, 12, rows), dt, 60 * dt), 0.03, 0.0625), 2),
    }
    return Case(
        table(rng, columns),
        ("state_HEATING", "state_COOLING"),
        ("beer_temp",),
        dt,
        free=("room_temp",),
        asks=r"state\b.*(word|text|number)",
    )


# ---- closed loops ----


def pid_terms(rng: Rng) -> Case:
    """A PID log with its error and terms as columns."""
    dt, rows = float(rng.choice([0.5, 1])), 1800
    target = steps(rng, rows, [40, 55, 70, 85], 180, 400)
    loop = under_pi(rng, target, dt, 21, 1.1, 90 * dt)
    rate = np.gradient(loop.temperature, dt)
    setpoint, y, u = (
        pick(rng, "Setpoint", "SP", "target"),
        pick(rng, "Input", "PV", "temp"),
        pick(rng, "Output", "OP"),
    )
    columns = {
        "time_s": (clock(rows, dt, rng), 1),
        setpoint: (target, 1),
        y: (loop.temperature, 3),
        "error": (loop.error, 3),
        "P": (6 / 1.1 * loop.error, 3),
        "I": (loop.integral, 3),
        "D": (-2 * rate, 3),
        u: (loop.drive, 1),
    }
    return Case(
        table(rng, columns),
        (u,),
        (y,),
        dt,
        free=(setpoint, "error", "P", "I", "D"),
        says=(CLOSED_LOOP, r"\berror\b"),
    )


def loop_without_set_point(rng: Rng) -> Case:
    """A PI loop whose set point was not logged."""
    dt, rows = float(rng.choice([1, 2, 5])), 1600
    target = steps(rng, rows, [45, 50, 60, 75], 150, 350)
    loop = under_pi(rng, target, dt, 20, 0.9, 100 * dt)
    y, u = pick(rng, "reactor_degC", "bad_degC", "tank_degC"), pick(rng, "output_percent", "heater_percent")
    columns = {"time_s": (clock(rows, dt, rng), 0), y: (loop.temperature, 4), u: (loop.drive, 1)}
    return Case(table(rng, columns), (u,), (y,), dt, says=(CLOSED_LOOP,))


def thermostat_alone(rng: Rng) -> Case:
    """A relay with hysteresis, no set point logged."""
    dt, rows = float(rng.choice([10, 20])), 1600
    target = steps(rng, rows, [20.0, 21, 22.5, 24], 250, 500)
    loop = thermostat(rng, target, dt, 12, 25, 120 * dt)
    u, y = pick(rng, "burner", "chaudiere", "Brenner"), pick(rng, "room_degC", "salon_degC", "Stube_degC")
    columns = {"time_s": (clock(rows, dt, rng), 0), u: (loop.drive, 0), y: (loop.temperature, 4)}
    return Case(table(rng, columns), (u,), (y,), dt, says=(CLOSED_LOOP,))


def set_point_logged(rng: Rng) -> Case:
    """A loop with its set point beside it, in words of another language."""
    dt, rows = float(rng.choice([2, 5])), 1700
    target = steps(rng, rows, [30, 38, 46, 52], 160, 380)
    loop = under_pi(rng, target, dt, 19, 0.7, 80 * dt)
    names = [
        ("Sollwert", "Istwert", "Stellgröße"),
        ("consigne", "mesure", "commande"),
        ("setpunto", "temperatura", "salida"),
    ]
    setpoint, y, u = names[int(rng.integers(3))]
    columns = {
        "time_s": (clock(rows, dt, rng), 0),
        setpoint: (target, 1),
        y: (loop.temperature, 2),
        u: (loop.drive, 1),
    }
    return Case(table(rng, columns), (u,), (y,), dt, free=(setpoint,), says=(CLOSED_LOOP, setpoint))


# ---- clocks ----


def open_block(rng: Rng, rows: int, dt: float) -> tuple[Series, Series]:
    """Return a drive of 0 to 255 and the temperature that it makes."""
    u = steps(rng, rows, [0, 60, 120, 180, 255], 20, 90)
    return u, sensor(rng, block(rng, u, dt, 23, 0.25, rng.uniform(50, 90) * dt), 0.06, 0.0625)


def bare(rng: Rng, counts: Series, u: Series, y: Series, dt: float) -> Case:
    """Write counts of a clock, drive and reading without a header: columns have their place for a name."""
    lines = table(rng, {"clock": (counts, 0), "u": (u, 0), "y": (y, 4)}, first=0).split("\n", 1)
    place = {name: f"c{at}" for at, name in enumerate(lines[0].split(","), 1)}
    return Case(lines[1], (place["u"],), (place["y"],), dt, asks="clock|time|--dt")


def bare_milliseconds(rng: Rng) -> Case:
    """Milliseconds since the board's start, no header at all."""
    dt, rows = float(rng.choice([0.1, 0.25, 0.5])), 1500
    u, y = open_block(rng, rows, dt)
    ms = np.round(1000 * clock(rows, dt, rng, 0.02, start=float(rng.uniform(1, 900))))
    return bare(rng, ms, u, y, dt)


def microseconds(rng: Rng) -> Case:
    """A column `micros`, as Arduino's function is called."""
    dt, rows = float(rng.choice([0.02, 0.05])), 1500
    u, y = open_block(rng, rows, dt)
    us = np.round(1e6 * clock(rows, dt, rng, 0.01, start=3.0))
    return Case(table(rng, {"micros": (us, 0), "pwm": (u, 0), "temp": (y, 4)}), ("pwm",), ("temp",), dt)


def bare_epoch_milliseconds(rng: Rng) -> Case:
    """Milliseconds since 1970, no header."""
    dt, rows = float(rng.choice([1, 10, 30])), 1500
    u, y = open_block(rng, rows, dt)
    ms = np.round(1000 * clock(rows, dt, rng, 0.01, start=1.68e9 + float(rng.integers(0, 10**7))))
    return bare(rng, ms, u, y, dt)


def epoch_seconds(rng: Rng) -> Case:
    """Seconds since 1970 under a name that does not say so."""
    dt, rows = float(rng.choice([5, 15])), 1500
    u, y = open_block(rng, rows, dt)
    stamp = np.round(clock(rows, dt, rng, start=1.6e9 + float(rng.integers(0, 10**7))))
    name = pick(rng, "ts", "created", "Zeit")
    return Case(
        table(rng, {name: (stamp, 0), "pwm": (u, 0), "temp": (y, 4)}, first=0), ("pwm",), ("temp",), dt
    )


def wrap_16(rng: Rng) -> Case:
    """A counter of 16 bits in milliseconds that begins anew every 65.5 s."""
    dt, rows = float(rng.choice([0.1, 0.2])), 1500
    u, y = open_block(rng, rows, dt)
    ms = np.round(1000 * clock(rows, dt, rng, 0.0, start=float(rng.uniform(1, 60)))) % 2**16
    return Case(
        table(rng, {"ms": (ms, 0), "pwm": (u, 0), "temp": (y, 4)}), ("pwm",), ("temp",), dt, asks="ms|--dt"
    )


def bare_wrap_32(rng: Rng) -> Case:
    """Microseconds of 32 bits that begin anew in the middle, no header."""
    dt, rows = 0.05, 1600
    u, y = open_block(rng, rows, dt)
    us = np.round(2**32 - 1e6 * dt * rows * rng.uniform(0.3, 0.7) + 1e6 * dt * np.arange(rows)) % 2**32
    return bare(rng, us, u, y, dt)


def reset_in_the_middle(rng: Rng) -> Case:
    """The board is reset: its clock begins anew, the block cooled meanwhile."""
    dt, rows = float(rng.choice([0.5, 1])), 1800
    cut = int(rows * rng.uniform(0.4, 0.6))
    u1, y1 = open_block(rng, cut, dt)
    u2, y2 = open_block(rng, rows - cut, dt)
    ms = np.round(
        1000 * np.concatenate([clock(cut, dt, rng, start=700.0), clock(rows - cut, dt, rng, start=2.0)])
    )
    name = pick(rng, "millis", "time_ms", "t_ms")
    columns = {name: (ms, 0), "duty": (np.r_[u1, u2], 0), "temp_degC": (np.r_[y1, y2], 4)}
    return Case(
        table(rng, columns),
        ("duty",),
        ("temp",),
        dt,
        says=("reset|(begins?|starts?) (anew|again)|goes back|two pieces",),
        asks="reset|(begins?|starts?) (anew|again)|cut",
    )


def row_counter_and_meter(rng: Rng) -> Case:
    """A row number and an energy meter beside the clock: neither is a clock, an input or an output."""
    dt, rows = float(rng.choice([2, 4])), 1500
    u, y = open_block(rng, rows, dt)
    columns = {
        "time_s": (clock(rows, dt, rng, 0.02), 2),
        "n": (np.arange(rows, dtype=float), 0),
        "energy_Wh": (np.cumsum(u) * dt / 3600 * 0.2, 2),
        "pwm": (u, 0),
        "temp": (y, 4),
    }
    return Case(table(rng, columns, first=0), ("pwm",), ("temp",), dt)


# ---- dead sensors ----


def code_runs(rng: Rng) -> Case:
    """-127 while the probe is unplugged, 85 once after a brown-out."""
    dt, rows = float(rng.choice([2, 5])), 1600
    u = steps(rng, rows, [0, 1], 20, 90)
    y = sensor(rng, block(rng, u, dt, 19, 28, 70 * dt), 0.04, 0.0625)
    for start in rng.choice(np.arange(40, rows - 60, 70), 6, replace=False):
        y[start : start + int(rng.integers(2, 40))] = -127
    y[rng.choice(rows, 8, replace=False)] = 85.0
    name = pick(rng, "probe_degC", "T_boiler_degC", "sonde_degC")
    columns = {"time_s": (clock(rows, dt, rng), 0), "relay": (u, 0), name: (y, 4)}
    return Case(table(rng, columns), ("relay",), (name,), dt, says=("-127", r"\b85\b"))


def code_in_a_disturbance(rng: Rng) -> Case:
    """999.9 in runs outdoors."""
    dt, rows = 60.0, 1600
    outside = weather(rng, rows, dt)
    u = steps(rng, rows, [0, 25, 50, 75, 100], 20, 90)
    room = 6 + lag(outside, dt, 200 * dt, outside[0]) + lag(0.16 * u, dt, 60 * dt)
    seen = sensor(rng, outside, 0.03, 0.1)
    for start in rng.choice(np.arange(40, rows - 60, 70), 5, replace=False):
        seen[start : start + int(rng.integers(3, 25))] = 999.9
    columns = {
        "time": (stamps(rng, rows, dt), 0),
        "valve_percent": (u, 0),
        "room_degC": (sensor(rng, room, 0.03, 0.05), 2),
        "outdoor_degC": (seen, 1),
    }
    return Case(table(rng, columns), ("valve",), ("room",), dt, ("outdoor",), says=(r"999\.9",))


def open_thermocouple(rng: Rng) -> Case:
    """-242.02 for ten rows at a time (an open PT100), one of two outputs."""
    dt, rows = 1.0, 1500
    u, y = open_block(rng, rows, dt)
    other = sensor(rng, 23 + lag(0.1 * u, dt, 150), 0.05, 0.05)
    for start in rng.choice(np.arange(50, rows - 50, 60), 5, replace=False):
        y[start : start + 10] = -242.02
    columns = {
        "t_s": (clock(rows, dt, rng), 1),
        "heat": (u, 0),
        "pt100_degC": (y, 2),
        "shell_degC": (other, 2),
    }
    return Case(table(rng, columns), ("heat",), ("pt100", "shell"), dt, says=(r"-242",))


def zero_for_a_half(rng: Rng) -> Case:
    """A sensor that reads 0 from the middle on; the other one is sound."""
    dt, rows = 2.0, 1600
    u, y = open_block(rng, rows, dt)
    other = sensor(rng, 23 + lag(0.12 * u, dt, 240), 0.05, 0.05)
    y[int(rows * rng.uniform(0.45, 0.6)) :] = 0.0
    columns = {"t_s": (clock(rows, dt, rng), 1), "heat": (u, 0), "near_degC": (y, 2), "far_degC": (other, 2)}
    return Case(
        table(rng, columns),
        ("heat",),
        ("far",),
        dt,
        free=("near",),
        says=(r"near.*(stuck|lost|\b0\b|held|same value)",),
    )


def stuck_sensor(rng: Rng) -> Case:
    """A sensor that holds one value from some row on while the drive swings from 0 to 100."""
    dt, rows = float(rng.choice([1, 2])), 1600
    u = steps(rng, rows, [0, 100], 25, 90)
    y = sensor(rng, block(rng, u, dt, 21, 0.5, 60 * dt), 0.05, 0.0625)
    cut = int(rows * rng.uniform(0.55, 0.7))
    y[cut:] = y[cut]
    name = pick(rng, "hot_end_degC", "plate_degC")
    columns = {"time_s": (clock(rows, dt, rng), 1), "heater_percent": (u, 0), name: (y, 4)}
    return Case(
        table(rng, columns),
        ("heater",),
        (name,),
        dt,
        says=("stuck|same value|held|stands still",),
        asks="stuck|same value",
    )


def lost_half(rng: Rng) -> Case:
    """One of two outputs has empty cells in one half."""
    dt, rows = 2.0, 1600
    u, y = open_block(rng, rows, dt)
    other = sensor(rng, 23 + lag(0.12 * u, dt, 240), 0.05, 0.05)
    y[: int(rows * rng.uniform(0.4, 0.55))] = np.nan
    columns = {"t_s": (clock(rows, dt, rng), 1), "heat": (u, 0), "near_degC": (y, 2), "far_degC": (other, 2)}
    return Case(table(rng, columns), ("heat",), ("far",), dt, free=("near",), says=("near",))


# ---- surroundings ----


def outdoors_and_rooms(rng: Rng) -> Case:
    """A heated room, one beside it, outdoors; German or Dutch columns, one line in five minutes."""
    dt, rows = 300.0, 1700
    outside = weather(rng, rows, dt)
    u = steps(rng, rows, [0, 30, 60, 100], 10, 60)
    room = 9 + lag(0.7 * outside, dt, 150 * dt, 5.0) + lag(0.1 * u, dt, 30 * dt)
    second = 6 + lag(0.5 * outside, dt, 200 * dt, 4.0) + lag(0.35 * room, dt, 50 * dt, 6.0)
    v, o, r, s = [
        ("Ventil_percent", "Aussen_degC", "Wohnzimmer_degC", "Flur_degC"),
        ("klep_percent", "buiten_degC", "woonkamer_degC", "gang_degC"),
    ][int(rng.integers(2))]
    columns = {
        "time": (stamps(rng, rows, dt), 0),
        v: (u, 0),
        o: (sensor(rng, outside, 0.05, 0.1), 1),
        r: (sensor(rng, room, 0.03, 0.05), 2),
        s: (sensor(rng, second, 0.03, 0.05), 2),
    }
    return Case(table(rng, columns), (v,), (r, s), dt, (o,))


def nameless_weather(rng: Rng) -> Case:
    """Columns called by number: behaviour alone tells the weather from the room."""
    dt, rows = 60.0, 1800
    outside = weather(rng, rows, dt)
    u = steps(rng, rows, [0, 1], 15, 60)
    room = 8 + lag(outside, dt, 120 * dt, outside[0]) + lag(9 * u, dt, 40 * dt)
    names = [f"ch{k}" for k in rng.permutation(np.arange(1, 4))]
    columns = {
        "time_s": (clock(rows, dt, rng), 0),
        names[0]: (u, 0),
        names[1]: (sensor(rng, room, 0.03, 0.05), 2),
        names[2]: (sensor(rng, outside, 0.03, 0.05), 2),
    }
    return Case(table(rng, columns), (names[0],), (names[1],), dt, (names[2],))


def constant_ambient(rng: Rng) -> Case:
    """An ambient that was logged and never moves: kept as a disturbance, or its value said."""
    dt, rows = 1.0, 1400
    ambient = float(np.round(rng.uniform(18, 26), 1))
    u = steps(rng, rows, [0, 40, 70, 100], 20, 80)
    y = sensor(rng, block(rng, u, dt, ambient, 0.6, 70), 0.05, 0.1)
    name = pick(rng, "t_ambient_degC", "ambient_degC", "room_degC")
    columns = {
        "time_s": (clock(rows, dt, rng), 0),
        "heater_percent": (u, 0),
        "block_degC": (y, 1),
        name: (np.full(rows, ambient), 1),
    }
    return Case(table(rng, columns), ("heater",), ("block",), dt, free=(name,), says=(rf"{name[:-5]}",))


def wind_and_door(rng: Rng) -> Case:
    """A door contact in words and the wind: neither is moved by the heater, both move the room."""
    dt, rows = 60.0, 1700
    u = steps(rng, rows, [0, 100], 15, 60)
    door = steps(rng, rows, [0, 1], 30, 90)
    wind = np.abs(6 + lag(rng.normal(0, 25, rows), dt, 20 * dt))
    room = 17 + lag(0.09 * u - 4 * door - 0.3 * wind, dt, 35 * dt)
    columns = {
        "time": (stamps(rng, rows, dt), 0),
        "heater_percent": (u, 0),
        "door": (["open" if value else "closed" for value in door], 0),
        "wind_speed": (wind, 1),
        "hall_degC": (sensor(rng, room, 0.03, 0.05), 2),
    }
    return Case(
        table(rng, columns), ("heater",), ("hall",), dt, ("wind_speed",), free=("door",), says=("door",)
    )


# ---- units and duplicates ----


def fahrenheit_beside(rng: Rng) -> Case:
    """Two bodies, one in degF and one in degC."""
    dt, rows = 2.0, 1500
    u = steps(rng, rows, [0, 35, 70, 100], 20, 80)
    near, far = block(rng, u, dt, 21, 0.5, 60 * dt), 21 + lag(0.2 * u, dt, 160 * dt)
    columns = {
        "time_s": (clock(rows, dt, rng), 0),
        "power_percent": (u, 0),
        "smoker_degF": (sensor(rng, 1.8 * near + 32, 0.1, 0.1), 1),
        "meat_degC": (sensor(rng, far, 0.05, 0.05), 2),
    }
    return Case(table(rng, columns), ("power",), ("smoker", "meat"), dt)


def duplicate_in_another_unit(rng: Rng) -> Case:
    """One sensor in degC and degF, one drive in percent and 0 to 255."""
    dt, rows = 1.0, 1500
    u = steps(rng, rows, [0, 20, 40, 60, 80, 100], 20, 80)
    y = sensor(rng, block(rng, u, dt, 22, 0.7, 65), 0.05, 0.0625)
    columns = {
        "time_s": (clock(rows, dt, rng), 0),
        "duty_percent": (u, 0),
        "duty_raw": (np.round(u * 2.55), 0),
        "tempC": (y, 2),
        "tempF": (1.8 * y + 32, 2),
    }
    return Case(
        table(rng, columns),
        ("duty|duty_raw",),
        ("tempC|tempF",),
        dt,
        free=("duty", "duty_raw", "tempC", "tempF"),
        says=(SAME_SIGNAL,),
    )


def decimal_commas(rng: Rng) -> Case:
    """Semicolons and decimal commas, French or Italian columns with units in brackets."""
    dt, rows = float(rng.choice([1, 2])), 1500
    u = steps(rng, rows, [0, 30.5, 60.5, 99.5], 20, 80)
    y = sensor(rng, block(rng, u, dt, 20, 0.55, 60 * dt), 0.05, 0.05)
    t, a, b = [("temps (s)", "chauffage (%)", "four (°C)"), ("tempo [s]", "riscaldamento [%]", "forno [°C]")][
        int(rng.integers(2))
    ]
    columns = {t: (clock(rows, dt, rng), 1), a: (u, 1), b: (y, 2)}
    return Case(table(rng, columns, separator=";", decimal=","), (a,), (b,), dt)


def sixty_rows(rng: Rng) -> Case:
    """Too few rows: refused with the number that is needed and the number there is."""
    dt, rows = 10.0, 60
    u = steps(rng, rows, [0, 50, 100], 5, 12)
    y = sensor(rng, block(rng, u, dt, 20, 0.5, 80), 0.05, 0.05)
    columns = {"time_s": (clock(rows, dt, rng), 0), "heater_percent": (u, 0), "block_degC": (y, 2)}
    return Case(
        table(rng, columns),
        ("heater",),
        ("block",),
        dt,
        asks=r"\b60\b.*\b\d+ (rows )?(are )?needed|\b\d+\b.*needed.*\b60\b|needs.*\b\d+\b.*\b60\b",
    )


# ---- programs ----


def marlin(rng: Rng) -> Case:
    """A printer host's terminal: M105 answers with chatter between."""
    dt, rows = 1.0, 1300
    target = steps(rng, rows, [0, 150, 190, 220], 90, 240)
    u = np.clip(np.round(steps(rng, rows, [0, 30, 60, 90, 127], 20, 70)), 0, 127)
    hot = block(rng, u, dt, 24, 1.7, 60)
    bed = 24 + lag(rng.normal(0, 1, rows), dt, 40)
    lines = []
    start = datetime(2024, 5, 3, 14, 2, 11)
    for row in range(rows):
        stamp = (start + timedelta(seconds=row * dt)).strftime("%H:%M:%S.%f")[:-3]
        if rng.random() < 0.08:
            lines.append(
                f"{stamp} : " + pick(rng, "N123 G1 X20.1 Y33.7 E1.2*87", "echo:busy: processing", "ok")
            )
        lines.append(
            f"{stamp} : ok T:{hot[row]:.2f} /{target[row]:.2f} B:{bed[row]:.2f} /0.00 @:{u[row]:.0f} B@:0"
        )
    text = "\n".join(lines) + "\n"
    return Case(
        text,
        ("@|drive|T_duty|duty",),
        ("T",),
        dt,
        free=("B", "T_target", "B_target", "B_duty"),
        suffix=".log",
    )


def klipper(rng: Rng) -> Case:
    """klippy.log: one line of statistics a second, key=value."""
    dt, rows = 1.0, 1300
    target = steps(rng, rows, [60, 120, 180, 200], 100, 300)
    loop = under_pi(rng, target, dt, 25, 2.4, 70)
    lines = ["Start printer at Fri May  3 14:02:11 2024", "Loaded MCU 'mcu' 100 commands"]
    for row in range(rows):
        lines.append(
            f"Stats {1200.3 + row * dt:.1f}: gcodein=0  mcu: mcu_awake=0.002 mcu_task_avg=0.000015 "
            f"bytes_write=15{row:04d} heater_bed: target=0 temp={25 + rng.normal(0, 0.1):.1f} pwm=0.000 "
            f"sysload=0.31 cputime={3 + 0.05 * row:.3f} memavail=721{int(rng.integers(100, 999))} "
            f"extruder: target={target[row]:.0f} temp={loop.temperature[row]:.1f} "
            f"pwm={loop.drive[row] / 100:.3f}"
        )
        if rng.random() < 0.05:
            lines.append("Timeout with MCU 'mcu' (eventtime=1200.1)")
    return Case(
        "\n".join(lines) + "\n",
        ("extruder_pwm",),
        ("extruder_temp|extruder",),
        dt,
        free=("extruder_target", "heater_bed_temp", "heater_bed_target", "heater_bed_pwm"),
        says=(CLOSED_LOOP,),
        suffix=".log",
    )


def home_assistant(rng: Rng) -> Case:
    """The history of a home hub: entity, state, moment; a row per change."""
    dt, rows = 60.0, 1500
    u = steps(rng, rows, [0, 1], 10, 50)
    outside = sensor(rng, weather(rng, rows, dt), 0.02, 0.1)
    room = sensor(rng, 9 + lag(0.8 * outside, dt, 150 * dt, outside[0]) + lag(8 * u, dt, 35 * dt), 0.03, 0.1)
    start = datetime(2024, 2, 11, 6, 0, tzinfo=UTC)
    lines = ["entity_id,state,last_changed"]
    series = {"switch.heater": u, "sensor.living_room": room, "sensor.outdoor": outside}
    for name, values in series.items():
        last = None
        for row in range(rows):
            value = float(values[row])
            if value == last:
                continue
            last = value
            moment = (
                (start + timedelta(seconds=row * dt))
                .isoformat(timespec="milliseconds")
                .replace("+00:00", "Z")
            )
            state = ("on" if value else "off") if name.startswith("switch") else f"{value:.1f}"
            lines.append(f"{name},{state},{moment}")
    return Case(
        "\n".join(lines) + "\n",
        ("heater",),
        ("living_room",),
        dt,
        ("outdoor",),
        asks="entity_id|long|pivot|one column",
    )


def esphome(rng: Rng) -> Case:
    """The log of a board: one line per reading, in words."""
    dt, rows = 10.0, 1300
    u, y = open_block(rng, rows, dt)
    start = datetime(2024, 2, 11, 6, 0)
    lines = []
    for row in range(rows):
        stamp = (start + timedelta(seconds=row * dt)).strftime("%H:%M:%S")
        lines.append(
            f"[{stamp}][D][sensor:094]: 'Kettle': Sending state {y[row]:.5f} °C with 2 decimals of accuracy"
        )
        lines.append(
            f"[{stamp}][D][sensor:094]: 'Duty': Sending state {u[row] / 2.55:.5f} % with 1 decimals"
        )
        if rng.random() < 0.1:
            lines.append(f"[{stamp}][D][wifi:123]: WiFi signal -61 dB")
    return Case(
        "\n".join(lines) + "\n", ("Duty",), ("Kettle",), dt, asks="no column|column|read", suffix=".log"
    )


def labview(rng: Rng) -> Case:
    """A .lvm file: a header of its own, tabs, decimal commas in half of the seeds."""
    dt, rows = float(rng.choice([0.1, 0.5])), 1500
    u, y = open_block(rng, rows, dt)
    decimal = pick(rng, ".", ",")
    head = [
        "LabVIEW Measurement\t", "Writer_Version\t2", "Separator\tTab", f"Decimal_Separator\t{decimal}",
        "X_Columns\tOne", "Time_Pref\tRelative", "Date\t2024/02/11", "Time\t10:11:12,5",
        "***End_of_Header***\t", "\t", "Channels\t2\t\t", f"Samples\t{rows}\t{rows}\t",
        "Date\t2024/02/11\t2024/02/11\t", "Time\t10:11:12\t10:11:12\t", "Y_Unit_Label\tVolt\tdegC\t",
        "X0\t0\t0\t", f"Delta_X\t{number(dt, 6, decimal)}\t{number(dt, 6, decimal)}\t",
        "***End_of_Header***\t\t\t", "X_Value\tDrive\tOven\tComment",
    ]  # fmt: skip
    rows_of = [
        f"{number(row * dt, 6, decimal)}\t{number(u[row] / 51, 6, decimal)}\t{number(y[row], 6, decimal)}\t"
        for row in range(rows)
    ]
    return Case("\n".join(head + rows_of) + "\n", ("Drive",), ("Oven",), dt, suffix=".lvm")


def serial_plotter(rng: Rng) -> Case:
    """Labelled values of a serial plotter, without any clock: the step has to be asked."""
    rows = 1400
    u, y = open_block(rng, rows, 1.0)
    text = "".join(f"pwm:{u[row]:.0f},temp:{y[row]:.2f}\n" for row in range(rows))
    return Case(text, ("pwm",), ("temp",), float("nan"), asks="--dt", suffix=".txt")


def putty(rng: Rng) -> Case:
    """A terminal's log with a head of its own and stamps in brackets."""
    dt, rows = float(rng.choice([1, 2])), 1400
    u, y = open_block(rng, rows, dt)
    start = datetime(2024, 3, 1, 22, 55, 40)
    lines = ["=~=~=~=~=~=~=~=~=~=~=~= PuTTY log 2024.03.01 22:55:39 =~=~=~=~=~=~=~=~=~=~=~="]
    lines.append("temp\tpwm")
    for row in range(rows):
        stamp = (start + timedelta(seconds=row * dt)).strftime("%Y-%m-%d %H:%M:%S")
        lines.append(f"[{stamp}] {y[row]:.2f}\t{u[row]:.0f}")
    return Case(
        "\n".join(lines) + "\n", ("pwm",), ("temp",), dt, asks="column|stamp|time|header", suffix=".log"
    )


def tclab(rng: Rng) -> Case:
    """The table of the TCLab package: Time, T1, T2, Q1, Q2."""
    dt, rows = 1.0, 1500
    q1, q2 = steps(rng, rows, [0, 30, 60, 90], 30, 110), steps(rng, rows, [0, 25, 50, 80], 30, 110)
    one = 22 + lag(lag(0.6 * q1 + 0.15 * q2, dt, 150), dt, 15)
    two = 22 + lag(lag(0.2 * q1 + 0.4 * q2, dt, 170), dt, 15)
    columns = {
        "Time": (clock(rows, dt, rng, 0.01), 3),
        "T1": (sensor(rng, one, 0.1, 0.32), 2),
        "T2": (sensor(rng, two, 0.1, 0.32), 2),
        "Q1": (q1, 1),
        "Q2": (q2, 1),
    }
    return Case(table(rng, columns), ("Q1", "Q2"), ("T1", "T2"), dt)


CASES: tuple[Callable[[Rng], Case], ...] = (
    two_relays, three_relays, relay_and_duty, elements_together, heater_and_cooler, states_in_words,
    pid_terms, loop_without_set_point, thermostat_alone, set_point_logged,
    bare_milliseconds, microseconds, bare_epoch_milliseconds, epoch_seconds, wrap_16, bare_wrap_32,
    reset_in_the_middle, row_counter_and_meter,
    code_runs, code_in_a_disturbance, open_thermocouple, zero_for_a_half, stuck_sensor, lost_half,
    outdoors_and_rooms, nameless_weather, constant_ambient, wind_and_door,
    fahrenheit_beside, duplicate_in_another_unit, decimal_commas, sixty_rows,
    marlin, klipper, home_assistant, esphome, labview, serial_plotter, putty, tclab,
)  # fmt: skip


# ---- the judge ----


def plain(name: str) -> str:
    """Reduce a heading to letters and digits without its unit, as `identify` names columns."""
    bare = re.sub(r"(_percent|_degC|_degF|_Wh|_celsius|\s*[(\[][^)\]]*[)\]])$", "", name)
    return re.sub(r"[\W_]+", "", bare.lower())


def role_faults(case: Case, signals: list[dict[str, str]]) -> dict[str, str]:
    """Return what is wrong, by column: the role it has and the one it should have."""
    has = {plain(signal["name"]): signal["role"] for signal in signals}
    faults = {}
    free = {plain(name) for name in case.free}
    for role in ("input", "output", "disturbance"):
        wanted = getattr(case, role + "s")
        for names in wanted:  # "a|b": one of them
            if not any(has.get(plain(name)) == role for name in names.split("|")):
                faults[names] = f"{has.get(plain(names.split('|')[0]), 'absent')}, is {role}"
        known = {plain(name) for names in wanted for name in names.split("|")}
        for name, its_role in has.items():
            if its_role == role and name not in known | free:
                faults.setdefault(name, f"{role}, is not")
    return faults


def judge(case: Case, code: int, answer: dict[str, Any], stderr: str) -> tuple[str, str]:
    """Return right, asked or wrong, and why."""
    if code not in (0, 3):
        said = re.sub(r"(?m)^identify +\d+ %.*\n?", "", stderr).strip()
        asked = code == 2 and re.search(case.asks, said, re.IGNORECASE | re.DOTALL) and "bug" not in said
        return ("asked" if asked else "wrong"), f"rc {code}: {said[-400:]}"
    checks = [str(row["says"]) for row in answer["data_check"] if row["verdict"] != "ok"]
    doubts = [str(doubt) for doubt in answer["doubts"]]
    said = "\n".join([stderr, str(answer["verdict"]), *doubts, *answer["notes"], *checks])
    said += "\n".join(f"{one['name']}: {one['why']}" for one in answer["signals"])
    faults = role_faults(case, answer["signals"])
    apart = [
        float(m[1])
        for row in answer["data_check"]
        if (m := re.match(r"rows are ([\d.e+-]+) s apart", row["says"]))
    ]
    if not apart or not abs(apart[0] - case.dt) <= 0.02 * case.dt:
        faults["clock"] = f"rows {apart} s apart, are {case.dt:g}"
    unsaid = [words for words in case.says if not re.search(words, said, re.IGNORECASE)]
    why = "; ".join(
        [f"{name}: {fault}" for name, fault in faults.items()] + [f"unsaid: {words}" for words in unsaid]
    )
    why += "".join(f"\n    doubt: {doubt}" for doubt in doubts)
    if not faults and not unsaid:
        return "right", why
    doubted = plain(" ".join(doubts)) + (" clock" if re.search("--dt|clock|time", " ".join(doubts)) else "")
    named = all(any(plain(one) in doubted for one in name.split("|")) for name in faults)
    return ("asked" if faults and named and not unsaid and not answer["good"] else "wrong"), why


def fitted(path: Path) -> tuple[int, dict[str, Any], str]:
    """Return exit code, answer and stderr of `identify`, one kind of model."""
    command = [sys.executable, "-m", "thermogrip", "identify", str(path), "--models", "arx", "--json"]
    ran = subprocess.run(
        [*command, "--out", str(path.with_suffix(".json"))], capture_output=True, text=True, check=False
    )
    return ran.returncode, json.loads(ran.stdout) if ran.returncode in (0, 3) else {}, ran.stderr


def read_only(path: Path) -> tuple[int, dict[str, Any], str]:
    """Return what `identify` would: its data check, doubts and roles, without a fit."""
    try:
        log = read_log(path)
        checks = [asdict(finding) for finding in check_data([log]).findings]
    except UserError as error:
        return 2, {}, str(error)
    guesses = dict(line.split(": ", 1) for line in str(log.attrs["guesses"]).splitlines())
    signals = [
        {"name": str(name), "role": one.attrs["role"], "why": guesses.get(str(name), "")}
        for name, one in log.items()
    ]
    doubts = [d for kind in ("clock", "role") for d in log.attrs[f"{kind}_doubts"].splitlines()]
    answer = {"data_check": checks, "doubts": doubts, "signals": signals, "verdict": "", "notes": []}
    return 0, answer | {"good": not doubts}, str(log.attrs["repairs"])


def main() -> None:
    """Print a line for every file, and the count of right, asked and wrong."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="")
    parser.add_argument("--fit", action="store_true", help="run identify, and not what it reads alone")
    parser.add_argument("--keep", type=Path, help="leave the files here")
    arguments = parser.parse_args()
    folder = arguments.keep or Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    counts: dict[str, int] = {}
    for place, make in enumerate(CASES):
        if arguments.only not in make.__name__:
            continue
        case = make(np.random.default_rng([arguments.seed, place]))
        path = folder / f"log{place:02}{case.suffix}"  # a name that says nothing
        path.write_text(case.text, encoding="utf-8")
        verdict, why = judge(case, *(fitted(path) if arguments.fit else read_only(path)))
        counts[verdict] = counts.get(verdict, 0) + 1
        print(f"{make.__name__:26}{verdict:7}{why}", flush=True)
    print(", ".join(f"{count} {verdict}" for verdict, count in sorted(counts.items())))


if __name__ == "__main__":
    main()
