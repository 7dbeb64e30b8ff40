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
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
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
Columns = Mapping[str, Series | list[str]]

CLOSED_LOOP = "closed loop|feedback"
STATES_ROLES = "--inputs|--outputs|--disturbances|--columns"


@dataclass(frozen=True)
class Case:
    """A log and its right answer: columns by role; those of `free` may have any role or none."""

    dt: float
    inputs: Columns
    outputs: Columns
    disturbances: Columns = field(default_factory=dict)
    free: Columns = field(default_factory=dict)
    time: tuple[str, Series | list[str]] | None = None  # header and cells; None: time_s
    says: tuple[str, ...] = ()  # regular expressions: all of them, for "right"
    asks: str = STATES_ROLES  # what a refusal has to name
    separator: str = ","
    decimal: str = "."
    suffix: str = ".csv"
    text: str = ""  # where a program writes no table

    def written(self, rng: Rng) -> str:
        """Return the text of the file, its columns in random order, often with the clock not the first."""
        if self.text:
            return self.text
        columns = {**self.inputs, **self.outputs, **self.disturbances, **self.free}
        rows = len(next(iter(columns.values())))
        header, cells = self.time or ("time_s", self.dt * np.arange(rows))
        names = [str(name) for name in rng.permutation([*columns])]
        if header:
            names.insert(int(rng.integers(3)) if rng.random() < 0.3 else 0, header)
            columns = {**columns, header: cells}
        lines = zip(*(written(columns[name], self.decimal) for name in names), strict=True)
        return "\n".join([self.separator.join(names), *map(self.separator.join, lines)]) + "\n"


def written(values: Series | list[str], decimal: str) -> list[str]:
    """Return the cells of a column as a logger would write them; NaN is an empty cell."""
    if isinstance(values, list):
        return values
    cells = (f"{value:.10g}" for value in np.round(values, 4))
    return ["" if cell == "nan" else cell.replace(".", decimal) for cell in cells]


# ---- plants ----


def lag(drive: Series, dt: float, seconds: float, start: float = 0.0) -> Series:
    """Follow `drive`, held between rows, through one time constant."""
    keep, state, out = np.exp(-dt / seconds), start, np.empty(len(drive))
    for row, value in enumerate(drive):
        out[row] = state
        state = keep * state + (1 - keep) * value
    return out


def steps(rng: Rng, rows: int, levels: list[float], shortest: int, longest: int) -> Series:
    """Hold one of `levels` for a random number of rows, then another one."""
    out: list[float] = []
    while len(out) < rows:
        level = float(rng.choice([one for one in levels if one != (out or [None])[-1]]))
        out += [level] * int(rng.integers(shortest, longest + 1))
    return np.array(out[:rows])


def weather(rng: Rng, rows: int, dt: float) -> Series:
    """Return a day outdoors: a slow swing and a random walk."""
    period, t = rows * dt / rng.uniform(1.2, 2.5), np.arange(rows) * dt
    swing = rng.uniform(3, 6) * np.sin(2 * np.pi * t / period + rng.uniform(0, 6))
    return np.asarray(rng.uniform(4, 12) + swing + np.cumsum(rng.normal(0, 0.02, rows)))


def sensor(rng: Rng, truth: Series, noise: float = 0.05, step: float = 0.0625) -> Series:
    """Read with noise, in steps of the sensor."""
    return np.asarray(np.round((truth + rng.normal(0, noise, len(truth))) / step) * step)


def block(rng: Rng, drive: Series, dt: float, ambient: float, gain: float, seconds: float) -> Series:
    """Return a heated body behind its sensor: `gain` degC per unit of drive."""
    return ambient + lag(lag(gain * drive, dt, seconds), dt, seconds / rng.uniform(8, 15))


def heated(rng: Rng, rows: int, dt: float) -> tuple[Series, Series]:
    """Return a drive of 0 to 255 and the temperature that it makes."""
    u = steps(rng, rows, [0, 60, 120, 180, 255], 20, 90)
    return u, sensor(rng, block(rng, u, dt, 23, 0.25, rng.uniform(50, 90) * dt))


def controlled(
    rng: Rng, target: Series, dt: float, gain: float, seconds: float, *, relay: bool = False
) -> tuple[Series, Series, Series]:
    """Return reading, drive and integral of a PI controller of 0 to 100 %, or of a relay, on two lags."""
    read, drive, integral = (np.zeros(len(target)) for _ in range(3))
    body = skin = 20.0
    on, total = 0.0, 0.0
    for row in range(len(target)):
        read[row] = np.round((skin + rng.normal(0, 0.04)) / 0.0625) * 0.0625
        error = target[row] - read[row]
        on = 1.0 if error > 0.4 else 0.0 if error < -0.4 else on
        total = float(np.clip(total + error * dt * 4 / gain / seconds, 0, 100))
        integral[row] = total
        drive[row] = on if relay else np.round(np.clip(6 / gain * error + total, 0, 100), 1)
        body += dt / seconds * (20 + gain * drive[row] - body)
        skin += dt / (seconds / 12) * (body - skin)
    return read, drive, integral


