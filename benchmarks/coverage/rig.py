"""A simulated rig for the coverage study: the fitted network's physics, and terms that the network lacks.

It shares no code with the fit: equations of its own, Heun steps of 0.5 s.  What the fitted network knows is
drawn from that network's own prior.  Beyond it, by family:

===========  =========================================================================================
``none``     nothing: the model is right
``wall``     a metal wall between module and water, resistance that rises with its temperature
``drive``    dead zone of the driver, heatsink whose convection grows with its excess temperature, ambient
             sensor with a lag
``mixed``    each of these terms with probability one half
===========  =========================================================================================

Every family has what logs always have: sensors' offsets and the ambient's bias of each log, flow and drive
gain that vary from log to log, slow (AR(1)) and white noise, quantisation.  Amplitudes are drawn anew for
each replication.  Capacities are conserved (wall plus water is the tank of the fitted model), so that the
value of the generator is what a perfect fit would find.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.schema import Log, make_log
from thermogrip.sysid.models.network import NetworkModel

__all__ = ["FAMILIES", "Rig", "draw_rig", "make_logs"]

Array = NDArray[np.float64]

FAMILIES = ("none", "wall", "drive", "mixed")
WALL = ("wall", "warm_resistance")
DRIVE = ("dead_zone", "convection", "ambient_lag")
DT = 0.5  # [s] of the simulation
READ = 2.0  # [s] between rows
QUANTUM = 0.0625  # [degC] of both thermocouples
TANK = 900.0  # [J/K] of water and wall
G_WALL = 40.0  # [W/K] wall to water
EXCESS = 15.0  # [K] of the heatsink at which G_sink is defined


@dataclass(frozen=True)
class Rig:
    """One rig: the parameters that are looked for, and the terms beyond the fitted model.

    Parameters
    ----------
    truth : dict of str to float
        By name of the fitted network's free parameters.
    terms : dict of str to float
        Amplitude of each missing term; 0 where this rig has it not.
    """

    truth: dict[str, float]
    terms: dict[str, float]


def draw_rig(model: NetworkModel, family: str, rng: np.random.Generator) -> Rig:
    """Draw the parameters from the network's prior and the amplitudes of the family's terms."""
    truth = {}
    for name, spec in model.specs.items():
        if spec.fixed:
            continue
        low, high = spec.bounds
        sd = spec.sd if spec.sd_log is None else spec.sd_log
        assert sd is not None
        z = float(np.clip(rng.standard_normal(), -2.5, 2.5))  # bounds are at 5 sd
        value = spec.value + sd * z if spec.sd_log is None else spec.value * float(np.exp(sd * z))
        truth[name] = float(np.clip(value, low, high))
    strength = {
        "wall": rng.uniform(0.03, 0.12),  # share of the tank's capacity
        "warm_resistance": rng.uniform(0.002, 0.006),  # per K of the module
        "dead_zone": rng.uniform(0.003, 0.015),  # of full drive
        "convection": rng.uniform(0.1, 0.3),  # exponent of the excess temperature
        "ambient_lag": rng.uniform(30.0, 200.0),  # [s]
    }
    chosen = {
        "none": dict.fromkeys(strength, False),
        "wall": {name: name in WALL for name in strength},
        "drive": {name: name in DRIVE for name in strength},
        "mixed": {name: bool(rng.random() < 0.5) for name in strength},
    }[family]
    return Rig(truth, {name: float(value) if chosen[name] else 0.0 for name, value in strength.items()})


def make_logs(rig: Rig, rng: np.random.Generator, *, n_logs: int = 4) -> list[Log]:
    """Simulate logs of 20 to 40 minutes, each with its own excitation, room and sensors."""
    lengths = rng.uniform(1200.0, 2400.0, n_logs)
    n = int(np.ceil(lengths.max() / DT))
    t = DT * np.arange(n + 1)
    drive = np.stack([_excitation(t, k % 3, rng) for k in range(n_logs)], axis=1)
    room = np.stack([_room(t, rng) for _ in range(n_logs)], axis=1)
    gain = np.exp(0.01 * rng.standard_normal(n_logs))  # supply voltage
    flow = np.exp(0.03 * rng.standard_normal(n_logs))  # pump
    tank, finger = _simulate(rig, drive, room, gain, flow)
    seen_room = room if not rig.terms["ambient_lag"] else _lagged(room, rig.terms["ambient_lag"])
    rows = int(READ / DT)
    logs = []
    for k in range(n_logs):
        m = int(lengths[k] / DT) // rows * rows
        at = slice(0, m + 1, rows)
        air = np.round(seen_room[at, k] + 0.15 * rng.standard_normal(), 1)
        channels = {
            "drive": (drive[at, k], "1", "input"),
            "t_ambient": (air, "degC", "disturbance"),
            "t_tank": (_read(tank[at, k], 0.05, rng), "degC", "output"),
            "t_surface": (_read(finger[at, k], 0.10, rng), "degC", "output"),
        }
        logs.append(make_log(t[at], channels, name=f"log{k + 1}"))
    return logs


def _excitation(t: Array, kind: int, rng: np.random.Generator) -> Array:
    """Return random dwell, steps or a multisine, at rest for the first 10 s."""
    if kind == 0:
        u = _held(t, rng, (20.0, 150.0), lambda: 0.5 * rng.choice([-1.0, 1.0]) * rng.uniform(0.3, 1.0))
    elif kind == 1:
        u = _held(t, rng, (150.0, 450.0), lambda: rng.uniform(-0.45, 0.55))
    else:
        periods = rng.uniform(40.0, 900.0, 8)
        waves = np.sin(2 * np.pi * t[:, None] / periods + rng.uniform(0, 2 * np.pi, 8))
        u = waves @ rng.uniform(0.05, 0.2, 8)
    return np.where(t < 10.0, 0.0, np.clip(u, -0.7, 0.7))


def _held(t: Array, rng: np.random.Generator, dwell: tuple[float, float], level: object) -> Array:
    u, at = np.zeros(t.size), 10.0
    while at < t[-1]:
        until = at + rng.uniform(*dwell)
        u[(t >= at) & (t < until)] = level()  # type: ignore[operator]
        at = until
    return u


def _room(t: Array, rng: np.random.Generator) -> Array:
    """Return a room that drifts by some tenths over a quarter of an hour."""
    phase = rng.uniform(0, 2 * np.pi, 2)
    drift = 0.4 * np.sin(2 * np.pi * t / rng.uniform(700, 2500) + phase[0])
    drift += 0.15 * np.sin(2 * np.pi * t / rng.uniform(200, 600) + phase[1])
    return np.asarray(rng.uniform(19.0, 26.0) + drift - drift[0])


def _lagged(x: Array, tau: float) -> Array:
    out, keep = x.copy(), np.exp(-DT / tau)
    for k in range(1, len(x)):
        out[k] = keep * out[k - 1] + (1 - keep) * x[k]
    return out


def _read(true: Array, offset_sd: float, rng: np.random.Generator) -> Array:
    """Return readings: offset, slow noise of 20 s, white noise, quantum."""
    keep, n = np.exp(-READ / 20.0), true.size
    slow = np.empty(n)
    slow[0] = 0.03 * rng.standard_normal()
    kick = 0.03 * np.sqrt(1 - keep**2) * rng.standard_normal(n)
    for k in range(1, n):
        slow[k] = keep * slow[k - 1] + kick[k]
    noisy = true + offset_sd * rng.standard_normal() + slow + 0.03 * rng.standard_normal(n)
    return np.asarray(QUANTUM * np.round(noisy / QUANTUM))


def _simulate(rig: Rig, drive: Array, room: Array, gain: Array, flow: Array) -> tuple[Array, Array]:
    """Return temperatures of tank and finger (n, n_logs)."""
    n, n_logs = drive.shape
    x = np.repeat(room[0][None], 4, axis=0)  # wall, tank, sink, finger
    tank, finger = np.empty((n, n_logs)), np.empty((n, n_logs))
    for k in range(n):
        tank[k], finger[k] = x[1], x[3]
        slope = _slopes(x, drive[k], room[k], gain, flow, rig)
        x = x + DT / 2 * (slope + _slopes(x + DT * slope, drive[k], room[k], gain, flow, rig))
    return tank, finger


def _slopes(x: Array, u: Array, room: Array, gain: Array, flow: Array, rig: Rig) -> Array:
    """Return dx/dt of wall, tank, sink, finger [K/s]."""
    p, terms = rig.truth, rig.terms
    wall, tank, sink, finger = x
    c_wall = TANK * terms["wall"]
    face = wall if c_wall else tank
    v = np.sign(u) * np.maximum(np.abs(u) - terms["dead_zone"], 0.0) + p["drive_offset"]
    i = 4.0 * gain * np.where(v > 0, v, p["cooling_gain"] * v)
    r = p["resistance"] * (1 + terms["warm_resistance"] * ((face + sink) / 2 - 25.0))
    joule, conducted = r * i**2 / 2, p["K_module"] * (sink - face)
    into_face = p["seebeck"] * i * (face + 273.15) + joule + conducted
    into_sink = -p["seebeck"] * i * (sink + 273.15) + joule - conducted
    excess = np.maximum(np.abs(sink - room), 0.5) / EXCESS
    into_sink = into_sink - p["G_sink"] * excess ** terms["convection"] * (sink - room)
    through = G_WALL * (wall - tank) if c_wall else into_face
    looped = p["G_loop"] * flow * (tank - finger)
    return np.stack(
        [
            (into_face - through) / c_wall if c_wall else np.zeros_like(u),
            (through - looped - p["G_tank"] * (tank - room)) / (TANK - c_wall),
            into_sink / p["C_sink"],
            (looped - 0.05 * (finger - room)) / p["C_finger"],
        ]
    )
