"""A model's equations, compiled and run over a log for many parameter sets at once.

CasADi writes a step down as a list of instructions, and each becomes one of LLVM for eight numbers side by
side.  The machine code moves eight members of a batch through a log, so that blocks of eight run on all cores
as threads.  What depends on parameters alone is done before the first row, what depends on switches besides
where one of them moves: LLVM takes both out of the loop over rows.  No branch may depend on a value: a choice
is ``np.where(a > 0, a, b)``.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from itertools import islice
from typing import Any

import casadi as ca
import numpy as np
from llvmlite import binding, ir
from numpy.typing import ArrayLike

from thermogrip.sysid.models.model import Output, Run, Sizes, Step, Values

#: Numbers side by side.
WIDTH = 8

DOUBLE = ir.DoubleType()
INTEGER = ir.IntType(64)
BYTE = ir.IntType(8)
VECTOR = ir.VectorType(DOUBLE, WIDTH)
_PLACE = ir.IntType(32)

# a product may be fused with a sum; a quotient may be a product with the reciprocal, so that what each step
# divides by (a capacity) is inverted once
_FUSED, _INVERTED = ("contract",), ("arcp",)


def _constant(number: float) -> Any:
    return ir.Constant(VECTOR, [float(number)] * WIDTH)


_ZERO, _ONE = _constant(0.0), _constant(1.0)


def _is_true(at: ir.IRBuilder, value: Any) -> Any:
    return at.fcmp_unordered("!=", value, _ZERO)


def _number(at: ir.IRBuilder, truth: Any) -> Any:
    return at.uitofp(truth, VECTOR)  # a truth of CasADi is 1 or 0


def _compared(how: str, at: ir.IRBuilder, a: Any, b: Any) -> Any:
    return _number(at, at.fcmp_ordered(how, a, b))


def _larger(how: str, at: ir.IRBuilder, a: Any, b: Any) -> Any:
    """Return the larger (or smaller); what is not a number stays so, as in NumPy."""
    is_lost = at.fcmp_unordered("!=", a, a)
    return at.select(at.or_(at.fcmp_ordered(how, a, b), is_lost), a, b)


def _intrinsic(name: str, at: ir.IRBuilder, a: Any) -> Any:
    function = _declared(at, f"llvm.{name}.v{WIDTH}f64", ir.FunctionType(VECTOR, [VECTOR]))
    return at.call(function, [a])


def _c_function(name: str, at: ir.IRBuilder, *values: Any) -> Any:
    """Return a function of the C library, of each number."""
    function = _declared(at, name, ir.FunctionType(DOUBLE, [DOUBLE] * len(values)))
    filled = ir.Constant(VECTOR, ir.Undefined)
    for k in range(WIDTH):
        numbers = [at.extract_element(value, _PLACE(k)) for value in values]
        filled = at.insert_element(filled, at.call(function, numbers), _PLACE(k))
    return filled


def _declared(at: ir.IRBuilder, name: str, kind: Any) -> Any:
    return at.module.globals.get(name) or ir.Function(at.module, kind, name)


#: What each of CasADi's operations is in LLVM.
_OPERATIONS: dict[str, Callable[..., Any]] = {
    "ASSIGN": lambda at, a: a,
    "ADD": lambda at, a, b: at.fadd(a, b, flags=_FUSED),
    "SUB": lambda at, a, b: at.fsub(a, b, flags=_FUSED),
    "MUL": lambda at, a, b: at.fmul(a, b, flags=_FUSED),
    "DIV": lambda at, a, b: at.fdiv(a, b, flags=_INVERTED),
    "INV": lambda at, a: at.fdiv(_ONE, a, flags=_INVERTED),
    "NEG": lambda at, a: at.fneg(a),
    "SQ": lambda at, a: at.fmul(a, a, flags=_FUSED),
    "TWICE": lambda at, a: at.fadd(a, a, flags=_FUSED),
    "FABS": partial(_intrinsic, "fabs"),
    "SQRT": partial(_intrinsic, "sqrt"),
    "FLOOR": partial(_intrinsic, "floor"),
    "CEIL": partial(_intrinsic, "ceil"),
    "LT": partial(_compared, "<"),
    "LE": partial(_compared, "<="),
    "EQ": partial(_compared, "=="),
    "NE": lambda at, a, b: _number(at, at.fcmp_unordered("!=", a, b)),
    "AND": lambda at, a, b: _number(at, at.and_(_is_true(at, a), _is_true(at, b))),
    "OR": lambda at, a, b: _number(at, at.or_(_is_true(at, a), _is_true(at, b))),
    "NOT": lambda at, a: _number(at, at.not_(_is_true(at, a))),
    "SIGN": lambda at, a: at.fsub(_compared(">", at, a, _ZERO), _compared("<", at, a, _ZERO)),
    "IF_ELSE_ZERO": lambda at, a, b: at.select(_is_true(at, a), b, _ZERO),
    "FMAX": partial(_larger, ">="),
    "FMIN": partial(_larger, "<="),
    "POW": partial(_c_function, "pow"),
    "CONSTPOW": partial(_c_function, "pow"),
}
_OPERATIONS |= {
    name.upper(): partial(_c_function, name)
    for name in (
        *("exp", "expm1", "log", "log1p", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh"),
        *("tanh", "asinh", "acosh", "atanh", "erf", "hypot", "atan2", "fmod", "copysign"),
    )
}


_NAMES = {getattr(ca, key): key.removeprefix("OP_") for key in dir(ca) if key.startswith("OP_")}


def _instructions(function: Any, inputs: Sequence[Values], at: ir.IRBuilder) -> list[Any]:
    """Write the instructions of a CasADi function of registers, and return the registers of its output."""
    work, results = dict[int, Any](), [_ZERO] * function.numel_out(0)
    for k in range(function.n_instructions()):
        name = _NAMES[function.instruction_id(k)]
        into, of = function.instruction_output(k), function.instruction_input(k)
        if name == "OUTPUT":
            results[into[1]] = work[of[0]]
        elif name == "INPUT":
            work[into[0]] = inputs[of[0]][of[1]]
        elif name == "CONST":
            work[into[0]] = _constant(function.instruction_constant(k))
        elif name in _OPERATIONS:
            work[into[0]] = _OPERATIONS[name](at, *(work[place] for place in of))
        else:
            raise NotImplementedError(f"{name} has no machine code here")
    return results


def _spread(at: ir.IRBuilder, number: Any) -> Any:
    """Return a register of one number."""
    first = at.insert_element(ir.Constant(VECTOR, ir.Undefined), number, _PLACE(0))
    everywhere = ir.Constant(ir.VectorType(_PLACE, WIDTH), [0] * WIDTH)
    return at.shuffle_vector(first, ir.Constant(VECTOR, ir.Undefined), everywhere)


def _assembled(module: ir.Module) -> Callable[[str], int]:
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


# Fewer steps of a block than this are done sooner than another thread takes over.
_WORTH_THREADS = 1000
_FIRST = INTEGER(0)


class Kernel:
    """Compiled equations: ``step(x, u, d, p, h)`` and ``output(x, p)`` on lists of CasADi's symbols;
    ``switches`` are inputs that seldom move."""

    def __init__(self, step: Step, output: Output, sizes: Sizes, switches: Sequence[int] = ()) -> None:
        self.sizes, self.switches = sizes, list(switches)
        written = _Writer(step, output, sizes, self.switches)
        self._n_y = written.n_y
        self._address = _assembled(written.module)
        kinds = [ctypes.c_void_p] * 7 + [ctypes.c_int64] * 3 + [ctypes.c_double, ctypes.c_void_p]
        self._rollout = ctypes.CFUNCTYPE(None, *kinds)(self._address("rollout"))

    def rollout(
        self, x0: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike, h: float, pieces: int = 1
    ) -> Run:
        """Simulate a batch, ``pieces`` steps of h with each row of u and d."""
        x0, u, d, p = arrays = [np.ascontiguousarray(value, dtype=float) for value in (x0, u, d, p)]
        batch, n = len(x0), u.shape[1]
        n_x, n_u, n_d, n_p = self.sizes
        ends = x0.shape[1:], u.shape[1:], d.shape[1:], p.shape[1:]
        lengths = len(u), len(d), len(p)
        if ends != ((n_x,), (n, n_u), (n, n_d), (n_p,)) or any(m not in (1, batch) for m in lengths):
            raise ValueError(f"shapes {x0.shape}, {u.shape}, {d.shape}, {p.shape} do not belong together")
        # where what depends on switches is renewed; the row behind the last ends the loop
        moved = np.ones(n + 1, dtype=np.uint8)
        on = u[:, :, self.switches]
        moved[1:n] = np.any(on[:, 1:] != on[:, :-1], axis=(0, 2)) if self.switches else 0
        # which entry of each array a member begins at; places beyond the last member repeat it, so that a
        # member's numbers do not depend on who its neighbours are
        n_block = -(-batch // WIDTH)
        member = np.minimum(np.arange(n_block * WIDTH), batch - 1).reshape(n_block, 1, WIDTH)
        begin = member * np.array([a[0].size if len(a) > 1 else 0 for a in arrays])[:, None]
        y = np.empty((self._n_y, n + 1, n_block * WIDTH))
        x_end = np.empty((n_x, n_block * WIDTH))
        *addresses, to_y, to_end, from_begin, if_moved = (
            a.ctypes.data for a in (*arrays, y, x_end, begin, moved)
        )
        room = 8 * WIDTH  # bytes of a register
        into = [(from_begin + k * 4 * room, to_y + k * room, to_end + k * room) for k in range(n_block)]
        calls = [(*addresses, *places, n, n_block * WIDTH, pieces, h, if_moved) for places in into]
        if len(calls) == 1 or n < _WORTH_THREADS or _cores() == 1:
            for call in calls:
                self._rollout(*call)
        else:
            # without the interpreter's lock
            list(_threads().map(lambda call: self._rollout(*call), calls))
        return y.transpose(2, 1, 0)[:batch], x_end.T[:batch]


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_cores(), thread_name_prefix="rollout")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_threads.cache_clear)  # threads do not survive a fork


class _Writer:
    """Writes the function ``rollout``: a block of members through all rows."""

    def __init__(self, step: Step, output: Output, sizes: Sizes, switches: Sequence[int]) -> None:
        symbols = [ca.SX.sym(letter, n) for letter, n in zip("xudph", (*sizes, 1))]
        x, u, d, p, h = (ca.vertsplit(item) if item.numel() else [] for item in symbols)
        after = ca.densify(ca.vertcat(*step(x, u, d, p, h[0])))
        read = ca.densify(ca.vertcat(*output(x, p)))
        self.step = ca.Function("step", symbols, [after])
        self.read = ca.Function("read", [symbols[0], symbols[3]], [read])
        self.sizes, self.switches, self.n_y = sizes, switches, int(read.numel())
        numbers, whole = DOUBLE.as_pointer(), INTEGER.as_pointer()
        self.module = ir.Module("kernel")
        last = [INTEGER, INTEGER, INTEGER, DOUBLE, BYTE.as_pointer()]
        kind = ir.FunctionType(ir.VoidType(), [numbers] * 4 + [whole] + [numbers] * 2 + last)
        self.function = ir.Function(self.module, kind, "rollout")
        *arrays, begin, self.y, self.x_end, self.n, self.columns, self.pieces, duration, self.moved = (
            self.function.args
        )
        for pointer in (*arrays, begin, self.y, self.x_end, self.moved):
            pointer.add_attribute("noalias")
        self.at = ir.IRBuilder(self.function.append_basic_block("entry"))
        self.h = _spread(self.at, duration)
        members = (self.at.load(self.at.gep(begin, [INTEGER(k)])) for k in range(4 * WIDTH))
        self.places = [[self.at.gep(a, [offset]) for offset in islice(members, WIDTH)] for a in arrays]
        self._write()

    def _write(self) -> None:
        builder, (n_x, n_u, n_d, n_p) = self.at, self.sizes
        head, renew, step, done = (
            self.function.append_basic_block(name) for name in ("head", "renew", "step", "done")
        )
        first, p = (self._row(array, range(size)) for array, size in ((0, n_x), (3, n_p)))
        rows = builder.add(self.n, INTEGER(1))
        entry = builder.block
        self._put(_instructions(self.read, (first, p), builder), self.y, INTEGER(0), rows)
        builder.branch(head)

        builder.position_at_end(head)
        begin, state = builder.phi(INTEGER), [builder.phi(VECTOR) for _ in first]
        builder.cbranch(builder.icmp_signed("<", begin, self.n), renew, done)

        builder.position_at_end(renew)
        switched = self._row(1, self.switches, begin)
        builder.branch(step)

        builder.position_at_end(step)
        t = builder.phi(INTEGER)
        piece = builder.phi(INTEGER)
        x = [builder.phi(VECTOR) for _ in first]
        u, d = self._row(1, range(n_u), t), self._row(2, range(n_d), t)
        for place, value in zip(self.switches, switched):
            u[place] = value
        later = _instructions(self.step, (x, u, d, p, [self.h]), builder)
        after, count = builder.add(t, INTEGER(1)), builder.add(piece, INTEGER(1))
        # the last piece has the last word
        self._put(_instructions(self.read, (later, p), builder), self.y, after, rows)
        last = builder.icmp_signed(">=", count, self.pieces)
        moved = builder.icmp_signed("!=", builder.load(builder.gep(self.moved, [after])), BYTE(0))
        following = builder.select(last, after, t), builder.select(last, INTEGER(0), count)
        builder.cbranch(builder.and_(last, moved), head, step)

        for phi, came, value in zip([begin, *state], [INTEGER(0), *first], [after, *later], strict=True):
            phi.add_incoming(came, entry)
            phi.add_incoming(value, step)
        for phi, came, value in zip(
            [t, piece, *x], [begin, INTEGER(0), *state], [*following, *later], strict=True
        ):
            phi.add_incoming(came, renew)
            phi.add_incoming(value, step)

        builder.position_at_end(done)
        self._put(state, self.x_end, INTEGER(0), INTEGER(1))
        builder.ret_void()

    def _row(self, array: int, entries: Sequence[int], t: Any = _FIRST) -> list[Any]:
        """Return registers of the entries of row t of an array, each of eight members."""
        base, registers = self.at.mul(t, INTEGER(self.sizes[array])), []
        for i in entries:
            filled, entry = ir.Constant(VECTOR, ir.Undefined), self.at.add(base, INTEGER(i))
            for k, place in enumerate(self.places[array]):
                number = self.at.load(self.at.gep(place, [entry]))
                filled = self.at.insert_element(filled, number, _PLACE(k))
            registers.append(filled)
        return registers

    def _put(self, values: Values, array: Any, row: Any, length: Any) -> None:
        """Write values[m] to the block's columns of array[m, row]."""
        for m, value in enumerate(values):
            offset = self.at.mul(self.at.add(self.at.mul(INTEGER(m), length), row), self.columns)
            place = self.at.bitcast(self.at.gep(array, [offset]), VECTOR.as_pointer())
            self.at.store(value, place, align=8)
