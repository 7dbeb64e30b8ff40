"""Eight plants of other desks, by the command line as their users would: logs, plant, controller, days.

    python benchmarks/control/other_desks.py --plants board,oven --keep FOLDER [--stages logs,commands,loop]

As ``truths.py``, nothing here is shared with the package.  Written down before the first look, with the
spec of each user.  For each plant: two logs (CSV) -> ``thermogrip identify`` -> ``validate`` on a third log
-> ``tune`` -> ``review``, every output kept in the folder; then the controller on the truth, day by day,
beside the default design, the PI that ``tune`` found and SIMC from the same logs (with no row missing).

Musts: both targets settle within 1.05 of the time of SIMC and of the default design; overshoot at most half
a percent of the range, or 0.3 degC; offset at most 0.05 of the unit while no drive is at its limit; where a
loop is out of its band long after it should have settled, or never settles, status says so within 60 s; the
90 % bands of ``validate`` cover 80 to 97 % of the third log; ``review`` fails or warns where the loop is
bad; no traceback.

* board: two heaters, logs of a quiet day.  Days: quiet; fan (room 8 K warmer, heater 1 loses 1.6 times as
  much, heater 2 gives 0.8 of its heat); glued (sensor 2 lags by 20 s more); swapped (sensor wires crossed).
* oven: a relay that is switched once in 2 s, readings in steps of 0.25 degC, walls that warm for an hour.
* fermenter: growth that heats more the warmer it is, three times as much in the evening; a valve of 0 to 1,
  that an operator moved by hand in the logs.
* sink: a Peltier finger in A whose heatsink, which nobody reads, warms for half an hour.
* extruder: logs of a PI loop alone, irregular rows, some missing.
* brief: one step test of three minutes, of a block that needs half an hour.
* zones: two zones that exchange five times what they lose, to be held 4 degC apart (relative gain 3.3).
* sticky: a valve with 3 percent of play.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from opponents import SimcPI, first_order
from ten_plants import HEAD, Ours, Player, Result, evaluate, figures, row
from truths import Array, Case, Changes, Plant, Signal, _glow, _heat, _sensors

from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.design.spec import spec_from_dict
from thermogrip.sysid.plant.plant import Plant as Model


@dataclass(frozen=True)
class Desk(Case):
    """A plant with the days on which its controller runs."""

    days: Mapping[str, Callable[[], Plant]] = field(default_factory=dict)
    quantum: float = 0.0  # of its sensors
    apart: tuple[float, ...] = ()  # added to the target of each output
    logged: str = "open"  # how its logs came about: open, loop, step or hand


class Growing(Plant):
    """What grows stands still until the clock starts."""

    growing = False

    def settle(self, u: Sequence[float], seconds: float) -> None:
        """Start the clock."""
        self.time, self.growing = 0.0, True


def board(
    room: float = 21.0, loss: float = 1.0, power: float = 1.0, lag: float = 18.0, *, crossed: bool = False
) -> Plant:
    """Two heaters of 1.5 W with sensors that lag."""

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        a, b, sa, sb = x
        draught = 1.15 if c.disturbed else 1.0
        over = 0.014 * (a - b)
        lost_a = loss * draught * 0.026 * (a - room) + 1.1e-3 * 0.9 * _glow(a, room)
        lost_b = draught * 0.026 * (b - room) + 1.1e-3 * 0.9 * _glow(b, room)
        return [
            (0.0165 * u[0] - lost_a - over) / 6.2,
            (power * 0.0120 * u[1] - lost_b + over) / 5.8,
            (a - sa) / 18.0,
            (b - sb) / lag,
        ]

    return Plant(rates, [room] * 4, [3, 2] if crossed else [2, 3], step=0.2)


def oven() -> Plant:
    """1.5 kW through a relay, an element, air, walls."""
    clock, given = [0, 0.0], 2.0

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        at = clock[0] % 20
        if at == 0:
            clock[1] = u[0]  # read once in 2 s
        clock[0] += 1
        on = at < round(20 * clock[1] / 100.0)
        element, air, wall, shown = x
        heat = 9.0 * (element - air) + 0.01 * _glow(element, wall)
        door = (1.2 if c.disturbed else 0.0) * (air - 22.0)
        return [
            ((1500.0 if on else 0.0) - heat) / 260.0,
            (9.0 * (element - air) - 7.0 * (air - wall) - 0.8 * (air - 22.0) - door) / 700.0,
            (7.0 * (air - wall) + 0.01 * _glow(element, wall) - 2.6 * (wall - 22.0)) / 7000.0,
            (air - shown) / 9.0,
        ]

    return Plant(rates, [22.0] * 4, [3], step=given / 20)


def fermenter() -> Plant:
    """50 litres of broth, a jacket, growth."""
    plant: Growing

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        broth, jacket, shown, heat = x
        faster = float(np.exp(0.07 * (broth - 35.0)))
        made = heat * faster + 60.0 + (90.0 if c.disturbed else 0.0)
        return [
            (made - 200.0 * (broth - jacket) - 3.0 * (broth - 20.0)) / 209e3,
            (200.0 * (broth - jacket) - 125.0 * min(max(u[0], 0.0), 1.0) * (jacket - 15.0)) / 2e4,
            (broth - shown) / 25.0,
            0.26 / 3600.0 * faster * heat * (1.0 - heat / 1500.0) if plant.growing else 0.0,
        ]

    plant = Growing(rates, [35.0, 33.8, 35.0, 220.0], [2], step=2.0)
    return plant


def sink() -> Plant:
    """A finger of 15 J/K on a heatsink of 2500 J/K."""

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        finger, sink, shown = x
        joule = 0.5 * 2.0 * u[0] * u[0]
        into = 0.03 * u[0] * (finger + 273.15) + joule + 0.3 * (sink - finger)
        back = -0.03 * u[0] * (sink + 273.15) + joule - 0.3 * (sink - finger)
        return [
            (into + 0.1 * (23.0 - finger) - (0.5 if c.disturbed else 0.0)) / 15.0,
            (back + 1.2 * (23.0 - sink)) / 2500.0,
            (finger - shown) / 1.5,
        ]

    return Plant(rates, [23.0] * 3, [2], step=0.05)


def extruder() -> Plant:
    """A barrel under a heater band."""

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        band, barrel, shown = x
        melt = 0.7 if c.disturbed else 0.0
        return [
            (20.0 * u[0] - 22.0 * (band - barrel)) / 800.0,
            (22.0 * (band - barrel) - (9.0 + melt) * (barrel - 25.0)) / 3600.0,
            (barrel - shown) / 5.0,
        ]

    return Plant(rates, [25.0] * 3, [2], step=0.25, delay=6.0)


def brief() -> Plant:
    """A block of aluminium with a second one behind it."""

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        block, behind, shown = x
        lost = (0.35 + (0.06 if c.disturbed else 0.0)) * (block - 22.0)
        over = 0.5 * (block - behind)
        return [
            (0.55 * u[0] - lost - over) / 190.0,
            (over - 0.1 * (behind - 22.0)) / 240.0,
            (block - shown) / 5.0,
        ]

    return Plant(rates, [22.0] * 3, [2], step=0.1, delay=1.5)


def zones() -> Plant:
    """Two zones on one bar."""

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        a, b, sa, sb = x
        over = 3.0 * (a - b)
        load = 4.0 if c.disturbed else 0.0
        return [
            (1.0 * u[0] - 0.6 * (a - 22.0) - over - load) / 300.0,
            (0.9 * u[1] - 0.6 * (b - 22.0) + over) / 260.0,
            (a - sa) / 4.0,
            (b - sb) / 4.0,
        ]

    return Plant(rates, [22.0] * 4, [2, 3], step=0.2, delay=2.0)


def sticky() -> Plant:
    """Air over a coil; the valve's stem follows with 3 percent of play."""
    stem = [40.0]

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        stem[0] = min(max(stem[0], u[0] - 1.5), u[0] + 1.5)
        coil, air = x
        inlet = 12.0 - (2.0 if c.disturbed else 0.0)
        return [
            (0.55 * stem[0] ** 0.9 + inlet + 8.0 - coil) / 35.0,
            (coil - air) / 12.0,
        ]

    return Plant(rates, [35.0] * 2, [1], step=0.1, delay=3.0)


