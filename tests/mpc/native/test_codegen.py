"""A model's step in C: each operation does what CasADi does, and so do the step and its slopes."""

from __future__ import annotations

import ctypes
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from tests.mpc.makers import make_tank, network_plant
from thermogrip.mpc.native.codegen import _OPERATIONS, write_model
from thermogrip.mpc.native.runtime import build_library, compiler
from thermogrip.mpc.plant.prediction import PredictionModel

needs_gcc = pytest.mark.skipif(compiler() is None, reason="no gcc here")

X = ca.SX.sym("x")
Y = ca.SX.sym("y")
#: Every operation in CasADi's own words.
WORDS = {
    "ASSIGN": X, "ADD": X + Y, "SUB": X - Y, "MUL": X * Y, "DIV": X / Y, "NEG": -X, "SQ": X * X,
    "TWICE": 2 * X, "INV": 1 / X, "LT": X < Y, "LE": X <= Y, "EQ": X == Y, "NE": X != Y,
    "AND": ca.logic_and(X, Y),
    "OR": ca.logic_or(X, Y), "NOT": ca.logic_not(X), "SIGN": ca.sign(X), "IF_ELSE_ZERO": ca.if_else(X, Y, 0),
    "POW": X**Y, "CONSTPOW": X**2.5, "FMIN": ca.fmin(X, Y), "FMAX": ca.fmax(X, Y), "FMOD": ca.fmod(X, Y),
    "COPYSIGN": ca.copysign(X, Y), "ATAN2": ca.atan2(X, Y), "HYPOT": ca.hypot(X, Y), "FABS": ca.fabs(X),
    "FLOOR": ca.floor(X), "CEIL": ca.ceil(X), "ERF": ca.erf(X), "LOG1P": ca.log1p(X), "EXPM1": ca.expm1(X),
} | {
    name.upper(): getattr(ca, name)(X)
    for name in ("exp", "log", "sqrt", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh",
                 "asinh", "acosh", "atanh")
}  # fmt: skip
PAIRS = [
    (0.3, 0.7),
    (0.7, 0.3),
    (0.5, 0.5),
    (2.6, 1.3),
    (1.5, -2.5),
    (-1.5, 0.4),
    (-0.4, -0.6),
    (0.0, 1.2),
    (0.9, 0.0),
]


def meant(name: str, pair: tuple[float, float]) -> float:
    return float(ca.Function("f", [X, Y], [WORDS[name]])(*pair))


def test_every_operation_does_in_python_what_casadi_does():
    assert {f"OP_{name}" for name in WORDS} == set(_OPERATIONS)
    for name in WORDS:
        done, compared = _OPERATIONS[f"OP_{name}"][1], 0
        for x, y in PAIRS:
            want = meant(name, (x, y))
            if not np.isfinite(want):
                continue  # Python raises where C has a NaN
            first = 2.5 if name == "CONSTPOW" else y
            values = [x, first][
                : len({part for part in ("{0}", "{1}") if part in _OPERATIONS[f"OP_{name}"][0]})
            ]
            assert done(*values) == pytest.approx(want, rel=1e-14), (name, x, y)
            compared += 1
        assert compared >= 1 + (name not in ("ACOSH",)), name


@needs_gcc
def test_every_operation_does_in_c_what_casadi_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    lines = [
        f"    out[{k}] = {_OPERATIONS[f'OP_{name}'][0].format('x', '2.5' if name == 'CONSTPOW' else 'y')};"
        for k, name in enumerate(WORDS)
    ]
    head = "void all(double x, double y, double *out);\n"
    body = "\n".join(lines)
    source = f"#include <math.h>\n{head}void all(double x, double y, double *out)\n{{\n{body}\n}}\n"
    library = ctypes.CDLL(str(build_library({"all.c": source})))
    library.all.argtypes = [ctypes.c_double, ctypes.c_double, ctypes.POINTER(ctypes.c_double)]
    for pair in PAIRS:
        out = (ctypes.c_double * len(WORDS))()
        library.all(*pair, out)
        for name, value in zip(WORDS, out, strict=True):
            np.testing.assert_allclose(value, meant(name, pair), rtol=1e-14, err_msg=f"{name} {pair}")


