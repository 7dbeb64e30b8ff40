"""What happens to a block between two touches.

A touch takes heat from the block or gives it some.  The face that is touched again later finds, per degree of
initial difference, the drop

    rho = sum_j w_j int_0^t1 q(tau) exp(-lam_j (t1 + rest - tau)) d tau

of the block's modes (lam_j, w_j) under the flux q of the first touch: in a metal the heat that left over the
heat capacity, since its temperature is even after seconds; in wood more than that, since the heat is still
near the face.  A share a of it is left to find (a block stores heat beside the part that a touch sees, and
may be touched at another face).  Meanwhile the block relaxes towards the room with time constant C / U, so

    T_2 = T_room + exp(-U rest / C) (T_1 - a rho (T_1 - T_grip) - T_room) + N(0, s^2 + (0.15 way)^2).

One time constant is not the law of a slab, and U is not the same wherever a block lies and however warm it
is.  So of the way that the block went towards the room 15 % are in doubt: little after a minute near the
room's temperature, most of the spread after long rests and far from it, where nothing was learnt.

Contact conductance scatters from touch to touch about the block's own; ``ln_h_sd`` is that scatter in touches
of one block, which a person or an arm made one after the other, and may be wider than between grasps of a
series. All of it is learnt from groups of known material by maximum likelihood (:func:`learn_coupling` of
:mod:`thermogrip.sysid.effusivity.multi_touch`); the defaults are those of the example rig.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.atomic_files import read_json, write_json
from thermogrip.datasets.errors import UserError
from thermogrip.sysid.contact.response import block_modes, step_response, time_nodes
from thermogrip.sysid.effusivity.data import Touches
from thermogrip.sysid.effusivity.gripper_model import Device
from thermogrip.sysid.effusivity.priors import Hypotheses

__all__ = ["REST", "Coupling", "Traces", "joint_prior", "traces_of"]

Array = NDArray[np.float64]

_SCHEMA, _VERSION = "thermogrip.coupling", 1
#: Time between two touches, where the record does not say [s].
REST = 60.0
_LAW = 0.15  # of the way to the room, in doubt
_INTO = 2.0  # s into the next touch: where its reading knows most of the block


@dataclass(frozen=True, kw_only=True)
class Coupling:
    """How a block moves between two touches.

    Parameters
    ----------
    found : float
        Share a of the first touch's drop that the next one finds.
    loss : float
        U, to the room, per contact face [W m^-2 K^-1].
    sd : float
        s, what the two leave open [K].
    ln_h_sd : float
        Scatter of ln h from touch to touch of one block.
    longest_rest : float
        The longest rest that taught it [s]; what a block does in a longer one is a guess.

    Examples
    --------
    >>> Coupling().found
    0.75
    """

    found: float = 0.75
    loss: float = 100.0
    sd: float = 0.36
    ln_h_sd: float = 0.12
    longest_rest: float = REST

    def __post_init__(self) -> None:
        if not (0 <= self.found <= 2 and self.loss >= 0 and self.sd > 0 and self.ln_h_sd > 0):
            raise ValueError(f"need 0 <= found <= 2, loss >= 0, sd > 0, ln_h_sd > 0, got {self}")

    @property
    def touch_sd(self) -> float:
        """Return the error of a temperature that a touch finds, beyond its noise [K].

        Two touches show the sum of the block's own wandering, of variance s^2 / 2 here, and of their two
        errors, s^2 / 4 each; they cannot tell which is which.
        """
        return 0.5 * self.sd

    def to_dict(self) -> dict[str, float]:
        """Return the numbers by name, without a longest rest that is not known."""
        return {name: value for name, value in asdict(self).items() if np.isfinite(value)}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], *, file: str | Path = "coupling") -> Coupling:
        """Return what :meth:`to_dict` described; a wrong entry is a :class:`UserError`."""
        try:
            numbers = {"longest_rest": np.inf} | dict(content)  # which earlier files do not say
            return cls(**{f.name: float(numbers[f.name]) for f in fields(cls)})
        except (KeyError, TypeError, ValueError) as error:
            problem = f"is not a whole coupling of touches ({error})"
            raise UserError(problem, file=file, hint="train again") from error

    def save(self, path: str | Path) -> Path:
        """Write the coupling as JSON and return the path."""
        return write_json(path, self.to_dict(), schema=_SCHEMA, version=_VERSION)

    @classmethod
    def load(cls, path: str | Path) -> Coupling:
        """Return the coupling of a file."""
        return cls.from_dict(read_json(path, _SCHEMA, _VERSION), file=path)


@dataclass(frozen=True, kw_only=True)
class Traces:
    """What touches leave in blocks: ``n`` touches, m hypotheses.

    ``moved`` (m, n_mode) is each mode's drop of the face at the end of a touch, per degree of initial
    difference, and ``decay`` (m, n_mode) its rate [1/s]; ``capacity`` (m,) is C [J m^-2 K^-1]; ``skin``,
    ``room``, ``rest`` (n,) the gripper's temperature in the touch, the room's (NaN where unknown) [degC], and
    the time since the touch before [s].
    """

    moved: Array
    decay: Array
    capacity: Array
    skin: Array
    room: Array
    rest: Array

    def drop(self, rest: float) -> Array:
        """Return rho of each hypothesis after a rest [s], (m,)."""
        return np.asarray((self.moved * np.exp(-self.decay * (rest + _INTO))).sum(axis=1))


def traces_of(device: Device, data: Touches, rest: Array, hypotheses: Hypotheses) -> Traces:
    """Return what the touches leave in their blocks; ``rest`` (n,) [s] is NaN where unknown."""
    capacity = np.exp(hypotheses.ln_rho_c) * device.block_length * device.depth_share
    effusivity = np.exp(hypotheses.ln_e)
    nodes = time_nodes(data.end)
    flux = step_response(
        device.stack, nodes, effusivity=effusivity, capacity=capacity, h_c=np.exp(hypotheses.ln_h)
    )[2]
    inside = nodes.t <= data.end
    t, q = nodes.t[inside], flux[:, inside]
    lam, weight, _ = block_modes(effusivity, capacity)
    history = np.exp(-lam[:, :, None] * (data.end - t)) * q[:, None, :]
    return Traces(
        moved=weight * np.trapezoid(history, t, axis=2),
        decay=lam,
        capacity=capacity,
        skin=data.level,
        room=data.t_ambient,
        rest=np.where(np.isfinite(rest), rest, REST),
    )


def joint_prior(
    coupling: Coupling,
    traces: Traces,
    rows: NDArray[np.int64],
    one: tuple[Array, Array],
    shared: tuple[Array, Array, Array],
    about: Array | None = None,
) -> tuple[Array, Array]:
    """Return mean (m, 4 n) and covariance (m, 4 n, 4 n) of the x of n touches of one block.

    Parameters
    ----------
    coupling : Coupling
    traces : Traces
    rows : (n,) ndarray
        The touches, in their order.
    one : (m, 4), (m,) ndarrays
        Prior mean of x at the first touch, and the variance of its temperature [K^2].
    shared : three (m,) ndarrays
        Variances of ln h (of the block, not of a touch), ln e and ln C.
    about : (m, n) ndarray, optional
        About where each touch finds the block [degC]: how far it then goes decides how much of that is in
        doubt; default nothing.
    """
    mean, variance = one
    n, m = rows.size, variance.size
    mu, p = np.repeat(mean[:, None, :], n, axis=1), np.zeros((m, n, 4, n, 4))
    p[:, :, 1, :, 1] = shared[0][:, None, None]
    p[:, :, 2, :, 2] = shared[1][:, None, None]
    p[:, :, 3, :, 3] = shared[2][:, None, None]
    at = np.arange(n)
    p[:, at, 1, at, 1] += coupling.ln_h_sd**2
    p[:, 0, 0, 0, 0] = variance
    for k in range(1, n):
        start = None if about is None else about[:, k - 1]
        gain, offset, way = _move(coupling, traces, int(rows[k - 1]), int(rows[k]), start)
        mu[:, k, 0] = gain * mu[:, k - 1, 0] + offset
        for j in range(k):
            p[:, j, 0, k, 0] = p[:, k, 0, j, 0] = gain * p[:, j, 0, k - 1, 0]
        p[:, k, 0, k, 0] = gain**2 * p[:, k - 1, 0, k - 1, 0] + coupling.sd**2 + (_LAW * way) ** 2
    return mu.reshape(m, 4 * n), p.reshape(m, 4 * n, 4 * n)


def _move(
    coupling: Coupling, traces: Traces, before: int, after: int, about: Array | None
) -> tuple[Array, Array, Array]:
    """Return gain and offset (m,) of the block's temperature from one touch to the next, and how far the room
    takes one that is found at ``about`` (m,) [K]."""
    rest = float(traces.rest[after])
    taken = coupling.found * traces.drop(rest)
    room = traces.room[before]
    stay = np.exp(-coupling.loss * rest / traces.capacity) if np.isfinite(room) else 1.0
    gain = np.asarray(stay * (1 - taken))
    offset = stay * taken * traces.skin[before] + (1 - stay) * np.nan_to_num(room)
    if about is None:
        return gain, np.asarray(offset), np.zeros(gain.shape)
    way = gain * about + offset - (about - taken * (about - traces.skin[before]))
    return gain, np.asarray(offset), np.asarray(way)
