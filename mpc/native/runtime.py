"""The controller's C, built where gcc is there, in place of the same thing in Python.

The sources of an export (:mod:`thermogrip.mpc.controllers.export`), with a model's step written by
:mod:`thermogrip.mpc.native.codegen`, become a library in the user's cache directory.  It is named by the hash
of all that went into it: sources, flags, and what the compiler says of the machine.  A second controller of
the same structure (any parameters, any weights) finds it built; anything else is built beside it.

:class:`CompiledOptimiser` and :class:`CompiledObserver` answer what their Python parents answer, to 1e-10.
Nothing needs them: without gcc, or with ``THERMOGRIP_COMPILED=0`` in the environment, Python does the work.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.code_cache import code_cache, only_ours
from thermogrip.mpc.estimator.observer import Observer
from thermogrip.mpc.native.codegen import ModelCode, write_model
from thermogrip.mpc.native.design_struct import (
    Sizes,
    as_structure,
    config_header,
    filter_modes,
    numbers_of,
    sizes_of,
)
from thermogrip.mpc.optimiser.rti import Optimiser, Outcome, Sample

if TYPE_CHECKING:
    from thermogrip.mpc.optimiser.rti import ControllerParts
    from thermogrip.mpc.plant.prediction import PredictionModel
    from thermogrip.sysid.models.model import Model

#: The C files that every export shares.
_CODE = ("tg_qp", "tg_controller", "tg_observer", "tg_optimiser")
SOURCES = ("tg_qp.h", "tg_controller.h", *(f"{name}.c" for name in _CODE))

# sums may be done in any order and pairs of operations at once; NaN keeps its meaning
_FLAGS = (
    *(
        "-std=c99",
        "-O2",
        "-fvect-cost-model=dynamic",
        "-fno-inline-functions-called-once",
        "-march=native",
        "-fno-math-errno",
        "-fno-trapping-math",
        "-fno-signed-zeros",
    ),
    *("-fassociative-math", "-ffp-contract=fast", "-fPIC", "-shared"),
)


def compiler() -> str | None:
    """Return the path of gcc, None where there is none."""
    return shutil.which("gcc")


def wanted() -> bool:
    """Return whether compiled code is to be used: gcc is there, and nobody said no."""
    return os.environ.get("THERMOGRIP_COMPILED", "1") != "0" and compiler() is not None


def c_source(name: str) -> str:
    """Return a C file of the package."""
    return (resources.files("thermogrip.mpc.native") / "csource" / name).read_text(encoding="utf-8")


def build_library(files: dict[str, str]) -> Path:
    """Return a shared library of these C files, from the cache where it was built before; a RuntimeError has
    the first words of a compiler that refuses."""
    gcc = compiler()
    if gcc is None:
        raise RuntimeError("no gcc")
    text = "\n".join(f"{name}\n{content}" for name, content in sorted(files.items()))
    key = hashlib.sha256("\n".join([*_FLAGS, _machine(gcc), text]).encode()).hexdigest()[:32]
    path = code_cache() / f"mpc-{key}.so"
    if path.is_file() and only_ours(path):
        return path
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        for name, content in files.items():
            (Path(folder) / name).write_text(content, encoding="utf-8")
        units = [name for name in files if name.endswith(".c")]
        command = [gcc, *_FLAGS, *units, "-lm", "-o", "built.so"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"gcc refused: {done.stderr.strip()[:300]}")
        built = Path(folder) / "built.so"
        built.chmod(0o755)
        os.replace(built, path)  # whole, or not there
    return path


@cache
def _machine(gcc: str) -> str:
    """Return what the compiler says of itself and of this machine."""
    command = [gcc, "-march=native", "-dM", "-E", "-x", "c", os.devnull]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout


#: What tg_qp.h calls its answers.
QP_STATUS = ("solved", "infeasible", "iteration limit", "not convex", "not finite", "time limit")


_codes: dict[tuple[_ByStructure, tuple[int, ...], float], ModelCode] = {}


def _written(model: _ByStructure, drives: tuple[int, ...], h: float) -> ModelCode:
    key = (model, drives, h)
    if key not in _codes:
        _codes[key] = write_model(model.model, drives, h)
    return _codes[key]


#: Structure, drives and step of a model, and its C.
KnownCode: TypeAlias = tuple[str, tuple[int, ...], float, ModelCode]


def known_codes() -> list[KnownCode]:
    """Return the C of models that this process has written, for :func:`remember_codes` of another one."""
    return [(model.text, drives, h, code) for (model, drives, h), code in _codes.items() if model.complete]


def remember_codes(codes: Sequence[KnownCode]) -> None:
    """Take over what another process has written."""
    for text, drives, h, code in codes:
        _codes.setdefault((_ByStructure.named(text), drives, h), code)


def _code_of(model: PredictionModel) -> ModelCode:
    return _written(_ByStructure(model.model), tuple(model.drive_index), model.dt / model.sub)


class _ByStructure:
    """A model that counts as any other of the same equations."""

    def __init__(self, model: Model) -> None:
        # equations in a file of the user's own are not in what a model saves: only itself is the same
        self.complete = model.kind in ("network", "statespace", "sindy")
        self.model = model
        self.text = repr(model.to_dict()) if self.complete else f"{model.kind} {id(model)}"

    @classmethod
    def named(cls, text: str) -> _ByStructure:
        """Return what counts as a model of these equations, without the model."""
        made = object.__new__(cls)
        made.text, made.complete = text, True
        return made

    def __hash__(self) -> int:
        return hash(self.text)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ByStructure) and other.text == self.text


@cache
def _truth_library(model: _ByStructure, drives: tuple[int, ...], h: float) -> ctypes.CDLL:
    return ctypes.CDLL(str(build_library(_written(model, drives, h).files)))


@cache
def _library(path: Path) -> ctypes.CDLL:
    library = ctypes.CDLL(str(path))
    doubles, integers = "x w P found_offset innovation between", "held lost"
    for names, kind in ((doubles, ctypes.c_double), (integers, ctypes.c_int)):
        for name in names.split():
            getattr(library, f"tg_host_{name}").restype = ctypes.POINTER(kind)
    library.tg_advice_text.restype = ctypes.c_char_p
    library.tg_host_size.restype = library.tg_host_design_size.restype = ctypes.c_long
    return library


class CompiledController:
    """The C of one controller, loaded: its design and one state, for optimiser, observer and trials."""

    def __init__(self, controller: ControllerParts) -> None:
        model = controller.model
        step = _code_of(model)
        self.sizes: Sizes = sizes_of(controller, step, room=True)
        files = {name: c_source(name) for name in (*SOURCES, "tg_host.c")} | step.files
        self.library = _library(build_library(files | {"tg_config.h": config_header(self.sizes)}))
        k = np.zeros(max(1, step.n_k))
        self.library.tg_host_prepare(address(np.ascontiguousarray(model.p)), address(k))
        self.design = as_structure(self.sizes, numbers_of(controller, k[: step.n_k]))
        if ctypes.sizeof(self.design) != self.library.tg_host_design_size():
            raise RuntimeError("the C struct and its table disagree")
        self.modes = filter_modes(controller)
        self.advice = ""  # of the last step
        self._room = np.zeros(self.library.tg_host_size() // 8 + 8)
        self.state = ctypes.c_void_p(self._room.ctypes.data)
        self.begin()

    def begin(self) -> None:
        """Clear the state."""
        self.library.tg_host_begin(self.state, ctypes.byref(self.design))

    def reset(self, y: Array, d: Array, like: Observer | None = None) -> None:
        """Start at rest at reading y (n_y,), disturbances d (n_d,); with the estimate of an observer, where
        one is given, in place of the one of the plant linearised in its room."""
        given = np.ascontiguousarray(y, float), np.ascontiguousarray(d, float)
        self.library.tg_host_reset(self.state, address(given[0]), address(given[1]))
        if like is not None:
            estimate = like.estimate()
            estimate["P"] = self.kept(estimate["P"])
            for name, values in estimate.items():
                self.view(name, values.shape)[...] = values

    def step(
        self,
        y: Array,
        d: Array,
        target: Array,
        *,
        time_s: float = np.nan,
        applied: Array | None = None,
    ) -> tuple[Array, int, int]:
        """Do one step of the whole controller in C and return drives (n_u,), pump, and the place in
        :data:`thermogrip.mpc.interface.STATUSES`, for readings, disturbances and targets in degC, NaN where
        lost; without a time one sample has passed, without ``applied`` (n_u,) the last answer was."""
        given = [np.ascontiguousarray(values, float) for values in (y, d, target)]
        did = None if applied is None else np.ascontiguousarray(applied, float)
        drive, over, what = np.zeros(self.sizes.NU), ctypes.c_double(), np.zeros(4, dtype=np.int32)
        self.library.tg_host_step(
            self.state,
            ctypes.c_double(time_s),
            address(given[0]),
            address(given[1]),
            None if did is None else address(did),
            *(address(given[2]), address(drive), ctypes.byref(over), address(what)),
        )
        self.advice = self.library.tg_advice_text(int(what[2])).decode()
        return drive, int(what[0]), int(what[1])

    def kept(self, P: Array) -> Array:
        """Return the filter's covariance (n_z, n_z) of states, modes or not, as the C keeps it."""
        return P if self.modes is None else self.modes.into(P)

    def covariance(self) -> Array:
        """Return the filter's covariance (n_z, n_z) of states."""
        P = self.view("P", (self.sizes.NZ, self.sizes.NZ)).copy()
        return P if self.modes is None else self.modes.out_of(P)

    def view(self, name: str, shape: tuple[int, ...]) -> NDArray[Any]:
        """Return an array that shares memory with a part of the state: ``x``, ``w``, ``P``
        (see :meth:`kept`), ``found_offset``, ``innovation``, ``between`` or ``held``."""
        pointer = getattr(self.library, f"tg_host_{name}")(self.state)
        return np.ctypeslib.as_array(pointer, shape=shape)