@needs_gcc
@pytest.mark.parametrize("name", ["gripper", "peltier_chamber", "tank"])
def test_the_step_in_c_is_the_models_with_its_switches_on(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    plant = make_tank(joule=0.05) if name == "tank" else network_plant(name)
    model, rng = PredictionModel(plant, dt=plant.dt), np.random.default_rng(0)
    code = write_model(model.model, model.drive_index, model.dt)
    library = ctypes.CDLL(str(build_library(code.files)))
    at = ctypes.POINTER(ctypes.c_double)

    def given(values: Any) -> Any:
        return np.ascontiguousarray(values, dtype=float).ctypes.data_as(at)

    k, after = np.zeros(code.n_k), np.zeros(model.n_x)
    library.tg_model_prepare(given(plant.p), given(k))
    np.testing.assert_allclose(code.constants(plant.p.tolist()), k, rtol=1e-13)
    for _ in range(5):
        x = 25.0 + 3.0 * rng.normal(size=model.n_x)
        u, d = rng.uniform(model.lowest, model.highest), 22.0 + rng.normal(size=model.n_d)
        library.tg_model_next(given(x), given(u), given(d), given(k), given(after))
        np.testing.assert_allclose(after, model.next_state(x, u, d), rtol=1e-10)
    # and its slopes along six directions, two groups of four, with and without drives and disturbances
    _, A, B, E = model.linearise(x, u, d)
    sx, su, sd = (rng.normal(size=(n, 8)) for n in (model.n_x, model.n_u, model.n_d))
    h, m, out = np.zeros(4 * code.n_h + 1), np.zeros(code.n_m), np.zeros((2, model.n_x, 4))
    groups = [np.stack([part[:, :4], part[:, 4:]]) for part in (sx, su, sd)]
    library.tg_model_hold_slopes(1, given(u), given(k), given(h))
    library.tg_model_partials(given(x), given(u), given(d), given(k), given(h), given(after), given(m))
    np.testing.assert_allclose(after, model.next_state(x, u, d), rtol=1e-10)
    meant = {"": A @ sx, "_u": A @ sx + B @ su, "_d": A @ sx + B @ su + E @ sd}
    for count, (what, want) in enumerate(meant.items(), 1):
        tangent = getattr(library, f"tg_model_tangent{what}")
        kept = [np.ascontiguousarray(group) for group in groups[:count]]
        tangent(2, given(m), given(k), given(h), *(given(group) for group in kept), given(out))
        np.testing.assert_allclose(np.hstack([out[0], out[1]]), want, atol=1e-9)
    # what holds for a step alone is the beginning of what holds for its slopes
    less = np.full(4 * code.n_h + 1, np.nan)
    library.tg_model_hold(1, given(u), given(k), given(less))
    seen = np.isfinite(less)
    np.testing.assert_array_equal(less[seen], h[seen])
    library.tg_model_step(given(x), given(u), given(d), given(k), given(less), given(after))
    np.testing.assert_allclose(after, model.next_state(x, u, d), rtol=1e-10)
    # and of four blocks each is what it is alone
    drives, each = rng.uniform(model.lowest, model.highest, (4, model.n_u)), np.zeros(4 * code.n_h + 1)
    drives[2] = u
    library.tg_model_hold_slopes(4, given(drives), given(k), given(each))
    np.testing.assert_allclose(each[2:-1:4], h[:-1:4], rtol=1e-12, atol=1e-12)
    library.tg_model_step(given(x), given(u), given(d), given(k), given(each[2:]), given(after))
    np.testing.assert_allclose(after, model.next_state(x, u, d), rtol=1e-10)
    if name == "gripper":
        assert model.model.switches  # the pump


def test_a_state_that_parameters_alone_decide_is_handed_over():
    model: Any = SimpleNamespace(disturbances=(), parameters=("a",), n_x=1, inputs=("q",))
    model.step = lambda x, u, d, p, h: [2.0 * p[0]]
    code = write_model(model, [0], 1.0)
    assert (code.constants([3.0]), "xn[0] = k[0];" in code.source) == ([6.0], True)
