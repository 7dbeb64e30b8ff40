"""The controller's C, built where gcc is there.

The sources of an export (:mod:`thermogrip.mpc.controllers.export`), with a model's step written by
:mod:`thermogrip.mpc.native.codegen`, become a library in the user's cache directory.  It is named by the hash
of all that went into it: sources, flags, and what the compiler says of the machine.  A second controller of
the same structure (any parameters, any weights) finds it built; anything else is built beside it.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array
from thermogrip.mpc.design.relays import NOW_S, SHORTEST_S, Switches
from thermogrip.mpc.native.code_cache import code_cache, only_ours
from thermogrip.mpc.native.codegen import ModelCode, write_model
from thermogrip.mpc.native.design_struct import Sizes, as_structure, config_header, numbers_of, sizes_of

if TYPE_CHECKING:
    from thermogrip.mpc.optimiser.rti import ControllerParts
    from thermogrip.mpc.plant.prediction import PredictionModel
    from thermogrip.sysid.models.model import Model

#: The C files that every export shares.
_CODE = ("tg_qp", "tg_controller", "tg_observer", "tg_optimiser")
SWITCHES = ("tg_switches.h", "tg_switches.c")  # where drives are switched
SOURCES = ("tg_qp.h", "tg_controller.h", *(f"{name}.c" for name in _CODE))

_BUILD = ("-std=c99", "-O2", "-march=native", "-fvect-cost-model=dynamic", "-fPIC", "-shared")
# sums may be done in any order and pairs of operations at once; NaN keeps its meaning
_ARITHMETIC = ("-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros", "-fassociative-math")
_GCC_FLAGS = (*_BUILD, *_ARITHMETIC, "-ffp-contract=fast", "-fno-inline-functions-called-once")


def compiler() -> str | None:
    """Return the path of gcc, None where there is none."""
    return shutil.which("gcc")


def wanted() -> bool:
    """Return whether compiled code is to be used: gcc is there, and nobody said no."""
    return os.environ.get("THERMOGRIP_COMPILED", "1") != "0" and compiler() is not None


def c_source(name: str) -> str:
    """Return a C file of the package."""
    return (resources.files("thermogrip.mpc.native") / "csource" / name).read_text(encoding="utf-8")


def relay_rows(switches: Switches, drives: Sequence[str]) -> list[tuple[float, ...]]:
    """Return the numbers of ``tg_relay`` of each switch: drive, opposite, full and least times."""
    place = {switch: number for number, switch in enumerate(switches.each)} | {None: -1}
    return [
        (drives.index(one.drive), place[one.opposite], one.full, one.on_s, one.off_s, one.dead_s)
        for one in switches.each
    ]


def relays_header(switches: Switches, drives: Sequence[str]) -> str:
    """Return ``tg_relays.h``: the numbers of relays, and those that all share."""
    rows = ",\n".join(f"    {{{', '.join(map(repr, row))}}}" for row in relay_rows(switches, drives))
    numbers = {"count": len(switches.each), "now": NOW_S, "shortest": SHORTEST_S}
    return c_source("tg_relays.h.in").format(rows=rows, **numbers)


def build_library(files: dict[str, str]) -> Path:
    """Return a shared library of these C files, from the cache where it was built before."""
    gcc = compiler()
    if gcc is None:
        raise RuntimeError("no gcc")
    text = "\n".join(f"{name}\n{content}" for name, content in sorted(files.items()))
    key = hashlib.sha256("\n".join([*_GCC_FLAGS, _machine(gcc), text]).encode()).hexdigest()[:32]
    path = code_cache() / f"mpc-{key}.so"
    if path.is_file() and only_ours(path):
        return path
    if key in _refused:
        raise RuntimeError(_refused[key])
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        for name, content in files.items():
            (Path(folder) / name).write_text(content, encoding="utf-8")
        units = [name for name in files if name.endswith(".c")]
        command = [gcc, *_GCC_FLAGS, *units, "-lm", "-o", "built.so"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode:
            _refused[key] = f"gcc refused: {done.stderr.strip()[:300]}"
            raise RuntimeError(_refused[key])
        built = Path(folder) / "built.so"
        built.chmod(0o755)
        os.replace(built, path)  # whole, or not there
    return path


_refused: dict[str, str] = {}  # what gcc said of libraries that it did not build, so as not to ask it again


@cache
def _machine(gcc: str) -> str:
    """Return what the compiler says of itself and of this machine."""
    command = [gcc, "-march=native", "-dM", "-E", "-x", "c", os.devnull]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout


#: What tg_qp.h calls its answers.
QP_STATUS = ("solved", "infeasible", "iteration limit", "not convex", "not finite", "time limit")


@cache
def _model_code(model: _ByStructure, drives: tuple[int, ...], h: float) -> ModelCode:
    return write_model(model.model, drives, h)


def _code_of(model: PredictionModel) -> ModelCode:
    return _model_code(_ByStructure(model.model), tuple(model.drive_index), model.dt / model.sub)


class _ByStructure:
    """A model that counts as any other of the same equations."""

    def __init__(self, model: Model) -> None:
        # equations in a file of the user's own are not in what a model saves: only itself is the same
        complete = model.kind in ("network", "statespace", "sindy")
        self.model = model
        self.text = repr(model.to_dict()) if complete else f"{model.kind} {id(model)}"

    def __hash__(self) -> int:
        return hash(self.text)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ByStructure) and other.text == self.text


@cache
def _truth_library(model: _ByStructure, drives: tuple[int, ...], h: float) -> ctypes.CDLL:
    return ctypes.CDLL(str(build_library(_model_code(model, drives, h).files)))


@cache
def _loaded_library(path: Path) -> ctypes.CDLL:
    library = ctypes.CDLL(str(path))
    doubles, integers = "x w P found_offset seen target y unread_s", "stays qp_status"
    for names, kind in ((doubles, ctypes.c_double), (integers, ctypes.c_int)):
        for name in names.split():
            getattr(library, f"tg_host_{name}").restype = ctypes.POINTER(kind)
    library.tg_host_size.restype = library.tg_host_design_size.restype = ctypes.c_long
    return library


class CompiledController:
    """The C of one controller, loaded: its design and one state."""

    def __init__(self, controller: ControllerParts, late: Callable[[], bool] | None = None) -> None:
        model = controller.model
        code = _code_of(model)
        self.sizes: Sizes = sizes_of(controller, code, room=True)
        files = {name: c_source(name) for name in (*SOURCES, *SWITCHES, "tg_host.c")} | code.files
        files["tg_relays.h"] = relays_header(Switches({}, {}), ())
        self.library = _loaded_library(build_library(files | {"tg_config.h": config_header(self.sizes)}))
        k = np.zeros(max(1, code.n_k))
        self.library.tg_host_prepare(address(np.ascontiguousarray(model.p)), address(k))
        self.design = as_structure(self.sizes, numbers_of(controller, k[: code.n_k]))
        if ctypes.sizeof(self.design) != self.library.tg_host_design_size():
            raise RuntimeError("the C struct and its table disagree")
        self._memory = np.zeros(self.library.tg_host_size() // 8 + 8)
        self.state = ctypes.c_void_p(self._memory.ctypes.data)
        self.library.tg_host_begin(self.state, ctypes.byref(self.design))
        n_u = self.sizes.NU
        # outputs, disturbances, drives that were applied, time and targets, NaN where there is none
        self.given = (ctypes.c_double * (model.n_y + model.n_d + n_u + 1 + self.sizes.NC))()
        self.answer = (ctypes.c_double * (n_u + 7))()  # see ``tg_host_step`` of ``tg_host.c``
        self._step, self._seconds = self.library.tg_host_step, ctypes.c_double(controller.design.deadline_s)
        self._places = ctypes.byref(self.given), ctypes.byref(self.answer)
        self._until = ctypes.c_double()
        if late is None:
            self._late: Any = self.library.tg_host_clock
        else:
            self._late = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p)(lambda _: int(late()))
        self.library.tg_host_late(self.state, self._late, ctypes.byref(self._until))

    def reset(self, estimate: Mapping[str, Array] | None = None) -> None:
        """Start at rest at what is ``given``, with this estimate where there is one."""
        self.library.tg_host_reset(self.state, self._places[0])
        for name, values in ({} if estimate is None else estimate).items():
            self.view(name, values.shape)[...] = values

    def step(self, paused: bool = False) -> None:
        """Do one step with what is ``given``; ``paused`` while the pump is off."""
        self._step(self.state, self._places[0], paused, self._seconds, self._places[1])

    def plan(self) -> Array | None:
        """Return the drives (N, n_u) that are planned from now on, if any are."""
        plan = np.zeros((self.design.N, self.sizes.NU))
        return plan if self.library.tg_host_plan(self.state, address(plan)) else None

    def view(self, name: str, shape: tuple[int, ...]) -> NDArray[Any]:
        """Return an array that shares memory with a part of the state; see :func:`_loaded_library`."""
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
        arrays = (np.array(x, dtype=float), np.zeros(len(x)), self._k, self._C, self._level + offset)
        after = ctypes.cast(self._library.tg_model_next, ctypes.c_void_p)
        return _Truth(after, len(x), *(address(values) for values in arrays)), arrays


def address(values: NDArray[Any]) -> ctypes.c_void_p:
    """Return the pointer to an array's numbers, for as long as the array lives."""
    return ctypes.c_void_p(values.ctypes.data)