def pick(rng: Rng, *names: str) -> str:
    """Choose a name."""
    return str(rng.choice(names))


def stamps(rng: Rng, rows: int, dt: float, form: str = "%Y-%m-%d %H:%M:%S") -> list[str]:
    """Return stamps of local time."""
    start = datetime(2023, int(rng.integers(1, 13)), 7, 6, 13, 20)
    return [(start + timedelta(seconds=row * dt)).strftime(form) for row in range(rows)]


def clock(rng: Rng, rows: int, dt: float, jitter: float = 0.0, start: float = 0.0) -> Series:
    """Return seconds with jitter, strictly rising."""
    return np.asarray(start + dt * np.arange(rows) + rng.uniform(0, jitter, rows) * dt)


# ---- inputs that are nearly alike ----


def two_relays(rng: Rng) -> Case:
    """Two relays that know nothing of each other, two temperatures."""
    dt, rows = float(rng.choice([5, 10, 30])), 1400
    a, b = steps(rng, rows, [0, 1], 15, 70), steps(rng, rows, [0, 1], 15, 70)
    kettle = sensor(rng, 20 + lag(14 * a + 3 * b, dt, 40 * dt))
    pipe = sensor(rng, 20 + lag(4 * a - 9 * b, dt, 70 * dt))
    first, second = (
        pick(rng, "pump", "relais1", "SSR_A", "heater"),
        pick(rng, "fan", "relais2", "SSR_B", "chiller"),
    )
    return Case(dt, {first: a, second: b}, {"kettle_degC": kettle, "pipe_degC": pipe})


def three_relays(rng: Rng) -> Case:
    """Three relays as words, one temperature each, stamps of local time."""
    dt, rows = float(rng.choice([10, 60])), 1500
    relays = np.array([steps(rng, rows, [0, 1], 12, 60) for _ in range(3)])
    words = [("off", "on"), ("OFF", "ON"), ("false", "true")][int(rng.integers(3))]
    mixed = np.array([[12, 2, 1], [2, 9, 2], [1, 3, 15]]) @ relays
    valves = {f"zone{k + 1}_valve": [words[int(value)] for value in relays[k]] for k in range(3)}
    truths = [18 + lag(mixed[k], dt, (30 + 15 * k) * dt) for k in range(3)]
    zones = {f"zone{k + 1}_temperature": sensor(rng, truths[k], 0.04, 0.1) for k in range(3)}
    return Case(dt, valves, zones, time=("time", stamps(rng, rows, dt)))


def relay_and_duty(rng: Rng) -> Case:
    """A relay of 0/1 beside a duty of 0 and 255 that moves on its own."""
    dt, rows = float(rng.choice([1, 2])), 1500
    relay, duty = steps(rng, rows, [0, 1], 20, 90), steps(rng, rows, [0, 255], 20, 90)
    truth = 22 + lag(lag(10 * relay + 0.12 * duty, dt, 60 * dt), dt, 5 * dt)
    drives = {pick(rng, "valve", "solenoid"): relay, pick(rng, "pwm", "heater_pwm"): duty}
    return Case(dt, drives, {pick(rng, "probe_degC", "oven_degC"): sensor(rng, truth, 0.05, 0.05)})


def elements_together(rng: Rng) -> Case:
    """Two elements that are always driven alike: their effects cannot be estimated separately."""
    u = steps(rng, 1500, [0, 20, 50, 80, 100], 20, 110)
    oven = sensor(rng, 24 + lag(0.5 * u, 1, 80) + lag(0.3 * u, 1, 190), 0.1, 0.25)
    return Case(1, {"element_left": u, "element_right": u}, {"oven_degC": oven}, says=("separately",))


