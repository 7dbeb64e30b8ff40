"""Eight plants of other trades, for ``eight_plants.py``: their equations, sensors, loads and users' wishes.

As in :mod:`truths` nothing is shared with the package.  A sensor has noise and steps (12 bit, the laser's
20); each plant rests at a first target, goes to a second, meets a load that nobody measures, and returns.

* espresso: 0.3 l of boiler; then 2 ml/s of cold water are drawn for half a minute.
* kiln: elements, ware and brick that radiate; then a peep hole stands open.
* pcr: a block of 30 J/K between Peltier elements, 0.1 s a sample; then air blows at it.
* sous_vide: 8 l of water, the heater's relay in windows of 4 s; then 150 W of cold food.
* extruder: two zones, a melt that is read 12 and 20 s later; then cold granulate at twice the rate.
* laser: a mount held to some mK; then the diode's 0.3 W.
* bed: 8 kg of aluminium under a printer; then a draught.
* reflow: a plate on a profile that is known ahead; at the soak a cold board is laid on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from truths import Case, Changes, Plant, Signal, _glow


class Windowed(Plant):
    """A plant whose first input, in percent, is the share of a window in which a relay is on."""

    window = 4.0  # s

    def run(self, u: Sequence[float], seconds: float) -> None:
        for _ in range(max(1, round(seconds / self.step))):
            on_s = self.window * u[0] / 100.0 - self.time % self.window
            super().run([100.0 * min(max(on_s / self.step, 0.0), 1.0)], self.step)


def espresso() -> Plant:
    """A heater of 1200 W in a boiler, its sensor 2.5 s behind, a brass group beside."""

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        wire, water, group, shown = x
        draw = 8.36 * (water - 20.0) if c.disturbed else 0.0
        return [
            (12.0 * u[0] - 60.0 * (wire - water)) / 120.0,
            (60.0 * (wire - water) - 4.0 * (water - group) - 0.8 * (water - 22.0) - draw) / 1300.0,
            (4.0 * (water - group) - 0.6 * (group - 22.0)) / 350.0,
            (water - shown) / 2.5,
        ]

    return Plant(rates, [82.0, 82.0, 74.0, 82.0], [3], step=0.1)


def kiln() -> Plant:
    """Elements of 9 kW, ware, two layers of brick, a thermocouple in a tube."""

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        wire, ware, inner, outer, shown = x
        to_ware = 0.06 * _glow(wire, ware)
        to_brick = 0.05 * _glow(wire, inner)
        between = 0.10 * _glow(ware, inner)
        hole = 0.006 * _glow(ware, 25.0) if c.disturbed else 0.0
        return [
            (90.0 * u[0] - to_ware - to_brick) / 1500.0,
            (to_ware - between - hole) / 9000.0,
            (to_brick + between - 6.0 * (inner - outer)) / 14000.0,
            (6.0 * (inner - outer) - 9.0 * (outer - 25.0)) / 60000.0,
            (ware - shown) / 12.0,
        ]

    return Plant(rates, [640.0, 630.0, 620.0, 260.0, 630.0], [4], step=0.5)


def pcr() -> Plant:
    """A block and its sample, elements that heat and cool, a fan on the sink."""

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        block, sink, shown = x
        amp = 6.0 * u[0]
        pumped = 0.10 * amp * (block + 273.15) + 0.5 * 3.0 * amp * amp
        drawn = 0.10 * amp * (sink + 273.15) - 0.5 * 3.0 * amp * amp
        across = 1.2 * (block - sink)
        air = (0.12 + (0.10 if c.disturbed else 0.0)) * (block - 25.0)
        return [
            (pumped - across - air) / 34.0,
            (across - drawn - 9.0 * (sink - 25.0)) / 260.0,
            (block - shown) / 0.25,
        ]

    return Plant(rates, [47.0, 27.0, 47.0], [2], step=0.01)


def sous_vide() -> Plant:
    """Water that a pump stirs, a heater of 1000 W, a probe 10 s behind."""

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        wire, water, shown = x
        load = 150.0 if c.disturbed else 0.0
        return [
            (10.0 * u[0] - 40.0 * (wire - water)) / 400.0,
            (40.0 * (wire - water) - 9.0 * (water - 22.0) - load) / 33400.0,
            (water - shown) / 10.0,
        ]

    return Windowed(rates, [62.0, 54.0, 54.0], [2], step=0.5)


def extruder() -> Plant:
    """Two heated zones of a barrel; the melt takes heat along, and is read through delays."""

    pipes = [[], []]  # type: ignore[var-annotated]

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        a, b, first, second = x
        flow = 2.0 if c.disturbed else 1.0  # W/K of granulate
        return [
            (8.0 * u[0] - 1.6 * (a - 25.0) - 2.2 * (a - b) - flow * 0.9 * (a - 60.0)) / 900.0,
            (7.0 * u[1] - 1.5 * (b - 25.0) + 2.2 * (a - b) - flow * 0.4 * (b - 0.6 * a - 20.0)) / 800.0,
            (_later(pipes[0], a, 12.0) - first) / 6.0,
            (_later(pipes[1], b, 20.0) - second) / 6.0,
        ]

    return Plant(rates, [180.0] * 4, [2, 3], step=0.5)


def _later(pipe: list[float], value: float, seconds: float) -> float:
    """Return what went into a pipe so long ago, of steps of 0.5 s."""
    pipe.append(value)
    return pipe.pop(0) if len(pipe) > round(seconds / 0.5) else pipe[0]


def laser() -> Plant:
    """A mount on a Peltier element, its thermistor 0.4 s behind."""

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        mount, sink, shown = x
        amp = 1.5 * u[0]
        load = 0.3 if c.disturbed else 0.0
        pumped = 0.012 * amp * (mount + 273.15) + 0.5 * 2.0 * amp * amp
        drawn = 0.012 * amp * (sink + 273.15) - 0.5 * 2.0 * amp * amp
        across = 0.18 * (mount - sink)
        return [
            (pumped - across - 0.02 * (mount - 23.0) + load) / 9.0,
            (across - drawn - 2.5 * (sink - 23.0)) / 180.0,
            (mount - shown) / 0.4,
        ]

    return Plant(rates, [28.0, 23.0, 28.0], [2], step=0.02)


def bed() -> Plant:
    """8 kg of aluminium on a pad of 1200 W, the thermistor in a bore."""

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        pad, plate, shown = x
        air = 2.6 + (1.6 if c.disturbed else 0.0)
        lost = air * (plate - 24.0) + 0.16 * 0.8 * _glow(plate, 24.0)
        return [
            (12.0 * u[0] - 45.0 * (pad - plate) - 0.4 * (pad - 24.0)) / 500.0,
            (45.0 * (pad - plate) - lost) / 7200.0,
            (plate - shown) / 9.0,
        ]

    return Plant(rates, [63.0, 60.0, 60.0], [2], step=0.5)


def reflow() -> Plant:
    """A plate over quartz tubes of 1500 W; a board of 60 J/K comes cold."""

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        tube, plate, board, shown = x
        to_board = 5.0 * (plate - board) if c.disturbed else 0.0
        radiated = 0.010 * _glow(tube, plate)
        return [
            (15.0 * u[0] - radiated - 0.8 * (tube - plate)) / 40.0,
            (radiated + 0.8 * (tube - plate) - 1.8 * (plate - 25.0) - to_board) / 420.0,
            (to_board - 0.3 * (board - 25.0)) / 60.0,
            (plate - shown) / 2.0,
        ]

    return Plant(rates, [150.0, 80.0, 25.0, 80.0], [3], step=0.1)


@dataclass(frozen=True)
class Trade:
    """A case with the steps of its sensors and how it is judged."""

    case: Case  # its first target is where it rests, the second where it goes
    quantum: float  # of the sensors
    load_s: float  # s, for which the load lasts
    profile: Callable[[float], float] | None = None  # a target that is known ahead, in place of steps


def profile_of_reflow(t: float) -> float:
    """Return the plate's target: a ramp, a soak, a peak, and down as fast as air allows."""
    points = ((0, 80), (10, 80), (70, 150), (140, 170), (180, 225), (200, 225), (380, 130), (500, 110))
    for (t0, y0), (t1, y1) in pairwise(points):
        if t <= t1:
            return float(y0 + (y1 - y0) * (t - t0) / (t1 - t0))
    return float(points[-1][1])


