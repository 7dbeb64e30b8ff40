"""What the sensor of a layered gripper reads after it closes on a finite block.

The sensor temperature, scaled by the initial difference, is one step response F(t), so that

    T(t) = b (1 - F(t - t0)) + T_obj F(t - t0)

is linear in the level b before contact and in the object's temperature T_obj, and a later onset t0 is a
shift of time; what the room does by the block's far face comes on top (:func:`far_response`).  F depends on
the block (effusivity e, heat capacity per face C = rho c_p L), on the contact conductance and on the gripper
only:

- **Block**: a slab whose far face loses U per degree, as modes
  (:mod:`thermogrip.sysid.contact.time_stepping`), of which 37 serve copper (diffusion time C^2/e^2 of 4 s)
  and wood (over an hour) alike.
- **Gripper**: a stack of layers in the coordinate z = x / sqrt(alpha) [s^0.5], in which a layer is its
  effusivity alone (a cell holds e dz and conducts e / dz).  An outer sheet, the sensor, an inner layer, a
  conductance to what is behind; beside the sensor a store of heat, since the pipe that it is glued to holds
  water on one side and foam on the other.  The sensor follows its node with a first-order lag.
- **Contact**: h(t) = h [f0 + (1 - f0) (1 - exp(-t / tau_b))] [1 + c (1 - exp(-t / tau_c))], soft skin that
  meets the block and then settles.

With h constant and one layer this is the closed form of :mod:`thermogrip.sysid.contact.closed_forms`, which
the tests use.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import make_interp_spline
from scipy.linalg import eigh

Array = NDArray[np.float64]

LAYER_NAMES = ("e_outer", "z_outer", "e_inner", "z_inner", "g_back", "g_side", "c_side")  # what shapes modes

_N_OUTER, _N_INNER = 5, 26


@dataclass(frozen=True, kw_only=True)
class Stack:
    """The gripper and the way it makes contact."""

    e_outer: float  # effusivity of the sheet over the sensor [W s^0.5 m^-2 K^-1]
    z_outer: float  # its thickness in diffusion time, x / sqrt(alpha) [s^0.5]
    e_inner: float  # of what lies behind the sensor
    z_inner: float
    g_back: float  # conductance from the back to the water [W m^-2 K^-1]
    lag: float  # time constant of the sensor [s]
    first: float  # share of h at first touch
    build_up: float  # build-up time of the contact [s]
    creep: float  # relative growth of h while the skin settles
    leak: float = 0.0  # rate of the skin's drift to the room once the pump is off [1/s]
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


class StackModes(NamedTuple):
    """Modes of the gripper: decay rates [1/s], weights at face and sensor, resistance of the outer cell."""

    lam: Array
    face: Array
    sensor: Array
    resistance: Any  # a float, or (n,) of n grippers


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
def stack_modes(stack: Stack) -> StackModes:
    """Return the gripper's modes: rise at face and sensor per unit flux into the face."""
    lam, vectors, _, root, half = _solved(stack)
    return StackModes(*(part[0] for part in _modes(lam[None], vectors[None], root, half)))


@lru_cache(maxsize=8)
def _solved(stack: Stack) -> tuple[Array, Array, Array, Array, Array]:
    """Return eigenvalues (32,), vectors (32, 32), and what :func:`_assembled` gave."""
    matrix, root, half = _assembled(np.array([[getattr(stack, name) for name in LAYER_NAMES]]))
    lam, vectors = eigh(matrix[0], check_finite=False, driver="evd")
    return lam, vectors, matrix, root, half


def nearby_modes(stack: Stack, moved: Array) -> StackModes:
    """Return modes of n grippers to first order about ``stack``; ``moved`` (n, 7) holds their LAYER_NAMES."""
    lam, vectors, here, _, _ = _solved(stack)
    matrix, root, half = _assembled(moved)
    change = vectors.T @ (matrix - here) @ vectors
    gap = lam[None, :] - lam[:, None] + np.eye(lam.size)
    turn = change / gap * (1 - np.eye(lam.size))
    shifted = lam + np.diagonal(change, axis1=1, axis2=2)
    return _modes(shifted, vectors + vectors @ turn, root, half)