DESKS = (
    Desk(
        "board", "two heaters, logs of a quiet day",
        _heat("q1", "q2"), _sensors(0.05, "t1", "t2"), board,
        1.0, 1500.0, (60.0, 300.0), ((0.0, 90.0), (0.0, 90.0)), (0.0, 0.0),
        {"output": ["t1", "t2"], "steps": [(25.0, 38.0), (38.0, 45.0)], "settle_within_s": 500.0,
         "hold_s": 600.0},
        (38.0, 44.0), 600.0, 0.25, 60.0, (("q1", "t1"), ("q2", "t2")),
        days={
            "quiet": board,
            "fan": lambda: board(29.0, 1.6, 0.8),
            "glued": lambda: board(lag=38.0),
            "swapped": lambda: board(crossed=True),
        },
    ),
    Desk(
        "oven", "a relay of 2 s, steps of 0.25 degC",
        _heat("heater"), _sensors(0.05, "t_oven"), oven,
        1.0, 3600.0, (60.0, 500.0), ((0.0, 65.0),), (0.0,),
        {"output": "t_oven", "steps": [(100.0, 150.0), (150.0, 180.0)], "band_degC": 1.0,
         "overshoot_degC": 1.0, "settle_within_s": 600.0, "hold_s": 900.0},
        (150.0, 180.0), 900.0, 1.0, 200.0, (("heater", "t_oven"),), quantum=0.25,
    ),
    Desk(
        "fermenter", "growth that heats",
        (Signal("valve", "1", 0.0, 1.0),), _sensors(0.03, "t_broth"), fermenter,
        20.0, 14400.0, (300.0, 900.0), ((-0.08, 0.08),), (0.1,),
        {"output": "t_broth", "steps": [(33.0, 36.0), (36.0, 34.0)], "settle_within_s": 3000.0,
         "hold_s": 5400.0, "drive_limits": {"valve": (0.0, 1.0)}, "safe_drive": {"valve": 1.0}},
        (36.0, 34.0), 5400.0, 0.25, 40.0, (("valve", "t_broth"),), logged="hand",
    ),
    Desk(
        "sink", "a heatsink that warms for half an hour",
        (Signal("current", "A", -2.0, 2.0),), _sensors(0.03, "t_finger"), sink,
        0.5, 900.0, (10.0, 90.0), ((-1.2, 1.2),), (0.0,),
        {"output": "t_finger", "steps": [(25.0, 34.0), (34.0, 16.0)], "settle_within_s": 120.0,
         "hold_s": 300.0, "drive_limits": {"current": (-2.0, 2.0)}},
        (34.0, 15.0), 900.0, 0.25, 40.0, (("current", "t_finger"),),
    ),
    Desk(
        "extruder", "logs of a loop, rows missing",
        _heat("band"), _sensors(0.1, "t_barrel"), extruder,
        2.0, 3600.0, (400.0, 900.0), ((130.0, 200.0),), (60.0,),
        {"output": "t_barrel", "steps": [(150.0, 180.0), (180.0, 165.0)], "band_degC": 0.5,
         "overshoot_degC": 0.5, "settle_within_s": 400.0, "hold_s": 700.0},
        (180.0, 165.0), 900.0, 0.5, 200.0, (("band", "t_barrel"),), logged="loop",
    ),
    Desk(
        "brief", "one step test of three minutes",
        _heat("heater"), _sensors(0.04, "t_block"), brief,
        0.5, 180.0, (300.0, 400.0), ((40.0, 40.0),), (0.0,),
        {"output": "t_block", "steps": [(25.0, 45.0), (45.0, 40.0)], "settle_within_s": 300.0,
         "hold_s": 600.0},
        (45.0, 40.0), 900.0, 0.25, 40.0, (("heater", "t_block"),), logged="step", logs=1,
    ),
    Desk(
        "zones", "two zones that exchange heat",
        _heat("p1", "p2"), _sensors(0.04, "t1_zone", "t2_zone"), zones,
        1.0, 2400.0, (40.0, 300.0), ((0.0, 60.0), (0.0, 60.0)), (20.0, 20.0),
        {"output": ["t1_zone", "t2_zone"], "steps": [(52.0, 60.0), (60.0, 55.0)], "settle_within_s": 300.0,
         "hold_s": 500.0},
        (60.0, 55.0), 600.0, 0.25, 40.0, (("p1", "t1_zone"), ("p2", "t2_zone")), apart=(2.0, -2.0),
    ),
    Desk(
        "sticky", "a valve with play",
        _heat("valve"), _sensors(0.05, "t_air"), sticky,
        1.0, 2400.0, (30.0, 200.0), ((20.0, 80.0),), (40.0,),
        {"output": "t_air", "steps": [(35.0, 42.0), (42.0, 34.0)], "settle_within_s": 200.0, "hold_s": 400.0},
        (42.0, 34.0), 500.0, 0.25, 40.0, (("valve", "t_air"),),
    ),
)  # fmt: skip


