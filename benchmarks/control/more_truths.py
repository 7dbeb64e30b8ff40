"""Six plants more that the tuner was never looked at with, for ``ten_plants.py --plants``; as :mod:`truths`.

Late in a run comes an unmeasured change: more steam, a wider choke, warmer inflow, solder at the tip, a cold
load on a finger or in the bath.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from truths import Case, Changes, Plant, Signal, _glow, _heat, _sensors


def drum() -> Plant:
    """A level in percent that first goes the wrong way."""

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        mass, swell = x[0], x[1]
        steam = 50.0 + (8.0 if c.disturbed else 0.0)
        dm = 0.005 * (u[0] - steam)
        ds = (0.06 * (50.0 - u[0]) - swell) / 9.0
        return [dm, ds, (mass + swell - x[2]) / 2.0]

    return Plant(rates, [50.0, 0.0, 50.0], [2], step=0.25)


def exchanger() -> Plant:
    """Hot water through a valve, 15 s of pipe behind it."""

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        flow = 0.3 + 0.09 * u[0]  # kg/s of hot water
        wall, out = x
        inlet = 12.0 + (3.0 if c.disturbed else 0.0)
        heat = 1.6 * flow / (flow + 0.6) * (78.0 - wall)
        return [(heat - 2.2 * (wall - out)) / 30.0, (2.2 * (wall - out) - 1.1 * (out - inlet)) / 14.0]

    return Plant(rates, [40.0, 30.0], [1], step=0.5, delay=15.0)


def iron() -> Plant:
    """A heater of 60 W, a tip that radiates, a sensor 0.6 s behind."""

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        coil, tip, shown = x
        load = (0.12 if c.disturbed else 0.0) * (tip - 25.0) * 0.25
        lost = 0.035 * (tip - 25.0) + 4.5e-4 * 0.6 * _glow(tip, 25.0) + load
        return [
            (0.6 * u[0] - 0.9 * (coil - tip)) / 2.2,
            (0.9 * (coil - tip) - lost) / 5.5,
            (tip - shown) / 0.6,
        ]

    return Plant(rates, [25.0] * 3, [2], step=0.02)


def vessel() -> Plant:
    """A pressure in bar between a valve and a choke."""

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        p, valve = x
        out = 0.9 * np.sqrt(max(p, 0.0)) * (1.25 if c.disturbed else 1.0)
        inflow = 0.03 * valve * np.sqrt(max(7.0 - p, 0.0))
        return [(inflow - out) / 12.0, (u[0] - valve) / 1.5]

    return Plant(rates, [2.0, 20.0], [0], step=0.05)


def fingers() -> Plant:
    """Two Peltier fingers on one heatsink."""

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        a, b, sink, sa, sb = x

        def element(t: float, w: float) -> tuple[float, float]:
            i = 2.5 * w
            return 0.018 * i * (t + 273.15) + 0.5 * 1.6 * i * i, -0.018 * i * (
                sink + 273.15
            ) + 0.5 * 1.6 * i * i

        qa, ha = element(a, u[0])
        qb, hb = element(b, u[1])
        k = 0.25
        load = 0.25 if c.disturbed else 0.0
        return [
            (qa + k * (sink - a) + 0.05 * (23 - a) + 0.03 * (b - a) - load) / 14.0,
            (qb + k * (sink - b) + 0.05 * (23 - b) + 0.03 * (a - b)) / 14.0,
            (ha + hb + k * (a - sink) + k * (b - sink) + 1.8 * (23 - sink)) / 160.0,
            (a - sa) / 1.2,
            (b - sb) / 1.2,
        ]

    return Plant(rates, [23.0] * 5, [3, 4], step=0.1)


def bath() -> Plant:
    """Ten litres of water that are only heated."""

    def rates(x: list[float], u: Sequence[float], _: Sequence[float], c: Changes) -> list[float]:
        heater, water, shown = x
        return [
            (10.0 * u[0] - 35.0 * (heater - water)) / 900.0,
            (35.0 * (heater - water) - 14.0 * (water - 21.0) - (60.0 if c.disturbed else 0.0)) / 42000.0,
            (water - shown) / 45.0,
        ]

    return Plant(rates, [21.0] * 3, [2], step=1.0, delay=8.0)


MORE_CASES = (
    Case(
        "drum",
        "a level that first goes the wrong way",
        _heat("feed"),
        _sensors(0.08, "level", unit="percent"),
        drum,
        1.0,
        2400.0,
        (25.0, 120.0),
        ((38.0, 62.0),),
        (50.0,),
        {
            "output": "level",
            "steps": [(50.0, 56.0), (56.0, 46.0)],
            "band_degC": 0.5,
            "noise_degC": 0.08,
            "overshoot_degC": 0.5,
            "sensor_offset_degC": 0.0,
            "settle_within_s": 400.0,
        },
        (56.0, 46.0),
        500.0,
        0.5,
        60.0,
        (("feed", "level"),),
    ),
    Case(
        "exchanger",
        "hot water through a valve, 15 s of pipe",
        (Signal("valve", "V", 0.0, 10.0),),
        _sensors(0.06, "t_out"),
        exchanger,
        2.0,
        3600.0,
        (60.0, 300.0),
        ((1.0, 8.0),),
        (3.0,),
        {
            "output": "t_out",
            "steps": [(30.0, 36.0), (36.0, 31.0)],
            "settle_within_s": 300.0,
            "drive_limits": {"valve": (0.0, 10.0)},
        },
        (36.0, 31.0),
        600.0,
        0.25,
        40.0,
        (("valve", "t_out"),),
    ),
    Case(
        "iron",
        "a soldering iron",
        _heat("heater"),
        _sensors(0.4, "t_tip"),
        iron,
        0.1,
        400.0,
        (5.0, 40.0),
        ((0.0, 80.0),),
        (0.0,),
        {
            "output": "t_tip",
            "steps": [(250.0, 320.0), (320.0, 350.0)],
            "band_degC": 2.0,
            "overshoot_degC": 2.0,
            "bias_degC": 0.4,
            "noise_degC": 0.4,
            "settle_within_s": 30.0,
            "hold_s": 80.0,
        },
        (320.0, 350.0),
        80.0,
        2.0,
        350.0,
        (("heater", "t_tip"),),
    ),
    Case(
        "vessel",
        "a pressure between valve and choke",
        _heat("valve"),
        _sensors(0.006, "p", unit="bar"),
        vessel,
        0.5,
        900.0,
        (10.0, 60.0),
        ((8.0, 40.0),),
        (20.0,),
        {
            "output": "p",
            "steps": [(2.0, 3.0), (3.0, 1.5)],
            "band_degC": 0.03,
            "noise_degC": 0.006,
            "overshoot_degC": 0.03,
            "bias_degC": 0.01,
            "sensor_offset_degC": 0.0,
            "settle_within_s": 60.0,
            "hold_s": 120.0,
        },
        (3.0, 1.5),
        120.0,
        0.03,
        6.0,
        (("valve", "p"),),
    ),
    Case(
        "fingers",
        "two Peltier fingers on one heatsink",
        (Signal("u1", "1", -1.0, 1.0), Signal("u2", "1", -1.0, 1.0)),
        _sensors(0.04, "t1", "t2"),
        fingers,
        0.5,
        1500.0,
        (20.0, 120.0),
        ((-0.5, 0.7), (-0.5, 0.7)),
        (0.0, 0.0),
        {
            "output": ["t1", "t2"],
            "steps": [(23.0, 34.0), (34.0, 28.0)],
            "settle_within_s": 200.0,
            "ambient_degC": 23.0,
        },
        (34.0, 28.0),
        300.0,
        0.25,
        40.0,
        (("u1", "t1"), ("u2", "t2")),
    ),
    Case(
        "bath",
        "ten litres of water, heated only",
        _heat("heater"),
        _sensors(0.03, "t_bath"),
        bath,
        10.0,
        6 * 3600.0,
        (600.0, 3000.0),
        ((0.0, 80.0),),
        (0.0,),
        {
            "output": "t_bath",
            "steps": [(37.0, 41.0), (41.0, 43.0)],
            "settle_within_s": 2500.0,
            "hold_s": 4000.0,
            "ambient_degC": 21.0,
            "noise_degC": 0.03,
        },
        (41.0, 43.0),
        4000.0,
        0.25,
        30.0,
        (("heater", "t_bath"),),
    ),
)
