"""What a grasp does to the skin's sensor: a step response, and the circumstances that no two grasps share.

A grasp is one step response F(t) of :mod:`thermogrip.sysid.contact.response` (layered gripper, finite block,
contact that builds up and creeps), scaled by the difference between object and skin:

    T(t) = T_dev(t) + (T_obj - T_dev(t0)) F(t - t0) + (T_room - T_obj) G(t - t0),

G being what the room does by the block's far face.

From grasp to grasp four things differ, and they limit what one touch can tell: the contact conductance (a
factor, log-normal), the moment of contact about the "closed" message, the object's true temperature about the
warmer's setting, and for natural materials the effusivity itself.  :class:`Grip` holds these spreads and
draws from them. While the object is carried it relaxes by a small share of the way to the room's temperature.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermogrip.datasets.materials import find_material, load_materials
from thermogrip.datasets.schema import Grasps, make_grasps
from thermogrip.sysid.contact.response import Stack, far_response, step_response, time_nodes
from thermogrip.sysid.effusivity.gripper_model import INSULATOR, GripperModel, load_default_gripper

__all__ = ["ContactModel", "Grip", "Touch", "simulate_grasps"]

Array = NDArray[np.float64]

#: A foam finger with a graphite sheet on a copper-filled silicone pipe, of the size of the example rig's.
SOFT_FINGER = Stack(
    e_outer=2000.0,
    z_outer=0.1,
    e_inner=3800.0,
    z_inner=8.0,
    g_back=0.0,
    lag=0.1,
    first=0.01,
    build_up=0.78,
    creep=0.3,
)


@dataclass(frozen=True, eq=False)
class Touch:
    """One grasp: the object's true temperature [degC], when contact was made [s after the message], and F.

    Attributes
    ----------
    t_object, onset, h_c : float
        [degC], [s], [W m^-2 K^-1].
    times, rise : (n,) ndarray
        F on a grid of times since contact; F(0) = 0.
    room : (n,) ndarray, optional
        What the room does by the block's far face, on the same grid [K]; default nothing.
    """

    t_object: float
    onset: float
    h_c: float
    times: Array
    rise: Array
    room: Array | None = None

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
    """A gripper and the spreads of its grasps; :meth:`from_device` takes both from a calibration.

    Parameters
    ----------
    stack : Stack
        Layers, sensor and contact law.
    h_c : float
        Settled contact conductance [W m^-2 K^-1] of a block that ``h_c_of`` does not name.
    h_c_of : dict of str to float
        Conductance by material: the finish of the block.
    h_c_sd_ln, build_sd_ln : float
        Spread from grasp to grasp of the conductance and of its build-up time, standard deviations of ln.
    onset, onset_sd : float
        Mean and spread of the moment of contact after the "closed" message [s].
    bias, t_object_sd : float
        Mean and spread of the true less the nominal temperature of the object [K].
    transit_loss : float
        Share of the way to room temperature that an object goes while it is carried.
    effusivity_of : dict of str to float
        Effusivity as this gripper sees it [W s^0.5 m^-2 K^-1]; the library's for a material not named.
    effusivity_sd_ln : dict of str to float
        Spread of ln e from grasp to grasp, by material.
    length : float
        Thickness of the block [m].
    until : float
        How long a touch is worked out for [s].

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
    build_sd_ln: float = 0.03
    onset: float = 0.02
    onset_sd: float = 0.09
    bias: float = 0.0
    t_object_sd: float = 0.40
    transit_loss: float = 0.02
    effusivity_of: Mapping[str, float] = field(default_factory=dict)
    effusivity_sd_ln: Mapping[str, float] = field(default_factory=lambda: {"wood": 0.08})
    length: float = 0.02
    until: float = 60.0

    @classmethod
    def from_device(cls, device: GripperModel | None = None) -> Grip:
        """Return the gripper and the populations of a calibration; default the example rig's.

        A material without a block in the calibration gets its library effusivity on the gripper's scale and
        the conductance that the calibration expects of an unknown finish.

        Examples
        --------
        >>> grip = Grip.from_device()
        >>> bool(grip.h_c_of["copper"] > grip.h_c_of["wood"]), grip.relaxes < 0.1
        (True, True)
        """
        device = load_default_gripper() if device is None else device
        h_c, e = ({name: b.ln_h for name, b in device.blocks.items()} for _ in range(2))
        for name, material in load_materials().items():
            found = np.log(np.array([material.effusivity]))
            block = device.blocks.get(name)
            e[name] = (
                float(found[0] + device.effusivity_scale(found)[0][0])
                if block is None
                else block.ln_effusivity
            )
            h_c[name] = float(device.expected_ln_h(np.array([e[name]]))[0]) if block is None else block.ln_h
        spreads = device.spreads
        return cls(
            stack=device.stack,
            h_c_of={name: float(np.exp(value)) for name, value in h_c.items()},
            h_c_sd_ln=spreads.ln_h,
            build_sd_ln=spreads.ln_build_up,
            onset=device.onset,
            onset_sd=spreads.onset,
            bias=device.bias,
            t_object_sd=spreads.t_object,
            transit_loss=device.transit_loss,
            effusivity_of={name: float(np.exp(value)) for name, value in e.items()},
            effusivity_sd_ln={
                n: spreads.ln_effusivity for n, value in e.items() if value < np.log(INSULATOR)
            },
            length=device.block_length * device.depth_share,
        )

    def draw(self, material: str, t_object: float, rng: np.random.Generator, *, ambient: float) -> Touch:
        """Return one grasp of this material at this nominal temperature [degC]."""
        return self.draw_many([material], t_object, rng, ambient=ambient)[0]

    def draw_many(
        self, materials: Sequence[str], t_object: float, rng: np.random.Generator, *, ambient: float
    ) -> list[Touch]:
        """Return one grasp per entry of ``materials``; all step responses are worked out in one pass."""
        rows = [find_material(name) for name in materials]
        normal = rng.standard_normal((5, len(rows)))
        h_c = np.array([self.h_c_of.get(row.name, self.h_c) for row in rows]) * np.exp(
            self.h_c_sd_ln * normal[0]
        )
        onset = self.onset + self.onset_sd * normal[1]
        carried = t_object + self.bias + self.t_object_sd * normal[2]
        true = carried + self.transit_loss * (ambient - carried)
        e = np.array([self.effusivity_of.get(row.name, row.effusivity) for row in rows])
        e = e * np.exp(np.array([self.effusivity_sd_ln.get(row.name, 0.0) for row in rows]) * normal[3])
        nodes = time_nodes(self.until)
        capacity = [row.rho * row.c_p * self.length for row in rows]
        rise, _, _ = step_response(
            self.stack,
            nodes,
            effusivity=e,
            capacity=capacity,
            h_c=h_c,
            build_up=self.stack.build_up * np.exp(self.build_sd_ln * normal[4]),
        )
        room = far_response(self.stack, nodes, rise, effusivity=e, capacity=capacity)
        room *= (ambient - true)[:, None]
        return [
            Touch(float(true[i]), float(onset[i]), float(h_c[i]), nodes.t, np.asarray(rise[i]), room[i])
            for i in range(len(rows))
        ]


