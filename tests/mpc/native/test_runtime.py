"""The controller in C: the same answers as in Python, the same loops, the same fallbacks, from the cache."""

from __future__ import annotations

import ctypes
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from tests.mpc.makers import network_plant
from thermogrip.mpc.closed_loop.simulate import ClosedLoop, Surroundings, simulate_closed_loop
from thermogrip.mpc.closed_loop.simulate_native import compiled_loop
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.controllers.reference import ReferenceController
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.native import runtime as build
from thermogrip.mpc.native.runtime import build_library, compiler, wanted
from thermogrip.mpc.optimiser.rti import Sample
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

pytestmark = pytest.mark.skipif(compiler() is None, reason="no gcc here")

LIMITS = {"t_tank": (8.0, 45.0)}


@pytest.fixture(scope="module")
def plant(tank_maker) -> Plant:
    return tank_maker(joule=0.05)


@pytest.fixture(scope="module")
def pair(plant) -> tuple[ReferenceController, Controller]:
    design = default_design(plant, limits=LIMITS)
    return ReferenceController(plant, design), Controller(plant, design)


@pytest.fixture(scope="module")
def tclab() -> Plant:
    return network_plant("tclab")


def test_what_is_kept_of_a_linear_plant_is_what_would_be_made_anew(tank_maker):
    # lost outputs are another program; between them the first one comes back
    plant = tank_maker(joule=0.0)
    design = default_design(plant, dt=2.0, controlled=("t_tank", "t_surface"), limits=LIMITS)
    kept, fresh = (ReferenceController(plant, design) for _ in range(2))
    assert kept.model.affine is not None
    x, rng, room = np.full(kept.model.n_x, 25.0), np.random.default_rng(2), np.array([25.0])
    for k in range(40):
        x = x + rng.normal(size=x.size)
        last = rng.uniform(-1, 1, 1)
        about = {"target": rng.uniform(15, 40, 2), "side": rng.choice([-1.0, 0, 1], 2)}
        about |= {"bias": 0.2 * rng.normal(size=2), "drive_bias": 0.02 * rng.normal(size=1)}
        about["lost"] = np.array([k % 7 == 3, False])
        guess = np.repeat(last[None], kept.optimiser.n_b, axis=0)
        sample = Sample(x, last, guess, room, **about)
        if k % 9 == 8:  # nothing of a program that fails is kept
            lost = sample._replace(x=np.full(x.size, np.nan))
            assert kept.optimiser.solve(lost).status == "not finite"
        one = kept.optimiser.solve(sample)
        fresh.optimiser = type(kept.optimiser)(fresh.model, design)
        two = fresh.optimiser.solve(sample)
        assert one.status == two.status == "solved"
        np.testing.assert_allclose(one.plan, two.plan, atol=1e-7)
        np.testing.assert_allclose(one.y, two.y, atol=1e-6)
        drives = np.repeat(one.plan + about["drive_bias"], design.blocks, axis=0)
        y, _ = kept.model.run(x[None], drives[None], room)
        np.testing.assert_allclose(one.y, y[0, 1:] + about["bias"], atol=1e-6)


