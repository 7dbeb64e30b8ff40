"""A model's equations, compiled and run over a log for many parameter sets at once.

The equations come as three functions on lists of numbers (:class:`Equations`): what depends on the parameters
alone, what depends on a switch besides, and the step.  Each is called once, with
:class:`~thermogrip.sysid.models.jit_simd.Lanes` for numbers, and leaves its instructions in one function,

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

from thermogrip.sysid.models.jit_simd import (
    BYTE,
    BYTES,
    DOUBLE,
    INTEGER,
    VECTOR,
    WIDTH,
    Lanes,
    assemble,
    gather,
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
    in_pieces : bool, optional
        Whether a row may be held for several steps; a kernel that need not count them is a fifth faster.

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

    def __init__(self, equations: Equations, *, in_pieces: bool = False) -> None:
        self.equations, self._in_pieces = equations, in_pieces
        written = _Writer(equations, in_pieces)
        self._n_y = written.n_y
        self._address = assemble(written.module)
        kinds = [ctypes.c_void_p] * 7 + [ctypes.c_int64] * 3 + [ctypes.c_double, ctypes.c_void_p]
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
            Steps in a row, if the kernel is made for it.

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
        if pieces != 1 and not (self._in_pieces and pieces > 1):
            raise ValueError(f"not made for {pieces} steps in a row")
        moved = np.ones(n + 1, dtype=np.uint8)  # the row behind the last ends the loop
        if renew is not None:
            moved[:n] = renew
        arrays = [np.ascontiguousarray(a, dtype=float) for a in (x0, u, d, p)]
        n_block = -(-batch // WIDTH)
        # which entry of each array a lane begins at; the lanes beyond the last member repeat it
        member = np.minimum(np.arange(n_block * WIDTH), batch - 1).reshape(n_block, 1, WIDTH)
        stride = [a[0].size if len(a) > 1 else 0 for a in arrays]
        begin = np.ascontiguousarray(member * np.array(stride)[:, None])
        y, x_end = np.empty((self._n_y, n + 1, n_block * WIDTH)), np.empty((size.n_x, n_block * WIDTH))

        def run(block: int) -> None:
            self._march(
                *(a.ctypes.data for a in arrays),
                begin[block].ctypes.data,
                y.ctypes.data + block * BYTES,
                x_end.ctypes.data + block * BYTES,
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

    def __init__(self, equations: Equations, in_pieces: bool) -> None:
        numbers, whole = DOUBLE.as_pointer(), INTEGER.as_pointer()
        self.equations, self.in_pieces, self.module = equations, in_pieces, ir.Module("kernel")
        last = [INTEGER, INTEGER, INTEGER, DOUBLE, BYTE.as_pointer()]
        kind = ir.FunctionType(ir.VoidType(), [numbers] * 4 + [whole] + [numbers] * 2 + last)
        self.march = ir.Function(self.module, kind, "march")
        x0, u, d, p, begin, self.y, self.x_end, *more = self.march.args
        self.n, self.columns, self.pieces, h, self.moved = more
        for pointer in (x0, u, d, p, begin, self.y, self.x_end, self.moved):
            pointer.add_attribute("noalias")
        self.at = ir.IRBuilder(self.march.append_basic_block("entry"))
        self.h = spread(self.at, h)
        self.places = [self._places(array, begin, k) for k, array in enumerate((x0, u, d, p))]
        self.n_y = 0
        self._write()

    def _write(self) -> None:
        at, size = self.at, self.equations
        head, renew, step, done = (
            self.march.append_basic_block(name) for name in ("head", "renew", "step", "done")
        )
        c = size.prepare(self._row(3, size.n_p))
        first = self._row(0, size.n_x)
        rows = at.add(self.n, INTEGER(1))
        entry = at.block
        self.n_y = self._put(size.read(first, c), self.y, INTEGER(0), rows)
        at.branch(head)

        at.position_at_end(head)
        begin, state = at.phi(INTEGER), [at.phi(VECTOR) for _ in first]
        at.cbranch(at.icmp_signed("<", begin, self.n), renew, done)

        at.position_at_end(renew)
        kept = size.renew(self._row(1, size.n_u, begin), c, self.h)
        at.branch(step)

        at.position_at_end(step)
        t, piece, x = at.phi(INTEGER), at.phi(INTEGER), [at.phi(VECTOR) for _ in first]
        u, d = self._row(1, size.n_u, t), self._row(2, size.n_d, t)
        later = size.advance([Lanes(at, item) for item in x], u, d, c, kept, self.h)
        after, count = at.add(t, INTEGER(1)), at.add(piece, INTEGER(1))
        self._put(size.read(later, c), self.y, after, rows)  # the last piece has the last word
        last = at.icmp_signed(">=", count, self.pieces if self.in_pieces else INTEGER(1))
        moved = at.icmp_signed("!=", at.load(at.gep(self.moved, [after])), BYTE(0))
        following = at.select(last, after, t), at.select(last, INTEGER(0), count)
        at.cbranch(at.and_(last, moved), head, step)

        for phi, came, value in zip([begin, *state], [INTEGER(0), *first], [after, *later], strict=True):
            phi.add_incoming(register(came), entry)
            phi.add_incoming(register(value), step)
        for phi, came, value in zip(
            [t, piece, *x], [begin, INTEGER(0), *state], [*following, *later], strict=True
        ):
            phi.add_incoming(register(came), renew)
            phi.add_incoming(register(value), step)

        at.position_at_end(done)
        self._put(state, self.x_end, INTEGER(0), INTEGER(1))
        at.ret_void()

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