def simulate_grasps(
    grip: Grip,
    materials: Sequence[str],
    *,
    t_object: float,
    t_gripper: float,
    n: int,
    seed: int = 0,
    ambient: float = 28.0,
    until: float = 10.0,
    dt: float = 0.1,
    regulation_sd: float = 0.35,
    noise: float = 0.04,
    slow_noise: float = 0.018,
    quantum: float = 1 / 16,
    split: Callable[[int], str] | None = None,
    name: str = "simulated",
) -> Grasps:
    """Return ``n`` simulated grasps of each material at one condition, from 2 s before the "closed" message.

    Parameters
    ----------
    grip : Grip
        Gripper and spreads.
    materials : sequence of str
        What is grasped.
    t_object, t_gripper : float
        Nominal temperatures of object and skin [degC].
    n : int
        Grasps per material.
    seed : int, optional
        Of everything that is drawn.
    ambient : float, optional
        Room temperature [degC].
    until, dt : float, optional
        Recorded time after the message and sample time [s].
    regulation_sd : float, optional
        Spread of the skin's temperature about its set point [K].
    noise, slow_noise, quantum : float, optional
        White and slow (memory 4 s) sensor noise, and the sensor's step [K].
    split : callable, optional
        Label of the k-th repeat, e.g. ``lambda k: "train" if k < 5 else "test"``.
    name : str, optional
        The condition.

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
    time = np.round(np.arange(round(-2.0 / dt), round(until / dt) + 1) * dt, 9)
    each = [material for material in materials for _ in range(n)]
    touches = grip.draw_many(each, t_object, rng, ambient=ambient)
    level = t_gripper + regulation_sd * rng.standard_normal(len(each))
    rise = np.stack([touch.response(time) for touch in touches])
    true = level[:, None] + (np.array([touch.t_object for touch in touches]) - level)[:, None] * rise
    true += np.stack([touch.by_room(time) for touch in touches])
    keep = np.exp(-dt / 4.0)
    slow = slow_noise * rng.standard_normal(true.shape)
    slow[:, 1:] *= np.sqrt(1 - keep**2)
    for k in range(1, time.size):
        slow[:, k] += keep * slow[:, k - 1]
    reading = true + slow + noise * rng.standard_normal(true.shape)
    if quantum > 0:
        reading = np.round(reading / quantum) * quantum
    return make_grasps(
        time,
        reading,
        [f"s{i:04d}" for i in range(len(each))],
        name=name,
        material=each,
        t_object=np.full(len(each), t_object),
        t_gripper=np.full(len(each), t_gripper),
        t_ambient=np.full(len(each), ambient),
        split=["" if split is None else split(i % n) for i in range(len(each))],
    )
