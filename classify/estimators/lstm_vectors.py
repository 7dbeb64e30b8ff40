r"""Registers of a processor, from numba: small matrix products and the gates of an LSTM cell.

An LSTM of 32 units spends its time in products of 100 x 33 by 33 x 128 numbers.  What is added up there fits
into registers: a block of R rows and V vectors of the result stays in them while k runs,

    acc[r, v] += a[r, k] * b[k, v],        r < R, v < V,

so that each pair of loads feeds many multiplications.  numba's own loops write the result back to memory
in every step and reach a quarter of that speed.  Here the instructions are written out (LLVM's, through
numba's ``intrinsic``); LLVM turns a vector into what the machine has.

The logistic function and tanh are one function, :math:`\sigma(x) = (1 + \tanh(x / 2)) / 2`, and

.. math:: \tanh x \approx x\, p(x^2) / q(x^2), \qquad |x| \le 8,

with p and q of degree 5, fitted to the least largest error (7e-12; single precision rounds to 4e-7).

Everything here works on single and on double precision; indices are offsets into the arrays' memory, which
must be contiguous.  Nothing is checked.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import binding, ir
from numba.core import types
from numba.extending import intrinsic

__all__ = ["LANE_BYTES", "ROWS", "VECTORS", "add_product", "close_gates", "open_gates", "set_product"]

_WIDE = bool(binding.get_host_cpu_features().get("avx512f", False))
#: Bytes of a vector: a register of AVX-512, one of AVX2, two of SSE or NEON.
LANE_BYTES = 64 if _WIDE else 32
#: A block of a product, in rows and in vectors: ten sums, which 16 registers hold beside what is multiplied.
ROWS, VECTORS = 5, 2

_EDGE = 8.0
_P = (
    0.999999999961891,
    0.141326880310313,
    0.00447073633347869,
    4.34432993018181e-05,
    1.18083527909079e-07,
    4.12633229733103e-11,
)
_Q = (
    1,
    0.474660213444082,
    0.0293574744510156,
    0.000509493393128057,
    2.71382146857782e-06,
    3.21269610168264e-09,
)

_PLACE = ir.IntType(32)
_FUSED = ("contract",)  # a product and a sum in one instruction, where the machine has it


class _Vectors:
    """Writes vector instructions for one kind of number."""

    def __init__(self, builder: ir.IRBuilder, real: Any) -> None:
        self.builder, self.size = builder, 4 if isinstance(real, ir.FloatType) else 8
        self.lanes = LANE_BYTES // self.size
        self.kind = ir.VectorType(real, self.lanes)

    def load(self, place: Any) -> Any:
        value = self.builder.load(self.builder.bitcast(place, self.kind.as_pointer()))
        value.align = self.size
        return value

    def store(self, value: Any, place: Any) -> None:
        self.builder.store(value, self.builder.bitcast(place, self.kind.as_pointer())).align = self.size

    def number(self, value: float) -> Any:
        return ir.Constant(self.kind, [value] * self.lanes)

    def spread(self, number: Any) -> Any:
        """Return a vector that holds one number in all places."""
        blank = ir.Constant(self.kind, ir.Undefined)
        everywhere = ir.Constant(ir.VectorType(_PLACE, self.lanes), [0] * self.lanes)
        return self.builder.shuffle_vector(
            self.builder.insert_element(blank, number, _PLACE(0)), blank, everywhere
        )

    def mul(self, a: Any, b: Any) -> Any:
        return self.builder.fmul(a, b, flags=_FUSED)

    def add(self, a: Any, b: Any) -> Any:
        return self.builder.fadd(a, b, flags=_FUSED)

    def fused(self, a: Any, b: Any, c: Any) -> Any:
        """Return a b + c."""
        return self.add(self.mul(a, b), c)

    def slope(self, s: Any) -> Any:
        """Return s (1 - s), the derivative of the logistic function."""
        return self.mul(s, self.builder.fsub(self.number(1.0), s))

    def tanh(self, x: Any) -> Any:
        b = self.builder
        for limit, outside in ((_EDGE, ">"), (-_EDGE, "<")):
            edge = self.number(limit)
            x = b.select(b.fcmp_ordered(outside, x, edge), edge, x)
        y = self.mul(x, x)
        return b.fdiv(self.mul(x, self._polynomial(y, _P)), self._polynomial(y, _Q))

    def logistic(self, x: Any) -> Any:
        half = self.number(0.5)
        return self.fused(half, self.tanh(self.mul(half, x)), half)

    def _polynomial(self, y: Any, coefficients: tuple[float, ...]) -> Any:
        total = self.number(coefficients[-1])
        for c in reversed(coefficients[:-1]):
            total = self.fused(total, y, self.number(c))
        return total


def _place(context: Any, builder: ir.IRBuilder, kind: Any, array: Any, offset: Any) -> Any:
    """Return the address of an entry of an array."""
    return builder.gep(context.make_array(kind)(context, builder, array).data, [offset])


def _counted(builder: ir.IRBuilder, stop: Any, step: int, body: Callable[[Any], None]) -> None:
    """Write a loop over 0, step, ... below ``stop``, which is run at least once."""
    before = builder.block
    loop, after = builder.append_basic_block(), builder.append_basic_block()
    builder.branch(loop)
    builder.position_at_end(loop)
    index = builder.phi(stop.type)
    index.add_incoming(stop.type(0), before)
    body(index)
    following = builder.add(index, stop.type(step))
    index.add_incoming(following, builder.block)
    builder.cbranch(builder.icmp_signed("<", following, stop), loop, after)
    builder.position_at_end(after)


def _product(keep: bool) -> Callable[..., Any]:
    """Return an intrinsic for a block of C = A B, or of C + A B where ``keep``.

    C begins at ``c0`` and has rows ``ldc`` apart; A[r, k] is at ``a0 + r a_row + k a_k``, row k of B at
    ``b0 + k ldb``.
    """

    def typed(
        _: Any,
        C: Any,
        c0: Any,
        ldc: Any,
        A: Any,
        a0: Any,
        a_row: Any,
        a_k: Any,
        B: Any,
        b0: Any,
        ldb: Any,
        n: Any,
    ) -> Any:
        at = types.intp
        return types.void(C, at, at, A, at, at, at, B, at, at, at), written

    def written(context: Any, builder: ir.IRBuilder, of: Any, args: Any) -> Any:
        C, c0, ldc, A, a0, a_row, a_k, B, b0, ldb, n = args
        v = _Vectors(builder, context.get_data_type(of.args[0].dtype))
        c = _place(context, builder, of.args[0], C, c0)
        a = _place(context, builder, of.args[3], A, a0)
        b = _place(context, builder, of.args[7], B, b0)
        places = [
            builder.gep(c, [builder.add(builder.mul(ldc, n.type(r)), n.type(j * v.lanes))])
            for r in range(ROWS)
            for j in range(VECTORS)
        ]
        first = [v.load(p) if keep else v.number(0.0) for p in places]
        for place, total in zip(places, _summed(v, first, (a, a_row, a_k), (b, ldb), n)):
            v.store(total, place)
        return context.get_dummy_value()

    return intrinsic(typed)  # type: ignore[no-any-return]


def _summed(v: _Vectors, first: list[Any], a: tuple[Any, Any, Any], b: tuple[Any, Any], n: Any) -> list[Any]:
    """Write the loop over k; return the sums after it."""
    builder, before, index = v.builder, v.builder.block, n.type
    loop, after = builder.append_basic_block(), builder.append_basic_block()
    builder.branch(loop)
    builder.position_at_end(loop)
    k = builder.phi(index)
    k.add_incoming(index(0), before)
    sums = [builder.phi(v.kind) for _ in first]
    for total, value in zip(sums, first):
        total.add_incoming(value, before)
    (a_at, a_row, a_k), (b_at, ldb) = a, b
    row = builder.gep(b_at, [builder.mul(k, ldb)])
    right = [v.load(builder.gep(row, [index(j * v.lanes)])) for j in range(VECTORS)]
    column = builder.gep(a_at, [builder.mul(k, a_k)])
    new = []
    for r in range(ROWS):
        left = v.spread(builder.load(builder.gep(column, [builder.mul(a_row, index(r))])))
        new += [v.fused(left, right[j], sums[r * VECTORS + j]) for j in range(VECTORS)]
    following = builder.add(k, index(1))
    k.add_incoming(following, loop)
    for total, value in zip(sums, new):
        total.add_incoming(value, loop)
    builder.cbranch(builder.icmp_signed("<", following, n), loop, after)
    builder.position_at_end(after)
    return new


set_product, add_product = _product(keep=False), _product(keep=True)


@intrinsic  # type: ignore[untyped-decorator]
def open_gates(
    _: Any, G: Any, g0: Any, C: Any, c0: Any, c1: Any, T: Any, t0: Any, X: Any, h0: Any, n: Any
) -> Any:
    """Turn a row of sums at ``g0`` into gates i, f, g, o; write the cell at ``c1``, its tanh and the state.

    c1 = f c0 + i g, T = tanh c1, h = o T, each of n units.
    """
    at = types.intp
    return types.void(G, at, C, at, at, T, at, X, at, at), _write_open


def _write_open(context: Any, builder: ir.IRBuilder, of: Any, args: Any) -> Any:
    G, g0, C, c0, c1, T, t0, X, h0, n = args
    v = _Vectors(builder, context.get_data_type(of.args[0].dtype))
    gates = _place(context, builder, of.args[0], G, g0)
    old, new = (_place(context, builder, of.args[2], C, c) for c in (c0, c1))
    tanh_c = _place(context, builder, of.args[5], T, t0)
    state = _place(context, builder, of.args[7], X, h0)

    def body(j: Any) -> None:
        at = [builder.gep(gates, [builder.add(j, builder.mul(n, n.type(q)))]) for q in range(4)]
        i, f, o = (v.logistic(v.load(at[q])) for q in (0, 1, 3))
        g = v.tanh(v.load(at[2]))
        cell = v.fused(f, v.load(builder.gep(old, [j])), v.mul(i, g))
        squashed = v.tanh(cell)
        for place, value in zip(at, (i, f, g, o)):
            v.store(value, place)
        v.store(cell, builder.gep(new, [j]))
        v.store(squashed, builder.gep(tanh_c, [j]))
        v.store(v.mul(o, squashed), builder.gep(state, [j]))

    _counted(builder, n, v.lanes, body)
    return context.get_dummy_value()


@intrinsic  # type: ignore[untyped-decorator]
def close_gates(
    _: Any, G: Any, g0: Any, C: Any, c0: Any, T: Any, t0: Any, H: Any, h0: Any, D: Any, d0: Any, n: Any
) -> Any:
    """Turn a row of gates at ``g0`` into the slopes of the loss by the sums before them.

    H holds the slope by the state and D the slope by the cell from the step after; D is replaced by that by
    the cell before, c0.
    """
    at = types.intp
    return types.void(G, at, C, at, T, at, H, at, D, at, at), _write_close


def _write_close(context: Any, builder: ir.IRBuilder, of: Any, args: Any) -> Any:
    G, g0, C, c0, T, t0, H, h0, D, d0, n = args
    v = _Vectors(builder, context.get_data_type(of.args[0].dtype))
    gates = _place(context, builder, of.args[0], G, g0)
    old = _place(context, builder, of.args[2], C, c0)
    tanh_c = _place(context, builder, of.args[4], T, t0)
    by_state = _place(context, builder, of.args[6], H, h0)
    by_cell = _place(context, builder, of.args[8], D, d0)

    def body(j: Any) -> None:
        at = [builder.gep(gates, [builder.add(j, builder.mul(n, n.type(q)))]) for q in range(4)]
        i, f, g, o = (v.load(place) for place in at)
        s, dh = v.load(builder.gep(tanh_c, [j])), v.load(builder.gep(by_state, [j]))
        one, cell = v.number(1.0), builder.gep(by_cell, [j])
        dc = v.fused(v.mul(dh, o), builder.fsub(one, v.mul(s, s)), v.load(cell))
        v.store(v.mul(v.mul(dc, g), v.slope(i)), at[0])
        v.store(v.mul(v.mul(dc, v.load(builder.gep(old, [j]))), v.slope(f)), at[1])
        v.store(v.mul(v.mul(dc, i), builder.fsub(one, v.mul(g, g))), at[2])
        v.store(v.mul(v.mul(dh, s), v.slope(o)), at[3])
        v.store(v.mul(dc, f), cell)

    _counted(builder, n, v.lanes, body)
    return context.get_dummy_value()
