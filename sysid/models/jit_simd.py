"""Plain arithmetic, written down as machine code while it runs.

A processor multiplies eight numbers as fast as one.  :class:`Lanes` stands for eight of them in a register,
one for each of eight parameter sets.  It has no value; each ``+ - * /`` on it appends one instruction of
LLVM.  So equations that are called once with lanes in place of numbers,

    q[i] = q[i] + g[k] * (z[j] - z[i]),

leave behind a straight line of instructions: which i, j and k belong together has been looked up, loops are
unrolled, products with a constant 0 or 1 are gone.  LLVM turns the line into what the machine has (a register
of AVX-512, two of AVX2, four of SSE2 or NEON).  For a network of 28 states all this takes 0.2 s, and no
compiler beside llvmlite, which is a Python package.

No branch may depend on a value, for none is known: ``if lanes > 0`` raises.  A choice is
``np.where(lanes > 0, a, b)``; this, ``np.interp`` and NumPy's elementary functions work on lanes, so that
equations meant for arrays do as well.  What processors lack (exp, sin, ...) is the C library's, called number
by number.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import binding, ir

__all__ = [
    "BYTE",
    "BYTES",
    "DOUBLE",
    "INTEGER",
    "VECTOR",
    "WIDTH",
    "Lanes",
    "Mask",
    "assemble",
    "gather",
    "register",
    "spread",
    "store",
]

#: Numbers side by side.
WIDTH = 8

DOUBLE, INTEGER, BYTE = ir.DoubleType(), ir.IntType(64), ir.IntType(8)
VECTOR = ir.VectorType(DOUBLE, WIDTH)
BYTES = 8 * WIDTH  # of a register
_PLACE = ir.IntType(32)

_NO_BRANCH = "a compiled equation cannot branch on a value: no value is known yet"

# a product may be fused with a sum; a quotient may be a product with the reciprocal, so that what each step
# divides by (a capacity) is inverted once
_FUSED, _INVERTED = ("contract",), ("arcp",)


class Lanes:
    """Eight numbers that will stand in a register.

    Parameters
    ----------
    builder : ir.IRBuilder
        Writes the instructions.
    register : ir.Value
        What the last one left.

    Examples
    --------
    >>> function = ir.Function(ir.Module(), ir.FunctionType(ir.VoidType(), [DOUBLE]), "f")
    >>> x = spread(ir.IRBuilder(function.append_basic_block()), function.args[0])
    >>> [value.register.opname for value in (x + 3.0, 1.0 - x, np.where(x > 0.0, x, 0.0))]
    ['fadd', 'fsub', 'select']
    >>> 1.0 * x is x, 0.0 * x
    (True, 0.0)
    """

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
        if isinstance(power, Lanes) or power not in range(1, 9):
            return _library("pow", self, power)
        half = self ** (power // 2) if power > 1 else 1.0
        return half * half * (self if power % 2 else 1.0)

    def __rpow__(self, base: Any) -> Any:
        return _library("pow", base, self)

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
        result = getattr(self.builder, instruction)(register(a), register(b), flags=flags)
        return Lanes(self.builder, result)

    def _intrinsic(self, name: str) -> Lanes:
        kind = ir.FunctionType(VECTOR, [VECTOR])
        function = _declared(self.builder, f"llvm.{name}.v{WIDTH}f64", kind)
        return Lanes(self.builder, self.builder.call(function, [self.register]))

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

    __array_ufunc__ = Lanes.__array_ufunc__
    __array_function__ = Lanes.__array_function__


def _declared(builder: ir.IRBuilder, name: str, kind: Any) -> Any:
    return builder.module.globals.get(name) or ir.Function(builder.module, kind, name)


def _library(name: str, *values: Any) -> Lanes:
    """Return a function of the C library, of each number."""
    builder = next(value.builder for value in values if isinstance(value, Lanes))
    function = _declared(builder, name, ir.FunctionType(DOUBLE, [DOUBLE] * len(values)))
    filled = ir.Constant(VECTOR, ir.Undefined)
    for lane in range(WIDTH):
        numbers = [builder.extract_element(register(value), _PLACE(lane)) for value in values]
        filled = builder.insert_element(filled, builder.call(function, numbers), _PLACE(lane))
    return Lanes(builder, filled)


def _where(condition: Any, a: Any, b: Any) -> Any:
    if not isinstance(condition, Mask):
        return a if condition else b
    return Lanes(condition.builder, condition.builder.select(condition.register, register(a), register(b)))


def _maximum(a: Any, b: Any) -> Any:
    """Return the larger; what is not a number stays so, as in NumPy."""
    a, b = (a, b) if isinstance(a, Lanes) else (b, a)
    lost = a.builder.fcmp_unordered("!=", a.register, a.register)
    return _where((a >= b) | Mask(a.builder, lost), a, b)


def _minimum(a: Any, b: Any) -> Any:
    return -_maximum(-a, -b)


def _interp(x: Any, places: Sequence[float], values: Sequence[float]) -> Any:
    """Return a table's value: its first, and what each piece between two of its places adds."""
    wide, high = np.diff(places).tolist(), np.diff(values).tolist()
    pieces = zip(places, wide, high)
    return values[0] + sum(h / w * _minimum(_maximum(x - at, 0.0), w) for at, w, h in pieces)


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
_SAME = (
    "exp",
    "expm1",
    "log",
    "log1p",
    "log10",
    "sin",
    "cos",
    "tan",
    "sinh",
    "cosh",
    "tanh",
    "hypot",
    "cbrt",
)
_LIBRARY = {getattr(np, name): name for name in _SAME} | {np.arctan: "atan", np.arctan2: "atan2"}


