"""Grasps by finite volumes: a truth that shares no code and no closed form with the inference.

Gripper and block are rows of cells in metres, with the library's k, rho and c_p; conduction between them by
implicit Euler steps of 20 ms, all grasps of a batch in one tridiagonal solve.  What the inference does not
have is in here: the block loses heat through its sides and its far face to the room, during the touch and
between touches; its temperature is uneven when it is touched again; contact builds up by a stretched
exponential and creeps with the root of time; the sensor is a cell behind the sheet with a lag; water is
behind the pipe. Readings are noisy, drift slowly and are rounded to 1/16 degC.

    python benchmarks/classify/finite_volumes.py          # checks itself against the closed form
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.schema import Grasps, make_grasps
from thermogrip.sysid.contact.materials import find_material

Array = NDArray[np.float64]

DT = 0.02  # s
LENGTH = 0.02  # m, of a block
N_BLOCK = 60
CONDITIONS = ((43.0, 23.0), (28.0, 48.0), (18.0, 38.0), (28.0, 38.0))
SETTINGS = (20.0, 25.0, 40.0, 45.0)  # of the gripper in two touches
EIGHT = ("acrylic", "aluminium", "brass", "copper", "iron", "stainless", "wood", "zinc")


@dataclass(frozen=True)
class Rig:
    """What the truth is made of: spreads from grasp to grasp, the gripper's layers, losses."""

    layers: tuple[tuple[float, float, float, int], ...] = (  # thickness [m], k [W/mK], rho c [J/m3K], cells
        (2.0e-4, 5.0, 1.6e6, 8),  # graphite sheet; the sensor is behind it
        (1.5e-3, 1.4, 2.3e6, 20),  # filled silicone
        (6.0e-3, 0.6, 4.2e6, 16),  # standing water
    )
    lag: float = 0.12
    beside: float = 0.0  # share of the reading that a slow mass beside the sensor has
    tilt: float = 0.0  # K by which the skin is behind its water at contact, on its way to it
    h_c: dict[str, float] = field(default_factory=lambda: {"acrylic": 700.0, "wood": 600.0})
    h_c_else: float = 1400.0
    h_c_sd: float = 0.09
    build: float = 0.6
    far: float = 15.0  # W m^-2 K^-1, far face, and the near one between touches
    sides: float = 10.0  # W m^-2 K^-1, four sides of 20 mm
    room: tuple[float, float] = (22.0, 29.0)  # degC
    h_scale: dict[str, float] = field(default_factory=dict)  # factor on h_c of a material's block
    grade: dict[str, float] = field(default_factory=dict)  # factor on its k
    t_object_sd: float = 0.35
    natural_sd: float = 0.05  # of ln k of wood
    scatter: float = 0.0  # and of all others
    onset_sd: float = 0.08
    noise: float = 0.04
    slow: float = 0.018
    quantum: float = 1 / 16


class Batch(NamedTuple):
    """Cells of n blocks: conductance between neighbours, capacity, loss to the room, all per face area, and
    the resistance from the near face to the middle of the first cell."""

    link: Array
    capacity: Array
    loss: Array
    near: Array  # (n,)


@dataclass(frozen=True)
class Disturbed:
    """What n grasps have that those of a training have not, (n,) each."""

    length: Array  # [m], of the block
    cover: Array  # [m], of a film or paint of 0.2 W/mK on its near face; 0 for none
    onset: Array  # [s], when the contact is disturbed
    off: Array  # [s], for how long
    during: Array  # factor on the contact conductance meanwhile
    after: Array  # and from then on

    @classmethod
    def not_at_all(cls, n: int) -> Disturbed:
        """Return n grasps like those of a training."""
        one = np.ones(n)
        return cls(LENGTH * one, 0 * one, np.inf * one, 0 * one, one, one)

    def factor(self, t: float) -> Array:
        """Return the factors on the contact conductance at a time [s] since contact."""
        during = (t >= self.onset) & (t < self.onset + self.off)
        return np.where(during, self.during, np.where(t >= self.onset, self.after, 1.0))


def labelled(
    materials: tuple[str, ...] = EIGHT,
    *,
    repeats: int = 5,
    seed: int = 0,
    rig: Rig | None = None,
    conditions: tuple[tuple[float, float], ...] = CONDITIONS,
    seconds: float = 10.0,
    disturb: Callable[[int, np.random.Generator], Disturbed] | None = None,
) -> list[Grasps]:
    """Return one record a condition: nominal object temperatures, ``repeats`` of each material; ``disturb``
    draws what is unlike a training."""
    rig = rig or Rig()
    out = []
    for k, (t_object, t_gripper) in enumerate(conditions):
        rng = np.random.default_rng([seed, k])
        names = [m for m in materials for _ in range(repeats)]
        n = len(names)
        true = t_object + rig.t_object_sd * rng.standard_normal(n)
        room = rng.uniform(*rig.room, n)
        unlike = Disturbed.not_at_all(n) if disturb is None else disturb(n, rng)
        blocks = _blocks(names, rig, rng, unlike)
        state = np.repeat(true[:, None], N_BLOCK, axis=1)
        time, y, _ = _touch(blocks, state, names, np.full(n, t_gripper), room, rig, rng, seconds, unlike)
        ids = [f"c{k}-{seed}-{i}" for i in range(n)]
        out.append(
            make_grasps(
                time, y, ids, name=f"finite-{k}", material=names, t_object=np.full(n, t_object),
                t_gripper=np.full(n, t_gripper), t_ambient=room,
            )
        )  # fmt: skip
    return out