def heater_and_cooler(rng: Rng) -> Case:
    """A fermenter under a controller of two relays that are never on at once."""
    dt, rows = 30.0, 2200
    target = steps(rng, rows, [10, 13, 16, 19, 21], 200, 420)
    beer, fridge, heat, cool = 16.0, 16.0, 0.0, 0.0
    seen = np.zeros((4, rows))
    for row in range(rows):
        read = round((beer + rng.normal(0, 0.02)) / 0.0625) * 0.0625
        air = round((fridge + rng.normal(0, 0.04)) / 0.0625) * 0.0625
        goal = target[row] + 3 * (target[row] - read)
        heat = float(air < goal - (0.2 if heat else 0.8))
        cool = float(not heat and air > goal + (0.2 if cool else 0.8))
        seen[:, row] = heat, cool, read, air
        fridge += dt * ((19 - fridge) / 5000 + (beer - fridge) / 2200 + 0.006 * heat - 0.011 * cool)
        beer += dt * (fridge - beer) / 6000
    return Case(
        dt,
        {"Heat": seen[0], "Cool": seen[1]},
        {"Beer Temp": seen[2], "Fridge Temp": seen[3]},
        free={"Beer Set": target},
        time=("Time", stamps(rng, rows, dt)),
        says=(CLOSED_LOOP, "Beer.?Set"),
    )


def states_in_words(rng: Rng) -> Case:
    """A fermenter whose drive is a word of three: one input for each of the two that act."""
    dt, rows = 60.0, 1600
    state = steps(rng, rows, [-1, 0, 1], 10, 50)
    beer = sensor(rng, 18 + lag(np.where(state > 0, 9.0, 12 * state), dt, 45 * dt), 0.03)
    room = sensor(rng, 18 + lag(rng.normal(0, 12, rows), dt, 60 * dt), 0.03)
    words = [{-1.0: "COOLING", 0.0: "IDLE", 1.0: "HEATING"}[float(value)] for value in state]
    when = [f"{stamp},{word}" for stamp, word in zip(stamps(rng, rows, dt), words, strict=True)]
    made = {"state_COOLING": (state < 0) * 1.0, "state_HEATING": (state > 0) * 1.0}
    lines = [f"{head},{b:.2f},{r:.2f}" for head, b, r in zip(when, beer, room, strict=True)]
    text = "\n".join(["timestamp,state,beer_temp,room_temp", *lines]) + "\n"
    return Case(dt, made, {"beer_temp": beer}, free={"room_temp": room}, text=text)


# ---- closed loops ----


def pid_terms(rng: Rng) -> Case:
    """A PID log with its error and terms as columns."""
    dt = float(rng.choice([0.5, 1]))
    target = steps(rng, 1800, [40, 55, 70, 85], 180, 400)
    y, u, integral = controlled(rng, target, dt, 1.1, 90 * dt)
    terms = {"error": target - y, "P": 6 / 1.1 * (target - y), "I": integral, "D": -2 * np.gradient(y, dt)}
    return Case(
        dt,
        {pick(rng, "Output", "OP"): u},
        {pick(rng, "Input", "PV", "temp"): y},
        free={pick(rng, "Setpoint", "SP", "target"): target, **terms},
        says=(CLOSED_LOOP, r"\berror\b"),
    )


def loop_without_set_point(rng: Rng) -> Case:
    """A PI loop whose set point was not logged."""
    dt = float(rng.choice([1, 2, 5]))
    y, u, _ = controlled(rng, steps(rng, 1600, [45, 50, 60, 75], 150, 350), dt, 0.9, 100 * dt)
    name = pick(rng, "reactor_degC", "bad_degC", "tank_degC")
    return Case(dt, {pick(rng, "output_percent", "heater_percent"): u}, {name: y}, says=(CLOSED_LOOP,))


def thermostat(rng: Rng) -> Case:
    """A relay with hysteresis, no set point logged."""
    dt = float(rng.choice([10, 20]))
    y, u, _ = controlled(rng, steps(rng, 1600, [28.0, 30, 33, 36], 250, 500), dt, 25, 120 * dt, relay=True)
    name = pick(rng, "room_degC", "salon_degC", "Stube_degC")
    return Case(dt, {pick(rng, "burner", "chaudiere", "Brenner"): u}, {name: y}, says=(CLOSED_LOOP,))


def set_point_logged(rng: Rng) -> Case:
    """A loop with its set point beside it, in words of another language."""
    dt = float(rng.choice([2, 5]))
    target = steps(rng, 1700, [30, 38, 46, 52], 160, 380)
    y, u, _ = controlled(rng, target, dt, 0.7, 80 * dt)
    names = [
        ("Sollwert", "Istwert", "Stellgröße"),
        ("consigne", "mesure", "commande"),
        ("setpunto", "temperatura", "salida"),
    ][int(rng.integers(3))]
    return Case(dt, {names[2]: u}, {names[1]: y}, free={names[0]: target}, says=(CLOSED_LOOP, names[0]))


# ---- clocks ----


