"""A class of the user's own: what it must say, how it is called, and whose fault an error is.

    class Tank:
        inputs = {"pump": "V"}
        outputs = {"level": {"unit": "V", "sd": 0.05}}
        states = {"level": 0.1}
        parameters = {"inflow": {"value": 0.1, "sd_log": 0.7, "unit": "1/s"}, "outflow": 0.05}
        dt = 4.0

        def rhs(self, x, u, d, p):
            return [p.inflow * u.pump - p.outflow * np.sqrt(np.maximum(x.level, 0.0))]

No import of thermogrip is needed.  The arguments are named tuples, so ``x.level``, ``x[0]`` and
``level, = x`` mean the same.  The same lines run on numbers, on rows of a batch, compiled, and on CasADi
symbols, so a choice between two values is ``np.where`` or ``np.maximum``, never ``if``.

Whatever goes wrong inside the user's code is theirs to correct, so it becomes one line that names the file,
the class and, for an exception, the line of their code where it was raised.
"""

from __future__ import annotations

import difflib
import hashlib
import importlib.util
import inspect
import keyword
import sys
import traceback
from collections import namedtuple
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from thermogrip.datasets.arrays import Values
from thermogrip.datasets.errors import UserError
from thermogrip.sysid.models.network_spec import Parameter

_REQUIRED = {
    "inputs": 'inputs = {"pump": "V"}: name and unit of each',
    "outputs": 'outputs = {"level": "V"}: name and unit of each',
    "states": 'states = {"level": 0.1}: each with how unsure it is where a log begins',
    "parameters": 'parameters = {"area": {"value": 2.0, "sd_log": 0.7, "unit": "m2"}}',
    "dt": "dt = 1.0: the step of the simulation in seconds",
    "rhs": "def rhs(self, x, u, d, p): return dx/dt of each state",
}
_OPTIONAL = ("disturbances", "limits", "output", "rest", "average", "warmup")


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Input(_Table):
    """Something that is moved; ``switch`` marks a pump or valve that is on or off."""

    unit: Annotated[str, Field(min_length=1)]
    range: tuple[float, float] | None = None
    switch: bool = False


class Output(_Table):
    """A sensor: ``sd`` of a bin's mean about the model, ``log_sd`` of its offset from log to log."""

    unit: Annotated[str, Field(min_length=1)]
    sd: Annotated[float, Field(gt=0)] | None = None
    log_sd: Annotated[float, Field(ge=0)] = 0.0


class Disturbance(_Table):
    """Something measured and not moved; ``log_sd`` of its sensor's offset from log to log."""

    unit: Annotated[str, Field(min_length=1)]
    log_sd: Annotated[float, Field(ge=0)] = 0.0


class _State(_Table):
    sd: Annotated[float, Field(gt=0)]