class _Truth(ctypes.Structure):
    _fields_ = [
        ("next", ctypes.c_void_p),
        ("n_x", ctypes.c_int),
        *((name, ctypes.c_void_p) for name in ("x", "after", "k", "C", "y0")),
    ]


class CompiledTruth:
    """A plant in C that closes a loop."""

    def __init__(self, model: PredictionModel) -> None:
        code = _code_of(model)
        self._library = _truth_library(
            _ByStructure(model.model), tuple(model.drive_index), model.dt / model.sub
        )
        self._k = np.zeros(max(1, code.n_k))
        self._library.tg_model_prepare(address(np.ascontiguousarray(model.p)), address(self._k))
        self._C = np.ascontiguousarray(model.C)
        self._level = model.output(np.zeros(model.n_x))

    def at(self, x: Array, offset: Array) -> tuple[_Truth, Any]:
        """Return the C struct at state x (n_x,) behind sensors of offset (n_y,), and what it points to."""
        held = (np.array(x, dtype=float), np.zeros(len(x)), self._k, self._C, self._level + offset)
        after = ctypes.cast(self._library.tg_model_next, ctypes.c_void_p)
        return _Truth(after, len(x), *(address(values) for values in held)), held


class CompiledOptimiser(Optimiser):
    """:class:`Optimiser` whose samples are solved in C."""

    def __init__(self, like: Optimiser, c: CompiledController) -> None:
        self.__dict__.update(like.__dict__)
        self._c = c
        n, n_u, model = self.n_b * self.model.n_u, self.model.n_u, self.model
        self._plan, self._y = np.zeros((self.n_b, n_u)), np.zeros((self.N, model.n_y))
        self._authority_now, self._over = np.zeros((self.n_b, n_u)), ctypes.c_double()
        self._iterations = ctypes.c_int()
        self._lost = c.view("lost", (len(self.design.controlled),))
        n_c = len(self.design.controlled)
        # one block of memory for what goes in, so that a call costs next to nothing
        lengths = (model.n_x, n_u, n, model.n_d, n_c, n_c, model.n_y, n_u, 2 + self.n_b)
        self._given = np.zeros(sum(lengths))
        ends = np.cumsum(lengths)
        self._parts = [self._given[end - length : end] for end, length in zip(ends, lengths)]
        self._arguments = (
            c.state,
            *(address(part) for part in self._parts),
            *(address(values) for values in (self._plan, self._y, self._authority_now)),
            ctypes.byref(self._over),
            ctypes.byref(self._iterations),
        )
        self._run = c.library.tg_host_optimise

    def solve(self, sample: Sample) -> Outcome:
        """Improve a plan; see :meth:`Optimiser.solve`."""
        if sample.d.ndim > 1:
            return super().solve(sample)
        *parts, slew = self._parts
        for part, values in zip(parts, sample[:8], strict=True):
            part[:] = values.ravel()
        slew[:2] = self.design.dt if sample.slew_s is None else sample.slew_s, sample.caution
        slew[2:] = self.counted(sample.prices)
        self._lost[:] = 0 if sample.lost is None else sample.lost
        if sample.ahead is None:
            status = QP_STATUS[self._run(*self._arguments)]
        else:
            ahead = np.ascontiguousarray(sample.ahead, float)
            self._c.library.tg_host_goals(self._c.state, address(ahead))
            status = QP_STATUS[self._run(*self._arguments)]
            self._c.library.tg_host_goals(self._c.state, None)
        y, authority, iterations = self._y.copy(), self._authority_now[0].copy(), self._iterations.value
        if status != "solved":
            plan = np.full(self._plan.shape, np.nan)
            return Outcome(plan, y, status, {}, iterations, authority)
        broken = self._broken(y) if self._over.value > 0.1 else {}
        return Outcome(self._plan.copy(), y, status, broken, iterations, authority)

    def forget(self) -> None:
        """Start afresh."""
        super().forget()
        self._c.library.tg_host_forget(self._c.state)