def bare(rng: Rng, counts: Series, u: Series, y: Series, dt: float) -> Case:
    """Write counts of a clock, drive and reading without a header: columns have their place for a name."""
    columns = {"clock": counts, "u": u, "y": y}
    order = [str(name) for name in rng.permutation([*columns])]
    lines = zip(*(written(columns[name], ".") for name in order), strict=True)
    place = {name: f"c{at}" for at, name in enumerate(order, 1)}
    text = "\n".join(map(",".join, lines)) + "\n"
    return Case(dt, {place["u"]: u}, {place["y"]: y}, asks="clock|time|--dt", text=text)


def bare_milliseconds(rng: Rng) -> Case:
    """Milliseconds since the board's start, no header at all."""
    dt = float(rng.choice([0.1, 0.25, 0.5]))
    u, y = heated(rng, 1500, dt)
    return bare(rng, np.round(1000 * clock(rng, 1500, dt, 0.02, float(rng.uniform(1, 900)))), u, y, dt)


def microseconds(rng: Rng) -> Case:
    """A column `micros`, as Arduino's function is called."""
    dt = float(rng.choice([0.02, 0.05]))
    u, y = heated(rng, 1500, dt)
    return Case(dt, {"pwm": u}, {"temp": y}, time=("micros", np.round(1e6 * clock(rng, 1500, dt, 0.01, 3.0))))


def bare_epoch_milliseconds(rng: Rng) -> Case:
    """Milliseconds since 1970, no header."""
    dt = float(rng.choice([1, 10, 30]))
    u, y = heated(rng, 1500, dt)
    start = 1.68e9 + float(rng.integers(0, 10**7))
    return bare(rng, np.round(1000 * clock(rng, 1500, dt, 0.01, start)), u, y, dt)


def epoch_seconds(rng: Rng) -> Case:
    """Seconds since 1970 under a name that does not say so."""
    dt = float(rng.choice([5, 15]))
    u, y = heated(rng, 1500, dt)
    seconds = np.round(clock(rng, 1500, dt, start=1.6e9 + float(rng.integers(0, 10**7))))
    return Case(dt, {"pwm": u}, {"temp": y}, time=(pick(rng, "ts", "created", "Zeit"), seconds))


def wrap_16(rng: Rng) -> Case:
    """A counter of 16 bits in milliseconds that begins anew every 65.5 s."""
    dt = float(rng.choice([0.1, 0.2]))
    u, y = heated(rng, 1500, dt)
    counts = np.round(1000 * clock(rng, 1500, dt, start=float(rng.uniform(1, 60)))) % 2**16
    return Case(dt, {"pwm": u}, {"temp": y}, time=("ms", counts), asks="ms|--dt")


def bare_wrap_32(rng: Rng) -> Case:
    """Microseconds of 32 bits that begin anew in the middle, no header."""
    dt, rows = 0.05, 1600
    u, y = heated(rng, rows, dt)
    first = 2**32 - 1e6 * dt * rows * rng.uniform(0.3, 0.7)
    return bare(rng, np.round(first + 1e6 * dt * np.arange(rows)) % 2**32, u, y, dt)


def reset_in_the_middle(rng: Rng) -> Case:
    """The board is reset: its clock begins anew, the block cooled meanwhile."""
    dt, rows = float(rng.choice([0.5, 1])), 1800
    cut = int(rows * rng.uniform(0.4, 0.6))
    (u1, y1), (u2, y2) = heated(rng, cut, dt), heated(rng, rows - cut, dt)
    ms = np.round(1000 * np.r_[clock(rng, cut, dt, start=700.0), clock(rng, rows - cut, dt, start=2.0)])
    says = "reset|(begins?|starts?) (anew|again)|goes back|two pieces"
    time = (pick(rng, "millis", "time_ms", "t_ms"), ms)
    return Case(dt, {"duty": np.r_[u1, u2]}, {"temp_degC": np.r_[y1, y2]}, time=time, says=(says,), asks=says)


def row_counter_and_meter(rng: Rng) -> Case:
    """A row number and an energy meter beside the clock: neither is a clock, an input or an output."""
    dt, rows = float(rng.choice([2, 4])), 1500
    u, y = heated(rng, rows, dt)
    free = {"n": np.arange(rows, dtype=float), "energy_Wh": np.round(np.cumsum(u) * dt / 18000, 2)}
    case = Case(dt, {"pwm": u}, {"temp": y}, time=("time_s", clock(rng, rows, dt, 0.02)))
    return Case(
        dt,
        {"pwm": u},
        {"temp": y},
        time=case.time,
        text=Case(dt, {"pwm": u}, {"temp": y} | free).written(rng),
    )


# ---- dead sensors ----