def _blocks(names: list[str], rig: Rig, rng: np.random.Generator, unlike: Disturbed | None = None) -> Batch:
    rows = [find_material(name) for name in names]
    natural = np.where([name == "wood" for name in names], rig.natural_sd, rig.scatter)
    k = np.array([row.k * rig.grade.get(name, 1.0) for row, name in zip(rows, names)])
    k = k * np.exp(natural * rng.standard_normal(len(rows)))
    unlike = Disturbed.not_at_all(len(names)) if unlike is None else unlike
    capacity = np.array([row.rho * row.c_p for row in rows])
    n_cover = np.where(unlike.cover > 0, 3, 0)[:, None]
    covered = np.arange(N_BLOCK) < n_cover
    dx = np.where(covered, unlike.cover[:, None] / 3, unlike.length[:, None] / (N_BLOCK - n_cover))
    half = dx / (2 * np.where(covered, 0.2, k[:, None]))
    loss = rig.sides * 4 * dx / LENGTH
    loss[:, -1] += rig.far
    whole = dx * np.where(covered, 1.5e6, capacity[:, None])
    return Batch(1 / (half[:, :-1] + half[:, 1:]), whole, loss, half[:, 0])


def _gripper(rig: Rig) -> tuple[Array, Array, int]:
    """Return links and capacities from the face inwards, and the sensor's cell."""
    dx = np.concatenate([np.full(n, d / n) for d, _, _, n in rig.layers])
    k = np.concatenate([np.full(n, k) for _, k, _, n in rig.layers])
    c = np.concatenate([np.full(n, c) for _, _, c, n in rig.layers])
    half = dx / (2 * k)
    return 1 / (half[:-1] + half[1:]), c * dx, rig.layers[0][3]


def _touch(
    blocks: Batch,
    state: Array,
    names: list[str],
    setting: Array,
    room: Array,
    rig: Rig,
    rng: np.random.Generator,
    seconds: float = 10.0,
    unlike: Disturbed | None = None,
) -> tuple[Array, Array, Array]:
    """Return sample times, readings (n, n_time) and the blocks' cells when the gripper lets go."""
    n = len(names)
    h = np.array([rig.h_c.get(m, rig.h_c_else) * rig.h_scale.get(m, 1.0) for m in names])
    h = h * np.exp(rig.h_c_sd * rng.standard_normal(n))
    tau = rig.build * np.exp(0.05 * rng.standard_normal(n))
    level = setting + 0.35 * rng.standard_normal(n)
    link, capacity, sensor = _gripper(rig)
    n_g = capacity.size
    dx0 = rig.layers[0][0] / rig.layers[0][3]
    resistance = dx0 / (2 * rig.layers[0][1]) + blocks.near
    unlike = Disturbed.not_at_all(n) if unlike is None else unlike
    # gripper reversed, so that its face is next to the block's
    skin = level[:, None] - rig.tilt * np.linspace(0.0, 1.0, n_g)
    cells = np.concatenate([skin, state], axis=1)
    caps = np.concatenate([np.repeat(capacity[None, ::-1], n, axis=0), blocks.capacity], axis=1)
    links = np.concatenate([np.repeat(link[None, ::-1], n, axis=0), np.zeros((n, 1)), blocks.link], axis=1)
    loss = np.concatenate([np.zeros((n, n_g)), blocks.loss], axis=1)
    steps = round((seconds + 0.5) / DT)
    lagged = np.empty((n, steps + 1))
    at = n_g - 1 - sensor
    lagged[:, 0] = skin[:, at]
    slow = lagged[:, 0]
    keep, keep_slow = np.exp(-DT / rig.lag), np.exp(-DT / 2.0)
    for i in range(steps):
        t = (i + 0.5) * DT
        grown = h * (1 - 0.97 * np.exp(-((t / tau) ** 0.85))) * (1 + 0.1 * np.sqrt(t / 10))
        grown = grown * unlike.factor(t)
        links[:, n_g - 1] = 1 / (1 / grown + resistance)
        cells = _implicit(cells, caps, links, loss, room)
        slow = keep_slow * slow + (1 - keep_slow) * cells[:, at]
        seen = cells[:, at] + rig.beside * (slow - cells[:, at])
        lagged[:, i + 1] = keep * lagged[:, i] + (1 - keep) * seen
    time = np.round(np.arange(-20, round(10 * seconds) + 1) / 10, 1)
    onset = rig.onset_sd * rng.standard_normal(n)
    clock = np.arange(steps + 1) * DT
    y = np.stack([np.interp(time - t0, clock, row) for t0, row in zip(onset, lagged)])
    drift = np.zeros_like(y)
    drift[:, 0] = rng.standard_normal(n)
    for i in range(1, time.size):
        drift[:, i] = np.exp(-0.1 / 4) * drift[:, i - 1] + np.sqrt(
            1 - np.exp(-0.2 / 4)
        ) * rng.standard_normal(n)
    y = y + rig.slow * drift + rig.noise * rng.standard_normal(y.shape)
    return time, np.round(y / rig.quantum) * rig.quantum, cells[:, n_g:]


def _implicit(cells: Array, capacity: Array, link: Array, loss: Array, room: Array, dt: float = DT) -> Array:
    """Return the cells one implicit Euler step later: Thomas's algorithm over a whole batch."""
    a = capacity / dt
    diagonal = a + loss
    diagonal[:, :-1] += link
    diagonal[:, 1:] += link
    right = a * cells + loss * room[:, None]
    k = cells.shape[1]
    for i in range(1, k):
        w = link[:, i - 1] / diagonal[:, i - 1]
        diagonal[:, i] -= w * link[:, i - 1]
        right[:, i] += w * right[:, i - 1]
    out = np.empty_like(cells)
    out[:, -1] = right[:, -1] / diagonal[:, -1]
    for i in range(k - 2, -1, -1):
        out[:, i] = (right[:, i] + link[:, i] * out[:, i + 1]) / diagonal[:, i]
    return out
