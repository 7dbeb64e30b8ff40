"""What a grasp does to the skin's sensor: a step response, and the circumstances that no two grasps share.

A grasp is one step response F(t) of :mod:`thermogrip.sysid.contact.response` (layered gripper, finite block,
contact that builds up and creeps), scaled by the difference between object and skin:

    T(t) = T_dev(t) + (T_obj - T_dev(t0)) F(t - t0) + (T_room - T_obj) G(t - t0),

G being what the room does by the block's far face.

From grasp to grasp five things differ and limit what one touch can identify: the contact conductance and
its build-up time (log-normal factors), the moment of contact about the "closed" message, the object's true
temperature about the nominal one, and for natural materials the effusivity itself.  :class:`Grip` holds these
spreads and draws from them.  On its way to the contact the object relaxes by a small share of the way to the
room's temperature.  The twin of the rig plays single touches; :func:`simulate_grasps` makes records of them,
which show the accuracy that the spreads allow at all, and train classifiers.  How a calibrated
gripper is simulated is in :meth:`thermogrip.sysid.effusivity.gripper_model.GripperModel.grip`; its misfit is
left out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermogrip.datasets.materials import find_material
from thermogrip.datasets.schema import Grasps, make_grasps
from thermogrip.sysid.contact.response import Stack, far_response, step_response, time_nodes

Array = NDArray[np.float64]

#: A foam finger with a graphite sheet on a copper-filled silicone pipe, of the size of the example rig's.
SOFT_FINGER = Stack(
    e_outer=2000.0, z_outer=0.1, e_inner=3800.0, z_inner=8.0, g_back=0.0, lag=0.1, first=0.01, build_up=0.78,
    creep=0.3,
)  # fmt: skip
PUMP_OFF = -1.0  # s: the pump stops about a second before contact


class Blocks(NamedTuple):
    """Of n grasps: effusivity [W s^0.5 m^-2 K^-1], settled h_c [W m^-2 K^-1], C = rho c_p L [J m^-2 K^-1]."""

    effusivity: ArrayLike
    h_c: ArrayLike
    capacity: ArrayLike


@dataclass(frozen=True, eq=False)
class Touch:
    """One grasp."""

    t_object: float  # true [degC]
    onset: float  # of contact [s after the "closed" message]
    h_c: float
    times: Array  # (n,), since contact [s]
    rise: Array  # (n,), F at these times
    room: Array | None = None  # (n,), what the room does by the block's far face [K], nothing by default

    def response(self, t: ArrayLike) -> Array:
        """Return F at times since the "closed" message [s], same shape; 0 before contact."""
        return np.asarray(np.interp(np.asarray(t, dtype=float) - self.onset, self.times, self.rise))

    def by_room(self, t: ArrayLike) -> Array:
        """Return what the room does by the block's far face [K], as :meth:`response` does."""
        since = np.asarray(t, dtype=float) - self.onset
        room = np.zeros(self.times.shape) if self.room is None else self.room
        return np.asarray(np.interp(since, self.times, room))


class ContactModel(Protocol):
    """Whatever can draw a grasp."""

    def draw(self, material: str, t_object: float, rng: np.random.Generator, *, ambient: float) -> Touch:
        """Return one grasp of this material at this nominal temperature [degC]."""
        ...


@dataclass(frozen=True, kw_only=True)
class Grip:
    """A gripper and the spreads of its grasps.

    Attributes
    ----------
    stack : Stack
        The finger, from skin to water.
    h_c : float
        Settled contact conductance of a block that ``h_c_of`` does not name [W m^-2 K^-1].
    h_c_of : mapping of str to float
        By material [W m^-2 K^-1].
    h_c_sd_ln, build_up_sd_ln : float
        Spreads from grasp to grasp of conductance and build-up time, standard deviations of ln [1].
    onset, onset_sd : float
        Moment of contact after the "closed" message, mean and standard deviation [s].
    bias, t_object_sd : float
        True less nominal temperature of the object, mean and standard deviation [K].
    transit_loss : float
        Fraction of the way to the room that an object goes before contact.
    effusivity_of : mapping of str to float
        By material, on the gripper's scale [W s^0.5 m^-2 K^-1]; else the library's.
    effusivity_sd_ln : mapping of str to float
        By material, standard deviation of ln [1].
    length : float
        Of the block [m].
    until : float
        A touch is computed for so long [s].

    Examples
    --------
    >>> touch = Grip().draw("copper", 43.0, np.random.default_rng(0), ambient=28.0)
    >>> bool(abs(touch.t_object - 43) < 2), touch.response([-2.0]).tolist()
    (True, [0.0])
    """

    stack: Stack = SOFT_FINGER
    h_c: float = 1600.0
    h_c_of: Mapping[str, float] = field(default_factory=lambda: {"wood": 910.0})
    h_c_sd_ln: float = 0.09
    build_up_sd_ln: float = 0.03
    onset: float = 0.02
    onset_sd: float = 0.09
    bias: float = 0.0
    t_object_sd: float = 0.40
    transit_loss: float = 0.02
    effusivity_of: Mapping[str, float] = field(default_factory=dict)
    effusivity_sd_ln: Mapping[str, float] = field(default_factory=lambda: {"wood": 0.08})
    length: float = 0.02
    until: float = 60.0

    def draw(self, material: str, t_object: float, rng: np.random.Generator, *, ambient: float) -> Touch:
        """Return one grasp of this material at this nominal temperature [degC]."""
        return self.draw_many([material], t_object, rng, ambient=ambient)[0]

    def draw_many(
        self, materials: Sequence[str], t_object: float, rng: np.random.Generator, *, ambient: float,
        blocks: Blocks | None = None,
    ) -> list[Touch]:  # fmt: skip
        """Return one grasp per entry of ``materials``, or of ``blocks``, whose numbers have no spread."""
        normal = rng.standard_normal((5, len(materials)))
        if blocks is None:
            rows = [find_material(name) for name in materials]
            h_c = np.array([self.h_c_of.get(row.name, self.h_c) for row in rows])
            h_c = h_c * np.exp(self.h_c_sd_ln * normal[0])
            e = np.array([self.effusivity_of.get(row.name, row.effusivity) for row in rows])
            e = e * np.exp(np.array([self.effusivity_sd_ln.get(row.name, 0.0) for row in rows]) * normal[3])
            capacity = np.array([row.rho * row.c_p * self.length for row in rows])
        else:
            e, h_c, capacity = (np.asarray(part, dtype=float) for part in blocks)
        onset = self.onset + self.onset_sd * normal[1]
        away = t_object + self.bias + self.t_object_sd * normal[2]
        true = away + self.transit_loss * (ambient - away)
        nodes = time_nodes(self.until)
        build_up = self.stack.build_up * np.exp(self.build_up_sd_ln * normal[4])
        rise, _, _ = step_response(
            self.stack, nodes, effusivity=e, capacity=capacity, h_c=h_c, build_up=build_up
        )
        room = far_response(self.stack, nodes, rise, effusivity=e, capacity=capacity)
        room *= (ambient - true)[:, None]
        return [
            Touch(float(true[i]), float(onset[i]), float(h_c[i]), nodes.t, np.asarray(rise[i]), room[i])
            for i in range(len(materials))
        ]


