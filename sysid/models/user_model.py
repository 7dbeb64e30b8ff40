"""A user's own class as a model: fitted, sampled, validated and simulated as a thermal network is.

    class Tank:
        inputs = {"pump": "V"}
        outputs = {"level": {"unit": "V", "sd": 0.05}}
        states = {"level": 0.1}
        parameters = {"inflow": {"value": 0.1, "sd_log": 0.7, "unit": "1/s"}, "outflow": 0.05}
        dt = 4.0

        def rhs(self, x, u, d, p):
            return [p.inflow * u.pump - p.outflow * np.sqrt(np.maximum(x.level, 0.0))]

The arguments are named tuples.  The same lines run on numbers and on CasADi symbols, of which machine code is
made: a choice between two values is ``np.where`` or ``np.maximum``, never ``if``.  What symbols cannot say
(sorting, a function of SciPy) is refused.
"""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import keyword
import reprlib
import sys
import traceback
from collections import namedtuple
from collections.abc import Iterator, Mapping, Sequence, Sized
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import lru_cache, partial
from importlib import import_module
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import ArrayLike
from pydantic import AfterValidator, BeforeValidator, Field, ValidationError, model_validator

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError, known_names, reading
from thermogrip.sysid.models.model import Described, FreeRuns, RestWeights, Run, Sizes, Values
from thermogrip.sysid.models.network_spec import OpenHigh, OpenLow, Parameter, Table

if TYPE_CHECKING:
    from thermogrip.sysid.models.jit_rollout import Kernel

_EXAMPLES = {
    "inputs": 'inputs = {"pump": "V"}: name and unit of each',
    "outputs": 'outputs = {"level": "V"}: name and unit of each',
    "states": 'states = {"level": 0.1}: each with how unsure it is where a log begins',
    "parameters": 'parameters = {"area": {"value": 2.0, "sd_log": 0.7, "unit": "m2"}}',
    "limits": 'limits = {"level": (0, 10)}: lowest and highest of a state, None for an open end',
    "dt": "dt = 1.0: the step of the simulation in seconds",
    "rhs": "def rhs(self, x, u, d, p): return dx/dt of each state",
    "output": "def output(self, x, p): return what each output reads",
}


def _signal_name(name: str) -> str:
    if not name.isidentifier() or name.startswith("_") or keyword.iskeyword(name):
        raise ValueError("use letters, digits and underscores, and no word of Python's own")
    return name


def _bare(key: str, **others: Any) -> BeforeValidator:
    """Let a bare value stand for a table that has it under ``key``."""
    return BeforeValidator(lambda item: item if isinstance(item, Mapping) else {key: item} | others)


_Name = Annotated[str, AfterValidator(_signal_name)]
_Unit = Annotated[str, Field(min_length=1)]
_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
_Some = Field(min_length=1)


class Input(Table):
    """Something that is moved; ``switch`` marks a pump or valve that is on or off."""

    unit: _Unit
    range: tuple[float, float] | None = None
    switch: bool = False


class Output(Table):
    """A sensor: ``sd`` of a bin's mean about the model, ``log_sd`` of its offset from log to log."""

    unit: _Unit
    sd: _Positive | None = None
    log_sd: Annotated[float, Field(ge=0)] = 0.0


class Disturbance(Table):
    """Something measured and not moved; ``log_sd`` of its sensor's offset from log to log."""

    unit: _Unit
    log_sd: Annotated[float, Field(ge=0)] = 0.0


class _OwnParameter(Parameter):
    unit: str = "1"


class _Attributes(Table):
    """What a class states beside its functions."""

    inputs: dict[_Name, Annotated[Input, _bare("unit")]]
    outputs: Annotated[dict[_Name, Annotated[Output, _bare("unit")]], _Some]
    states: Annotated[dict[_Name, _Positive], _Some]
    parameters: Annotated[dict[_Name, Annotated[_OwnParameter, _bare("value", fixed=True)]], _Some]
    dt: _Positive
    disturbances: dict[_Name, Annotated[Disturbance, _bare("unit")]] = Field({})
    limits: dict[_Name, tuple[OpenLow, OpenHigh]] = Field({})
    average: _Positive | None = None
    warmup: _Positive | None = None

    @model_validator(mode="after")
    def _limited(self) -> Self:
        for name, (low, high) in self.limits.items():
            if name not in self.states:
                raise ValueError(f"{name!r} is no state")
            if not low < high:
                raise ValueError(f"{name} is between {low:g} and {high:g}")
        return self