def code_runs(rng: Rng) -> Case:
    """-127 while the probe is unplugged, 85 once after a brown-out."""
    dt, rows = float(rng.choice([2, 5])), 1600
    u = steps(rng, rows, [0, 1], 20, 90)
    y = sensor(rng, block(rng, u, dt, 19, 28, 70 * dt), 0.04)
    for start in rng.choice(np.arange(40, rows - 60, 70), 6, replace=False):
        y[start : start + int(rng.integers(2, 40))] = -127
    y[rng.choice(rows, 8, replace=False)] = 85.0
    name = pick(rng, "probe_degC", "T_boiler_degC", "sonde_degC")
    return Case(dt, {"relay": u}, {name: y}, says=("-127", r"\b85\b"))


def code_in_a_disturbance(rng: Rng) -> Case:
    """999.9 in runs outdoors."""
    dt, rows = 60.0, 1600
    outside = weather(rng, rows, dt)
    u = steps(rng, rows, [0, 25, 50, 75, 100], 20, 90)
    room = 6 + lag(outside, dt, 200 * dt, outside[0]) + lag(0.16 * u, dt, 60 * dt)
    seen = sensor(rng, outside, 0.03, 0.1)
    for start in rng.choice(np.arange(40, rows - 60, 70), 5, replace=False):
        seen[start : start + int(rng.integers(3, 25))] = 999.9
    return Case(
        dt,
        {"valve_percent": u},
        {"room_degC": sensor(rng, room, 0.03, 0.05)},
        {"outdoor_degC": seen},
        time=("time", stamps(rng, rows, dt)),
        says=(r"999\.9",),
    )


def near_and_far(rng: Rng, rows: int) -> tuple[Series, Series, Series]:
    """Return a drive and the readings of two sensors, rows 2 s apart."""
    u, near = heated(rng, rows, 2.0)
    return u, near, sensor(rng, 23 + lag(0.12 * u, 2.0, 240), 0.05, 0.05)


def open_thermocouple(rng: Rng) -> Case:
    """-242.02 for ten rows at a time (an open PT100), one of two outputs."""
    u, near, far = near_and_far(rng, 1500)
    for start in rng.choice(np.arange(50, 1450, 60), 5, replace=False):
        near[start : start + 10] = -242.02
    return Case(2, {"heat": u}, {"pt100_degC": near, "shell_degC": far}, says=("-242",))


def zero_for_a_half(rng: Rng) -> Case:
    """A sensor that reads 0 from the middle on; the other one is sound."""
    u, near, far = near_and_far(rng, 1600)
    near[int(1600 * rng.uniform(0.45, 0.6)) :] = 0.0
    says = (r"near.*(stuck|lost|\b0\b|held|same value)",)
    return Case(2, {"heat": u}, {"far_degC": far}, free={"near_degC": near}, says=says)


def stuck_sensor(rng: Rng) -> Case:
    """A sensor that holds one value from some row on while the drive swings from 0 to 100."""
    dt, rows = float(rng.choice([1, 2])), 1600
    u = steps(rng, rows, [0, 100], 25, 90)
    y = sensor(rng, block(rng, u, dt, 21, 0.5, 60 * dt))
    cut = int(rows * rng.uniform(0.55, 0.7))
    y[cut:] = y[cut]
    says = "stuck|same value|held|stands still"
    return Case(
        dt, {"heater_percent": u}, {pick(rng, "hot_end_degC", "plate_degC"): y}, says=(says,), asks=says
    )


def lost_half(rng: Rng) -> Case:
    """One of two outputs has empty cells in one half."""
    u, near, far = near_and_far(rng, 1600)
    near[: int(1600 * rng.uniform(0.4, 0.55))] = np.nan
    return Case(2, {"heat": u}, {"far_degC": far}, free={"near_degC": near}, says=("near",))


# ---- surroundings ----


def outdoors_and_rooms(rng: Rng) -> Case:
    """A heated room, one beside it, outdoors; German or Dutch columns, one line in five minutes."""
    dt, rows = 300.0, 1700
    outside = weather(rng, rows, dt)
    u = steps(rng, rows, [0, 30, 60, 100], 10, 60)
    room = 9 + lag(0.7 * outside, dt, 150 * dt, 5.0) + lag(0.1 * u, dt, 30 * dt)
    second = 6 + lag(0.5 * outside, dt, 200 * dt, 4.0) + lag(0.35 * room, dt, 50 * dt, 6.0)
    names = [("Ventil", "Aussen", "Wohnzimmer", "Flur"), ("klep", "buiten", "woonkamer", "gang")][
        rng.integers(2)
    ]
    rooms = {
        f"{names[2]}_degC": sensor(rng, room, 0.03, 0.05),
        f"{names[3]}_degC": sensor(rng, second, 0.03, 0.05),
    }
    return Case(
        dt,
        {f"{names[0]}_percent": u},
        rooms,
        {f"{names[1]}_degC": sensor(rng, outside, 0.05, 0.1)},
        time=("time", stamps(rng, rows, dt)),
    )