def rounded(values: Array, quantum: float) -> Array:
    """Return readings in steps."""
    return np.asarray(np.round(values / quantum) * quantum) if quantum else values


def record(desk: Desk, seed: int) -> tuple[Array, dict[str, Array]]:
    """Return a log with every row; the third one of ``brief`` lasts 40 minutes and moves."""
    rng, plant = np.random.default_rng([seed, *desk.name.encode()]), desk.make()
    plant.settle(desk.rest, 40 * desk.hold[1])
    dt, seconds = desk.log_dt, desk.log_s
    levels, hold = desk.levels, desk.hold
    if desk.logged == "step" and seed >= desk.logs:
        seconds, levels, hold = 2400.0, ((0.0, 70.0),), (100.0, 500.0)
    u, goal, total = np.array(desk.rest, dtype=float), 0.0, desk.rest[0]
    until = np.full(len(levels), 20.0 if desk.logged == "step" else 2 * dt)
    rows: list[list[float]] = []
    for k in range(round(seconds / dt)):
        shown = plant.read() + [s.noise * rng.standard_normal() for s in desk.outputs]
        shown = rounded(shown, desk.quantum)
        for j, (low, high) in enumerate(levels):
            if k * dt >= until[j]:
                level = float(np.round(rng.uniform(low, high), 3))
                until[j] = k * dt + rng.uniform(*hold)
                if desk.logged == "loop":
                    goal = level
                elif desk.logged == "hand":
                    u[j] = float(np.clip(0.1 + 0.06 * (float(shown[0]) - 34.5) + level, 0.0, 1.0).round(3))
                else:
                    u[j] = level
        if desk.logged == "loop":
            error = (goal - float(shown[0])) if goal else 0.0
            wanted = total + 2.0 * error
            u[0] = float(np.clip(wanted, 0.0, 100.0))
            if u[0] == wanted:
                total += 2.0 / 250.0 * dt * error
        rows.append([*u, *shown])
        plant.run(u, dt)
    names = [s.name for s in (*desk.inputs, *desk.outputs)]
    return dt * np.arange(len(rows)), dict(zip(names, np.array(rows).T, strict=True))


