"""Plain arithmetic, written down as machine code while it runs.

A processor multiplies eight numbers as fast as one.  :class:`Lanes` stands for eight of them in a register,
one for each of eight parameter sets.  It has no value; each ``+ - * /`` on it appends one instruction of
LLVM.  So equations that are called once with lanes in place of numbers,

    q[i] = q[i] + g[k] * (z[j] - z[i]),

leave behind a straight line of instructions: which i, j and k belong together has been looked up, loops are
unrolled, products with a constant 0 or 1 are gone.  LLVM turns the line into what the machine has (a register
of AVX-512, two of AVX2, four of SSE2 or NEON).  For a network of 28 states all this takes 0.2 s, and no
compiler beside llvmlite, which is a Python package.

No branch may depend on a value, for none is known: ``if lanes > 0`` raises.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import binding, ir

__all__ = [
    "ALIGNED",
    "BYTE",
    "DOUBLE",
    "INTEGER",
    "VECTOR",
    "WIDTH",
    "Lanes",
    "assemble",
    "gather",
    "load",
    "register",
    "spread",
    "store",
]

#: Numbers side by side.
WIDTH = 8

DOUBLE, INTEGER, BYTE = ir.DoubleType(), ir.IntType(64), ir.IntType(8)
VECTOR = ir.VectorType(DOUBLE, WIDTH)
ALIGNED = 8 * WIDTH  # bytes
_PLACE = ir.IntType(32)

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
        name = f"llvm.fabs.v{WIDTH}f64"
        known = self.builder.module.globals.get(name)
        function = known or ir.Function(self.builder.module, ir.FunctionType(VECTOR, [VECTOR]), name)
        return Lanes(self.builder, self.builder.call(function, [self.register]))

    def __bool__(self) -> bool:
        raise TypeError("a compiled equation cannot branch on a value: no value is known yet")

    def _two(self, instruction: str, a: Any, b: Any, flags: Sequence[str]) -> Any:
        result = getattr(self.builder, instruction)(register(a), register(b), flags=flags)
        return Lanes(self.builder, result)


def register(value: Any) -> Any:
    """Return the register of lanes, a register that holds a number eight times, or a register as it is."""
    if isinstance(value, Lanes):
        return value.register
    return value if isinstance(value, ir.Value) else ir.Constant(VECTOR, [float(value)] * WIDTH)


def load(builder: ir.IRBuilder, place: Any, n: int) -> list[Any]:
    """Return ``n`` lanes in a row from an address that is a multiple of ``ALIGNED`` bytes."""
    base = builder.bitcast(place, VECTOR.as_pointer())
    found = [builder.load(builder.gep(base, [INTEGER(i)]), align=ALIGNED) for i in range(n)]
    return [Lanes(builder, item) for item in found]


def store(builder: ir.IRBuilder, place: Any, value: Any, *, align: int = 8) -> None:
    """Write one value to an address."""
    builder.store(register(value), builder.bitcast(place, VECTOR.as_pointer()), align=align)


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
    return not isinstance(value, Lanes) and math.isclose(value, number, rel_tol=0.0, abs_tol=0.0)