def _assembled(layers: Array) -> tuple[Array, Array, Array]:
    """Return symmetric matrices (n, 32, 32), roots of capacities (n, 32) and cells' conductances (n, 31)."""
    e_outer, z_outer, e_inner, z_inner, g_back, g_side, c_side = layers.T[:, :, None]
    # cells grow inwards: fast changes live near the face
    growth = 1.22 ** np.arange(_N_INNER)
    outer = np.ones(_N_OUTER)
    dz = np.concatenate([z_outer / _N_OUTER * outer, growth / growth.sum() * z_inner], axis=1)
    e = np.concatenate([e_outer * outer, e_inner * np.ones(_N_INNER)], axis=1)
    half = 2 * e / dz
    link = half[:, :-1] * half[:, 1:] / (half[:, :-1] + half[:, 1:])
    matrix = np.zeros((layers.shape[0], dz.shape[1] + 1, dz.shape[1] + 1))
    at = np.arange(dz.shape[1])
    matrix[:, at[:-1], at[:-1]] += link
    matrix[:, at[1:], at[1:]] += link
    matrix[:, at[-1], at[-1]] += (g_back * half[:, -1:] / (g_back + half[:, -1:]))[:, 0]
    matrix[:, at[:-1], at[1:]] = matrix[:, at[1:], at[:-1]] = -link
    matrix[:, _N_OUTER, _N_OUTER] += g_side[:, 0]
    matrix[:, -1, -1] = g_side[:, 0]
    matrix[:, _N_OUTER, -1] = matrix[:, -1, _N_OUTER] = -g_side[:, 0]
    root = np.sqrt(np.concatenate([e * dz, c_side], axis=1))
    return matrix / root[:, :, None] / root[:, None, :], root, half


def _modes(lam: Array, vectors: Array, root: Array, half: Array) -> StackModes:
    """Return the modes of n matrices from their eigenvalues (n, 32) and vectors (n, 32, 32)."""
    shape = vectors / root[:, :, None]
    left, right = half[:, _N_OUTER - 1, None], half[:, _N_OUTER, None]
    sensor = (left * shape[:, _N_OUTER - 1] + right * shape[:, _N_OUTER]) / (left + right)
    # the time stepping needs the sensor per unit of modal rise at the face; a mode that leaves the face still
    # is never excited
    still = np.abs(shape[:, 0]) <= 1e-9 * np.abs(shape[:, 0]).max(axis=1, keepdims=True)
    face = np.where(still, np.inf, shape[:, 0])
    return StackModes(np.maximum(lam, 0.0), shape[:, 0] ** 2, sensor / face, 1 / half[:, 0])


def block_modes(effusivity: ArrayLike, capacity: ArrayLike) -> tuple[Array, Array, Array]:
    """Return decay rates [1/s], weights (n, 37) and series resistance (n,) [m^2 K W^-1] of insulated slabs.

    ``effusivity`` and ``capacity`` (n,): e [W s^0.5 m^-2 K^-1] and C = rho c_p L [J m^-2 K^-1].
    """
    from thermogrip.sysid.contact.time_stepping import slabs

    e, c = (np.atleast_1d(np.asarray(v, dtype=float)) for v in (effusivity, capacity))
    lam, weight, resistance = slabs(e, c, 0.0)
    return lam, weight, resistance


def step_response(
    stack: Stack, nodes: TimeNodes, *, effusivity: ArrayLike, capacity: ArrayLike, h_c: ArrayLike,
    build_up: ArrayLike | None = None,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Return sensor rise, slope [1/s] and flux [W m^-2 K^-1] per degree of initial difference, (n, n_node).

    ``effusivity``, ``capacity``, settled ``h_c`` and ``build_up`` (default the stack's) are (n,);
    one that is not positive and finite raises a ValueError.
    """
    from thermogrip.sysid.contact.time_stepping import contacts, gripper_of

    given = (effusivity, capacity, h_c, stack.build_up if build_up is None else build_up)
    e, c, h, tau = np.broadcast_arrays(*(np.atleast_1d(np.asarray(v, dtype=float)) for v in given))
    for name, value in (("effusivity", e), ("capacity", c), ("h_c", h)):
        if not (np.all(np.isfinite(value)) and np.all(value > 0)):
            raise ValueError(f"{name} must be positive and finite, got {value[~(value > 0)][:3]}")
    found = stack_modes(stack)
    gripper = gripper_of(nodes.dt, found.lam, found.face, found.sensor, contact_numbers(stack, found))
    rise, slope, flux = contacts(tuple(nodes), gripper, *(np.ascontiguousarray(v) for v in (e, c, h, tau)))
    return rise, slope, flux


def far_response(
    stack: Stack, nodes: TimeNodes, rise: Array, *, effusivity: ArrayLike, capacity: ArrayLike
) -> Array:
    """Return what the far face of blocks does to the sensor, per degree from block to room, (n, n_node).

    ``rise`` (n, n_node) as :func:`step_response` gives it for the same blocks.
    """
    e, c = (np.broadcast_to(np.asarray(v, dtype=float), rise.shape[:1]) for v in (effusivity, capacity))
    since = np.maximum(nodes.t - (c**2 / (6 * e**2))[:, None], 0.0)
    total = [make_interp_spline(nodes.t, f, k=1).antiderivative()(s) for f, s in zip(rise, since)]
    return np.asarray((stack.g_far / c)[:, None] * np.array(total))


def contact_numbers(stack: Stack, modes: StackModes) -> Array:
    """Return resistance, lag, first, creep, settle, far loss and leak, which are beside the modes, (7,)."""
    own = (stack.lag, stack.first, stack.creep, stack.settle, stack.g_far, stack.leak)
    return np.array([float(modes.resistance), *own])