def nameless_weather(rng: Rng) -> Case:
    """Columns called by number: behaviour alone tells the weather from the room."""
    dt, rows = 60.0, 1800
    outside = weather(rng, rows, dt)
    u = steps(rng, rows, [0, 1], 15, 60)
    room = 8 + lag(outside, dt, 120 * dt, outside[0]) + lag(9 * u, dt, 40 * dt)
    names = [f"ch{k}" for k in rng.permutation(np.arange(1, 4))]
    room, outside = sensor(rng, room, 0.03, 0.05), sensor(rng, outside, 0.03, 0.05)
    return Case(dt, {names[0]: u}, {names[1]: room}, {names[2]: outside})


def constant_ambient(rng: Rng) -> Case:
    """An ambient that was logged and never moves: kept, or its column named."""
    ambient = float(np.round(rng.uniform(18, 26), 1))
    u = steps(rng, 1400, [0, 40, 70, 100], 20, 80)
    y = sensor(rng, block(rng, u, 1, ambient, 0.6, 70), 0.05, 0.1)
    name = pick(rng, "t_ambient", "ambient", "room")
    free = {f"{name}_degC": np.full(1400, ambient)}
    return Case(1, {"heater_percent": u}, {"block_degC": y}, free=free, says=(name,))


def wind_and_door(rng: Rng) -> Case:
    """A door contact in words and the wind: neither is moved by the heater, both move the room."""
    dt, rows = 60.0, 1700
    u, door = steps(rng, rows, [0, 100], 15, 60), steps(rng, rows, [0, 1], 30, 90)
    wind = np.round(np.abs(6 + lag(rng.normal(0, 25, rows), dt, 20 * dt)), 1)
    hall = sensor(rng, 17 + lag(0.09 * u - 4 * door - 0.3 * wind, dt, 35 * dt), 0.03, 0.05)
    words = ["open" if value else "closed" for value in door]
    when = ("time", stamps(rng, rows, dt))
    drives, wind_ = {"heater_percent": u}, {"wind_speed": wind}
    return Case(dt, drives, {"hall_degC": hall}, wind_, {"door": words}, when, says=("door",))


# ---- units and duplicates ----


def fahrenheit_beside(rng: Rng) -> Case:
    """Two bodies, one in degF and one in degC."""
    u = steps(rng, 1500, [0, 35, 70, 100], 20, 80)
    smoker = sensor(rng, 1.8 * block(rng, u, 2, 21, 0.5, 120) + 32, 0.1, 0.1)
    meat = sensor(rng, 21 + lag(0.2 * u, 2, 320), 0.05, 0.05)
    return Case(2, {"power_percent": u}, {"smoker_degF": smoker, "meat_degC": meat})


def duplicate_in_another_unit(rng: Rng) -> Case:
    """One sensor in degC and degF, one drive in percent and 0 to 255."""
    u = steps(rng, 1500, [0, 20, 40, 60, 80, 100], 20, 80)
    y = sensor(rng, block(rng, u, 1, 22, 0.7, 65))
    columns = {
        "duty_percent": u,
        "duty_raw": np.round(u * 2.55),
        "tempC": y,
        "tempF": np.round(1.8 * y + 32, 2),
    }
    says = ("same signal|another unit|same readings",)
    text = Case(1, {}, {}, free=columns).written(rng)
    return Case(1, {"duty|duty_raw": u}, {"tempC|tempF": y}, free=columns, says=says, text=text)


def decimal_commas(rng: Rng) -> Case:
    """Semicolons and decimal commas, French or Italian columns with units in brackets."""
    dt = float(rng.choice([1, 2]))
    u = steps(rng, 1500, [0, 30.5, 60.5, 99.5], 20, 80)
    y = sensor(rng, block(rng, u, dt, 20, 0.55, 60 * dt), 0.05, 0.05)
    french, italian = (
        ("temps (s)", "chauffage (%)", "four (°C)"),
        ("tempo [s]", "riscaldamento [%]", "forno [°C]"),
    )
    when, drive, oven = (french, italian)[int(rng.integers(2))]
    time = (when, dt * np.arange(1500))
    return Case(dt, {drive: u}, {oven: y}, time=time, separator=";", decimal=",")


