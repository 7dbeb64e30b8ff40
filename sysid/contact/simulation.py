"""What a grasp does to the skin's sensor: a step response, and the circumstances that no two grasps share.

**The sensor** of a layered gripper that closes on a finite block reads one step response F(t), scaled by the
difference between object and skin:

    T(t) = T_dev(t) + (T_obj - T_dev(t0)) F(t - t0) + (T_room - T_obj) G(t - t0),

G being what the room does by the block's far face (:func:`far_response`).  F depends on the block (effusivity
e, heat capacity per face C = rho c_p L), on the contact conductance and on the gripper only.  With h constant
and one layer this is the closed form of :mod:`thermogrip.sysid.contact.closed_forms`.

**From grasp to grasp** five things differ and limit what one touch can identify: the contact conductance and
its build-up time (log-normal factors), the moment of contact about the "closed" message, the object's true
temperature about the nominal one, and for natural materials the effusivity itself.  :class:`Grip` holds these
spreads and draws from them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.schema import make_grasps
from thermogrip.sysid.contact.materials import find_material

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Grasps


_N_OUTER, _N_INNER = 5, 26


@dataclass(frozen=True, kw_only=True)
class Stack:
    """The gripper and the way it makes contact."""

    # in z = x / sqrt(alpha) a layer is its effusivity alone: a cell holds e dz and conducts e / dz
    e_outer: float  # effusivity of the sheet over the sensor [W s^0.5 m^-2 K^-1]
    z_outer: float  # its thickness in diffusion time, x / sqrt(alpha) [s^0.5]
    e_inner: float  # of what lies behind the sensor
    z_inner: float
    g_back: float  # conductance from the back to the water [W m^-2 K^-1]
    lag: float  # time constant of the sensor [s]
    # soft skin that meets the block and then settles:
    # h(t) = h [f0 + (1 - f0) (1 - exp(-t / tau_b))] [1 + c (1 - exp(-t / tau_c))]
    first: float  # share of h at first touch
    build_up: float  # build-up time of the contact [s]
    creep: float  # relative growth of h while the skin settles
    leak: float = 0.0  # rate of the skin's drift to the room once the pump is off [1/s]
    # the pipe that the sensor is glued to holds water on one side and foam on the other
    g_side: float = 0.0  # conductance to a store beside the sensor, such as water in the pipe [W m^-2 K^-1]
    c_side: float = 1e4  # heat capacity of that store [J m^-2 K^-1]
    settle: float = 2.5  # time constant of the creep [s]
    g_far: float = 0.0  # conductance from the block's far face to the room [W m^-2 K^-1]

    def __post_init__(self) -> None:
        for name in ("e_outer", "z_outer", "e_inner", "z_inner", "lag", "build_up", "c_side", "settle"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name):g}")
        if not (0 <= self.first <= 1) or self.creep < -0.2 or min(self.g_back, self.g_side, self.g_far) < 0:
            raise ValueError(f"need 0 <= first <= 1, creep >= -0.2, conductances >= 0, got {self}")


class TimeNodes(NamedTuple):
    """Steps that double in groups: ``dt`` (n_group,), ``repeat`` (n_group,), ``t`` (n_node,) [s]."""

    dt: Array
    repeat: NDArray[np.int64]
    t: Array


def time_nodes(end: float, *, first: float = 0.01, per_group: int = 10) -> TimeNodes:
    """Return time nodes from 0 to just past ``end`` [s] whose step doubles every ``per_group`` steps."""
    n_group = max(1, int(np.ceil(np.log2(max(end, first) / (first * per_group) + 1))))
    dt = np.asarray(first * 2.0 ** np.arange(n_group), dtype=float)
    repeat = np.full(n_group, per_group, dtype=np.int64)
    before = first * per_group * (2.0 ** (n_group - 1) - 1)
    repeat[-1] = max(2, int(np.ceil((end - before) / dt[-1])))
    return TimeNodes(dt, repeat, np.concatenate([[0.0], np.cumsum(np.repeat(dt, repeat))]))


@lru_cache(maxsize=64)
def gripper_modes(stack: Stack) -> Any:
    """Return the gripper as the time stepping takes it: the rise at face and sensor per unit flux into the
    face, by modes."""
    from thermogrip.sysid.contact.time_stepping import Gripper

    # cells grow inwards: fast changes live near the face
    growth = 1.22 ** np.arange(_N_INNER)
    outer = np.ones(_N_OUTER)
    dz = np.concatenate([stack.z_outer / _N_OUTER * outer, growth / growth.sum() * stack.z_inner])
    e = np.concatenate([stack.e_outer * outer, stack.e_inner * np.ones(_N_INNER)])
    half = 2 * e / dz  # conductance of half a cell
    link = half[:-1] * half[1:] / (half[:-1] + half[1:])
    matrix = np.zeros((dz.size + 1, dz.size + 1))
    cell = np.arange(dz.size)
    matrix[cell[:-1], cell[:-1]] += link
    matrix[cell[1:], cell[1:]] += link
    matrix[cell[-1], cell[-1]] += stack.g_back * half[-1] / (stack.g_back + half[-1])
    matrix[cell[:-1], cell[1:]] = matrix[cell[1:], cell[:-1]] = -link
    matrix[_N_OUTER, _N_OUTER] += stack.g_side
    matrix[-1, -1] = stack.g_side
    matrix[_N_OUTER, -1] = matrix[-1, _N_OUTER] = -stack.g_side
    root_capacity = np.sqrt(np.concatenate([e * dz, [stack.c_side]]))
    lam, vectors = np.linalg.eigh(matrix / root_capacity[:, None] / root_capacity[None, :])
    shape = vectors / root_capacity[:, None]
    outer_conductance, right = half[_N_OUTER - 1], half[_N_OUTER]
    sensor = (outer_conductance * shape[_N_OUTER - 1] + right * shape[_N_OUTER]) / (outer_conductance + right)
    # the time stepping needs the sensor per unit of modal rise at the face; a mode that leaves the face still
    # is never excited
    still = np.abs(shape[0]) <= 1e-9 * np.abs(shape[0]).max()
    face = np.where(still, np.inf, shape[0])
    by_mode = np.stack([np.maximum(lam, 0.0), shape[0] ** 2, sensor / face])
    lag = np.array([[1 / stack.lag], [1 / stack.lag], [0.0]])
    numbers = [1 / half[0], stack.lag, stack.first, stack.creep, stack.settle, stack.g_far, stack.leak]
    return Gripper(np.concatenate([by_mode, lag], axis=1)[None], np.array([numbers]))


class ContactResponse(NamedTuple):
    """What a contact gives per degree of initial difference, (n, n_node) each."""

    rise: Array  # of the sensor
    slope: Array  # of the sensor [1/s]
    flux: Array  # into the face [W m^-2 K^-1]


def step_response(
    stack: Stack,
    nodes: TimeNodes,
    *,
    effusivity: ArrayLike,
    capacity: ArrayLike,
    h_c: ArrayLike,
    build_up: ArrayLike | None = None,
) -> ContactResponse:
    """Return the sensor's rise and slope and the flux at the nodes, per degree of initial difference.

    ``effusivity``, ``capacity``, settled ``h_c`` and ``build_up`` (default the stack's) are (n,);
    one that is not positive and finite raises a ValueError.
    """
    from thermogrip.sysid.contact.time_stepping import N_STEPPED, VALUE, contacts

    arguments = (effusivity, capacity, h_c, stack.build_up if build_up is None else build_up)
    e, c, h, tau = np.broadcast_arrays(*(np.atleast_1d(np.asarray(v, dtype=float)) for v in arguments))
    for name, value in (("effusivity", e), ("capacity", c), ("h_c", h)):
        if not (np.all(np.isfinite(value)) and np.all(value > 0)):
            raise ValueError(f"{name} must be positive and finite, got {value[~(value > 0)][:3]}")
    wanted = np.zeros((e.size, N_STEPPED), dtype=bool)
    wanted[:, VALUE] = True
    rise, slope, flux = contacts(nodes, gripper_modes(stack), np.stack([e, c, h, tau], axis=1), wanted)
    return ContactResponse(rise[:, VALUE], slope[:, VALUE], flux)


def far_response(
    stack: Stack, nodes: TimeNodes, rise: Array, *, effusivity: ArrayLike, capacity: ArrayLike
) -> Array:
    """Return what the far face of blocks, whose :func:`step_response` is ``rise`` (n, n_node), does to the
    sensor, per degree from block to room, (n, n_node)."""
    from scipy.interpolate import make_interp_spline

    # A block of capacity C per face whose far face loses U (T_obj - T_room) warms or cools at its near face,
    # untouched there, by d(t) = (U / C) (T_room - T_obj) max(t - L^2 / 6 alpha, 0), the mean time of the way
    # through the slab being L^2 / 6 alpha = C^2 / 6 e^2: 0.6 s in 20 mm of copper, 3 s in iron, minutes in
    # wood.  The sensor answers to d by its step response, so the reading gains the integral of that.  It is
    # the first order in U: the loss of what the gripper has warmed is left out (U t / C, 2 % in 10 s).
    e, c = (np.broadcast_to(np.asarray(v, dtype=float), rise.shape[:1]) for v in (effusivity, capacity))
    since = np.maximum(nodes.t - (c**2 / (6 * e**2))[:, None], 0.0)
    total = [make_interp_spline(nodes.t, f, k=1).antiderivative()(s) for f, s in zip(rise, since)]
    return np.asarray((stack.g_far / c)[:, None] * np.array(total))


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
    """A gripper and the spreads of its grasps; those with ``_ln`` are standard deviations of logarithms."""

    stack: Stack = SOFT_FINGER  # the finger, from skin to water
    h_c: float = 1600.0  # settled contact conductance of a block that ``h_c_of`` does not name [W m^-2 K^-1]
    h_c_of: Mapping[str, float] = field(default_factory=lambda: {"wood": 910.0})  # by material [W m^-2 K^-1]
    h_c_sd_ln: float = 0.09  # of conductance from grasp to grasp
    build_up_sd_ln: float = 0.03  # of build-up time from grasp to grasp
    onset: float = 0.02  # mean moment of contact after the "closed" message [s]
    onset_sd: float = 0.09  # [s]
    bias: float = 0.0  # mean of true less nominal temperature of the object [K]
    t_object_sd: float = 0.40  # of true less nominal [K]
    transit_loss: float = 0.02  # fraction of the way to the room that an object goes before contact
    # by material, on the gripper's scale [W s^0.5 m^-2 K^-1]; else the library's
    effusivity_of: Mapping[str, float] = field(default_factory=dict)
    effusivity_sd_ln: Mapping[str, float] = field(default_factory=lambda: {"wood": 0.08})  # by material
    length: float = 0.02  # of the block [m]
    until: float = 60.0  # a touch is computed for so long [s]

    def draw(self, material: str, t_object: float, rng: np.random.Generator, *, ambient: float) -> Touch:
        """Return one grasp of this material at this nominal temperature [degC]."""
        return self.draw_many([material], t_object, rng, ambient=ambient)[0]

    def draw_many(
        self,
        materials: Sequence[str],
        t_object: float,
        rng: np.random.Generator,
        *,
        ambient: float,
        blocks: Blocks | None = None,
    ) -> list[Touch]:
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
            e, h_c, capacity = (np.asarray(column, dtype=float) for column in blocks)
        onset = self.onset + self.onset_sd * normal[1]
        away = t_object + self.bias + self.t_object_sd * normal[2]
        # on its way to the contact the object relaxes by a small share of the way to the room's temperature
        true = away + self.transit_loss * (ambient - away)
        nodes = time_nodes(self.until)
        build_up = self.stack.build_up * np.exp(self.build_up_sd_ln * normal[4])
        rise = step_response(
            self.stack, nodes, effusivity=e, capacity=capacity, h_c=h_c, build_up=build_up
        ).rise
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
    material_of = [material for material in materials for _ in range(n)]
    touches = grip.draw_many(material_of, t_object, rng, ambient=ambient, blocks=blocks)
    time, reading = record_touches(touches, rng, t_gripper=t_gripper, ambient=ambient, **readings)
    return make_grasps(
        time, reading, [f"s{i:04d}" for i in range(len(material_of))], name=name, material=material_of,
        t_object=np.full(len(material_of), t_object), t_gripper=np.full(len(material_of), t_gripper),
        t_ambient=np.full(len(material_of), ambient),
        split=["" if split is None else split(i % n) for i in range(len(material_of))],
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