def write(desk: Desk, folder: Path) -> list[Path]:
    """Write the logs, and one more for ``validate``, as a logger would."""
    paths = []
    for seed in range(desk.logs + 1):
        time_s, columns = record(desk, seed)
        rng = np.random.default_rng([seed, 5])
        keep = np.ones(len(time_s), dtype=bool)
        if desk.logged == "loop":
            time_s = time_s + rng.uniform(0.0, 0.6, len(time_s))  # the logger's clock wavers
            keep = rng.random(len(time_s)) > 0.04
            keep[len(time_s) // 3 : len(time_s) // 3 + 15] = False
        header = ["time_s", *(f"{s.name} [{s.unit}]" for s in (*desk.inputs, *desk.outputs))]
        rows = np.column_stack([time_s, *columns.values()])[keep]
        lines = [",".join(header), *(",".join(f"{v:.7g}" for v in np.round(cells, 3)) for cells in rows)]
        paths.append(folder / f"{desk.name}{seed}.csv")
        paths[-1].write_text("\n".join(lines) + "\n", encoding="utf-8")
    return paths


def toml(spec: Mapping[str, object]) -> str:
    """Return a spec as a user's file."""

    def value(v: object) -> str:
        if isinstance(v, Mapping):
            return "{ " + ", ".join(f"{k} = {value(x)}" for k, x in v.items()) + " }"
        if isinstance(v, (list, tuple)):
            return "[" + ", ".join(value(x) for x in v) + "]"
        return f'"{v}"' if isinstance(v, str) else str(v)

    return "".join(f"{key} = {value(v)}\n" for key, v in spec.items())


def commands(desk: Desk, folder: Path, paths: Sequence[Path], evaluations: int) -> None:
    """Run what a user types; what is printed is kept."""
    plant, controller, spec = (
        folder / f"{desk.name}.{end}" for end in ("plant.json", "controller.json", "toml")
    )
    spec.write_text(
        toml({**desk.spec, **({"evaluations": evaluations} if evaluations else {})}), encoding="utf-8"
    )
    logs = [str(p) for p in paths]
    for name, line in (
        ("identify", ["identify", *logs[:-1], "--out", str(plant)]),
        ("validate", ["validate", str(plant), logs[-1]]),
        ("tune", ["tune", str(plant), "--spec", str(spec), "--out", str(controller)]),
        ("review", ["review", str(controller)]),
    ):
        if name in ("identify", "tune") and (plant if name == "identify" else controller).exists():
            continue
        done = subprocess.run(
            [str(Path(sys.executable).with_name("thermogrip")), *line],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        text = f"exit {done.returncode}\n{done.stdout}{done.stderr}"
        (folder / f"{desk.name}.{name}.txt").write_text(text, encoding="utf-8")
        print(f"--- {desk.name}: {name}\n{text}", flush=True)


def run(
    desk: Desk, make: Callable[[], Plant], player: Player, seed: int
) -> tuple[Result, float, dict[str, float]]:
    """Close the loop on a day; return its figures, when status first was not ok, and what was said when."""
    plant, rng = make(), np.random.default_rng([seed, 7])
    plant.settle(desk.rest, 40 * desk.hold[1])
    plant.changes.running = True
    n, dt = round(desk.seconds / player.dt), player.dt
    names = [s.name for s in desk.outputs]
    wanted = [output for _, output in desk.pairs]
    rows = [names.index(name) for name in wanted]
    apart = desk.apart or (0.0,) * len(wanted)
    goals = [desk.targets[0], desk.targets[1], desk.targets[1]]
    shown, applied, statuses = [plant.read()[rows]], [list(desk.rest)], Counter[str]()
    said: dict[str, float] = {}
    for k in range(3 * n):
        if k == 2 * n:
            plant.disturb()
        noise = [s.noise * rng.standard_normal() for s in desk.outputs]
        reading = dict(zip(names, rounded(plant.read() + noise, desk.quantum).tolist(), strict=True))
        reading |= {"time_s": k * dt, **dict(zip([s.name for s in desk.inputs], applied[-1], strict=True))}
        if not k:
            player.reset(reading)
        target = {name: goals[k // n] + more for name, more in zip(wanted, apart, strict=True)}
        u, status = player.step(reading, target if len(target) > 1 else next(iter(target.values())))
        statuses[status] += 1
        advice = getattr(getattr(player, "last", None), "advice", "")
        if status != "ok" or advice:
            said.setdefault(f"{status}: {advice}"[:90], k * dt)
        u = [float(np.clip(v, s.low, s.high)) for v, s in zip(u, desk.inputs, strict=True)]
        plant.run(u, dt)
        shown.append(plant.read()[rows])
        applied.append(u)
    when = min((t for what, t in said.items() if not what.startswith("ok")), default=float("inf"))
    y = np.array(shown) - np.array(apart)
    return figures(desk, y, np.array(applied), desk.inputs, n, dt, statuses), when, said


class Told(Ours):
    """A controller of the package that keeps its last move."""

    last: object = None

    def step(self, reading: Mapping[str, float], target: object) -> tuple[list[float], str]:
        move = self.last = self.loop.step(reading, target)  # type: ignore[arg-type]
        given = iter(move.drives([s.name for s in self.case.inputs]))
        return [next(given) for _ in self.case.inputs], move.status


class SimcApart(SimcPI):
    """SIMC with a target for each loop."""

    def step(self, reading: Mapping[str, float], target: object) -> tuple[list[float], str]:
        if not isinstance(target, Mapping):
            return super().step(reading, float(target))  # type: ignore[arg-type]
        moved = {output: reading[output] - value for output, value in target.items()}
        return super().step({**reading, **moved}, 0.0)


def loops(desk: Desk, folder: Path, days: str, without: str) -> list[str]:
    """Close all loops of a desk."""
    controller = Controller.load(folder / f"{desk.name}.controller.json")
    plant = Model.load(folder / f"{desk.name}.plant.json")
    spec = spec_from_dict(desk.spec)
    wide = spec.widened(plant)
    found: list[tuple[str, Player]] = [("mpc", Told(desk, controller))]
    if "default" not in without:
        found.append(("default", Told(desk, Controller(wide, spec.design(wide)))))
    if "pi" not in without:
        own = PIController.of(plant, spec.design(controller.plant), controller.design.loops)
        found.append(("pi", Told(desk, own)))
    if "simc" not in without:
        logs = [record(desk, seed) for seed in range(desk.logs)]
        models = {output: first_order(desk, logs, output)[drive] for drive, output in desk.pairs}
        print(f"{desk.name}: {models}", flush=True)
        found.append(("simc", SimcApart(desk, models, desk.log_dt)))
    lines = []
    for day, make in (desk.days or {"": desk.make}).items():
        if days and day and day not in days.split(","):
            continue
        results: dict[str, list[Result]] = {}
        for name, player in found:
            result, when, said = run(desk, make, player, 0)
            results[name] = [result]
            lines.append(row(desk, f"{name} {day}".strip(), [result]))
            print(lines[-1], f"not ok from {when:g} s" if name != "simc" else "", flush=True)
            for what, t in list(said.items())[:8]:
                print(f"    {t:g} s: {what}", flush=True)
        print(evaluate(desk, results), flush=True)
    return lines


def main() -> None:
    """Write logs, run commands, close loops."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--plants", default=",".join(desk.name for desk in DESKS), help="by commas")
    parser.add_argument("--stages", default="commands,loop", help="by commas")
    parser.add_argument("--days", default="", help="of the board, by commas")
    parser.add_argument("--without", default="", help="controllers to leave out")
    parser.add_argument("--evaluations", type=int, default=0, help="of the search; 0: as tune has it")
    parser.add_argument(
        "--keep", type=Path, required=True, help="folder of logs, plants, controllers, outputs"
    )
    given = parser.parse_args()
    given.keep.mkdir(parents=True, exist_ok=True)
    print(HEAD)
    for desk in DESKS:
        if desk.name in given.plants.split(","):
            paths = write(desk, given.keep)
            if "commands" in given.stages:
                commands(desk, given.keep, paths, given.evaluations)
            made = (given.keep / f"{desk.name}.controller.json").exists()
            if not made:
                print(f"{desk.name}: no controller", flush=True)
            if "loop" in given.stages and made:
                loops(desk, given.keep, given.days, given.without)


if __name__ == "__main__":
    warnings.simplefilter("default")
    sys.exit(main())
