"""A model's equations, compiled and run over a log for many parameter sets at once.

The equations come as functions on lists of numbers (:class:`Equations`). Each is called once, with
:class:`Vector` for numbers, and leaves its instructions in one function, which moves eight members of a batch
through a log, so that blocks of eight run on all cores as threads.  No branch may depend on a value: ``if
vector > 0`` raises.  A choice is ``np.where(vector > 0, a, b)``; this, ``np.interp`` and NumPy's elementary
functions work on vectors.
"""

from __future__ import annotations

import ctypes
import operator
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, lru_cache
from itertools import islice
from typing import Any

import numpy as np
from llvmlite import binding, ir
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array, Values
from thermogrip.sysid.models.model import Equations

#: Numbers side by side.
WIDTH = 8

DOUBLE = ir.DoubleType()
INTEGER = ir.IntType(64)
BYTE = ir.IntType(8)
VECTOR = ir.VectorType(DOUBLE, WIDTH)
BYTES = 8 * WIDTH  # of a register
_PLACE = ir.IntType(32)

_NO_BRANCH = "a compiled equation cannot branch on a value: no value is known yet"

# a product may be fused with a sum; a quotient may be a product with the reciprocal, so that what each step
# divides by (a capacity) is inverted once
_FUSED, _INVERTED = ("contract",), ("arcp",)