class OwnCode:
    """A user's class, its tables checked and its functions guarded."""

    def __init__(self, made: Any) -> None:
        self.made, self.name = made, type(made).__name__
        self.file = _file_of(type(made))
        if not callable(getattr(made, "rhs", None)):
            raise self.fault("has no function rhs", hint=f"write {_EXAMPLES['rhs']}")
        attributes = (*_Attributes.model_fields, "rhs", "output", "rest")
        for name in vars(type(made)):
            meant = get_close_matches(name, attributes, n=1, cutoff=0.8)
            if meant and name not in attributes and not hasattr(made, meant[0]):
                raise self.fault(f"has {name!r}, which nothing reads", hint=f"call it {meant[0]!r}")
        stated = {name: getattr(made, name) for name in _Attributes.model_fields if hasattr(made, name)}
        try:
            tables = _Attributes.model_validate(stated)
        except ValidationError as error:
            first = error.errors()[0]
            place = [str(key) for key in first["loc"]] or ["limits"]  # what the tables say of each other
            problem = f"states {' '.join(place)}: {first['msg'].removeprefix('Value error, ')}"
            example = _EXAMPLES.get(place[0])
            raise self.fault(problem, hint=f"write {example}" if example else "give seconds") from error
        self.inputs = tables.inputs
        self.outputs = tables.outputs
        self.disturbances = tables.disturbances
        self.parameters = tables.parameters
        self.states = tables.states
        self.dt = tables.dt
        lists: list[Sized] = [self.states, self.inputs, self.disturbances, self.parameters]
        self.sizes = Sizes(*map(len, lists))
        self.average, self.warmup = tables.average or 5 * self.dt, tables.warmup or 50 * self.dt
        self.limits = np.array([tables.limits.get(name, (-np.inf, np.inf)) for name in self.states])
        groups = ("states", "inputs", "disturbances", "parameters", "outputs")
        self.X, self.U, self.D, self.P, self.Y = (
            namedtuple(group, list(getattr(self, group))) for group in groups
        )
        unread = [name for name in self.outputs if name not in self.states]
        if unread and not hasattr(made, "output"):
            problem = f"does not say what output {unread[0]!r} reads: it is no state"
            raise self.fault(problem, hint=f"write {_EXAMPLES['output']}")

    @property
    def sha256(self) -> str | None:
        """Of the file that the class is in, line ends aside; None where there is no file."""
        if not Path(self.file).is_file():
            return None
        text = Path(self.file).read_bytes().replace(b"\r\n", b"\n")
        return hashlib.sha256(text).hexdigest()

    def step(self, x: Values, u: Values, d: Values, p: Values, h: Any) -> list[Any]:
        """Return the state one Runge-Kutta step of ``h`` on; CasADi's symbols too."""
        x, u, d, p, (h,) = (_for_numpy(values) for values in (x, u, d, p, [h]))
        # the classical rule of fourth order for dx/dt = f(x, u, d, p), u and d held over a step
        k1 = self.rhs(x, u, d, p)
        k2 = self.rhs([a + h / 2 * k for a, k in zip(x, k1)], u, d, p)
        k3 = self.rhs([a + h / 2 * k for a, k in zip(x, k2)], u, d, p)
        k4 = self.rhs([a + h * k for a, k in zip(x, k3)], u, d, p)
        state = [a + h / 6 * (s + 2 * (q + r) + t) for a, s, q, r, t in zip(x, k1, k2, k3, k4)]
        # a state with limits is put back inside them after each of the n pieces of a step
        for i, (low, high) in enumerate(self.limits):
            if np.isfinite(low):
                state[i] = np.maximum(state[i], low)
            if np.isfinite(high):
                state[i] = np.minimum(state[i], high)
        return _plain(state)

    def output(self, x: Values, p: Values) -> list[Any]:
        """Return what the outputs read, a list of length n_y."""
        if not hasattr(self.made, "output"):
            named = dict(zip(self.states, x))
            return [named[name] for name in self.outputs]
        return _plain(self._call("output", self.outputs, (self.X(*_for_numpy(x)), self.P(*_for_numpy(p)))))

    def rhs(self, x: Values, u: Values, d: Values, p: Values) -> list[Any]:
        """Return dx/dt, a list of length n_x."""
        return self._call("rhs", self.states, (self.X(*x), self.U(*u), self.D(*d), self.P(*p)))

    def rest(self, y: Values, u: Values, d: Values, p: Values) -> list[Any] | None:
        """Return the class's own state at rest, None where it has no such function."""
        if not hasattr(self.made, "rest"):
            return None
        return self._call("rest", self.states, (self.Y(*y), self.U(*u), self.D(*d), self.P(*p)))

    def fault(self, problem: str, *, line: int | None = None, hint: str | None = None) -> UserError:
        """Return the error that names file and class."""
        return UserError(f"{self.name} {problem}", file=_file_words(self.file, line) or None, hint=hint)

    def _call(self, what: str, names: Mapping[str, Any], args: tuple[Any, ...]) -> list[Any]:
        try:
            function = getattr(self.made, what)
            traced = any(isinstance(value, _Symbol) for group in args for value in group)
            with np.errstate(all="ignore"), _arrays_of_symbols(function) if traced else nullcontext():
                # CasADi leaves flags of its own in arrays of symbols
                got = function(*args)
        except UserError:
            raise
        except Exception as error:  # the user's own code may raise anything
            hint, fields = f"correct {what}", getattr(getattr(error, "obj", None), "_fields", None)
            if fields is not None:  # of a named tuple of the arguments
                hint = f"the {type(error.obj).__name__} are {', '.join(fields) or 'none'}"  # type: ignore[attr-defined]
            elif "an if about" in str(error):
                hint = "choose with np.where or np.maximum"
            elif any(word in str(error) for word in ("ArrayInterface", "_Symbol", "not known yet")):
                hint = "use arithmetic, NumPy's elementary functions, and np.array of a list"
            problem = f"fails in {what}: {type(error).__name__}: {error}"
            raise self.fault(problem, line=_line_of(error, self.file), hint=hint) from error
        alone = isinstance(got, str) or getattr(got, "ndim", None) == 0 or not np.iterable(got)
        values = [v.item() if getattr(v, "ndim", None) == 0 else v for v in ([got] if alone else got)]
        problem = f"returns {len(values)} numbers from {what}, not {len(names)}"
        # rows where its arguments are
        numbers: tuple[type, ...] = (_Symbol, Real, np.bool_, *{type(v) for group in args for v in group})
        wrong = [v for v in values if not isinstance(v, numbers)]
        if wrong:
            problem = f"returns {reprlib.repr(wrong[0])} from {what}, which is no number"
        if wrong or len(values) != len(names):
            raise self.fault(problem, hint=f"return one for each of {', '.join(names)}")
        return values


