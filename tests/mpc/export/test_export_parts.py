"""Parts of an export that the whole cannot tell apart: operations one by one, what counts as agreement."""

from __future__ import annotations

import ctypes
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import block_diag

from tests.mpc.conftest import make_tank
from tests.mpc.export.test_export import heater, kit
from thermogrip.datasets.errors import UserError
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.export import export
from thermogrip.mpc.export.export import Agreement
from thermogrip.mpc.interface import STATUSES, Move
from thermogrip.mpc.native import build, design_struct
from thermogrip.mpc.native.build import build_library, compiler, model_header, model_source
from thermogrip.mpc.native.codegen import _OPERATIONS, ModelCode, _Line, write_model
from thermogrip.mpc.native.design_struct import numbers_of, sizes_of
from thermogrip.mpc.plant.prediction import PredictionModel
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.plant.plant import Plant

needs_gcc = pytest.mark.skipif(compiler() is None or shutil.which("make") is None, reason="no gcc here")

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
        done, told = _OPERATIONS[f"OP_{name}"][1], 0
        for x, y in PAIRS:
            want = meant(name, (x, y))
            if not np.isfinite(want):
                continue  # Python raises where C has a NaN
            first = 2.5 if name == "CONSTPOW" else y
            values = [x, first][
                : len({part for part in ("{0}", "{1}") if part in _OPERATIONS[f"OP_{name}"][0]})
            ]
            assert done(*values) == pytest.approx(want, rel=1e-14), (name, x, y)
            told += 1
        assert told >= 1 + (name not in ("ACOSH",)), name


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
    plant = make_tank(joule=0.05) if name == "tank" else prior_plant(load_network(name))
    model, rng = PredictionModel(plant, dt=plant.dt), np.random.default_rng(0)
    code = write_model(model.model, model.drive_index, model.dt, name="tg_model")
    files = {"tg_model.h": model_header(code, "tg_model"), "tg_model.c": model_source(code, "tg_model")}
    library = ctypes.CDLL(str(build_library(files)))
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
    # and its slopes along three directions at once, with and without the disturbances
    _, A, B, E = model.linearise(x, u, d)
    sx, su, sd = (rng.normal(size=(n, 3)) for n in (model.n_x, model.n_u, model.n_d))
    m, out = np.zeros(code.n_m), np.zeros((model.n_x, 3))
    library.tg_model_partials(given(x), given(u), given(d), given(k), given(after), given(m))
    np.testing.assert_allclose(after, model.next_state(x, u, d), rtol=1e-10)
    library.tg_model_tangent(3, 3, given(m), given(k), given(sx), given(su), given(out))
    np.testing.assert_allclose(out, A @ sx + B @ su, atol=1e-9)
    library.tg_model_tangent_d(3, 3, given(m), given(k), given(sx), given(su), given(sd), given(out))
    np.testing.assert_allclose(out, A @ sx + B @ su + E @ sd, atol=1e-9)
    if name == "gripper":
        assert model.model.switches  # the pump


# ---- the library ----


@needs_gcc
def test_a_library_is_another_where_compiler_flags_or_machine_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    files = {"one.c": "int one(void);\nint one(void) { return 1; }\n", "one.h": "\n"}
    first = build_library(files)
    assert first.parent == tmp_path / "thermogrip"
    seen = {first, build_library({"one.c": files["one.c"], "two.h": "\n"})}
    monkeypatch.setattr(build, "_machine", lambda gcc: "another")
    seen.add(build_library(files))
    monkeypatch.setattr(build, "_FLAGS", tuple(flag for flag in build._FLAGS if flag != "-O3"))
    seen.add(build_library(files))
    assert len(seen) == 4
    assert build_library(dict(reversed(files.items()))) in seen  # the order of the files says nothing


@needs_gcc
def test_a_nan_stays_one_in_a_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    source = "int lost(double x);\nint lost(double x) { return x != x; }\n"
    library = ctypes.CDLL(str(build_library({"lost.c": source})))
    library.lost.argtypes = [ctypes.c_double]
    assert [library.lost(x) for x in (0.0, float("inf"), float("nan"))] == [0, 0, 1]


