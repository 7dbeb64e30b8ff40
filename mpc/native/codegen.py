r"""A model's step as plain C99: what depends on its parameters, on the state, on a direction, each once.

CasADi holds the equations as a list of instructions.  Each instruction depends on

    1. the parameters alone          (conductances, the factors of an implicit step)
    2. the state, the drives, too    (the step itself, its partial derivatives)
    3. the direction, too            (the tangent, linear in the direction)

and is written into the first function that knows all it needs:

    prepare(p -> k),    next(x, u, d, k -> x+),    partials(x, u, d, k -> x+, m),
    tangent(m, k, sx, su -> sx+)    and the same with a direction of the disturbances, sd.

``tangent`` runs over many directions side by side, column by column in its innermost loop, which a compiler
turns into vector instructions.  A dense Jacobian of an implicit step takes ten times the work of the step for
every sample; a dozen tangents that share their partial derivatives take two or three.  Where the Jacobian is
sparse and the other way about, its non-zeros are the partial derivatives and the tangent is their product
with the direction; the shorter of the two is written.

A quotient by something known earlier becomes a product with its reciprocal.  Nothing here is CasADi's own C:
the code needs ``math.h`` and nothing else.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

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
_STATE = "const double *x, const double *u, const double *d, const double *k, double *xn"
_COLUMNS = (
    "int n, int w, const double *m, const double *k, const double *restrict sx, const double *restrict su"
)
_HEADS = {
    part: f"void tg_model_{part}({arguments})"
    for part, arguments in {
        "prepare": "const double *p, double *k",
        "next": _STATE,
        "partials": f"{_STATE}, double *m",
        "tangent": f"{_COLUMNS}, double *restrict out",
        "tangent_d": f"{_COLUMNS}, const double *restrict sd, double *restrict out",
    }.items()
}


@dataclass
class _Value:
    """One number of the straight line: how it is made, from which others, and what it depends on."""

    what: str  # CasADi's name of the operation
    text: str  # in C
    uses: tuple[int, ...]
    stage: int  # 0 a constant, 1 parameters, 2 state, 3 direction
    number: float = 0.0  # a constant, or which entry of an input
    place: str = ""  # where a later function finds it


@dataclass
class _Line:
    values: list[_Value] = field(default_factory=list)
    outputs: list[dict[int, int]] = field(default_factory=list)  # by output: entry -> value


@dataclass(frozen=True)
class ModelCode:
    """C of one model at one step length."""

    source: str  # definitions of ``tg_model_prepare`` and the others of the module's text
    header: str  # their declarations
    n_k: int  # length of what ``prepare`` and ``partials`` leave behind
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
        found: dict[int, float] = {}
        kept: dict[int, float] = {}
        for at, value in enumerate(self.line.values):
            if value.stage > 1:
                continue
            if value.what == "OP_CONST":
                found[at] = value.number
            elif value.what == "OP_INPUT":
                found[at] = float(p[int(value.number)])
            else:
                found[at] = float(_OPERATIONS[value.what][1](*(found[use] for use in value.uses)))
            if value.place.startswith("k["):
                kept[int(value.place[2:-1])] = found[at]
        return [kept[entry] for entry in range(self.n_k)]


def write_model(model: Model, drives: Sequence[int], h: float) -> ModelCode:
    """Return the C of a model's step of length h [s]; inputs that are no drives are switches, and on."""
    sparse, tangents = (_straight(_graph(model, drives, h, jacobian=way)) for way in (True, False))
    # a tangent is done for a dozen directions, four side by side; all else once
    line = min(sparse, tangents, key=lambda item: _work(item, 12.0 / 4.0))
    return _write(line)


def _graph(model: Model, drives: Sequence[int], h: float, *, jacobian: bool) -> Any:
    """Return the function (p, x, u, d, sx, su, sd) -> (x+, tangent, tangent with sd)."""
    import casadi as ca

    n_d = len(model.disturbances)
    sizes = (len(model.parameters), model.n_x, len(drives), n_d)
    p, x, u, d = (ca.SX.sym(letter, n) for letter, n in zip("pxud", sizes))
    sx, su, sd = (ca.SX.sym("s" + letter, n) for letter, n in zip("xud", sizes[1:]))
    full = [ca.SX(1.0)] * len(model.inputs)
    for at, value in zip(drives, ca.vertsplit(u), strict=True):
        full[at] = value
    lists = [ca.vertsplit(item) if item.numel() else [] for item in (x, d, p)]
    after = ca.vertcat(*model.step(lists[0], full, lists[1], lists[2], h))
    if jacobian:
        A, B, E = (ca.jacobian(after, item) for item in (x, u, d))
        plain = ca.mtimes(A, sx) + ca.mtimes(B, su)
        whole = plain + ca.mtimes(E, sd)
    else:
        plain = ca.jtimes(after, ca.vertcat(x, u), ca.vertcat(sx, su))
        whole = ca.jtimes(after, ca.vertcat(x, u, d), ca.vertcat(sx, su, sd))
    results = ca.cse([ca.densify(item) for item in (after, plain, whole)])
    return ca.Function("model", [p, x, u, d, sx, su, sd], results)