class OwnCode:
    """A user's class, its tables checked and its functions guarded; from :func:`read_class`."""

    def __init__(self, made: Any) -> None:
        self.made, self.name = made, type(made).__name__
        self.file = _file_of(type(made))
        self._check_attributes()
        self.inputs = self._table("inputs", Input, short="unit")
        self.outputs = self._table("outputs", Output, short="unit")
        self.disturbances = self._table("disturbances", Disturbance, short="unit")
        self.parameters = self._table("parameters", Parameter, short="value")
        self.states = {name: item.sd for name, item in self._table("states", _State, short="sd").items()}
        self.limits = self._limits()
        self.dt = self._seconds("dt") or 1.0
        self.average, self.warmup = self._seconds("average"), self._seconds("warmup")
        for what in ("outputs", "states", "parameters"):
            if not getattr(self, what):
                raise self.fault(f"has no {what}", hint=_REQUIRED[what])
        self.X, self.U = _tuple("states", self.states), _tuple("inputs", self.inputs)
        self.D, self.P = _tuple("disturbances", self.disturbances), _tuple("parameters", self.parameters)
        self.Y = _tuple("outputs", self.outputs)
        if not hasattr(made, "output") and not set(self.outputs) <= set(self.states):
            lost = next(name for name in self.outputs if name not in self.states)
            raise self.fault(
                f"does not say what output {lost!r} reads: it is no state",
                hint="def output(self, x, p): return what each output reads",
            )

    @property
    def sha256(self) -> str | None:
        """Of the file that the class is in, line ends aside; None where there is no file."""
        if not Path(self.file).is_file():
            return None
        text = Path(self.file).read_bytes().replace(b"\r\n", b"\n")
        return hashlib.sha256(text).hexdigest()

    def rhs(self, x: Values, u: Values, d: Values, p: Values) -> list[Any]:
        """Return dx/dt, a list of length n_x."""
        args = (self.X(*x), self.U(*u), self.D(*d), self.P(*p))
        return self._call("rhs", self.states, args)

    def output(self, x: Values, p: Values) -> list[Any]:
        """Return what the outputs read, a list of length n_y."""
        if not hasattr(self.made, "output"):
            named = dict(zip(self.states, x))
            return [named[name] for name in self.outputs]
        return self._call("output", self.outputs, (self.X(*x), self.P(*p)))

    def rest(self, y: Values, u: Values, d: Values, p: Values) -> list[Any] | None:
        """Return the class's own state at rest, None where it has no such function."""
        if not hasattr(self.made, "rest"):
            return None
        return self._call("rest", self.states, (self.Y(*y), self.U(*u), self.D(*d), self.P(*p)))

    def fault(self, problem: str, *, line: int | None = None, hint: str | None = None) -> UserError:
        """Return the error that names file and class."""
        where = _shown(self.file, line)
        return UserError(f"{self.name} {problem}", file=where or None, hint=hint)

    def _call(self, what: str, names: Mapping[str, Any], args: tuple[Any, ...]) -> list[Any]:
        try:
            got = getattr(self.made, what)(*args)
        except UserError:
            raise
        except Exception as error:  # the user's own code may raise anything
            raise self._raised(what, error) from error
        try:
            values = list(got)
        except TypeError:
            values = [got]
        if len(values) != len(names):
            raise self.fault(
                f"returns {len(values)} numbers from {what}, not {len(names)}",
                hint=f"return one for each of {', '.join(names)}",
            )
        return values

    def _raised(self, what: str, error: Exception) -> UserError:
        """Return the line about an exception inside the user's function."""
        frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename == self.file]
        line = frames[-1].lineno if frames else None
        said, hint = f"{type(error).__name__}: {error}", f"correct {what}"
        fields = getattr(error.obj, "_fields", None) if isinstance(error, AttributeError) else None
        if isinstance(error, AttributeError) and fields is not None:
            group = type(error.obj).__name__
            said = f"{error.name!r} is not among its {group}"
            hint = f"they are {', '.join(fields)}" if fields else f"it has no {group}"
        elif isinstance(error, ValueError) and "truth value" in str(error):
            said, hint = "an if about many values at once", "choose with np.where or np.maximum"
        return self.fault(f"fails in {what}: {said}", line=line, hint=hint)

    def _check_attributes(self) -> None:
        """Refuse a class that lacks something or seems to misspell it."""
        for name, example in _REQUIRED.items():
            if not hasattr(self.made, name):
                raise self.fault(f"lacks {name}", hint=f"write {example}")
        known = (*_REQUIRED, *_OPTIONAL)
        for name in vars(type(self.made)):
            near = difflib.get_close_matches(name, _OPTIONAL, n=1, cutoff=0.8)
            if near and name not in known and not hasattr(self.made, near[0]):
                raise self.fault(f"has {name!r}, which nothing reads", hint=f"call it {near[0]!r}")
        if not callable(self.made.rhs):
            raise self.fault("has an rhs that is not a function", hint=f"write {_REQUIRED['rhs']}")

    def _table(self, what: str, kind: Any, *, short: str) -> dict[str, Any]:
        """Return a checked table; a bare value is that of its ``short`` key."""
        table = getattr(self.made, what, {})
        if not isinstance(table, Mapping):
            raise self.fault(f"has {what} that are not a table", hint=f"write {_REQUIRED[what]}")
        out = {}
        for name, item in table.items():
            if not isinstance(name, str) or not name.isidentifier() or name.startswith("_"):
                raise self.fault(f"has {name!r} in {what}", hint="use letters, digits and underscores")
            if keyword.iskeyword(name):
                raise self.fault(f"has {name!r} in {what}, a word of Python's own", hint="choose another")
            content = dict(item) if isinstance(item, Mapping) else {short: item}
            if kind is Parameter:
                content = {"unit": "1", "fixed": not isinstance(item, Mapping)} | content
            try:
                out[name] = kind.model_validate(content)
            except ValidationError as error:
                first = error.errors()[0]
                key = ".".join(str(part) for part in first["loc"])
                said = first["msg"].removeprefix("Value error, ")
                raise self.fault(f"{what} {name}{': ' + key if key else ''}: {said}") from error
        return out

    def _limits(self) -> dict[str, tuple[float, float]]:
        out = {}
        for name, ends in dict(getattr(self.made, "limits", {})).items():
            if name not in self.states:
                raise self.fault(f"limits {name!r}, which is no state", hint=f"use {', '.join(self.states)}")
            try:
                low, high = ends
                low = -float("inf") if low is None else float(low)
                high = float("inf") if high is None else float(high)
            except (TypeError, ValueError):
                low = high = 0.0
            if not low < high:
                raise self.fault(f"limits {name} to {ends!r}", hint="write (lowest, highest), None for open")
            out[name] = (low, high)
        return out

    def _seconds(self, what: str) -> float | None:
        value = getattr(self.made, what, None)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < float("inf"):
            raise self.fault(f"has {what} = {value!r}", hint="give seconds, more than 0")
        return float(value)


def read_class(kind: Any) -> OwnCode:
    """Return a user's class (or an instance of one), checked."""
    if not inspect.isclass(kind):
        return OwnCode(kind)
    try:
        made = kind()
    except Exception as error:  # the user's own code
        problem = f"{kind.__name__} cannot be made without arguments ({type(error).__name__}: {error})"
        where = _shown(_file_of(kind))
        raise UserError(problem, file=where or None, hint="give its arguments defaults") from error
    return OwnCode(made)


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
        frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename == spec.origin]
        line = error.lineno if isinstance(error, SyntaxError) else frames[-1].lineno if frames else None
        where = _shown(str(spec.origin), line)
        problem = f"fails with {type(error).__name__}: {error}"
        raise UserError(problem, file=where, hint="correct the file") from error
    if not hasattr(module, name):
        classes = [n for n, item in vars(module).items() if inspect.isclass(item) and hasattr(item, "rhs")]
        hint = f"it has {', '.join(classes)}" if classes else "name a class that is in it"
        raise UserError(f"has no {name!r}", file=path, hint=hint)
    return getattr(module, name)


def _file_of(kind: type) -> str:
    """Return the file of a class, "" where it was typed in."""
    module = sys.modules.get(kind.__module__)
    return str(getattr(module, "__file__", "") or "")


def _shown(file: str, line: int | None = None) -> str:
    """Return a file as a line of an error names it: from here on where it is below, with the line."""
    if not file:
        return ""
    path = Path(file)
    short = path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
    return str(short) if line is None else f"{short}:{line}"


def _tuple(what: str, names: Mapping[str, Any]) -> Callable[..., Any]:
    """Return the named tuple type of these fields."""
    return namedtuple(what, list(names))
