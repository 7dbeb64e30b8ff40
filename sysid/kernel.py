"""A model's equations, compiled and run over a log for many parameter sets at once.

The equations come as three functions on lists of numbers (:class:`Equations`): what depends on the parameters
alone, what depends on a switch besides, and the step.  Each is called once, with
:class:`~thermogrip.sysid.lanes.Lanes` for numbers, and leaves its instructions in one function,

    c = prepare(p)
    for t in 0 .. N-1:
        if a switch has moved:  kept = renew(u_t, c, h)
        m times:                x = advance(x, u_t, d_t, c, kept, h)
        y_(t+1) = read(x, c)

which moves eight members of a batch through a log.  It is made anew in each process, in a fraction of
a second; no file is written.  It holds no interpreter lock, so that blocks of eight run on all cores as plain
threads.  A member's numbers do not depend on who its neighbours are.

Importing this module imports llvmlite, so that models do it at their first rollout only.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, Protocol

import numpy as np
from llvmlite import ir
from numpy.typing import NDArray

from thermogrip.sysid.lanes import (
    ALIGNED,
    BYTE,
    DOUBLE,
    INTEGER,
    VECTOR,
    WIDTH,
    Lanes,
    assemble,
    gather,
    load,
    register,
    spread,
    store,
)

__all__ = ["Equations", "Kernel"]

Array = NDArray[np.float64]

# Fewer steps of a block than this are done sooner than another thread takes over.
_WORTH_THREADS = 1000
_FIRST = INTEGER(0)


class Equations(Protocol):
    """A model's step in three parts, on lists of numbers, of NumPy rows or of lanes.

    Attributes
    ----------
    n_x, n_u, n_d, n_p : int
        Length of state, inputs, disturbances, parameters.
    """

    @property
    def n_x(self) -> int: ...
    @property
    def n_u(self) -> int: ...
    @property
    def n_d(self) -> int: ...
    @property
    def n_p(self) -> int: ...

    def prepare(self, p: Sequence[Any]) -> list[Any]:
        """Return what depends on the parameters alone, c."""
        ...

    def renew(self, u: Sequence[Any], c: Sequence[Any], h: Any) -> list[Any]:
        """Return what depends on the switches among the inputs besides, and on the step h [s]."""
        ...

    def advance(
        self,
        x: Sequence[Any],
        u: Sequence[Any],
        d: Sequence[Any],
        c: Sequence[Any],
        kept: Sequence[Any],
        h: Any,
    ) -> list[Any]:
        """Return the state after h seconds."""
        ...

    def read(self, x: Sequence[Any], c: Sequence[Any]) -> list[Any]:
        """Return the outputs."""
        ...


class Kernel:
    """Compiled equations.

    Parameters
    ----------
    equations : Equations

    Examples
    --------
    A leaky integrator, dx/dt = u - p x, by Euler's rule:

    >>> class Leak:
    ...     n_x, n_u, n_d, n_p = 1, 1, 0, 1
    ...     def prepare(self, p):
    ...         return list(p)
    ...     def renew(self, u, c, h):
    ...         return []
    ...     def advance(self, x, u, d, c, kept, h):
    ...         return [x[0] + h * (u[0] - c[0] * x[0])]
    ...     def read(self, x, c):
    ...         return [x[0]]
    >>> y, x_end = Kernel(Leak()).rollout(
    ...     np.zeros((2, 1)), np.ones((1, 3, 1)), np.zeros((1, 3, 0)), np.array([[0.0], [0.5]]), 1.0)
    >>> y[:, :, 0].tolist()
    [[0.0, 1.0, 2.0, 3.0], [0.0, 1.0, 1.5, 1.75]]
    """

    def __init__(self, equations: Equations) -> None:
        self.equations = equations
        written = _Writer(equations)
        self._n_y, self._n_kept = written.n_y, written.n_kept
        self._address = assemble(written.module)
        kinds = [ctypes.c_void_p] * 8 + [ctypes.c_int64] * 3 + [ctypes.c_double, ctypes.c_void_p]
        self._march = ctypes.CFUNCTYPE(None, *kinds)(self._address("march"))

    def rollout(
        self,
        x0: Array,
        u: Array,
        d: Array,
        p: Array,
        h: float,
        renew: NDArray[np.bool_] | None = None,
        pieces: int = 1,
    ) -> tuple[Array, Array]:
        """Simulate a batch.

        Parameters
        ----------
        x0 : (B, n_x) ndarray
            States at the first row.
        u, d : (B or 1, N, n_u), (B or 1, N, n_d) ndarray
            Inputs and disturbances, each row held for all its steps.
        p : (B or 1, n_p) ndarray
        h : float
            Step [s].
        renew : (N,) ndarray of bool, optional
            Rows at which a switch of some member has moved; all where absent.
        pieces : int, optional
            Steps in a row.

        Returns
        -------
        y : (B, N + 1, n_y) ndarray
            Outputs; row 0 is the output at x0.
        x_end : (B, n_x) ndarray
        """
        size, batch, n = self.equations, len(x0), u.shape[1]
        shapes = ((batch, size.n_x), (n, size.n_u), (n, size.n_d), (size.n_p,))
        if not all(a.shape[-len(s) :] == s and len(a) in (1, batch) for a, s in zip((x0, u, d, p), shapes)):
            raise ValueError(f"shapes {x0.shape}, {u.shape}, {d.shape}, {p.shape} do not belong together")
        moved = np.ones(n, dtype=np.uint8) if renew is None else renew.astype(np.uint8)
        arrays = [np.ascontiguousarray(a, dtype=float) for a in (x0, u, d, p)]
        n_block = -(-batch // WIDTH)
        # which entry of each array a lane begins at; the lanes beyond the last member repeat it
        member = np.minimum(np.arange(n_block * WIDTH), batch - 1).reshape(n_block, 1, WIDTH)
        stride = [a[0].size if len(a) > 1 else 0 for a in arrays]
        begin = np.ascontiguousarray(member * np.array(stride)[:, None])
        y, x_end = np.empty((self._n_y, n + 1, n_block * WIDTH)), np.empty((size.n_x, n_block * WIDTH))

        def run(block: int) -> None:
            room = np.empty((self._n_kept + 1) * WIDTH)
            self._march(
                *(a.ctypes.data for a in arrays),
                begin[block].ctypes.data,
                y.ctypes.data + block * ALIGNED,
                x_end.ctypes.data + block * ALIGNED,
                room.ctypes.data + -room.ctypes.data % ALIGNED,
                n,
                n_block * WIDTH,
                pieces,
                h,
                moved.ctypes.data,
            )

        if n_block == 1 or n < _WORTH_THREADS or _cores() == 1:
            for block in range(n_block):
                run(block)
        else:
            list(_threads().map(run, range(n_block)))
        return y.transpose(2, 1, 0)[:batch], x_end.T[:batch]


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_cores(), thread_name_prefix="rollout")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_threads.cache_clear)  # threads do not survive a fork


class _Writer:
    """Writes the function ``march``: a block of members through all rows."""

    def __init__(self, equations: Equations) -> None:
        numbers, whole = DOUBLE.as_pointer(), INTEGER.as_pointer()
        self.equations, self.module = equations, ir.Module("kernel")
        kinds = (
            [numbers] * 4 + [whole] + [numbers] * 3 + [INTEGER, INTEGER, INTEGER, DOUBLE, BYTE.as_pointer()]
        )
        self.march = ir.Function(self.module, ir.FunctionType(ir.VoidType(), kinds), "march")
        (
            x0,
            u,
            d,
            p,
            begin,
            self.y,
            self.x_end,
            self.room,
            self.n,
            self.columns,
            self.pieces,
            h,
            self.moved,
        ) = self.march.args
        for pointer in (x0, u, d, p, begin, self.y, self.x_end, self.room, self.moved):
            pointer.add_attribute("noalias")
        self.at = ir.IRBuilder(self.march.append_basic_block("entry"))
        self.h = spread(self.at, h)
        self.places = [self._places(array, begin, k) for k, array in enumerate((x0, u, d, p))]
        self.n_y, self.n_kept = 0, 0
        self._write()

    def _write(self) -> None:
        at, size = self.at, self.equations
        names = ("head", "check", "renew", "row", "piece", "after", "done")
        head, check, renew, row, piece, end, done = (self.march.append_basic_block(name) for name in names)
        c = size.prepare(self._row(3, size.n_p))
        first = self._row(0, size.n_x)
        rows = at.add(self.n, INTEGER(1))
        entry = at.block
        self.n_y = self._put(size.read(first, c), self.y, INTEGER(0), rows)
        at.branch(head)

        at.position_at_end(head)
        t, *state = self._phis(len(first))
        at.cbranch(at.icmp_signed("<", t, self.n), check, done)

        at.position_at_end(check)
        u = self._row(1, size.n_u, t)
        at.cbranch(at.icmp_signed("!=", at.load(at.gep(self.moved, [t])), BYTE(0)), renew, row)

        at.position_at_end(renew)
        kept = size.renew(u, c, self.h)
        self.n_kept = len(kept)
        for k, value in enumerate(kept):
            store(at, at.gep(self.room, [INTEGER(k * WIDTH)]), value, align=ALIGNED)
        at.branch(row)

        at.position_at_end(row)
        d = self._row(2, size.n_d, t)
        at.branch(piece)

        at.position_at_end(piece)
        m, *x = self._phis(len(first))
        known = load(at, self.room, self.n_kept)
        later = size.advance([Lanes(at, item) for item in x], u, d, c, known, self.h)
        count = at.add(m, INTEGER(1))
        self._come((m, *x), (INTEGER(0), *state), row)
        self._come((m, *x), (count, *later), piece)
        at.cbranch(at.icmp_signed("<", count, self.pieces), piece, end)

        at.position_at_end(end)
        after = at.add(t, INTEGER(1))
        self._put(size.read(later, c), self.y, after, rows)
        self._come((t, *state), (INTEGER(0), *first), entry)
        self._come((t, *state), (after, *later), end)
        at.branch(head)

        at.position_at_end(done)
        self._put(state, self.x_end, INTEGER(0), INTEGER(1))
        at.ret_void()

    def _phis(self, n: int) -> list[Any]:
        """Return a counter and n registers whose values depend on the block that one comes from."""
        return [self.at.phi(INTEGER), *(self.at.phi(VECTOR) for _ in range(n))]

    @staticmethod
    def _come(phis: Sequence[Any], values: Sequence[Any], block: Any) -> None:
        """Say what they are where one comes from ``block``."""
        for phi, value in zip(phis, values, strict=True):
            phi.add_incoming(register(value), block)

    def _places(self, array: Any, begin: Any, k: int) -> list[Any]:
        """Return where each lane's member begins in an array."""
        offsets = [self.at.load(self.at.gep(begin, [INTEGER(k * WIDTH + lane)])) for lane in range(WIDTH)]
        return [self.at.gep(array, [offset]) for offset in offsets]

    def _row(self, k: int, n: int, t: Any = _FIRST) -> list[Lanes]:
        """Return row t, of n entries, of the k-th array."""
        base = self.at.mul(t, INTEGER(n))
        return [gather(self.at, self.places[k], self.at.add(base, INTEGER(i))) for i in range(n)]

    def _put(self, values: Sequence[Any], array: Any, row: Any, length: Any) -> int:
        """Write values[m] to the block's columns of array[m, row]; return how many there are."""
        for m, value in enumerate(values):
            offset = self.at.mul(self.at.add(self.at.mul(INTEGER(m), length), row), self.columns)
            store(self.at, self.at.gep(array, [offset]), value)
        return len(values)