class CompiledObserver(Observer):
    """:class:`Observer` whose filter runs in C."""

    def __init__(self, like: Observer, c: CompiledController) -> None:
        self._c = c
        n_x, n_w, n_z = like.model.n_x, like.disturbance.n_w, c.sizes.NZ
        self._views = {
            "x": c.view("x", (n_x,)),
            "w": c.view("w", (n_w,)),
            "_P": c.view("P", (n_z, n_z)),
            "_held": c.view("held", (n_z,)),
            "found_offset": c.view("found_offset", (like.model.n_y,)),
            "innovation": c.view("innovation", (like.model.n_y,)),
        }
        for name, value in like.__dict__.items():
            setattr(self, name, value)

    def __setattr__(self, name: str, value: Any) -> None:
        if name in self.__dict__.get("_views", ()):
            self._views[name][...] = self._c.kept(value) if name == "_P" else value
        else:
            object.__setattr__(self, name, value)

    def __getattr__(self, name: str) -> Any:
        views = self.__dict__.get("_views", {})
        if name not in views:
            raise AttributeError(name)
        if name == "_P":
            return self._c.covariance()
        return views[name] if name == "_held" else views[name].copy()

    def _on_sample(self) -> None:
        self._c.view("between", (3,))[...] = 0.0
        super()._on_sample()

    @property
    def now(self) -> Array:
        """The state (n_x,) where readings are compared."""
        n_u, n_x = self.model.n_u, self.model.n_x
        between = self._c.view("between", (3 + n_u + n_x,))
        return between[3 + n_u :].copy() if between[1] > 0 else self.x

    def update(self, y: Array) -> Array:
        """Correct the estimate with a reading (n_y,), NaN where lost; return the innovation (n_y,)."""
        innovation = y - self.reading()
        self._c.library.tg_observer_update(self._c.state, address(np.ascontiguousarray(y, float)))
        return np.asarray(innovation)

    def refine(self, y: Array) -> None:
        """Correct the estimate with a reading (n_y,) between two moves."""
        self._c.library.tg_observer_refine(self._c.state, address(np.ascontiguousarray(y, float)))

    def predict(self, u: Array, d: Array) -> None:
        """Carry the estimate one sample on under drives u (n_u,) and disturbances d (n_d,)."""
        drives, held = np.ascontiguousarray(u, float), np.ascontiguousarray(d, float)
        self._c.library.tg_observer_predict(self._c.state, address(drives), address(held))

    def advance(self, seconds: float, u: Array, d: Array) -> None:
        """Let so many seconds pass under drives u (n_u,) and disturbances d (n_d,)."""
        drives, held = np.ascontiguousarray(u, float), np.ascontiguousarray(d, float)
        passed = ctypes.c_double(seconds)
        self._c.library.tg_observer_advance(self._c.state, passed, address(drives), address(held))

    def look(self, d: Array) -> None:
        """Look where :meth:`advance` has come to."""
        self._c.library.tg_observer_look(self._c.state, address(np.ascontiguousarray(d, float)))


def address(values: NDArray[Any]) -> ctypes.c_void_p:
    """Return the pointer to an array's numbers, for as long as the array lives."""
    return ctypes.c_void_p(values.ctypes.data)