def _straight(function: Any) -> _Line:
    """Return CasADi's instructions with every intermediate result named once."""
    import casadi as ca

    names = {getattr(ca, key): key for key in dir(ca) if key.startswith("OP_")}
    inputs = ("p[{}]", "x[{}]", "u[{}]", "d[{}]", "sx[{} * w + c]", "su[{} * w + c]", "sd[{} * w + c]")
    stages = (1, 2, 2, 2, 3, 3, 3)
    line = _Line(outputs=[{} for _ in range(function.n_out())])
    at: dict[int, int] = {}  # place in CasADi's work vector -> value
    for number in range(function.n_instructions()):
        what = names[function.instruction_id(number)]
        into, out_of = function.instruction_output(number), function.instruction_input(number)
        if what == "OP_OUTPUT":
            line.outputs[into[0]][into[1]] = at[out_of[0]]
            continue
        if what == "OP_INPUT":
            source, entry = out_of
            value = _Value(what, inputs[source].format(entry), (), stages[source], entry)
        elif what == "OP_CONST":
            constant = float(function.instruction_constant(number))
            value = _Value(what, f"({constant!r})", (), 0, constant)
        else:
            uses = tuple(at[place] for place in out_of)
            value = _operation(line, what, uses)
        line.values.append(value)
        at[into[0]] = len(line.values) - 1
    return line


def _operation(line: _Line, what: str, uses: tuple[int, ...]) -> _Value:
    stage = max(line.values[use].stage for use in uses)
    if what not in _OPERATIONS:
        raise NotImplementedError(f"the model uses {what}, which has no C here")
    if what == "OP_DIV" and 0 < line.values[uses[1]].stage < stage:
        line.values.append(_Value("OP_INV", "1.0 / {0}", (uses[1],), line.values[uses[1]].stage))
        return _Value("OP_MUL", "{0} * {1}", (uses[0], len(line.values) - 1), stage)
    return _Value(what, _OPERATIONS[what][0], uses, stage)


def _needed(line: _Line, roots: Sequence[int]) -> set[int]:
    found, left = set(), list(roots)
    while left:
        at = left.pop()
        if at not in found:
            found.add(at)
            left.extend(line.values[at].uses)
    return found


def _work(line: _Line, directions: float) -> float:
    """Return the instructions of a sample and its tangents."""
    needed = _needed(line, [at for entry in line.outputs[:2] for at in entry.values()])
    stages = [line.values[at].stage for at in needed if line.values[at].uses]
    return stages.count(2) + directions * stages.count(3)


def _write(line: _Line) -> ModelCode:
    outputs = [list(found.items()) for found in line.outputs]
    roots = [[at for _, at in found] for found in outputs]
    everything = _needed(line, [at for part in roots for at in part])
    k, m = _hand_over(line, everything, 1, "k"), _hand_over(line, everything, 2, "m")
    parts = {
        "prepare": _body(line, 1, k, [f"k[{entry}] = {{}};" for entry in range(len(k))]),
        "next": _body(line, 2, roots[0], [f"xn[{entry}] = {{}};" for entry, _ in outputs[0]]),
        "partials": _body(
            line,
            2,
            roots[0] + m,
            [f"xn[{entry}] = {{}};" for entry, _ in outputs[0]]
            + [f"m[{entry}] = {{}};" for entry in range(len(m))],
        ),
        "tangent": _body(line, 3, roots[1], [f"out[{entry} * w + c] = {{}};" for entry, _ in outputs[1]]),
        "tangent_d": _body(line, 3, roots[2], [f"out[{entry} * w + c] = {{}};" for entry, _ in outputs[2]]),
    }
    source = []
    for part, lines in parts.items():
        head = _HEADS[part]
        arguments = [item.split()[-1].lstrip("*") for item in head[head.index("(") + 1 : -1].split(",")]
        body = "\n".join(lines)
        unused = [
            f"    (void){item};" for item in arguments if item not in ("n", "w") and f"{item}[" not in body
        ]
        if part.startswith("tangent"):
            lines = ["    for (int c = 0; c < n; c++) {", *("    " + item for item in lines), "    }"]
        source.append("\n".join([head, "{", *unused, *lines, "}", ""]))
    heads = [_HEADS[part].replace(" restrict ", " ").replace("*restrict ", "*") for part in parts]
    header = ";\n".join([*heads, ""])  # C++ has no such word, and to C it is the same declaration
    return ModelCode("\n".join(source), header, len(k), len(m), line)


def _hand_over(line: _Line, needed: set[int], stage: int, letter: str) -> list[int]:
    """Return the values of a stage that a later one reads, and say where it finds them."""
    later = [at for at in needed if line.values[at].stage > stage]
    read = {use for at in later for use in line.values[at].uses}
    if stage == 1:  # what is a result of the step is none of the tangent's business
        read |= {at for found in line.outputs for at in found.values()}
    kept = sorted(at for at in read if line.values[at].stage == stage)
    for entry, at in enumerate(kept):
        line.values[at].place = f"{letter}[{entry}]"
    return kept


def _body(line: _Line, stage: int, roots: Sequence[int], stores: Sequence[str]) -> list[str]:
    """Return the statements of a stage that lead to these values, and then their stores."""
    values, written, names = line.values, [], {}
    order = sorted(_needed(line, roots))
    for at in order:
        value = values[at]
        if value.stage < stage and value.stage > 0:
            names[at] = value.place
        elif not value.uses:
            names[at] = value.text
        elif value.stage == 0 or value.stage == stage:
            names[at] = f"v{at}"
            text = value.text.format(*(names[use] for use in value.uses))
            written.append(f"    const double v{at} = {text};")
    return written + ["    " + store.format(names[at]) for store, at in zip(stores, roots, strict=True)]
