"""Plants and controllers that the tests of this room share."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from thermogrip.datasets.arrays import Array
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.reference import ReferenceController
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.native.runtime import QP_STATUS, CompiledController, compiler
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

GCC = pytest.mark.skipif(compiler() is None, reason="no gcc here")


def make_tank(
    *, heat: float = 0.11, joule: float = 0.0, loss: float = 1 / 700, skin: float = 12.0, delay: int = 8
) -> Plant:
    """Return a tank (heated by ``heat`` K/s at full drive), ``delay`` steps of 1 s of tube, a skin that lags.

    ``joule`` K/s grows with the square of the drive, so the gain turns over at drive = -heat / (2 joule).
    """
    a, s = float(np.exp(-loss)), float(np.exp(-1 / skin))
    n = 2 + delay
    A, B, E, F = np.zeros((n, n)), np.zeros((n, 1)), np.zeros((n, 1)), np.zeros((n, 1))
    A[0, 0], A[1, 1], A[1, n - 1] = a, s, 0.98 * (1 - s)
    E[0, 0], E[1, 0] = 1 - a, 0.02 * (1 - s)
    A[2, 0] = 1.0
    for k in range(3, n):
        A[k, k - 1] = 1.0
    B[0, 0], F[0, 0] = heat, joule
    C = np.zeros((2, n))
    C[0, 0] = C[1, 1] = 1.0
    model = StateSpaceModel(
        ("drive", "pump"),
        ("t_ambient",),
        ("t_tank", "t_surface"),
        A=A,
        B=np.hstack([B, np.zeros((n, 1))]),
        C=C,
        dt=1.0,
        E=E,
        switches=("pump",),
        terms=("drive*drive",),
        F=F,
    )
    units = {"drive": "1", "pump": "1", "t_ambient": "degC", "t_tank": "degC", "t_surface": "degC"}
    valid = {"drive": (-1.0, 1.0), "t_tank": (5.0, 60.0), "t_surface": (8.0, 52.0)}
    noise = {"t_tank": 0.06, "t_surface": 0.06}
    return Plant(model, {}, dt=1.0, units=units, valid=valid, noise=noise, logs=("made up",))


def network_plant(name: str, **valid: tuple[float, float]) -> Plant:
    """Return a bundled network at its prior, drives in their whole range."""
    model = load_network(name)
    values = dict(zip(model.parameters, model.prior.tolist(), strict=True))
    whole = (0.0, 100.0) if name == "tclab" else (-1.0, 1.0)
    valid = dict.fromkeys(model.inputs, whole) | valid
    return Plant(model, values, dt=model.dt, units=model.units, reference=model.reference, valid=valid)


def crossed(q2: str = "percent") -> Plant:
    """Return two heaters: at rest a = room + 0.2 q2 and b = room + 0.25 q1; poles 0.9 and 0.8."""
    A, B = np.diag([0.9, 0.8]), np.array([[0.0, 0.02], [0.05, 0.0]])
    E, names = np.array([[0.1], [0.2]]), ("q1", "q2", "room", "a", "b")
    model = StateSpaceModel(names[:2], names[2:3], names[3:], A=A, B=B, E=E, C=np.eye(2), dt=2.0)
    units = {"q1": "percent", "q2": q2} | dict.fromkeys(names[2:], "degC")
    return Plant(model, {}, dt=2.0, units=units, valid={"q1": (0.0, 100.0), "q2": (0.0, 100.0)})


def heater(make: Callable[..., Any] = Controller, **changes: Any) -> Any:
    """Return the controller of one drive and one output, nothing measured beside."""
    a = float(np.exp(-0.05))
    A, B = np.array([[a, 40 * (1 - a)], [0, 0]]), np.array([[0.0], [1.0]])
    model = StateSpaceModel(("q",), (), ("t",), A=A, B=B, C=np.eye(1, 2), dt=5.0, y0=np.full(1, 25.0))
    plant = Plant(model, {}, dt=5.0, units={"q": "1"}, valid={"q": (0.0, 1.0), "t": (20.0, 60.0)})
    return make(plant, default_design(plant, **changes))


def kit(make: Callable[..., Any] = Controller, *, dt: float = 5.0, **changes: Any) -> Any:
    """Return the controller of two heaters and two sensors in a fan's room: drives in percent."""
    plant = network_plant("tclab", t1=(20.0, 60.0), t2=(20.0, 60.0))
    return make(plant, default_design(plant, dt=dt, **changes))


#: What makes a controller of a plant and a design whose steps are in Python, in C.
WAYS = [ReferenceController, pytest.param(Controller, marks=GCC)]


def start_in_c(controller: Controller, y: ArrayLike) -> Array:
    """Return the state (n_x,) at which the C alone starts from outputs y (n_y,)."""
    y, c = np.asarray(y, dtype=float), controller.c
    assert c is not None
    c.given[:] = [*y.tolist(), *[float("nan")] * (len(c.given) - len(y))]
    c.reset()
    return c.view("x", (controller.model.n_x,)).copy()


def solve_in_c(
    c: CompiledController,
    H: Array,
    f: Array,
    A: Array,
    lower: Array,
    upper: Array,
    *,
    linear: float,
    quadratic: float,
    warm: bool = False,
) -> tuple[Array, str, int]:
    """Return x (n,), status and iterations of one QP: bounds, differences of neighbours, then soft rows A."""
    bounds = [np.clip(v, -1e30, 1e30) for v in (lower, upper)]
    given = [np.ascontiguousarray(v, float) for v in (H, f, *bounds, A)]
    x, iterations = np.zeros(len(f)), ctypes.c_int()
    pointers = [ctypes.c_void_p(values.ctypes.data) for values in (*given, x)]
    weights = ctypes.c_double(linear), ctypes.c_double(quadratic)
    flag = c.library.tg_host_qp(
        c.state, len(f), len(A), *pointers[:-1], *weights, int(warm), pointers[-1], ctypes.byref(iterations)
    )
    return x, QP_STATUS[flag], iterations.value
