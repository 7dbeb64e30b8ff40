r"""A model's step as plain C99: what depends on parameters, drives, state and direction, each once.

CasADi holds the equations as a list of instructions.  Each is written into the first function that knows all
it needs, the parameters, the drives, the state, or the direction of a tangent:

    prepare(p -> k),    hold(u, k -> h),    step(x, u, d, k, h -> x+),
    partials(x, u, d, k, h -> x+, m),    tangent(m, k, h, sx -> sx+)

and the last with a direction of the drives, su, and of the disturbances, sd, too.  ``next`` is hold and step.
The code needs ``math.h`` and nothing else.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from thermogrip.mpc.plant.prediction import symbolic_step

if TYPE_CHECKING:
    from thermogrip.sysid.models.model import Model

#: How each of CasADi's operations is written in C, and done in Python.
_OPERATIONS: dict[str, tuple[str, Callable[..., float]]] = {
    "OP_ASSIGN": ("{0}", lambda a: a),
    "OP_ADD": ("{0} + {1}", lambda a, b: a + b),
    "OP_SUB": ("{0} - {1}", lambda a, b: a - b),
    "OP_MUL": ("{0} * {1}", lambda a, b: a * b),
    "OP_DIV": ("{0} / {1}", lambda a, b: a / b),
    "OP_NEG": ("-{0}", lambda a: -a),
    "OP_SQ": ("{0} * {0}", lambda a: a * a),
    "OP_TWICE": ("2.0 * {0}", lambda a: 2.0 * a),
    "OP_INV": ("1.0 / {0}", lambda a: 1.0 / a),
    "OP_LT": ("(double)({0} < {1})", lambda a, b: float(a < b)),
    "OP_LE": ("(double)({0} <= {1})", lambda a, b: float(a <= b)),
    "OP_EQ": ("(double)({0} == {1})", lambda a, b: float(a == b)),
    "OP_NE": ("(double)({0} != {1})", lambda a, b: float(a != b)),
    "OP_AND": ("(double)({0} && {1})", lambda a, b: float(bool(a) and bool(b))),
    "OP_OR": ("(double)({0} || {1})", lambda a, b: float(bool(a) or bool(b))),
    "OP_NOT": ("(double)!{0}", lambda a: float(not a)),
    "OP_SIGN": ("(double)(({0} > 0.0) - ({0} < 0.0))", lambda a: float((a > 0) - (a < 0))),
    "OP_IF_ELSE_ZERO": ("({0} != 0.0 ? {1} : 0.0)", lambda a, b: b if a else 0.0),
    "OP_POW": ("pow({0}, {1})", math.pow),
    "OP_CONSTPOW": ("pow({0}, {1})", math.pow),
    "OP_FMIN": ("fmin({0}, {1})", min),
    "OP_FMAX": ("fmax({0}, {1})", max),
    "OP_FMOD": ("fmod({0}, {1})", math.fmod),
    "OP_COPYSIGN": ("copysign({0}, {1})", math.copysign),
    "OP_ATAN2": ("atan2({0}, {1})", math.atan2),
    "OP_HYPOT": ("hypot({0}, {1})", math.hypot),
    "OP_FABS": ("fabs({0})", abs),
}
_OPERATIONS |= {
    f"OP_{name.upper()}": (name + "({0})", getattr(math, name))
    for name in (
        *("exp", "log", "sqrt", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh"),
        *("asinh", "acosh", "atanh", "floor", "ceil", "erf", "log1p", "expm1"),
    )
}
# what a value depends on
_PARAMETERS = 1
_DRIVES = 2
_STATE = 3
_DIRECTION = 4
_POINT = "const double *x, const double *u, const double *d, const double *k"
_SU, _SD = "const double *restrict su", "const double *restrict sd"
_COLUMNS = "int n, const double *m, const double *k, const double *h, const double *restrict sx"
_FUNCTION_HEADS = {
    part: f"void tg_model_{part}({arguments})"
    for part, arguments in {
        "prepare": "const double *p, double *k",
        "hold": "int n, const double *restrict u, const double *k, double *restrict h",
        "hold_slopes": "int n, const double *restrict u, const double *k, double *restrict h",
        "step": f"{_POINT}, const double *h, double *xn",
        "next": f"{_POINT}, double *xn",
        "partials": f"{_POINT}, const double *h, double *xn, double *m",
        "tangent": f"{_COLUMNS}, double *restrict out",
        "tangent_u": f"{_COLUMNS}, {_SU}, double *restrict out",
        "tangent_d": f"{_COLUMNS}, {_SU}, {_SD}, double *restrict out",
    }.items()
}


@dataclass
class _Value:
    """One number of the straight line: how it is made, from which others, and what it depends on."""

    what: str  # CasADi's name of the operation
    text: str  # in C
    uses: tuple[int, ...]
    stage: int  # 0 a constant, 1 parameters, 2 drives, 3 state, 4 direction
    number: float = 0.0  # a constant, or which entry of an input
    place: str = ""  # where a later function finds it


@dataclass
class _Line:
    values: list[_Value] = field(default_factory=list)
    outputs: list[dict[int, int]] = field(default_factory=list)  # by output: entry -> value
    n_u: int = 0
    n_d: int = 0


@dataclass(frozen=True)
class ModelCode:
    """C of one model at one step length."""

    source: str  # definitions of ``tg_model_prepare`` and the others of the module's text
    header: str  # their declarations
    n_k: int  # length of what ``prepare``, ``hold`` and ``partials`` leave behind
    n_h: int
    n_m: int
    line: _Line

    @property
    def files(self) -> dict[str, str]:
        """Header, which C++ may include, and source by file name."""
        begin, end = '#ifdef __cplusplus\nextern "C" {\n#endif\n', "#ifdef __cplusplus\n}\n#endif\n"
        guarded = f"#ifndef TG_MODEL_H\n#define TG_MODEL_H\n\n{begin}\n{self.header}\n{end}\n#endif\n"
        source = f'#include "tg_model.h"\n\n#include <math.h>\n\n{self.source}'
        return {"tg_model.h": guarded, "tg_model.c": source}

    def constants(self, p: Sequence[float]) -> list[float]:
        """Return what ``prepare`` leaves behind for parameters p, without a compiler."""
        numbers: dict[int, float] = {}
        constants: dict[int, float] = {}
        for number, value in enumerate(self.line.values):
            if value.stage > 1:
                continue
            if value.what == "OP_CONST":
                numbers[number] = value.number
            elif value.what == "OP_INPUT":
                numbers[number] = float(p[int(value.number)])
            else:
                numbers[number] = float(_OPERATIONS[value.what][1](*(numbers[use] for use in value.uses)))
            if value.place.startswith("k["):
                constants[int(value.place[2:-1])] = numbers[number]
        return [constants[entry] for entry in range(self.n_k)]


def write_model(model: Model, drives: Sequence[int], h: float) -> ModelCode:
    """Return the C of a model's step of length h [s]; inputs that are no drives are switches, and on."""
    line = _straight(_graph(model, drives, h))
    outputs = [list(entries.items()) for entries in line.outputs]
    roots = [[number for _, number in entries] for entries in outputs]
    everything = _needed(line, [number for name in roots for number in name])
    k = _hand_over(line, everything, _PARAMETERS, "k")
    # what a step reads comes first
    held = _hand_over(line, everything, _DRIVES, "h", first=_needed(line, roots[0]))
    m = _hand_over(line, everything, _STATE, "m")
    read = [number for number in held if number in _needed(line, roots[0])]
    into = {
        "k": [f"k[{entry}] = {{}};" for entry in range(len(k))],
        "h": [f"h[{4 * entry}] = {{}};" for entry in range(len(held))],
        "m": [f"m[{entry}] = {{}};" for entry in range(len(m))],
        "xn": [f"xn[{entry}] = {{}};" for entry, _ in outputs[0]],
    }
    out = [[f"out[{4 * entry} + c] = {{}};" for entry, _ in outputs[n]] for n in (1, 2, 3)]
    bodies = {
        "prepare": _body(line, _PARAMETERS, k, into["k"]),
        "hold": _over_drives(_body(line, _DRIVES, read, into["h"][: len(read)]), line.n_u),
        # hold does as much of it as a step reads, hold_slopes all
        "hold_slopes": _over_drives(_body(line, _DRIVES, held, into["h"]), line.n_u),
        "step": _body(line, _STATE, roots[0], into["xn"]),
        "next": [
            f"    double h[{4 * max(1, len(read))}];",
            "    tg_model_hold(1, u, k, h);",
            "    tg_model_step(x, u, d, k, h, xn);",
        ],
        "partials": _body(line, _STATE, roots[0] + m, into["xn"] + into["m"]),
        "tangent": _body(line, _DIRECTION, roots[1], out[0]),
        "tangent_u": _body(line, _DIRECTION, roots[2], out[1]),
        "tangent_d": _body(line, _DIRECTION, roots[3], out[2]),
    }
    source = []
    n_x = len(line.outputs[0])
    sizes = {"sx": n_x, "su": line.n_u, "sd": line.n_d, "out": n_x}
    for name, lines in bodies.items():
        head = _FUNCTION_HEADS[name]
        arguments = [item.split()[-1].lstrip("*") for item in head[head.index("(") + 1 : -1].split(",")]
        body = "\n".join(lines)
        unused = [f"    (void){item};" for item in arguments if not re.search(rf"\b{item}\b", body)]
        if name.startswith("tangent"):
            unused = [text for text in unused if text != "    (void)n;"]
            moving = [item for item in arguments if item in sizes]
            lines = _over_groups(lines, moving, sizes)
        source.append("\n".join([head, "{", *unused, *lines, "}", ""]))
    heads = [_FUNCTION_HEADS[name].replace(" restrict ", " ").replace("*restrict ", "*") for name in bodies]
    header = ";\n".join([*heads, ""])  # C++ has no such word, and to C it is the same declaration
    return ModelCode("\n".join(source), header, len(k), len(held), len(m), line)