def _case(
    name: str,
    make: Callable[[], Plant],
    drives: Sequence[str],
    sensors: Sequence[str],
    noise: float,
    *,
    unit: str = "percent",
    log: tuple[float, float],
    hold: tuple[float, float],
    levels: Sequence[tuple[float, float]],
    rest: Sequence[float],
    targets: tuple[float, float],
    seconds: float,
    band: float,
) -> Case:
    low, high = (0.0, 100.0) if unit == "percent" else (-1.0, 1.0)
    return Case(
        name,
        str(make.__doc__),
        tuple(Signal(drive, unit, low, high) for drive in drives),
        tuple(Signal(sensor, "degC", noise=noise) for sensor in sensors),
        make,
        *log,
        hold,
        tuple(levels),
        tuple(rest),
        {"output": list(sensors)},
        targets,
        seconds,
        band,
        abs(targets[1] - targets[0]),
        tuple(zip(drives, sensors, strict=True)),
        logs=1,
    )


TRADES = (
    Trade(
        _case("espresso", espresso, ["heater"], ["t_boiler"], 0.05, log=(0.5, 1800.0), hold=(10.0, 90.0),
              levels=[(0.0, 30.0)], rest=[6.6087], targets=(82.0, 93.0), seconds=300.0, band=0.5),
        150 / 4096, 30.0,
    ),
    Trade(
        _case("kiln", kiln, ["power"], ["t_kiln"], 0.6, log=(5.0, 14400.0), hold=(200.0, 1200.0),
              levels=[(10.0, 70.0)], rest=[21.9734], targets=(630.0, 800.0), seconds=2400.0, band=3.0),
        1300 / 4096, 1200.0,
    ),
    Trade(
        _case("pcr", pcr, ["current"], ["t_block"], 0.02, unit="1", log=(0.1, 600.0), hold=(2.0, 12.0),
              levels=[(-0.35, 0.6)], rest=[0.1443], targets=(47.0, 95.0), seconds=45.0, band=0.25),
        105 / 4096, 20.0,
    ),
    Trade(
        _case("sous_vide", sous_vide, ["duty"], ["t_bath"], 0.02, log=(4.0, 10800.0), hold=(100.0, 900.0),
              levels=[(0.0, 80.0)], rest=[28.8], targets=(54.0, 60.0), seconds=1500.0, band=0.2),
        120 / 4096, 900.0,
    ),
    Trade(
        _case("extruder", extruder, ["zone1", "zone2"], ["t_melt1", "t_melt2"], 0.2, log=(2.0, 7200.0),
              hold=(60.0, 500.0), levels=[(20.0, 80.0), (15.0, 70.0)], rest=[44.5, 36.1857],
              targets=(180.0, 200.0), seconds=900.0, band=1.0),
        400 / 4096, 600.0,
    ),
    Trade(
        _case("laser", laser, ["tec"], ["t_mount"], 0.001, unit="1", log=(0.2, 900.0), hold=(3.0, 30.0),
              levels=[(-0.35, 0.35)], rest=[0.1716], targets=(28.0, 25.0), seconds=60.0, band=0.01),
        100 / 2**20, 40.0,
    ),
    Trade(
        _case("bed", bed, ["pad"], ["t_bed"], 0.1, log=(1.0, 7200.0), hold=(60.0, 600.0),
              levels=[(0.0, 80.0)], rest=[11.8285], targets=(60.0, 100.0), seconds=2400.0, band=1.0),
        200 / 4096, 600.0,
    ),
    Trade(
        _case("reflow", reflow, ["tubes"], ["t_plate"], 0.15, log=(1.0, 2400.0), hold=(10.0, 90.0),
              levels=[(0.0, 60.0)], rest=[6.6], targets=(80.0, 80.0), seconds=500.0, band=3.0),
        300 / 4096, 500.0, profile_of_reflow,
    ),
)  # fmt: skip