def load_object(file: str | Path, name: str) -> Any:
    """Return what a Python file calls ``name``; this runs the file."""
    path = Path(file)
    if not path.is_file():
        raise UserError("no such file", file=path, hint="check the path")
    spec = importlib.util.spec_from_file_location(f"thermogrip_own_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise UserError("cannot be imported", file=path, hint="give a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses and inspect look a class's module up
    try:
        spec.loader.exec_module(module)
    except UserError:
        raise
    except Exception as error:  # the user's own code may raise anything
        where = _file_words(str(spec.origin), _line_of(error, str(spec.origin)))
        raise UserError(
            f"fails with {type(error).__name__}: {error}", file=where, hint="correct the file"
        ) from error
    if not hasattr(module, name):
        classes = [n for n, item in vars(module).items() if inspect.isclass(item) and hasattr(item, "rhs")]
        hint = known_names(name, classes, "it has {}") if classes else "name a class that is in it"
        raise UserError(f"has no {name!r}", file=path, hint=hint)
    return getattr(module, name)


def _line_of(error: Exception, file: str) -> int | None:
    """Return the line of a file where an exception was raised."""
    if isinstance(error, SyntaxError):
        return error.lineno
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
    return lines[-1] if lines else None


def _file_of(kind: type) -> str:
    """Return the file of a class, "" where it was typed in."""
    return str(getattr(sys.modules.get(kind.__module__), "__file__", "") or "")


def _file_words(file: str, line: int | None = None) -> str:
    """Return a file as a line of an error names it: from here on where it is below, with the line."""
    path = Path(file)
    short = path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
    return f"{short}:{line}" if line else str(short) if file else ""


@dataclass(frozen=True)
class OwnSettings:
    """Accuracy of a user's class."""

    step_error: float = 0.1  # of a sensor's sd (rms), between n pieces and 2 n
    most_pieces: int = 256  # of a step
    sensor_sd: float = 0.02  # of an output's spread in the logs, where the class states no sd
    # argument of a root, below which its slope is that of the chord: the difference of ``linearise_plant``
    chord: float = 1e-3
    tie: float = 1e-9  # difference of two values that are one but for rounding
    # of a rate times a step: from where on the Runge-Kutta rule grows, and where it damps most, the root of
    # 1 + z + z^2 / 2 + z^3 / 6
    unstable: float = 2.785
    strongest: float = 1.596


OWN = OwnSettings()


@lru_cache(maxsize=32)
def _kernel(code: OwnCode) -> Kernel:
    """Return the compiled steps of a class."""
    from thermogrip.sysid.models.jit_rollout import Kernel  # pulls in llvmlite

    return Kernel(code.step, code.output, code.sizes)


def _symbols(code: OwnCode) -> tuple[list[Any], list[list[Any]]]:
    """Return columns x, u, d, p of CasADi's, and their entries as a class takes them."""
    casadi: Any = import_module("casadi")
    columns = [casadi.SX.sym(letter, n) for letter, n in zip("xudp", code.sizes)]
    return columns, [_for_numpy(casadi.vertsplit(item) if item.numel() else []) for item in columns]


@lru_cache(maxsize=32)
def _balance(code: OwnCode) -> Any:
    """Return a CasADi function of (x, u, d, p) to dx/dt and what the outputs read."""
    casadi: Any = import_module("casadi")
    symbols, (x, u, d, p) = _symbols(code)
    both = _plain([*code.rhs(x, u, d, p)]), code.output(_plain(x), _plain(p))
    return casadi.Function("balance", symbols, [casadi.densify(casadi.vertcat(*values)) for values in both])


@lru_cache(maxsize=32)
def _rate(code: OwnCode, h: float) -> Any:
    """Return a function (x, u, d, p, su, sd) of CasADi's: dx/dt, its derivative by x, and along su and sd."""
    ca: Any = import_module("casadi")
    symbols, lists = _symbols(code)
    x, u, d, p = symbols
    su, sd = (ca.SX.sym("s" + letter, item.numel()) for letter, item in (("u", u), ("d", d)))
    rate = ca.vertcat(*_plain(code.rhs(*lists)))
    blunt = _without_infinite_slopes(rate, symbols)
    by_x = ca.densify(ca.jacobian(blunt, x))
    # a tank that runs empty has a rate that no step follows: the true answer of a sample dies out, that of
    # the rule would grow without bound.  All that the state does is scaled, for what leaves one tank enters
    # another
    speed = -h * ca.diag(by_x)
    scale = ca.if_else(speed > OWN.unstable, OWN.strongest / speed, 1)
    slope = ca.jtimes(blunt, ca.vertcat(u, d), ca.vertcat(su, sd))
    return ca.Function("rate", [x, u, d, p, su, sd], [rate, by_x @ ca.diag(scale), slope])


def _without_infinite_slopes(values: Any, symbols: Sequence[Any]) -> Any:
    """Return the same expressions of CasADi, but that roots are straight lines near 0."""
    ca: Any = import_module("casadi")
    # beside a factor that is 0, such as that of np.maximum(x, 0) below 0, an infinite slope is no number
    function = ca.Function("values", symbols, [values])
    work, results = dict[int, Any](), list(ca.vertsplit(values))
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        into, of = function.instruction_output(k), function.instruction_input(k)
        arguments = [work.get(place) for place in of]
        if operation == ca.OP_OUTPUT:
            results[into[1]] = work[of[0]]
        elif operation == ca.OP_INPUT:
            work[into[0]] = symbols[of[0]][of[1]]
        elif operation == ca.OP_CONST:
            work[into[0]] = ca.SX(function.instruction_constant(k))
        elif operation in (ca.OP_SQRT, ca.OP_POW, ca.OP_CONSTPOW):
            base, power = (*arguments, ca.SX(0.5))[:2]
            is_root = ca.logic_and(base < OWN.chord, ca.logic_and(power > 0, power < 1))
            work[into[0]] = ca.if_else(is_root, base * OWN.chord ** (power - 1), base**power)
        elif operation in (ca.OP_FMAX, ca.OP_FMIN):
            # at a valve's closed end rounding would say whether np.maximum(u, 0) moves
            a, b = (work[place] for place in of)
            is_tie = ca.fabs(a - b) < OWN.tie
            work[into[0]] = ca.if_else(is_tie, 0.5 * (a + b), ca.SX.binary(operation, a, b))
        else:
            operate = ca.SX.unary if len(of) == 1 else ca.SX.binary
            work[into[0]] = operate(operation, *arguments)
    return ca.vertcat(*results)


@dataclass(eq=False)
class OwnModel(Described):
    """The equations of a user's class; the numbers come as ``p``, in the order of :attr:`parameters`."""

    code: OwnCode  # the class, see :func:`own_model`
    pieces: int = 1  # Runge-Kutta steps in ``code.dt``
    sd: Mapping[str, float] | None = None  # sensor sd of outputs for which the class states none

    kind = "own"
    smooth = 0.0  # nothing says that its disturbances are of heat
    command_steps: ClassVar[dict[str, float]] = {}

    def __post_init__(self) -> None:
        code = self.code
        super().__init__(code)
        self.states, self.n_x = tuple(code.states), len(code.states)
        learnt_sd = dict(self.sd or {})
        self.sensor_sd = {name: item.sd or learnt_sd.get(name, 1.0) for name, item in code.outputs.items()}
        self.average, self.warmup = code.average, code.warmup
        self.independent = 4 * self.average
        # no output defines a scale: a log that starts at rest is not recognised as such
        self.reference: str | None = None
        scale = np.array(list(code.states.values()))
        self.spread = np.diag(np.square(scale))
        ends = [item.range for item in code.inputs.values()]
        self.rest_weights = RestWeights(
            state=scale,
            full=np.array([high - low for low, high in (pair or (0.0, 1.0) for pair in ends)]),
            limits=code.limits,
            ranges=np.array([pair or (-np.inf, np.inf) for pair in ends]).reshape(-1, 2),
            flow=self.warmup / scale,
            sensor=1e2 / self._sensors,
            input=1e-2,
        )

    def step(self, x: Values, u: Values, d: Values, p: Values, dt: float) -> list[Any]:
        """Return the state after ``dt`` seconds; numbers, NumPy rows or CasADi symbols alike."""
        n, state = self._pieces(dt), list(x)
        for _ in range(n):
            state = self.code.step(state, u, d, p, dt / n)
        return state

    def slope(self, x: Values, u: Values, d: Values, p: Values, dt: float, along: Sequence[Values]) -> Any:
        """Return the derivative of :meth:`step` along directions of x, u and d, of CasADi's symbols."""
        ca: Any = import_module("casadi")
        state, u, d, p, slope, *others = (ca.vertcat(*values) for values in (x, u, d, p, *along))
        n = self._pieces(dt)
        h, rate = dt / n, _rate(self.code, dt / n)
        for _ in range(n):
            k, by, rates, slopes = 0, 0, [], []
            for share in (0, h / 2, h / 2, h):
                k, by_state, by_others = rate(state + share * k, u, d, p, *others)
                by = by_state @ (slope + share * by) + by_others
                rates.append(k)
                slopes.append(by)
            state, slope = (
                value + h / 6 * (k1 + 2 * (k2 + k3) + k4)
                for value, (k1, k2, k3, k4) in ((state, rates), (slope, slopes))
            )
            for i, (low, high) in enumerate(self.code.limits):
                if np.isfinite([low, high]).any():
                    slope[i] *= ca.logic_and(state[i] >= low, state[i] <= high)
                    state[i] = ca.fmin(ca.fmax(state[i], low), high)
        return slope

    def output(self, x: Values, p: Values) -> list[Any]:
        """Return what the outputs read at state x, a list of length n_y."""
        return self.code.output(x, p)

    def balance(self, x: list[Any], u: list[Any], d: list[Any], p: list[Any]) -> tuple[Array, Array]:
        """Return dx/dt (..., n_x) and what the outputs read (..., n_y), at rows."""
        rows = np.broadcast_shapes(*(np.shape(value) for value in (*x, *u, *d, *p)))
        columns = [[np.broadcast_to(value, rows).ravel() for value in group] for group in (x, u, d, p)]
        whole = [np.reshape(group, (len(group), int(np.prod(rows)))) for group in columns]
        flow, read = _balance(self.code)(*whole)
        return flow.full().T.reshape(*rows, -1), read.full().T.reshape(*rows, -1)

    def rest_of_each(self, y: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike) -> Array:
        """Return the states (k, n_x) of a plant at rest: the class's own, or found ones."""
        with np.errstate(all="ignore"):
            if hasattr(self.code.made, "rest") and np.isfinite(y).any():
                y, u, d = (list(np.asarray(value, dtype=float)) for value in (y, u, d))
                x = np.array([self.code.rest(y, u, d, list(row)) for row in np.asarray(p)], dtype=float)
            else:
                x = super().rest_of_each(y, u, d, p)
        if not np.isfinite(x).all():
            lost = self.states[int(np.flatnonzero(~np.isfinite(x).all(axis=0))[0])]
            hint = "guard roots and divisions with np.maximum, or write rest(self, y, u, d, p)"
            raise self.code.fault(f"has no finite state at rest ({lost} is not)", hint=hint)
        return np.asarray(np.clip(x, *self.code.limits.T))

    def rollout(self, x0: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike, dt: float) -> Run:
        """Simulate a batch."""
        n = self._pieces(dt)
        return _kernel(self.code).rollout(x0, u, d, p, dt / n, pieces=n)

    def prepared(self, free_runs: FreeRuns, spread: Mapping[str, float], p: Array | None = None) -> OwnModel:
        """Return the model with steps short enough for these logs and its sensors' sd known."""
        sd = {name: OWN.sensor_sd * (spread[name] or 1.0) for name in self.outputs}
        model = replace(self, sd=sd)
        p_tried = self.prior if p is None else np.asarray(p, dtype=float)
        runs, n = free_runs(model, p_tried), model.pieces
        # until runs with n and with 2 n pieces differ by less than a tenth of each sensor's sd (rms), and by
        # less than that sd anywhere: for a smooth f the error of 2 n is a sixteenth of that difference
        while n <= OWN.most_pieces:
            finer = replace(model, pieces=2 * n)
            again = free_runs(finer, p_tried)
            if model._agree(runs, again):
                return self if (self.pieces, self.sd) == (n, sd) else model
            model = finer
            runs = again
            n = 2 * n
        for log, run in runs:
            lost_rows = np.flatnonzero(~np.isfinite(run[0]).all(axis=1))
            if lost_rows.size:
                where = f"{int(lost_rows[0]) * self.dt:g} s into {log}"
                problem = f"gives no finite output {where}, with its parameters at their prior values"
                raise self.code.fault(
                    problem, hint="guard roots and divisions with np.maximum, or set limits"
                )
        problem = f"changes too fast for {OWN.most_pieces} Runge-Kutta steps in dt = {self.dt:g} s"
        raise self.code.fault(problem, hint="give a smaller dt, or treat what is that fast as at rest")

    def to_dict(self) -> dict[str, Any]:
        """Return what a plant file says of the class: its name, its file's SHA-256, its signals."""
        return {
            "kind": self.kind,
            "class": self.name,
            "file": Path(self.code.file).name,
            "sha256": self.code.sha256,
            "inputs": list(self.inputs),
            "disturbances": list(self.disturbances),
            "outputs": list(self.outputs),
            "states": list(self.states),
            "pieces": self.pieces,
            "sd": self.sensor_sd,
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> OwnModel:
        """Refuse: the code of a user's class is no part of a file, so it has to be handed in."""
        name, file = data.get("class"), data.get("file") or "FILE.py"
        raise UserError(
            f"its equations are the class {name} of {file}, and opening a plant runs no code",
            hint=f"hand the class in with --network {file}:{name}",
        )

    def restored(self, data: Mapping[str, Any]) -> OwnModel:
        """Return this class as the plant file was fitted with it, step and sensors as they were."""
        if data.get("kind") != self.kind or data.get("class") != self.name:
            was = data.get("class", f"a {data.get('kind')}")
            raise UserError(f"the plant's equations are {was}, not {self.name}", hint="hand that class in")
        if data.get("sha256") not in (None, self.code.sha256):
            problem = "is not what the plant was fitted with: its file has changed"
            raise self.code.fault(problem, hint="fit the plant again, or give the file as it was")
        with reading("its model is not whole", hint="fit the plant again"):
            pieces, sd = int(data["pieces"]), {str(k): float(v) for k, v in data["sd"].items()}
        return replace(self, pieces=max(1, pieces), sd=sd)

    @property
    def _sensors(self) -> Array:
        return np.array([self.sensor_sd[name] for name in self.outputs])

    def _pieces(self, dt: float) -> int:
        """Return the number of Runge-Kutta steps of dt."""
        return max(1, int(np.ceil(self.pieces * dt / self.dt - 1e-9)))

    def _agree(self, runs: Sequence[tuple[str, Array]], finer: Sequence[tuple[str, Array]]) -> bool:
        with np.errstate(all="ignore"):
            change = [np.abs(a - b) / self._sensors for (_, a), (_, b) in zip(runs, finer)]
            rms, most = [np.sqrt((c**2).mean()) for c in change], [c.max() for c in change]
        return bool(np.max(rms) < OWN.step_error and np.max(most) < 1)  # NaN is not less


_LOGICAL = {np.bitwise_and: np.logical_and, np.bitwise_or: np.logical_or, np.invert: np.logical_not}


class _Symbol(NDArrayOperatorsMixin):
    """A symbol of CasADi that NumPy's functions take and that may stand in an array; ``view`` is CasADi's own
    for NumPy, which would fill an array with NaN."""

    def __init__(self, view: Any) -> None:
        self.view = view

    def __array_ufunc__(self, ufunc: Any, method: Any, *inputs: Any, **options: Any) -> Any:
        into = options.pop("out", (None,))[0]  # of h += 1, where the name h then means the sum
        if isinstance(into, np.ndarray):
            into[...] = ufunc(*inputs, **options)
            return into
        if method != "__call__" or options:
            raise TypeError(f"{ufunc.__name__}.{method} of a value that is not known yet")
        if any(isinstance(value, np.ndarray) and value.ndim for value in inputs):
            return np.frompyfunc(ufunc, len(inputs), 1)(
                *(np.asarray(value, dtype=object) for value in inputs)
            )
        return self.__array_function__(_LOGICAL.get(ufunc, ufunc), (), inputs, {})

    def __array_function__(self, function: Any, _types: Any, inputs: Any, options: Any) -> Any:
        if function is np.interp and (options or len(inputs) > 3):  # CasADi has none of them
            raise TypeError("np.interp takes no left, right or period here: clip or wrap its argument")
        result = function(*_bared(inputs), **options)
        if result.shape:
            raise TypeError(f"{function.__name__} of values that are not known yet makes an array")
        return _Symbol(result)

    def __getattr__(self, name: str) -> Any:
        function = getattr(np, name, None)
        if not isinstance(function, np.ufunc):  # which of an array of objects asks each for its own
            raise AttributeError(name)
        return partial(function, self)

    def __bool__(self) -> bool:
        raise TypeError("an if about a value that is not known yet")


class _NumPyOfSymbols:
    """NumPy, but that its new arrays take symbols."""

    def __getattr__(self, name: str) -> Any:
        made = getattr(np, name)
        if name not in ("zeros", "ones", "empty"):
            return made
        return lambda shape, *_args, **_options: made(shape, dtype=object)


@contextmanager
def _arrays_of_symbols(function: Any) -> Iterator[None]:
    """Let the file of a user's function have :class:`_NumPyOfSymbols` for as long as this."""
    names = getattr(function, "__globals__", {})
    aliases = [name for name, value in names.items() if value is np]
    names.update(dict.fromkeys(aliases, _NumPyOfSymbols()))
    try:
        yield
    finally:
        names.update(dict.fromkeys(aliases, np))


def _bared(value: Any) -> Any:
    """Return CasADi's own in place of symbols, in lists too."""
    if isinstance(value, (list, tuple)):
        return [_bared(item) for item in value]
    return value.view if isinstance(value, _Symbol) else value


def _for_numpy(values: Values) -> list[Any]:
    """Return values with CasADi's symbols made such that NumPy's functions take them."""
    casadi: Any = import_module("casadi")
    kinds = (casadi.SX, casadi.MX)
    return [
        _Symbol(casadi.ArrayInterface(value, ndim=0)) if isinstance(value, kinds) else value
        for value in values
    ]


def _plain(values: Values) -> list[Any]:
    """Return values with CasADi's symbols as CasADi knows them."""
    casadi: Any = import_module("casadi")
    return [casadi.vertcat(value.view) if isinstance(value, _Symbol) else value for value in values]


def own_model(kind: Any) -> OwnModel:
    """Return a user's class, or an instance of one, as a model.

    Parameters
    ----------
    kind : type or object
        What it must say: :mod:`thermogrip.sysid.models.user_model`.

    Raises
    ------
    UserError
        If the class lacks something or its functions do not answer with the right number of values.

    Examples
    --------
    A tank that drains with a time constant of 100 s (after which e^-1 is left):

    >>> class Tank:
    ...     inputs, outputs, states, dt = {"pump": "V"}, {"level": "V"}, {"level": 0.1}, 4.0
    ...     parameters = {"time": {"value": 100.0, "sd_log": 0.7, "unit": "s"}}
    ...     def rhs(self, x, u, d, p):
    ...         return [u.pump - x.level / p.time]
    >>> model = own_model(Tank)
    >>> y, _ = model.rollout([[1.0]], np.zeros((1, 25, 1)), np.zeros((1, 25, 0)), [[100.0]], 4.0)
    >>> float(y[0, -1, 0].round(6)), float(np.exp(-1).round(6))
    (0.367879, 0.367879)
    """
    try:
        made = kind() if inspect.isclass(kind) else kind
    except Exception as error:  # the user's own code
        problem = f"{kind.__name__} cannot be made without arguments ({type(error).__name__}: {error})"
        where = _file_words(_file_of(kind)) or None
        raise UserError(problem, file=where, hint="give its arguments defaults") from error
    code = OwnCode(made)
    model = OwnModel(code)
    x, u, d, p = map(_plain, _symbols(code)[1])
    # finds out an if, what symbols cannot say, and what is another each time
    if str(code.step(x, u, d, p, code.dt)) != str(code.step(x, u, d, p, code.dt)):
        problem = "gives another rhs each time it is called with the same arguments"
        raise code.fault(problem, hint="draw no random numbers there, and keep nothing from call to call")
    code.output(x, p)
    with np.errstate(all="ignore"):
        code.rest([1.0] * len(model.outputs), [1.0] * len(u), [1.0] * len(d), model.prior.tolist())
    return model