def sixty_rows(rng: Rng) -> Case:
    """Too few rows for most fits."""
    u = steps(rng, 60, [0, 50, 100], 5, 12)
    y = sensor(rng, block(rng, u, 10, 20, 0.5, 80), 0.05, 0.05)
    return Case(10, {"heater_percent": u}, {"block_degC": y}, asks=r"\b60\b.*\b80\b|\b80\b.*\b60\b")


# ---- programs ----


def marlin(rng: Rng) -> Case:
    """A printer host's terminal: M105 answers with chatter between."""
    rows = 1300
    target, u = steps(rng, rows, [0, 150, 190, 220], 90, 240), steps(rng, rows, [0, 30, 60, 90, 127], 20, 70)
    hot, bed = block(rng, u, 1, 24, 1.7, 60), 24 + lag(rng.normal(0, 1, rows), 1, 40)
    lines = []
    for row, stamp in enumerate(stamps(rng, rows, 1, "%H:%M:%S.000")):
        if rng.random() < 0.08:
            lines.append(
                f"{stamp} : " + pick(rng, "N123 G1 X20.1 Y33.7 E1.2*87", "echo:busy: processing", "ok")
            )
        lines.append(
            f"{stamp} : ok T:{hot[row]:.2f} /{target[row]:.2f} B:{bed[row]:.2f} /0.00 @:{u[row]:.0f} B@:0"
        )
    free = dict.fromkeys(("B", "T_target", "B_target", "B@"), bed)
    return Case(1, {"@": u}, {"T": hot}, free=free, suffix=".log", text="\n".join(lines) + "\n")


def klipper(rng: Rng) -> Case:
    """klippy.log: one line of statistics a second, key=value."""
    rows = 1300
    target = steps(rng, rows, [60, 120, 180, 200], 100, 300)
    y, u, _ = controlled(rng, target, 1.0, 2.4, 70)
    lines = ["Start printer at Fri May  3 14:02:11 2024", "Loaded MCU 'mcu' 100 commands"]
    for row in range(rows):
        lines.append(
            f"Stats {1200.3 + row:.1f}: gcodein=0  mcu: mcu_awake=0.002 mcu_task_avg=0.000015 "
            f"bytes_write=15{row:04d} heater_bed: target=0 temp={25 + rng.normal(0, 0.1):.1f} pwm=0.000 "
            f"sysload=0.31 cputime={3 + 0.05 * row:.3f} memavail=721{int(rng.integers(100, 999))} "
            f"extruder: target={target[row]:.0f} temp={y[row]:.1f} pwm={u[row] / 100:.3f}"
        )
        if rng.random() < 0.05:
            lines.append("Timeout with MCU 'mcu' (eventtime=1200.1)")
    free = dict.fromkeys(("extruder_target", "heater_bed_temp", "heater_bed_target", "heater_bed_pwm"), y)
    text = "\n".join(lines) + "\n"
    return Case(
        1, {"extruder_pwm": u}, {"extruder_temp": y}, {}, free, None, (CLOSED_LOOP,), suffix=".log", text=text
    )


def home_assistant(rng: Rng) -> Case:
    """The history of a home hub: entity, state, moment; a row per change."""
    dt, rows = 60.0, 1500
    u = steps(rng, rows, [0, 1], 10, 50)
    outside = sensor(rng, weather(rng, rows, dt), 0.02, 0.1)
    room = sensor(rng, 9 + lag(0.8 * outside, dt, 150 * dt, outside[0]) + lag(8 * u, dt, 35 * dt), 0.03, 0.1)
    start = datetime(2024, 2, 11, 6, 0, tzinfo=UTC)
    lines = ["entity_id,state,last_changed"]
    for name, values in {"switch.heater": u, "sensor.living_room": room, "sensor.outdoor": outside}.items():
        for row in np.flatnonzero(np.diff(values, prepend=np.nan) != 0):
            moment = (start + timedelta(seconds=int(row) * dt)).isoformat(timespec="milliseconds")
            state = ("on" if values[row] else "off") if name.startswith("switch") else f"{values[row]:.1f}"
            lines.append(f"{name},{state},{moment.replace('+00:00', 'Z')}")
    text = "\n".join(lines) + "\n"
    return Case(dt, {"heater": u}, {"living_room": room}, {"outdoor": outside}, text=text)


def esphome(rng: Rng) -> Case:
    """The log of a board: one line per reading, in words."""
    u, y = heated(rng, 1300, 10)
    lines = []
    for row, stamp in enumerate(stamps(rng, 1300, 10, "%H:%M:%S")):
        for name, value in (("Kettle", f"{y[row]:.5f} °C"), ("Duty", f"{u[row] / 2.55:.5f} %")):
            lines.append(f"[{stamp}][D][sensor:094]: '{name}': Sending state {value} with 2 decimals")
        if rng.random() < 0.1:
            lines.append(f"[{stamp}][D][wifi:123]: WiFi signal -61 dB")
    return Case(10, {"Duty": u}, {"Kettle": y}, suffix=".log", text="\n".join(lines) + "\n")