def rod(n: int = 24) -> Plant:
    """Return masses in a row, first and last heated, three of them read: a step reaches few neighbours."""
    flow = np.diag(np.full(n, -0.004))
    for k in range(n - 1):
        flow[k : k + 2, k : k + 2] += 0.3 * np.array([[-1.0, 1.0], [1.0, -1.0]])
    whole = np.zeros((n + 3, n + 3))
    whole[:n, :n], whole[0, n], whole[-4, n + 1], whole[:n, -1] = flow, 1.0, 0.5, 0.004
    step, C = expm(whole), np.zeros((3, n))
    C[0, 3] = C[1, n - 3] = C[2, n // 2] = 1.0
    A, B, E = step[:n, :n], step[:n, n : n + 2], step[:n, n + 2 :]
    names = ("q1", "q2"), ("room",), ("a", "b", "c")
    model = StateSpaceModel(*names, A=A, B=B, C=C, E=E, dt=1.0, y0=[0.0] * 3)
    return Plant(model, {}, dt=1.0, units={"q1": "1", "q2": "1"}, valid={"q1": (0.0, 1.0), "q2": (0.0, 1.0)})


def test_a_rod_of_many_masses_is_the_same_in_c():
    """What its Jacobian is below rounding is left out, its outputs are predicted by tables; one of three has
    neither target nor limit."""
    plant = rod()
    design = default_design(plant, controlled=("a", "b"), limits={"a": (0.0, 44.0)})
    python, c = ReferenceController(plant, design), Controller(plant, design)
    truth, rng, statuses = python.model, np.random.default_rng(3), []
    x, d = np.full(truth.n_x, 25.0), np.array([26.0])
    reading, applied = dict.fromkeys(("a", "b", "c"), 25.0) | {"room": 25.0}, dict[str, float]()
    for controller in (python, c):
        controller.reset(reading)
    for k in range(110):
        target = {"a": 41.0 if k < 80 else 28.0, "b": 38.0 if k < 80 else 60.0}
        y = truth.output(x) + 0.02 * rng.standard_normal(3)
        reading = dict(zip(("a", "b", "c"), y.tolist())) | {"room": 25.0} | applied
        one, two = (each.step(reading, target) for each in (python, c))
        ours, applied = np.array(one.drives(truth.drives)), dict(one.drive)
        np.testing.assert_allclose(two.drives(truth.drives), ours, atol=1e-9)
        assert (two.status, two.advice) == (one.status, one.advice), k
        P = python.observer.estimate()["P"]
        np.testing.assert_allclose(c.c.view("P", P.shape), P, rtol=0.0, atol=1e-8 * P.max())
        statuses.append(one.status)
        x = truth.next_state(x, ours, d)
    assert set(statuses) == {"ok"}


@pytest.mark.parametrize("held", [(), ("t_surface",)])
@pytest.mark.parametrize(
    "lacks", [{"move_delay_s": 1.0}, {"move_delay_s": 7.0, "sensor_lag_s": 3.0, "drive_share": 0.8}]
)
def test_a_loop_is_the_same_in_python_with_steps_in_c_and_wholly_in_c(pair, tank_maker, lacks, held):
    python, c = pair
    truth = tank_maker(heat=0.1, joule=0.055, loss=1 / 600, delay=9)
    around = Surroundings(ambient=23.0, offset={"t_surface": 0.3, "t_ambient": -0.4}, **lacks)
    around = replace(around, quanta={"t_ambient": 0.1}, noises={"t_tank": 0.2}, held=held)
    schedule, start = [(35.0, 120.0), (22.0, 120.0)], 30.0 if held else None
    runs = [
        simulate_closed_loop(python, truth, schedule, start=start, surroundings=around, seed=5),
        simulate_closed_loop(c, truth, schedule, start=start, surroundings=around, seed=5),
        compiled_loop(c, truth, schedule, start=start, surroundings=around, seed=5),
    ]
    for run in runs[1:]:
        np.testing.assert_allclose(run.drive["drive"], runs[0].drive["drive"], atol=1e-9)
        np.testing.assert_allclose(run.outputs["t_surface"], runs[0].outputs["t_surface"], atol=1e-9)
        np.testing.assert_allclose(run.readings["t_surface"], runs[0].readings["t_surface"], atol=1e-9)
        assert run.status == runs[0].status
        one, two = run.segments[1], runs[0].segments[1]
        assert (one.overshoot, one.travel, one.bias) == pytest.approx((two.overshoot, two.travel, two.bias))


LOOP = {"setpoint": 0.4}


@pytest.mark.parametrize("held", [(), ("t_surface",)])
@pytest.mark.parametrize(
    "lacks", [{"move_delay_s": 1.0}, {"move_delay_s": 7.0, "sensor_lag_s": 3.0, "drive_share": 0.8}]
)
def test_a_loop_of_a_pi_is_the_same_in_c(pair, tank_maker, lacks, held):
    truth = tank_maker(heat=0.1, joule=0.055, loss=1 / 600, delay=9)
    around = Surroundings(ambient=23.0, offset={"t_surface": 0.3, "t_ambient": -0.4}, **lacks)
    around = replace(around, quanta={"t_ambient": 0.1}, noises={"t_tank": 0.2}, held=held)
    loops = tuple(replace(loop, **LOOP, Kc=4 * loop.Kc) for loop in pair[1].design.loops)
    runs = _with_pi(pair[1], loops, truth, [(44.0, 240.0)], start=30.0, surroundings=around, seed=5)
    _same_loops(*runs)
    assert runs[0].segments[0].full_share > 0.1  # the integrator stood for a while


def test_two_loops_of_a_pi_are_the_same_in_c(tclab):
    c = Controller(tclab, default_design(tclab, dt=4.0))
    loops = tuple(replace(loop, **LOOP, Kc=(1 + k) * loop.Kc) for k, loop in enumerate(c.design.loops))
    _same_loops(*_with_pi(c, loops, tclab, [(40.0, 300.0)], seed=1))
    several = _with_pi(c, loops, tclab, [(40.0, 100.0), (35.0, 100.0)], seed=1)  # C goes to one target
    _same_loops(*several)
    assert [segment.target for segment in several[1].segments] == [40.0, 40.0, 35.0, 35.0]


def test_a_pi_in_c_that_reads_what_cannot_be_answers_as_python_does(tclab):
    c = Controller(tclab, default_design(tclab, dt=4.0))
    for wrong in ({"t1": 900.0}, {"t_ambient": -900.0}):
        around = Surroundings(
            offset={name: wrong.get(name, 0.0) for name in (*tclab.outputs, *tclab.disturbances)}
        )
        runs = _with_pi(c, c.design.loops, tclab, [(40.0, 100.0)], surroundings=around)
        _same_loops(*runs)
        assert ("fallback_plan" in runs[1].status) == ("t1" in wrong)


def _with_pi(c, loops, truth, schedule, **about) -> tuple[ClosedLoop, ClosedLoop]:
    """Return the loop of a PI under the limits of a compiled controller's design, in Python and in C."""
    python, compiled = (PIController(c.plant, replace(c.design, loops=loops)) for _ in range(2))
    compiled.c = c.c
    loop = simulate_closed_loop(python, truth, schedule, **about)
    return loop, compiled_loop(compiled, truth, schedule, **about)


def _same_loops(one: ClosedLoop, two: ClosedLoop) -> None:
    for part in ("drive", "outputs", "readings", "target"):
        for name, values in getattr(one, part).items():
            np.testing.assert_allclose(getattr(two, part)[name], values, atol=1e-9)
    assert two.status == one.status
    for ours, theirs in zip(two.segments, one.segments, strict=True):
        assert (ours.overshoot, ours.travel) == pytest.approx((theirs.overshoot, theirs.travel))


NAN = float("nan")


def test_where_gcc_refuses_steps_run_in_python_and_that_is_reported(plant, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(build, "_GCC_FLAGS", ("-std=c99", "--no-such-flag"))
    with pytest.warns(UserWarning, match="steps run in Python"):
        controller = Controller(plant)
    assert controller.c is None
    controller.reset({"t_tank": 25.0, "t_surface": 25.0})
    assert controller.step({"t_tank": 25.0, "t_surface": 25.0}, 30.0).status == "ok"


def test_an_uncompiled_controller_has_no_loop_in_c(plant, monkeypatch):
    monkeypatch.setenv("THERMOGRIP_COMPILED", "0")
    with pytest.raises(ValueError, match="not compiled"):
        compiled_loop(Controller(plant), plant, [(30.0, 10.0)])


needs_gcc = pytest.mark.skipif(compiler() is None, reason="no gcc here")


@needs_gcc
def test_no_compiler_is_used_where_the_environment_forbids_it(monkeypatch):
    monkeypatch.setenv("THERMOGRIP_COMPILED", "0")
    assert not wanted()
    monkeypatch.delenv("THERMOGRIP_COMPILED")
    assert wanted()
    monkeypatch.setenv("PATH", "")
    assert not wanted()


@needs_gcc
def test_a_library_is_built_once(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    files = {"one.c": "int one(void);\nint one(void) { return 1; }\n"}
    path = build_library(files)
    built = os.stat(path).st_mtime_ns
    assert build_library(files) == path
    assert os.stat(path).st_mtime_ns == built
    other = build_library({"one.c": files["one.c"].replace("1;", "2;")})
    assert other != path
    with pytest.raises(RuntimeError, match="gcc refused"):
        build_library({"one.c": "int one(void) { return }"})
    assert sorted(tmp_path.joinpath("thermogrip").iterdir()) == sorted([path, other])  # nothing half-built


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
    monkeypatch.setattr(build, "_GCC_FLAGS", build._GCC_FLAGS[:1] + build._GCC_FLAGS[2:])
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
