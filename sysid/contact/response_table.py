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

Where many grasps have their samples at the same times, bin means are combinations too: those of the 16 curves
are kept at onsets 0.02 s apart, and are cubics between.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.sysid.contact.simulation import Stack, gripper_modes, time_nodes
from thermogrip.sysid.contact.table_kernel import N_BASIS, blend, blended_means
from thermogrip.sysid.contact.time_stepping import N_STEPPED, VALUE, contacts

_NEAR = (6, 6, 6, 4)  # nodes of each direction between which a place is interpolated
_STEP = np.array([0.35, 0.2, 0.3, 0.15])
# between what the lattice answers; ln C/e ends by the record's length, ln tau_b is about the gripper's
_LOW, _HIGH = np.array([2.8, -4.2, 3.85, -1.5]), np.array([11.65, 0.0, 9.4, 0.9])
# responses that the basis is made of, and a quarter as many of all the lattice, whose beginning is seldom
# asked for
_DRAWN, _RARE = 800, np.array([0.0, 3.0, 0.75, 0.75])
_LATE = 12.0  # of the record's length
# onsets [s] at which bin means are kept, of so many kinds of samples
_FIRST, _APART, _PLACES, _KINDS = -1.5, 0.02, 116, 16


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
        self._kept = np.empty((int(np.prod(shape[1:])), N_BASIS))  # sums along one ln e
        self._rows, self._n = np.empty((1024, N_BASIS), dtype=np.float32), 0
        rng, most = np.random.default_rng(0), np.maximum(low, low + _RARE)
        places = [rng.uniform(most, high, (_DRAWN, 4)), rng.uniform(low, high, (_DRAWN // 4, 4))]
        drawn = self._stepped(np.concatenate(places))
        self._basis = np.linalg.svd(drawn, full_matrices=False)[2][:N_BASIS]
        self._rise, self._slope = map(np.ascontiguousarray, np.split(self._basis, 2, axis=1))
        self._means: dict[tuple[bytes, bytes], tuple[Array, Array]] = {}

    def inside(self, numbers: Array) -> Mask:
        """Return which contacts of logarithms ``numbers`` (n, 4) the lattice answers."""
        z = self._places(numbers)
        return np.asarray(((z >= self._low) & (z <= self._high)).all(axis=1))

    def curves(self, contact: Array, wanted: Mask) -> tuple[Array, Array]:
        """Return the sensor's rise and its slope (n, 5, n_node) of ``contact`` (n, 4) and the ``wanted``
        curves, as :func:`~thermogrip.sysid.contact.time_stepping.contacts`; (n, 1, n_node) where only values
        are."""
        numbers = np.log(contact)
        inside = self.inside(numbers)
        n_curve = N_STEPPED if wanted[:, 1:].any() else 1
        if inside.all():
            own = self._blended(numbers, wanted)[:, :n_curve]
            return own @ self._rise, own @ self._slope
        out, shape = ~inside, (len(numbers), n_curve, self._nodes.t.size)
        rise, slope = np.empty(shape), np.empty(shape)
        if inside.any():
            own = self._blended(numbers[inside], wanted[inside])[:, :n_curve]
            rise[inside], slope[inside] = own @ self._rise, own @ self._slope
        stepped = contacts(self._nodes, self._gripper, contact[out], wanted[out])
        rise[out], slope[out] = (part[:, :n_curve] for part in stepped[:2])
        return rise, slope

    def bin_means(
        self, times: Array, bins: NDArray[np.int64], row: NDArray[np.int64], numbers: Array, stepped: Mask,
        which: NDArray[np.int64], onset: Array, wanted: Mask, out: Array,
    ) -> None:  # fmt: skip
        """Fill ``out`` (n, 6, n_bin): bin means of contacts of logarithms ``numbers`` (k, 4), all inside, as
        :func:`~thermogrip.sysid.effusivity.mode_kernel.bin_means` of their curves."""
        own, room = self._blended(numbers, stepped), np.empty(out.shape[2])
        touched, at = np.unique(row, return_inverse=True)
        one = (times[touched] == times[touched[0]]).all() and (bins[touched] == bins[touched[0]]).all()
        of = [(times[i].tobytes(), bins[i].tobytes()) for i in (touched[:1] if one else touched)]
        kinds = list(dict.fromkeys(of))
        for key in kinds:
            first = touched[of.index(key)]
            means = self._basis_means(key, times[first], bins[first], out.shape[2])
            if len(kinds) == 1:
                blended_means(*means, _FIRST, _APART, own, which, onset, wanted, room, out)
                return
            some = np.array([one == key for one in of])[at]
            part = np.empty((int(some.sum()), *out.shape[1:]))
            blended_means(*means, _FIRST, _APART, own, which[some], onset[some], wanted[some], room, part)
            out[some] = part

    def _basis_means(
        self, key: tuple[bytes, bytes], times: Array, bins: NDArray[np.int64], n_bin: int
    ) -> tuple[Array, Array]:
        """Return bin means of the basis, (n_place, N_BASIS, n_bin), and their derivatives by the onset, of
        samples at ``times`` in ``bins``, those of negative ones left out."""
        if key in self._means:
            return self._means[key]
        read = bins >= 0
        since = times[read] - (_FIRST + _APART * np.arange(_PLACES))[:, None]
        nodes = self._nodes.t
        k = np.clip(np.searchsorted(nodes, since) - 1, 0, nodes.size - 2)
        dt = nodes[k + 1] - nodes[k]
        s = np.clip((since - nodes[k]) / dt, 0.0, 1.0)
        there = since > 0.0
        values = [s * s * (3 - 2 * s), s * (1 - s) ** 2 * dt, -s * s * (1 - s) * dt]
        rates = [6 * s * (1 - s) / dt, (1 - s) * (1 - 3 * s), s * (3 * s - 2)]
        pick = np.zeros((int(read.sum()), n_bin))
        pick[np.arange(len(pick)), bins[read]] = 1.0
        pick /= np.maximum(pick.sum(axis=0), 1.0)
        means = np.empty((2, _PLACES, N_BASIS, n_bin))
        for q in range(N_BASIS):
            r, v = self._rise[q], self._slope[q]
            high, low_slope, high_slope = r[k + 1] - r[k], v[k], v[k + 1]
            value = r[k] + values[0] * high + values[1] * low_slope + values[2] * high_slope
            rate = rates[0] * high + rates[1] * low_slope + rates[2] * high_slope
            means[0, :, q], means[1, :, q] = (
                np.where(there, value, 0.0) @ pick,
                np.where(there, -rate, 0.0) @ pick,
            )
        while len(self._means) >= _KINDS:
            self._means.pop(next(iter(self._means)))
        self._means[key] = means[0], means[1]
        return self._means[key]

    def _places(self, numbers: Array) -> Array:
        """Return where in the lattice contacts are, (n, 4)."""
        z = numbers.copy()
        z[:, 1] = np.minimum(z[:, 1] - z[:, 0], self._high[1])
        return z

    def _stepped(self, z: Array) -> Array:
        """Return rise and slope of places z (n, 4), (n, 2 n_node)."""
        wanted = np.zeros((len(z), N_STEPPED), dtype=bool)
        wanted[:, VALUE] = True
        contact = np.exp(z)
        contact[:, 1] *= contact[:, 0]
        rise, slope, _ = contacts(self._nodes, self._gripper, contact, wanted)
        return np.concatenate([rise[:, VALUE], slope[:, VALUE]], axis=1)

    def _blended(self, numbers: Array, wanted: Mask) -> Array:
        """Return the coefficients of the curves, (n, 5, N_BASIS)."""
        z = self._places(numbers)
        place = (z - self._low) / _STEP
        # the last cell holds its end too
        cell = np.minimum(np.floor(place).astype(np.int64), np.array(self._index.shape) - _NEAR)
        self._fill(cell)
        out, late = np.empty((len(z), N_STEPPED, N_BASIS)), z[:, 1] >= self._high[1]
        order, lattice = np.argsort(z[:, 0], kind="stable"), self._index.reshape(len(self._index), -1)
        kept_of, law = np.zeros(lattice.shape[1], dtype=np.int32), (_WEIGHT, _STEP, wanted, order)
        where = lattice, self._index.shape, self._rows, cell, place - cell, late
        room = np.empty((8, 6)), np.empty((N_STEPPED, N_BASIS))
        blend(*where, *law, self._kept, kept_of, *room, out)
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
# Lagrange's weights as polynomials, (direction, order, node); nodes that a direction lacks have none
_WEIGHT = np.zeros((4, 6, 6))
for _own, _at in zip(_WEIGHT, _AT):
    _own[: _at.size, : _at.size] = np.linalg.inv(np.vander(_at, increasing=True))
