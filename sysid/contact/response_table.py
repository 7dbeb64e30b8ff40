r"""Responses to contact by interpolation, for many grasps of one gripper.

A response is a smooth function of four numbers,

    z = (ln e, ln C/e, ln h, ln tau_b),

and grasps of one kind ask for it at thousands of neighbouring places.  So it is stepped
(:mod:`thermogrip.sysid.contact.time_stepping`) at the nodes of a regular lattice about the places that are
asked for, each node once, and is between them the polynomial of the nearest four of ln tau_b and six of the
others, derivatives included.  Response and slope at all time nodes are combinations of 16 curves, those of
the largest singular values of responses drawn over the whole lattice: only their coefficients are kept.

Once :math:`(C/e)^2` is twelve times the record's length, heat does not reach the far face, and nothing
depends on C any more: ln C/e ends there.  What lies outside of the lattice is stepped.

Beside the stepped ones responses are off by at most 2e-5 of the initial difference, 0.4 mK of 20 K.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.sysid.contact.simulation import Stack, gripper_modes, time_nodes
from thermogrip.sysid.contact.table_kernel import N_BASIS, blend
from thermogrip.sysid.contact.time_stepping import N_STEPPED, VALUE, contacts

_NEAR = (6, 6, 6, 4)  # nodes of each direction between which a place is interpolated
_STEP = np.array([0.35, 0.2, 0.3, 0.15])
# between what the lattice answers; ln C/e ends by the record's length, ln tau_b is about the gripper's
_LOW, _HIGH = np.array([2.8, -1.2, 4.6, -0.6]), np.array([11.65, 0.0, 9.4, 0.6])
_DRAWN = 800  # responses that the basis is made of
_LATE = 12.0  # of the record's length


@lru_cache(maxsize=4)
def response_table(stack: Stack, end: float) -> ResponseTable:
    """Return the table of a gripper for contacts of ``end`` [s]; it is filled as it is asked."""
    return ResponseTable(stack, end)


class ResponseTable:
    """Responses of one gripper on the time nodes to ``end`` [s]."""

    def __init__(self, stack: Stack, end: float) -> None:
        self._nodes, self._gripper = time_nodes(end), gripper_modes(stack)
        low, high = _LOW.copy(), _HIGH.copy()
        low[3], high[3] = low[3] + np.log(stack.build_up), high[3] + np.log(stack.build_up)
        high[1] = max(0.5 * np.log(_LATE * end), low[1] + 1.0)
        self._low, self._high = low, high
        self._origin = low + _STEP * [at[0] for at in _AT]
        shape = np.ceil((high - low) / _STEP).astype(int) + _NEAR
        self._index = np.full(shape, -1, dtype=np.int32)
        self._whole = np.zeros(shape, dtype=bool)  # where all nodes about a cell are there
        self._rows, self._n = np.empty((1024, N_BASIS), dtype=np.float32), 0
        drawn = self._stepped(np.random.default_rng(0).uniform(low, high, (_DRAWN, 4)))
        self._basis = np.linalg.svd(drawn, full_matrices=False)[2][:N_BASIS]
        self._rise, self._slope = map(np.ascontiguousarray, np.split(self._basis, 2, axis=1))

    def curves(self, contact: Array, wanted: Mask) -> tuple[Array, Array]:
        """Return the sensor's rise and its slope (n, 5, n_node) of ``contact`` (n, 4) and the ``wanted``
        curves, as :func:`~thermogrip.sysid.contact.time_stepping.contacts`; (n, 1, n_node) where only values
        are."""
        z = np.log(contact)
        z[:, 1] = np.minimum(z[:, 1] - z[:, 0], self._high[1])
        inside = ((z >= self._low) & (z <= self._high)).all(axis=1)
        n_curve = N_STEPPED if wanted[:, 1:].any() else 1
        if inside.all():
            own = self._blended(z, wanted)[:, :n_curve]
            return own @ self._rise, own @ self._slope
        out, shape = ~inside, (len(z), n_curve, self._nodes.t.size)
        rise, slope = np.empty(shape), np.empty(shape)
        if inside.any():
            own = self._blended(z[inside], wanted[inside])[:, :n_curve]
            rise[inside], slope[inside] = own @ self._rise, own @ self._slope
        stepped = contacts(self._nodes, self._gripper, contact[out], wanted[out])
        rise[out], slope[out] = (part[:, :n_curve] for part in stepped[:2])
        return rise, slope

    def _stepped(self, z: Array) -> Array:
        """Return rise and slope of places z (n, 4), (n, 2 n_node)."""
        wanted = np.zeros((len(z), N_STEPPED), dtype=bool)
        wanted[:, VALUE] = True
        contact = np.exp(z)
        contact[:, 1] *= contact[:, 0]
        rise, slope, _ = contacts(self._nodes, self._gripper, contact, wanted)
        return np.concatenate([rise[:, VALUE], slope[:, VALUE]], axis=1)

    def _blended(self, z: Array, wanted: Mask) -> Array:
        """Return the coefficients of the curves, (n, 5, N_BASIS)."""
        place = (z - self._low) / _STEP
        # the last cell holds its end too
        cell = np.minimum(np.floor(place).astype(np.int64), np.array(self._index.shape) - _NEAR)
        self._fill(cell)
        parts = [_weights(place[:, k] - cell[:, k], k) for k in range(4)]
        out = np.zeros((len(z), N_STEPPED, N_BASIS))
        blend(self._index, self._rows, cell, *parts, wanted, np.zeros((9, N_BASIS)), out)
        out[:, 4, :][z[:, 1] >= self._high[1]] = 0.0
        out[:, 3] -= out[:, 4]  # by ln e at the same C
        return out

    def _fill(self, cell: NDArray[np.int64]) -> None:
        """Step the responses at the nodes about cells (n, 4) that are not there yet."""
        new = cell[~self._whole[tuple(cell.T)]]
        if not len(new):
            return
        self._whole[tuple(new.T)] = True
        needed = np.zeros(self._index.size, dtype=bool)
        strides = np.array(self._index.strides) // self._index.itemsize
        about = sum(
            np.arange(near).reshape([-1 if i == k else 1 for i in range(4)]) * strides[k]
            for k, near in enumerate(_NEAR)
        )
        for first in np.unique(new @ strides):
            needed[first + about] = True
        missing = np.flatnonzero(needed & (self._index.ravel() < 0))
        for part in (missing[i : i + 512] for i in range(0, missing.size, 512)):
            node = np.stack(np.unravel_index(part, self._index.shape), axis=1)
            # sums in one order however many there are, so that it does not matter what was asked before
            rows = np.einsum("nt,kt->nk", self._stepped(self._origin + _STEP * node), self._basis)
            while self._n + part.size > len(self._rows):
                self._rows = np.concatenate([self._rows, np.empty_like(self._rows)])
            self._rows[self._n : self._n + part.size] = rows
            self._index.ravel()[part] = np.arange(self._n, self._n + part.size)
            self._n += part.size


_AT = [np.arange(n) - (n // 2 - 1.0) for n in _NEAR]  # of the nodes, from the one before a place
# Lagrange's weights as polynomials, (order, node), and their derivatives
_WEIGHT = [np.linalg.inv(np.vander(at, increasing=True)) for at in _AT]
_SLOPE = [np.arange(1, len(w))[:, None] * w[1:] for w in _WEIGHT]


def _weights(share: Array, k: int) -> tuple[Array, Array]:
    """Return the weights (n, m) of the nodes of a direction at a ``share`` (n,) of the way from one to the
    next, and their derivatives."""
    powers = np.vander(share, len(_WEIGHT[k]), increasing=True)
    return powers @ _WEIGHT[k], powers[:, :-1] @ (_SLOPE[k] / _STEP[k])