def _graph(model: Model, drives: Sequence[int], h: float) -> Any:
    """Return the step as a function (p, x, u, d, sx, su, sd) -> (x+, tangents along sx, with su, with sd)."""
    import casadi as ca

    n_d = len(model.disturbances)
    sizes = (len(model.parameters), model.n_x, len(drives), n_d)
    p, x, u, d = (ca.SX.sym(letter, n) for letter, n in zip("pxud", sizes))
    sx, su, sd = (ca.SX.sym("s" + letter, n) for letter, n in zip("xud", sizes[1:]))
    # a dense Jacobian of an implicit step takes ten times the work of the step for every sample; a dozen
    # tangents that share their partial derivatives take two or three
    directions = [(sx, 0 * su, 0 * sd), (sx, su, 0 * sd), (sx, su, sd)]
    parameters = ca.vertsplit(p) if p.numel() else []
    results = ca.cse(symbolic_step(model, drives, (x, u, d), parameters, h, *directions))
    return ca.Function("model", [p, x, u, d, sx, su, sd], results)


def _straight(function: Any) -> _Line:
    """Return CasADi's instructions with every intermediate result named once."""
    import casadi as ca

    names = {getattr(ca, key): key for key in dir(ca) if key.startswith("OP_")}
    inputs = ("p[{}]", "x[{}]", "u[{}]", "d[{}]", "sx[{} + c]", "su[{} + c]", "sd[{} + c]")
    stages = (_PARAMETERS, _STATE, _DRIVES, _STATE, *(_DIRECTION,) * 3)
    line = _Line([], [{} for _ in range(function.n_out())], function.numel_in(2), function.numel_in(3))
    value_at: dict[int, int] = {}  # place in CasADi's work vector -> value
    for number in range(function.n_instructions()):
        operation = names[function.instruction_id(number)]
        into, out_of = function.instruction_output(number), function.instruction_input(number)
        if operation == "OP_OUTPUT":
            line.outputs[into[0]][into[1]] = value_at[out_of[0]]
            continue
        if operation == "OP_INPUT":
            source, entry = out_of
            place = 4 * entry if stages[source] == _DIRECTION else entry
            value = _Value(operation, inputs[source].format(place), (), stages[source], entry)
        elif operation == "OP_CONST":
            constant = float(function.instruction_constant(number))
            text = f"({constant!r})".replace("inf", "INFINITY")
            value = _Value(operation, text, (), 0, constant)
        else:
            uses = tuple(value_at[place] for place in out_of)
            value = _operation(line, operation, uses)
        line.values.append(value)
        value_at[into[0]] = len(line.values) - 1
    return line