def _elementary(function: Any, method: str, inputs: Sequence[Any], options: dict[str, Any]) -> Any:
    """Return a function of NumPy, of lanes and plain numbers."""
    if method != "__call__" or options or not (function in _OWN or function in _LIBRARY):
        name = getattr(function, "__name__", function)
        raise TypeError(
            f"{name} of a value not known yet; there are the elementary functions, np.where and np.interp"
        )
    plain = [item.item() if isinstance(item, np.generic) else item for item in inputs]
    return _library(_LIBRARY[function], *plain) if function in _LIBRARY else _OWN[function](*plain)


def register(value: Any) -> Any:
    """Return the register of lanes, a register that holds a number eight times, or a register as it is."""
    if isinstance(value, Lanes):
        return value.register
    if isinstance(value, Mask):  # a truth as 1 or 0
        return value.builder.uitofp(value.register, VECTOR)
    return value if isinstance(value, ir.Value) else ir.Constant(VECTOR, [float(value)] * WIDTH)


def store(builder: ir.IRBuilder, place: Any, value: Any) -> None:
    """Write one value to an address."""
    builder.store(register(value), builder.bitcast(place, VECTOR.as_pointer()), align=8)


def gather(builder: ir.IRBuilder, places: Sequence[Any], index: Any) -> Lanes:
    """Return lanes of which each is the entry ``index`` of its own array."""
    filled = ir.Constant(VECTOR, ir.Undefined)
    for lane, place in enumerate(places):
        number = builder.load(builder.gep(place, [index]))
        filled = builder.insert_element(filled, number, _PLACE(lane))
    return Lanes(builder, filled)


def spread(builder: ir.IRBuilder, number: Any) -> Lanes:
    """Return one number on all lanes."""
    first = builder.insert_element(ir.Constant(VECTOR, ir.Undefined), number, _PLACE(0))
    everywhere = ir.Constant(ir.VectorType(_PLACE, WIDTH), [0] * WIDTH)
    return Lanes(builder, builder.shuffle_vector(first, ir.Constant(VECTOR, ir.Undefined), everywhere))


def assemble(module: ir.Module) -> Callable[[str], int]:
    """Return a function from the names in a module to the addresses of their machine code.

    The code lives as long as what is returned here.
    """
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
    return not isinstance(value, Lanes) and value == number