class Vector:
    """Eight numbers that will stand in a register."""

    __slots__ = ("builder", "register")

    def __init__(self, builder: ir.IRBuilder, register: Any) -> None:
        self.builder, self.register = builder, register

    def __add__(self, other: Any) -> Any:
        return self if _is(other, 0) else self._two("fadd", self, other, _FUSED)

    __radd__ = __add__

    def __sub__(self, other: Any) -> Any:
        return self if _is(other, 0) else self._two("fsub", self, other, _FUSED)

    def __rsub__(self, other: Any) -> Any:
        return self._two("fsub", other, self, _FUSED)

    def __mul__(self, other: Any) -> Any:
        if _is(other, 0):
            return 0.0
        return self if _is(other, 1) else self._two("fmul", self, other, _FUSED)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Any:
        return self if _is(other, 1) else self._two("fdiv", self, other, _INVERTED)

    def __rtruediv__(self, other: Any) -> Any:
        return self._two("fdiv", other, self, _INVERTED)

    def __neg__(self) -> Any:
        return self._two("fsub", -0.0, self, _FUSED)

    def __abs__(self) -> Any:
        return self._intrinsic("fabs")

    def __pow__(self, power: Any) -> Any:
        if _is(power, 0.5):
            return self._intrinsic("sqrt")
        if isinstance(power, Vector) or power not in range(1, 9):
            return _c_function("pow", self, power)
        half = self ** (power // 2) if power > 1 else 1.0
        return half * half * (self if power % 2 else 1.0)

    def __rpow__(self, base: Any) -> Any:
        return _c_function("pow", base, self)

    def __lt__(self, other: Any) -> Any:
        return self._compare("<", other)

    def __le__(self, other: Any) -> Any:
        return self._compare("<=", other)

    def __gt__(self, other: Any) -> Any:
        return self._compare(">", other)

    def __ge__(self, other: Any) -> Any:
        return self._compare(">=", other)

    def __bool__(self) -> bool:
        raise TypeError(_NO_BRANCH)

    def __array_ufunc__(self, function: Any, method: str, *inputs: Any, **options: Any) -> Any:
        return _elementary(function, method, inputs, options)

    def __array_function__(self, function: Any, _types: Any, inputs: Any, options: Any) -> Any:
        return _elementary(function, "__call__", inputs, options)

    def _two(self, instruction: str, a: Any, b: Any, flags: Sequence[str]) -> Any:
        # one instruction of LLVM for numbers that have no value yet: in what is compiled indices are looked
        # up, loops unrolled and products with a constant 0 or 1 gone
        result = getattr(self.builder, instruction)(register(a), register(b), flags=flags)
        return Vector(self.builder, result)

    def _intrinsic(self, name: str) -> Vector:
        kind = ir.FunctionType(VECTOR, [VECTOR])
        function = _declared(self.builder, f"llvm.{name}.v{WIDTH}f64", kind)
        return Vector(self.builder, self.builder.call(function, [self.register]))

    def _compare(self, how: str, other: Any) -> Mask:
        return Mask(self.builder, self.builder.fcmp_ordered(how, self.register, register(other)))


class Mask:
    """Eight truths that will stand in a register; for ``np.where``, ``&``, ``|`` and ``~``."""

    __slots__ = ("builder", "register")

    def __init__(self, builder: ir.IRBuilder, register: Any) -> None:
        self.builder, self.register = builder, register

    def __and__(self, other: Mask) -> Mask:
        return Mask(self.builder, self.builder.and_(self.register, other.register))

    def __or__(self, other: Mask) -> Mask:
        return Mask(self.builder, self.builder.or_(self.register, other.register))

    def __invert__(self) -> Mask:
        return Mask(self.builder, self.builder.not_(self.register))

    def __mul__(self, other: Any) -> Any:
        return _where(self, other, 0.0)

    __rmul__ = __mul__

    def __bool__(self) -> bool:
        raise TypeError(_NO_BRANCH)

    __array_ufunc__ = Vector.__array_ufunc__
    __array_function__ = Vector.__array_function__


def _declared(builder: ir.IRBuilder, name: str, kind: Any) -> Any:
    return builder.module.globals.get(name) or ir.Function(builder.module, kind, name)


def _c_function(name: str, *values: Any) -> Vector:
    """Return a function of the C library, of each number."""
    builder = next(value.builder for value in values if isinstance(value, Vector))
    function = _declared(builder, name, ir.FunctionType(DOUBLE, [DOUBLE] * len(values)))
    filled = ir.Constant(VECTOR, ir.Undefined)
    for k in range(WIDTH):
        numbers = [builder.extract_element(register(value), _PLACE(k)) for value in values]
        filled = builder.insert_element(filled, builder.call(function, numbers), _PLACE(k))
    return Vector(builder, filled)


def _where(condition: Any, a: Any, b: Any) -> Any:
    if not isinstance(condition, Mask):
        return a if condition else b
    return Vector(condition.builder, condition.builder.select(condition.register, register(a), register(b)))


def _maximum(a: Any, b: Any) -> Any:
    """Return the larger; what is not a number stays so, as in NumPy."""
    a, b = (a, b) if isinstance(a, Vector) else (b, a)
    lost = a.builder.fcmp_unordered("!=", a.register, a.register)
    return _where((a >= b) | Mask(a.builder, lost), a, b)


def _minimum(a: Any, b: Any) -> Any:
    return -_maximum(-a, -b)


def _interp(x: Any, places: Sequence[float], values: Sequence[float]) -> Any:
    """Return a table's value: its first, and what each piece between two of its places adds."""
    wide, high = np.diff(places).tolist(), np.diff(values).tolist()
    pieces = zip(places, wide, high)
    return values[0] + sum(
        height / width * _minimum(_maximum(x - place, 0.0), width) for place, width, height in pieces
    )


_OWN: dict[Any, Callable[..., Any]] = {
    np.add: operator.add,
    np.subtract: operator.sub,
    np.multiply: operator.mul,
    np.divide: operator.truediv,
    np.power: operator.pow,
    np.negative: operator.neg,
    np.absolute: operator.abs,
    np.square: lambda a: a * a,
    np.sign: lambda a: _where(a > 0.0, 1.0, _where(a < 0.0, -1.0, 0.0)),
    np.sqrt: lambda a: a**0.5,
    np.maximum: _maximum,
    np.minimum: _minimum,
    np.less: operator.lt,
    np.less_equal: operator.le,
    np.greater: operator.gt,
    np.greater_equal: operator.ge,
    np.logical_and: operator.and_,
    np.logical_or: operator.or_,
    np.logical_not: operator.invert,
    np.where: _where,
    np.interp: _interp,
    np.clip: lambda a, low, high: _minimum(_maximum(a, low), high),
}
_SHARED_OPERATIONS = (
    *("exp", "expm1", "log", "log1p", "log10", "sin", "cos", "tan"),
    *("sinh", "cosh", "tanh", "hypot", "cbrt"),
)
_LIBRARY = {getattr(np, name): name for name in _SHARED_OPERATIONS} | {np.arctan: "atan", np.arctan2: "atan2"}


def _elementary(function: Any, method: str, inputs: Values, options: dict[str, Any]) -> Any:
    """Return a function of NumPy, of vectors and plain numbers."""
    if method != "__call__" or options or not (function in _OWN or function in _LIBRARY):
        name = getattr(function, "__name__", function)
        raise TypeError(
            f"{name} of a value not known yet; there are the elementary functions, np.where and np.interp"
        )
    plain = [item.item() if isinstance(item, np.generic) else item for item in inputs]
    return _c_function(_LIBRARY[function], *plain) if function in _LIBRARY else _OWN[function](*plain)


def register(value: Any) -> Any:
    """Return the register of a vector, a register that holds a number eight times, or a register as it is."""
    if isinstance(value, Vector):
        return value.register
    if isinstance(value, Mask):  # a truth as 1 or 0
        return value.builder.uitofp(value.register, VECTOR)
    return value if isinstance(value, ir.Value) else ir.Constant(VECTOR, [float(value)] * WIDTH)


def store(builder: ir.IRBuilder, place: Any, value: Any) -> None:
    """Write one value to an address."""
    builder.store(register(value), builder.bitcast(place, VECTOR.as_pointer()), align=8)


def gather(builder: ir.IRBuilder, places: Values, index: Any) -> Vector:
    """Return a vector of the entries ``index`` of eight arrays."""
    filled = ir.Constant(VECTOR, ir.Undefined)
    for k, place in enumerate(places):
        number = builder.load(builder.gep(place, [index]))
        filled = builder.insert_element(filled, number, _PLACE(k))
    return Vector(builder, filled)


def spread(builder: ir.IRBuilder, number: Any) -> Vector:
    """Return a vector of one number."""
    first = builder.insert_element(ir.Constant(VECTOR, ir.Undefined), number, _PLACE(0))
    everywhere = ir.Constant(ir.VectorType(_PLACE, WIDTH), [0] * WIDTH)
    return Vector(builder, builder.shuffle_vector(first, ir.Constant(VECTOR, ir.Undefined), everywhere))


def assemble(module: ir.Module) -> Callable[[str], int]:
    """Return a function from the names in a module to the addresses of their machine code, which lives as
    long as that function."""
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    features = binding.get_host_cpu_features().flatten()
    target = binding.Target.from_triple(binding.get_process_triple())
    machine = target.create_target_machine(cpu=binding.get_host_cpu_name(), features=features, opt=3)
    checked = binding.parse_assembly(str(module))
    checked.verify()
    passes = binding.create_pass_builder(machine, binding.create_pipeline_tuning_options(speed_level=3))
    passes.getModulePassManager().run(checked, passes)
    engine = binding.create_mcjit_compiler(checked, machine)
    engine.finalize_object()
    address: Callable[[str], int] = engine.get_function_address  # a bound method: it keeps the engine
    return address


def _is(value: Any, number: float) -> bool:
    return not isinstance(value, Vector) and value == number


# Fewer steps of a block than this are done sooner than another thread takes over.
_WORTH_THREADS = 1000
_FIRST = INTEGER(0)


class Kernel:
    """Compiled equations."""

    def __init__(self, equations: Equations, *, in_pieces: bool = False) -> None:
        self.equations, self._in_pieces = equations, in_pieces
        written = _Writer(equations, in_pieces)
        self._n_y = written.n_y
        self._address = assemble(written.module)
        kinds = [ctypes.c_void_p] * 7 + [ctypes.c_int64] * 3 + [ctypes.c_double, ctypes.c_void_p]
        self._rollout = ctypes.CFUNCTYPE(None, *kinds)(self._address("rollout"))

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
        """Simulate a batch."""
        batch, n = len(x0), u.shape[1]
        n_x, n_u, n_d, n_p = self.equations.sizes
        ends = x0.shape[1:], u.shape[1:], d.shape[1:], p.shape[1:]
        lengths = len(u), len(d), len(p)
        if ends != ((n_x,), (n, n_u), (n, n_d), (n_p,)) or any(m not in (1, batch) for m in lengths):
            raise ValueError(f"shapes {x0.shape}, {u.shape}, {d.shape}, {p.shape} do not belong together")
        if pieces != 1 and not (self._in_pieces and pieces > 1):
            raise ValueError(f"not made for {pieces} steps in a row")
        moved = np.ones(n + 1, dtype=np.uint8)  # the row behind the last ends the loop
        if renew is not None:
            moved[:n] = renew
        arrays = [np.ascontiguousarray(a, dtype=float) for a in (x0, u, d, p)]
        n_block = -(-batch // WIDTH)
        entries = (x0[0].size, *(a[0].size if len(a) > 1 else 0 for a in arrays[1:]))
        begin = _entries(batch, entries if batch > 1 else (0,) * 4)
        y = np.empty((self._n_y, n + 1, n_block * WIDTH))
        x_end = np.empty((n_x, n_block * WIDTH))
        *addresses, to_y, to_end, to_moved, to_begin = (
            a.ctypes.data for a in (*arrays, y, x_end, moved, begin)
        )
        into = [
            (to_begin + k * begin[0].nbytes, to_y + k * BYTES, to_end + k * BYTES) for k in range(n_block)
        ]
        calls = [(*addresses, *places, n, n_block * WIDTH, pieces, h, to_moved) for places in into]
        if len(calls) == 1 or n < _WORTH_THREADS or _cores() == 1:
            for call in calls:
                self._rollout(*call)
        else:
            # without the interpreter's lock
            list(_threads().map(lambda call: self._rollout(*call), calls))
        return y.transpose(2, 1, 0)[:batch], x_end.T[:batch]


@lru_cache(maxsize=256)
def _entries(batch: int, own: tuple[int, ...]) -> NDArray[np.int64]:
    """Return by block which entry of each array a member begins at, where members have so many of their own
    there."""
    blocks = -(-batch // WIDTH)
    # places beyond the last member repeat it: a member's numbers do not depend on who its neighbours are
    member = np.minimum(np.arange(blocks * WIDTH), batch - 1).reshape(blocks, 1, WIDTH)
    return np.ascontiguousarray(member * np.array(own)[:, None])


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_cores(), thread_name_prefix="rollout")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_threads.cache_clear)  # threads do not survive a fork


class _Writer:
    """Writes the function ``rollout``: a block of members through all rows."""

    def __init__(self, equations: Equations, in_pieces: bool) -> None:
        numbers, whole = DOUBLE.as_pointer(), INTEGER.as_pointer()
        self.equations = equations
        self.in_pieces = in_pieces
        self.module = ir.Module("kernel")
        last = [INTEGER, INTEGER, INTEGER, DOUBLE, BYTE.as_pointer()]
        kind = ir.FunctionType(ir.VoidType(), [numbers] * 4 + [whole] + [numbers] * 2 + last)
        self.function = ir.Function(self.module, kind, "rollout")
        x0, u, d, p, begin, self.y, self.x_end, *more = self.function.args
        self.n, self.columns, self.pieces, h, self.moved = more
        for pointer in (x0, u, d, p, begin, self.y, self.x_end, self.moved):
            pointer.add_attribute("noalias")
        self.at = ir.IRBuilder(self.function.append_basic_block("entry"))
        self.h = spread(self.at, h)
        members = (self.at.load(self.at.gep(begin, [INTEGER(k)])) for k in range(4 * WIDTH))
        self.places = [
            [self.at.gep(array, [offset]) for offset in islice(members, WIDTH)] for array in (x0, u, d, p)
        ]
        self.n_y = 0
        self._write()

    def _write(self) -> None:
        builder, steps = self.at, self.equations
        n_x, n_u, n_d, n_p = steps.sizes
        head, renew, step, done = (
            self.function.append_basic_block(name) for name in ("head", "renew", "step", "done")
        )
        # c = prepare(p), and y_0
        c = steps.prepare(self._row(3, n_p))
        first = self._row(0, n_x)
        rows = builder.add(self.n, INTEGER(1))
        entry = builder.block
        self.n_y = self._put(steps.read(first, c), self.y, INTEGER(0), rows)
        builder.branch(head)

        builder.position_at_end(head)
        begin, state = builder.phi(INTEGER), [builder.phi(VECTOR) for _ in first]
        builder.cbranch(builder.icmp_signed("<", begin, self.n), renew, done)

        builder.position_at_end(renew)
        # if a switch has moved: kept = renew(u_t, c, h)
        switched = steps.renew(self._row(1, n_u, begin), c, self.h)
        builder.branch(step)

        builder.position_at_end(step)
        t = builder.phi(INTEGER)
        piece = builder.phi(INTEGER)
        x = [builder.phi(VECTOR) for _ in first]
        u, d = self._row(1, n_u, t), self._row(2, n_d, t)
        # m times x = advance(x, u_t, d_t, c, kept, h), then y_(t+1) = read(x, c)
        later = steps.advance([Vector(builder, item) for item in x], u, d, c, switched, self.h)
        after, count = builder.add(t, INTEGER(1)), builder.add(piece, INTEGER(1))
        self._put(steps.read(later, c), self.y, after, rows)  # the last piece has the last word
        last = builder.icmp_signed(">=", count, self.pieces if self.in_pieces else INTEGER(1))
        moved = builder.icmp_signed("!=", builder.load(builder.gep(self.moved, [after])), BYTE(0))
        following = builder.select(last, after, t), builder.select(last, INTEGER(0), count)
        builder.cbranch(builder.and_(last, moved), head, step)

        for phi, came, value in zip([begin, *state], [INTEGER(0), *first], [after, *later], strict=True):
            phi.add_incoming(register(came), entry)
            phi.add_incoming(register(value), step)
        for phi, came, value in zip(
            [t, piece, *x], [begin, INTEGER(0), *state], [*following, *later], strict=True
        ):
            phi.add_incoming(register(came), renew)
            phi.add_incoming(register(value), step)

        builder.position_at_end(done)
        self._put(state, self.x_end, INTEGER(0), INTEGER(1))
        builder.ret_void()

    def _row(self, k: int, n: int, t: Any = _FIRST) -> list[Vector]:
        """Return row t, of n entries, of the k-th array."""
        base = self.at.mul(t, INTEGER(n))
        return [gather(self.at, self.places[k], self.at.add(base, INTEGER(i))) for i in range(n)]

    def _put(self, values: Values, array: Any, row: Any, length: Any) -> int:
        """Write values[m] to the block's columns of array[m, row]; return their number."""
        for m, value in enumerate(values):
            offset = self.at.mul(self.at.add(self.at.mul(INTEGER(m), length), row), self.columns)
            store(self.at, self.at.gep(array, [offset]), value)
        return len(values)