def _operation(line: _Line, what: str, uses: tuple[int, ...]) -> _Value:
    stage = max(line.values[use].stage for use in uses)
    if what not in _OPERATIONS:
        raise NotImplementedError(f"the model uses {what}, which has no C here")
    divisor = line.values[uses[-1]]
    # a quotient by something known earlier becomes a product with its reciprocal
    if what == "OP_DIV" and divisor.what == "OP_CONST" and divisor.number and stage:
        constant = 1.0 / divisor.number
        line.values.append(_Value("OP_CONST", f"({constant!r})", (), 0, constant))
        return _Value("OP_MUL", "{0} * {1}", (uses[0], len(line.values) - 1), stage)
    if what == "OP_DIV" and 0 < divisor.stage < stage:
        line.values.append(_Value("OP_INV", "1.0 / {0}", (uses[1],), line.values[uses[1]].stage))
        return _Value("OP_MUL", "{0} * {1}", (uses[0], len(line.values) - 1), stage)
    return _Value(what, _OPERATIONS[what][0], uses, stage)


def _needed(line: _Line, roots: Sequence[int]) -> set[int]:
    needed, waiting = set(), list(roots)
    while waiting:
        number = waiting.pop()
        if number not in needed:
            needed.add(number)
            waiting.extend(line.values[number].uses)
    return needed