def simulate_grasps(
    grip: Grip, materials: Sequence[str], *, t_object: float, t_gripper: float, n: int = 1, seed: int = 0,
    ambient: float = 28.0, blocks: Blocks | None = None, split: Callable[[int], str] | None = None,
    name: str = "simulated", **readings: float,
) -> Grasps:  # fmt: skip
    """Return ``n`` simulated grasps of each material at one condition, from 2 s before the "closed" message.

    Parameters
    ----------
    grip : Grip
        Gripper and spreads.
    materials : sequence of str
        What is grasped.
    t_object, t_gripper, ambient : float
        Nominal temperatures of object and skin, and the room's [degC].
    n : int, optional
        Grasps per material.
    seed : int, optional
        Of everything that is drawn.
    blocks : Blocks, optional
        Of each grasp in place of the materials' own, which are labels then.
    split : callable, optional
        Label of the k-th repeat, e.g. ``lambda k: "train" if k < 5 else "test"``.
    name : str, optional
        The condition.
    **readings
        Length, sample time and noise as in :func:`record_touches`.

    Returns
    -------
    grasps : Grasps
        Ids ``s0000`` on, material by material.

    Examples
    --------
    >>> g = simulate_grasps(Grip(), ["copper", "wood"], t_object=43.0, t_gripper=23.0, n=3)
    >>> at_10_s = g["t_surface"].values[:, -1]
    >>> g.sizes["grasp"], bool(at_10_s[:3].min() > 33), bool(at_10_s[3:].max() < 27)
    (6, True, True)
    """
    rng = np.random.default_rng(seed)
    each = [material for material in materials for _ in range(n)]
    touches = grip.draw_many(each, t_object, rng, ambient=ambient, blocks=blocks)
    time, reading = record_touches(touches, rng, t_gripper=t_gripper, ambient=ambient, **readings)
    return make_grasps(
        time, reading, [f"s{i:04d}" for i in range(len(each))], name=name, material=each,
        t_object=np.full(len(each), t_object), t_gripper=np.full(len(each), t_gripper),
        t_ambient=np.full(len(each), ambient),
        split=["" if split is None else split(i % n) for i in range(len(each))],
    )  # fmt: skip


def record_touches(
    touches: Sequence[Touch], rng: np.random.Generator, *, t_gripper: float, ambient: float = 28.0,
    until: float = 10.0, dt: float = 0.1, regulation_sd: float = 0.35, noise: float = 0.04,
    slow_noise: float = 0.018, correlation_time: float = 4.0, leak: float = 0.0, quantum: float = 1 / 16,
) -> tuple[Array, Array]:  # fmt: skip
    """Return times (n_time,) from -2 s to ``until`` [s] by ``dt``, and readings (n, n_time) [degC].

    The skin starts within ``regulation_sd`` [K] of its set point and drifts to the room at ``leak`` [1/s]
    once the pump is off; ``noise`` [K] is white, ``slow_noise`` [K] of ``correlation_time`` [s], ``quantum``
    [K] the sensor's step, 0 for none.
    """
    time = np.round(np.arange(round(-2.0 / dt), round(until / dt) + 1) * dt, 9)
    level = t_gripper + regulation_sd * rng.standard_normal(len(touches))
    rise = np.stack([touch.response(time) for touch in touches])
    true = level[:, None] + (np.array([touch.t_object for touch in touches]) - level)[:, None] * rise
    true += np.stack([touch.by_room(time) for touch in touches])
    if leak:
        true += leak * (ambient - level)[:, None] * np.maximum(time - PUMP_OFF, 0.0)
    keep = np.exp(-dt / correlation_time)
    slow = slow_noise * rng.standard_normal(true.shape)
    slow[:, 1:] *= np.sqrt(1 - keep**2)
    for k in range(1, time.size):
        slow[:, k] += keep * slow[:, k - 1]
    reading = true + slow + noise * rng.standard_normal(true.shape)
    return time, np.asarray(np.round(reading / quantum) * quantum if quantum > 0 else reading)