def labview(rng: Rng) -> Case:
    """A .lvm file: a header of its own, tabs, decimal commas in half of the seeds."""
    dt, rows, decimal = float(rng.choice([0.1, 0.5])), 1500, pick(rng, ".", ",")
    u, y = heated(rng, rows, dt)
    step = f"{dt:.6f}".replace(".", decimal)
    head = [
        "LabVIEW Measurement\t", "Writer_Version\t2", "Separator\tTab", f"Decimal_Separator\t{decimal}",
        "X_Columns\tOne", "Time_Pref\tRelative", "Date\t2024/02/11", "Time\t10:11:12,5",
        "***End_of_Header***\t", "\t", "Channels\t2\t\t", f"Samples\t{rows}\t{rows}\t",
        "Date\t2024/02/11\t2024/02/11\t", "Time\t10:11:12\t10:11:12\t", "Y_Unit_Label\tVolt\tdegC\t",
        "X0\t0\t0\t", f"Delta_X\t{step}\t{step}\t",
        "***End_of_Header***\t\t\t", "X_Value\tDrive\tOven\tComment",
    ]  # fmt: skip
    lines = [
        f"{row * dt:.6f}\t{u[row] / 51:.6f}\t{y[row]:.6f}\t".replace(".", decimal) for row in range(rows)
    ]
    return Case(dt, {"Drive": u}, {"Oven": y}, suffix=".lvm", text="\n".join(head + lines) + "\n")


def serial_plotter(rng: Rng) -> Case:
    """Labelled values of a serial plotter, without any clock: the step has to be asked."""
    u, y = heated(rng, 1400, 1.0)
    text = "".join(f"pwm:{u[row]:.0f},temp:{y[row]:.2f}\n" for row in range(1400))
    return Case(float("nan"), {"pwm": u}, {"temp": y}, asks="--dt", suffix=".txt", text=text)


def putty(rng: Rng) -> Case:
    """A terminal's log with a head of its own and stamps in brackets."""
    dt = float(rng.choice([1, 2]))
    u, y = heated(rng, 1400, dt)
    lines = ["=~=~=~=~=~=~=~=~=~=~=~= PuTTY log 2024.03.01 22:55:39 =~=~=~=~=~=~=~=~=~=~=~=", "temp\tpwm"]
    lines += [f"[{stamp}] {y[row]:.2f}\t{u[row]:.0f}" for row, stamp in enumerate(stamps(rng, 1400, dt))]
    return Case(dt, {"pwm": u}, {"temp": y}, suffix=".log", text="\n".join(lines) + "\n")


def tclab(rng: Rng) -> Case:
    """The table of the TCLab package: Time, T1, T2, Q1, Q2."""
    q1, q2 = steps(rng, 1500, [0, 30, 60, 90], 30, 110), steps(rng, 1500, [0, 25, 50, 80], 30, 110)
    one = 22 + lag(lag(0.6 * q1 + 0.15 * q2, 1, 150), 1, 15)
    two = 22 + lag(lag(0.2 * q1 + 0.4 * q2, 1, 170), 1, 15)
    readings = {"T1": sensor(rng, one, 0.1, 0.32), "T2": sensor(rng, two, 0.1, 0.32)}
    return Case(1, {"Q1": q1, "Q2": q2}, readings, time=("Time", clock(rng, 1500, 1, 0.01)))


CASES: tuple[Callable[[Rng], Case], ...] = (
    two_relays, three_relays, relay_and_duty, elements_together, heater_and_cooler, states_in_words,
    pid_terms, loop_without_set_point, thermostat, set_point_logged,
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
    bare = re.sub(r"(_percent|_degC|_degF|_Wh|_A|_celsius|\s*[(\[][^)\]]*[)\]])$", "", name)
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
        rng = np.random.default_rng([arguments.seed, place])
        case = make(rng)
        path = folder / f"log{place:02}{case.suffix}"  # a name that says nothing
        path.write_text(case.written(rng), encoding="utf-8")
        verdict, why = judge(case, *(fitted(path) if arguments.fit else read_only(path)))
        counts[verdict] = counts.get(verdict, 0) + 1
        print(f"{make.__name__:26}{verdict:7}{why}", flush=True)
    print(", ".join(f"{count} {verdict}" for verdict, count in sorted(counts.items())))


if __name__ == "__main__":
    main()