def _over_drives(lines: Sequence[str], n_u: int) -> list[str]:
    """Return statements for the drives of one block, repeated over n of them."""
    if not lines:
        return ["    (void)n;"]
    # entry i of block c is at [4 i + c], of four blocks at most
    return [f"    for (; n > 0; n--, u += {n_u}, h++) {{", *("    " + item for item in lines), "    }"]


def _over_groups(lines: Sequence[str], moving: Sequence[str], sizes: Mapping[str, int]) -> list[str]:
    """Return statements for one direction, repeated over groups of four."""
    steps = ", ".join(["g++", *(f"{item} += {4 * sizes[item]}" for item in moving if sizes[item])])
    # entry i of direction c is at [c / 4][i][c % 4]: a compiler takes four at once
    inner = ["        for (int c = 0; c < 4; c++) {", *("        " + item for item in lines), "        }"]
    return [f"    for (int g = 0; g < n; {steps}) {{", *(inner if lines else []), "    }"]


def _hand_over(
    line: _Line, needed: set[int], stage: int, letter: str, first: Collection[int] = ()
) -> list[int]:
    """Return the values of a stage that a later one reads, those in ``first`` before others, and say where it
    finds them."""
    later = [at for at in needed if line.values[at].stage > stage]
    read = {use for at in later for use in line.values[at].uses}
    if stage < _STATE:  # what is a result of the step is none of the tangent's business
        read |= {at for found in line.outputs for at in found.values()}
    handed_over = sorted(
        (at for at in read if line.values[at].stage == stage), key=lambda at: (at not in first, at)
    )
    for entry, at in enumerate(handed_over):
        line.values[at].place = f"{letter}[{4 * entry if letter == 'h' else entry}]"
    return handed_over


def _body(line: _Line, stage: int, roots: Sequence[int], stores: Sequence[str]) -> list[str]:
    """Return the statements of a stage that lead to these values, and then their stores."""
    values = line.values
    written = []
    names = {}
    order = sorted(_needed(line, roots))
    for number in order:
        value = values[number]
        if value.stage < stage and value.stage > 0:
            names[number] = value.place
        elif not value.uses:
            names[number] = value.text
        elif value.stage == 0 or value.stage == stage:
            names[number] = f"v{number}"
            text = value.text.format(*(names[use] for use in value.uses))
            written.append(f"    const double v{number} = {text};")
    return written + [
        "    " + store.format(names[number]) for store, number in zip(stores, roots, strict=True)
    ]