def test_without_gcc_no_library_is_built(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PATH", "")
    with pytest.raises(RuntimeError, match="no gcc"):
        build_library({"one.c": "\n"})


def test_a_header_is_read_once_and_a_source_includes_it():
    code = ModelCode("double a;\n", "extern double a;\n", 0, 0, _Line())
    cpp, plain = "#ifdef __cplusplus", "extern double a;"
    lines = [line for line in model_header(code, "tg_x").splitlines() if line]
    assert lines[:2] == ["#ifndef TG_X_H", "#define TG_X_H"]
    assert lines[2:] == [cpp, 'extern "C" {', "#endif", plain, cpp, "}", "#endif", "#endif"]
    assert model_source(code, "tg_x") == '#include "tg_x.h"\n\n#include <math.h>\n\ndouble a;\n'


# ---- agreement ----


@pytest.mark.parametrize(
    ("difference", "status", "iterations", "passed"),
    [(1e-9, 7, 7, True), (1.1e-9, 7, 7, False), (0.0, 6, 7, False), (0.0, 7, 6, False), (0.0, 6, 6, False)],
)
def test_an_export_passes_where_drives_statuses_and_iterations_are_the_same(
    difference: float, status: int, iterations: int, passed: bool
):
    assert Agreement(7, difference, 3, status, iterations, 1, 1, 1).passed == passed


def test_sanitizers_must_not_change_an_answer():
    line = "0 3 " + " ".join(value.hex() for value in (0.25, -0.5))
    export._same_answers([line, line], [line, line])
    near = "0 3 " + " ".join(value.hex() for value in (0.25 + 1e-11, -0.5))
    export._same_answers([line], [near])
    for other in ("1" + line[1:], "0 4" + line[3:], "0 3 " + " ".join(v.hex() for v in (0.25, -0.5001))):
        with pytest.raises(UserError, match="answers otherwise under the sanitizers"):
            export._same_answers([line, line], [line, other])


def answer_of(move: Move, twin: Any, shift: float = 0.0) -> list[str]:
    model = twin.model
    drive = model.vector(move.drive, model.drives) if isinstance(move.drive, dict) else np.array([move.drive])
    plan = np.zeros((0, model.n_u)) if twin.plan is None else twin.plan
    numbers = np.concatenate([drive[None] + shift, plan]).ravel().tolist()
    return [str(STATUSES.index(move.status)), str(twin.last_iterations), *(v.hex() for v in numbers)]


@pytest.mark.parametrize(("make", "span"), [(heater, 1.0), (kit, 100.0)])
def test_a_difference_is_told_in_shares_of_a_drives_range(make: Any, span: float):
    twin = export._twin(make())
    rng, seen = np.random.default_rng(0), set()
    for _ in range(24 if span == 1.0 else 2):
        state = export._random_state(twin, rng)
        given = {name: getattr(state, name) for name in ("x", "w", "d", "u", "plan", "target", "side")}
        twin.clock.step = 60.0 if state.late else 0.0
        twin.place(**given)
        reading = dict(zip(twin.model.outputs, state.y.tolist())) | dict(
            zip(twin.model.disturbances, state.d_now.tolist())
        )
        move = twin.step(reading, dict(zip(twin.controlled, state.wanted.tolist())))
        same = answer_of(move, twin)
        difference, free, status, iterations = export._compare(twin, state, same)
        assert (difference, status, iterations) == (0.0, True, True)
        moved = export._compare(twin, state, answer_of(move, twin, shift=1e-3 * span))[0]
        assert moved == pytest.approx(1e-3)
        assert export._compare(twin, state, same[:-1] if span == 1.0 else same[:-2])[0] == np.inf
        other = [str((int(same[0]) + 1) % 6), str(int(same[1]) + 1), *same[2:]]
        assert export._compare(twin, state, other)[2:] == (False, False)
        seen.add(free)
        drives = np.array(list(move.drive.values()) if isinstance(move.drive, dict) else [move.drive])
        if free:  # then it is inside its range, and its slew from where it was
            assert np.all((drives > 0) & (drives < span))
            assert np.all(np.abs(drives - state.u) < twin.optimiser.slew)
    assert span != 1.0 or True in seen  # the kit's are hardly ever


def test_a_check_says_the_largest_difference_and_how_often_each_was_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    controller = heater()
    made, told = export.Export(tmp_path, (), 100, 50), []
    answers = iter([(0.0, True, True, True), (2e-3, False, True, False), (1e-4, True, True, True)])
    monkeypatch.setattr(export, "compiler", lambda: "gcc")
    monkeypatch.setattr(export, "_make", lambda folder, *targets: told.append(targets))
    monkeypatch.setattr(export, "_answers", lambda export, given, sanitize: ["0 1"] * len(given))
    monkeypatch.setattr(export, "_compare", lambda twin, state, answer: next(answers))
    monkeypatch.setattr(export, "_footprint", lambda folder: (7000, 300))
    found = export.check_export(made, controller, states=3)
    assert found == Agreement(3, 2e-3, 2, 3, 2, 7000, 100, 300)
    assert told == [("all", "sanitized")]


def test_the_model_of_an_export_takes_the_controllers_own_steps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    plant = kit().plant
    controller = Controller(plant, default_design(plant, dt=10.0))
    assert controller.model.sub == 2
    lengths: list[float] = []
    whole = export.write_model

    def watched(model: Any, drives: Any, h: float, *, name: str) -> ModelCode:
        lengths.append(h)
        return whole(model, drives, h, name=name)

    monkeypatch.setattr(export, "write_model", watched)
    export.export_controller(controller, tmp_path)
    assert lengths == [5.0]


def test_random_states_hold_some_of_every_misfortune():
    twin = export._twin(heater())
    rng = np.random.default_rng(1)
    states = [export._random_state(twin, rng) for _ in range(400)]
    share = {
        "late": np.mean([s.late for s in states]),
        "no plan": np.mean([s.plan is None for s in states if not s.late]),
        "late without a plan": np.mean([s.plan is None for s in states if s.late]),
        "lost": np.mean([np.isnan(s.y) for s in states]),
        "moved target": np.mean([np.any(s.wanted != s.target) for s in states]),
        "out of range": np.mean([np.any((s.u < 0) | (s.u > 1)) for s in states]),
    }
    wanted = {"late": 0.05, "no plan": 0.05, "late without a plan": 0.5, "lost": 0.03, "moved target": 0.3}
    for name, value in wanted.items():
        n = {"late without a plan": 20}.get(name, 400)
        assert abs(share[name] - value) < 4 * np.sqrt(value * (1 - value) / n), name
    assert share["out of range"] < 0.05
    for state in states[:50]:
        assert state.flat().size == states[0].flat().size
        assert np.all((state.plan_text >= 0) & (state.plan_text <= 1))


def gripper() -> Controller:
    """The gripper's network at its prior: 28 states, most of them a pump's delay."""
    model = load_network("gripper")
    values = dict(zip(model.parameters, model.prior.tolist(), strict=True))
    valid = {"drive": (-1.0, 1.0), "t_tank": (5.0, 60.0), "t_surface": (5.0, 60.0)}
    plant = Plant(model, values, dt=model.dt, units=model.units, valid=valid)
    return Controller(plant, default_design(plant))


def test_nearly_every_random_state_is_one_for_the_optimiser():
    """One whose reading is left out as a jump is not; and to find a rest for each takes longer than that."""
    twin = export._twin(gripper())
    rng, rests, solved = np.random.default_rng(0), [], []
    rest = twin.model.rest
    vars(twin.model)["rest"] = lambda y, d: rests.append(1) or rest(y, d)
    for _ in range(40):
        state = export._random_state(twin, rng)
        export._compare(twin, state, ["0", "0"])
        solved.append(twin.last_iterations > 0)
    assert np.mean(solved) > 0.8
    assert len(rests) < 60  # a place for each, and a few to start with


# ---- sizes and words ----


def test_a_search_has_room_for_its_variants_and_an_export_for_itself():
    controller: Controller = kit(controlled=("t2",), limits={"t1": (0.0, 50.0)})
    tight, wide = (sizes_of(controller, 5, 6, room=room) for room in (False, True))
    N = sum(controller.design.blocks)
    assert (tight.NH, tight.NC, tight.NL, tight.NS) == (N, 1, 1, 2)
    assert (wide.NH % 32, wide.NC, wide.NL, wide.NS) == (0, 2, 2, 4)
    assert N <= wide.NH < N + 32
    model = controller.model
    assert (model.n_x, 2, model.n_d, 2) == (tight.NX, tight.NU, tight.ND, tight.NY)
    assert (5, 6, model.n_x + controller.disturbance.n_w) == (tight.NK, tight.NM, tight.NZ)


def test_numbers_of_a_design_are_the_plants_offsets_and_its_rest_in_any_room():
    plant = replace(make_tank(), offsets={"t_tank": 0.4, "t_surface": -0.2})
    controller = Controller(plant, default_design(plant))
    model, ambient = controller.model, controller.design.ambient
    numbers = numbers_of(controller, np.zeros(3))
    assert numbers["offset"].tolist() == [0.4, -0.2]
    y, d = np.array([31.0, 28.0]), np.array([19.0])
    level = np.mean(y - numbers["offset"])
    x = numbers["rest"] + numbers["rest_level"] * (level - ambient) + numbers["rest_d"] @ (d - ambient)
    H = np.hstack([model.C, numbers["on_output"]])
    P = block_diag(numbers["P_rest"], np.diag(numbers["P0"]))
    miss = y - numbers["offset"] - model.output(x)
    after = x + (P @ H.T @ np.linalg.solve(H @ P @ H.T + np.diag(numbers["R_start"]), miss))[: model.n_x]
    controller.observer.reset(y, d)
    np.testing.assert_allclose(after, controller.observer.x, atol=1e-9)  # exactly so for a linear plant
    assert np.abs(numbers["rest_d"]).max() > 1e-4


def test_what_is_smaller_than_its_field_stands_in_the_fields_first_corner():
    sizes = replace(sizes_of(heater(), 1, 1, room=False), NB=3, NU=4)
    found = design_struct._padded(sizes, "at_rest", [[1, 2], [3, 4]])
    assert found.tolist() == [[1, 2, 0, 0], [3, 4, 0, 0], [0, 0, 0, 0]]


def test_the_readme_gives_the_controllers_own_numbers(tmp_path: Path):
    controller = kit(limits={"t1": (0.0, 50.0)})
    made = export.export_controller(controller, tmp_path)
    text = " ".join((tmp_path / "README.md").read_text().split())
    assert "q1 in [0, 100]; q2 in [0, 100]" in text
    for number in (made.ram, made.constants):
        assert f"{number} bytes" in text or str(number) in text
    low, high = export._range_of(controller)
    assert (low, high) == (20.0, 60.0)
    room = np.full(controller.model.n_d, controller.design.ambient)
    off = []
    for level in np.linspace(low, high, 5):  # as far as the plant is not its tangent about the room
        controller.observer.reset(np.full(2, level), room)
        x = controller.observer.x
        controller.observer.reset_in_room(np.full(2, level), room)
        off.append(np.abs(controller.observer.x - x).max())
    assert export._rest_error(controller, low, high) == pytest.approx(max(off))
    assert f"at most {max(off):.2g} degC" in text
    plain = replace(controller.plant, valid={})
    assert export._range_of(Controller(plain, controller.design)) == (15.0, 45.0)


def test_the_stack_is_the_largest_frame_of_the_library(tmp_path: Path):
    (tmp_path / "tg_a.su").write_text("a.c:1:2:f\t64\tstatic\na.c:9:2:g\t1200\tstatic\n")
    (tmp_path / "tg_b.su").write_text("b.c:1:2:h\t320\tstatic\n")
    (tmp_path / "check.su").write_text("check.c:1:2:main\t9000\tstatic\n")  # not of the library
    if shutil.which("size") is not None:
        assert export._footprint(tmp_path)[1] == 1200


def test_a_move_is_all_well_unless_it_says_otherwise():
    move = Move(0.5)
    assert (move.pump, move.status, move.advice, move.seconds, move.plan) == (1, "ok", "", 0.0, {})
    assert STATUSES == (
        "ok",
        "late",
        "infeasible",
        "fallback_plan",
        "fallback_pi",
        "off",
    )  # as the C counts them
