"""When a target that cannot be held is reported, and that no other is."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from tests.mpc.makers import WAYS, crossed
from thermogrip.mpc.closed_loop.simulate import simulate_closed_loop
from thermogrip.mpc.closed_loop.simulate_native import compiled_loop
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.reference import ReferenceController
from thermogrip.mpc.design.design import Design, default_design
from thermogrip.mpc.estimator.observer import Observer, choose_disturbances
from thermogrip.mpc.native.runtime import wanted
from thermogrip.mpc.optimiser.reach import Reach, _least_squares_in_box
from thermogrip.mpc.optimiser.rti import Optimiser
from thermogrip.mpc.plant.prediction import PredictionModel
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

LIMIT = {"t_tank": (8.0, 50.0)}
OWN = {"t_surface": (20.0, 48.0)}  # of what is controlled
LEAKY = {"heat": 0.14, "loss": 1 / 150}  # 45.6 degC at most, and the model expects 102: a monitor's matter
WEAK = {"heat": 0.02}  # 38.7 degC at most
OPTIMUM = {"joule": 0.1}  # 4.5 degC at least, as far as its drive may go

#: truth, its model, limits, targets with seconds, after how many samples at most the last target is reported
#: as unreachable (None: never), and the value that can be held
ROWS = {
    "more loss than the model's, 1.4 K out of reach": (LEAKY, {}, {}, [(34, 180), (47, 300)], None, 0),
    "more loss than the model's, 4.4 K out of reach": (LEAKY, {}, {}, [(34, 180), (50, 300)], None, 0),
    "more loss than the model's, in reach": (LEAKY, {}, {}, [(34, 180), (45, 300)], None, 0),
    "a limit of the tank": ({}, {}, LIMIT, [(34, 180), (60, 500)], 1, 49.5),
    "nearly a limit of the tank": ({}, {}, LIMIT, [(34, 180), (48, 500)], None, 0),
    "half a degree above its own limit": ({}, {}, OWN, [(34, 180), (48.5, 400)], 0, 48.0),
    "half a degree below its own limit": ({}, {}, OWN, [(34, 180), (19.5, 400)], 0, 20.0),
    "hardly above its own limit": ({}, {}, OWN, [(34, 180), (48.08, 400)], None, 0),
    "an optimum": (OPTIMUM, OPTIMUM, {}, [(0, 600)], 2, 4.5),
    "far beyond an optimum": (OPTIMUM, OPTIMUM, {}, [(-20, 600)], 3, 4.5),
    "nearly an optimum": (OPTIMUM, OPTIMUM, {}, [(5, 600)], None, 0),
    "an end of the drive": (WEAK, WEAK, {}, [(42, 600)], 1, 38.7),
    "hardly beyond an end of the drive": (WEAK, WEAK, {}, [(39.5, 600)], 60, 38.7),
    "nearly an end of the drive": (WEAK, WEAK, {}, [(38, 600)], None, 0),
    "less power than the model's": ({"heat": 0.077}, {}, {}, [(34, 180), (38, 300)], None, 0),
}


def test_where_the_steady_state_is_no_longer_found_the_report_is_kept(tank_maker, monkeypatch):
    plant = tank_maker(**OPTIMUM)
    controller = ReferenceController(plant, default_design(plant, dt=2.0, deadline_s=1e9))
    reading = {"t_tank": 25.0, "t_surface": 25.0, "t_ambient": 25.0}
    controller.reset(reading)
    before = [controller.step(reading, -20.0) for _ in range(4)][-1]
    assert before.status == "infeasible"
    solve = np.linalg.solve

    def fails(A, b):  # as where Newton's method does not converge
        if b.ndim == 2 and b.shape[1] > 1 and A.shape[0] == controller.model.n_x:
            raise np.linalg.LinAlgError
        return solve(A, b)

    monkeypatch.setattr("thermogrip.mpc.optimiser.reach.np.linalg.solve", fails)
    after = [controller.step(reading, -20.0) for _ in range(8)]
    assert {(move.status, move.advice) for move in after} == {(before.status, before.advice)}
    assert controller.reach._x is None


@pytest.mark.parametrize("row", ROWS)
def test_a_target_out_of_reach_is_reported_soon_and_kept_and_no_other_is(row, tank_maker):
    truth, model, limits, schedule, latest, value = ROWS[row]
    plant, truth = tank_maker(**model), tank_maker(**truth)
    design = default_design(plant, dt=2.0, limits=limits, deadline_s=1e9)
    loop = simulate_closed_loop(ReferenceController(plant, design), truth, schedule)
    first = sum(round(seconds / 2) for _, seconds in schedule[:-1])
    before, after = loop.status[:first], loop.status[first:]
    assert set(before) <= {"ok"}
    if latest is None:
        assert set(after) == {"ok"}
    else:
        first_said = after.index("infeasible")
        assert first_said <= latest
        assert set(after[first_said:]) == {"infeasible"}
        found = re.search(r"no drive holds .* degC: (-?[0-9.]+) degC can be held", loop.advice[-1])
        assert float(found[1]) == pytest.approx(value, abs=1.1)
    if wanted():
        compiled = compiled_loop(Controller(plant, design), truth, schedule)
        assert compiled.status == loop.status
        np.testing.assert_allclose(compiled.drive["drive"], loop.drive["drive"], atol=1e-5)


@pytest.mark.parametrize("make", WAYS)
@pytest.mark.parametrize(
    ("gain", "beyond", "status"),
    [(2.0, 0.06, "infeasible"), (2.0, 0.003, "ok"), (300.0, 0.4, "ok"), (300.0, 2.0, "infeasible")],
)
def test_what_is_out_of_reach_counts_in_the_unit_of_its_output(make, gain, beyond, status):
    """A mount whose logs span 2 K, unit 0.05, and a kiln of 300 K, unit 5: a tenth of it is near enough."""
    a = float(np.exp(-0.05))
    model = StateSpaceModel(("q",), (), ("t",), A=[[a]], B=[[gain * (1 - a)]], C=[[1.0]], dt=5.0, y0=[25.0])
    valid = {"q": (0.0, 1.0), "t": (25.0, 25.0 + gain)}
    plant = Plant(model, {}, dt=5.0, units={"q": "1", "t": "degC"}, valid=valid, noise={"t": 1e-4 * gain})
    controller = make(plant, default_design(plant, dt=5.0, deadline_s=1e9))
    x, target = np.zeros(1), 25.0 + gain + beyond
    controller.reset({"t": 25.0})
    for _ in range(120):
        move = controller.step({"t": 25.0 + x[0]}, target)
        x = a * x + gain * (1 - a) * move.drive
    assert move.status == status


# ---- its parts, by hand ----

DESIGN = Design(
    dt=2.0, controlled=("b", "a"), blocks=(1, 2), drive_range={"q1": (-50.0, 100.0), "q2": (0.0, 80.0)},
    slew_per_s={"q1": 4.0, "q2": 10.0}, limits={"a": (16.0, 28.0)}, price=50.0,
)  # fmt: skip
MODEL = PredictionModel(crossed("0_255"))
OBSERVER = Observer(MODEL, choose_disturbances(MODEL, ("b", "a")))
TARGET, BOTH = np.array([27.0, 26.5]), np.array([True, True])  # of b and a
NO_SIDE, FREE = np.zeros(2), {"low": np.array([-99.0, 0.0]), "high": np.array([99.0, 0.0])}


def reach(**changes) -> Reach:
    return Reach(Optimiser(MODEL, replace(DESIGN, **changes)), OBSERVER)


def test_least_squares_in_a_box_is_that_of_scipy():
    rng = np.random.default_rng(4)
    for _ in range(20):
        G, e, low = rng.normal(size=(4, 3)), rng.normal(size=4), -rng.random(3)
        want = lsq_linear(G, e, (low, low + 0.7), tol=1e-14).x
        np.testing.assert_allclose(_least_squares_in_box(G, e, low, low + 0.7), want, atol=1e-6)
    G = np.array([[2.0, 0.0], [1.0, 0.0]])  # a drive that moves nothing stays
    found = _least_squares_in_box(G, np.array([3.0, 4.0]), np.full(2, -9.0), np.full(2, 9.0))
    np.testing.assert_allclose(found, [2.0, 0.0])


@pytest.mark.parametrize(
    ("target", "side", "seen", "z"),
    [
        ([22.0, 26.0], [0.0, 0.0], BOTH, 4.0),
        ([22.0, 26.0], [1.0, 1.0], BOTH, 126 / 61),  # b, 1 beyond its target, costs 50 (1 / 5 + 1)
        ([18.0, 14.0], [0.0, 0.0], BOTH, (-8.0 - 40000.0) / 10002),  # a below its limit a hundred times
        ([22.0, 18.0], [-1.0, -1.0], BOTH, 118 / 61),
        ([22.0, 26.0], [1.0, 1.0], np.array([False, True]), 6.0),
        ([33.0, 33.0], [0.0, 0.0], BOTH, 80026 / 10002),
    ],
)
def test_the_nearest_outputs_of_one_drive_on_two(target, side, seen, z):
    G, y = np.array([[1.0, 0.0], [1.0, 0.0]]), np.full(2, 20.0)  # a and b
    found = reach()._nearest(G, y, np.array(target), np.array(side), seen, **FREE)
    np.testing.assert_allclose(found, [z, 0.0], rtol=1e-9)


@pytest.mark.parametrize(
    ("target", "held"), [([27.0, 26.5], [27.0, 26.5]), ([27.0, 45.0], [27.0, 280045 / 10001])]
)
def test_the_steady_outputs_nearest_to_the_targets_and_what_the_biases_do_there(target, held):
    made = reach()
    OBSERVER.reset(np.array([22.0, 22.0]), np.array([22.0]))
    OBSERVER.w = np.array([0.1, -0.05])
    for _ in range(2):  # from the drives of now, then from the last answer
        y, J = made._held(OBSERVER, np.array([40.0, 30.0]), np.array([22.0]), np.array(target), NO_SIDE, BOTH)
        np.testing.assert_allclose(y, held, atol=1e-6)
        np.testing.assert_allclose(J, np.diag([25.0, 51.0]), atol=1e-9)
        np.testing.assert_allclose(made._u, [10.0, (held[1] - 22.0) / 0.2 + 0.05 * 255], atol=1e-5)


def watcher(held: list[float], *, J=((2.0, 0.0), (0.0, 1.0)), bias: float = 0.5, w=(0.0, 0.0)):
    """Return a Reach whose steady outputs are these, and an observer: 0.4 degC of b and 0.1 of a unsure."""
    made = reach()
    made._held = lambda *given: (np.array(held), np.array(J))
    P = np.diag([9.0, 9.0, 0.04, 0.01])
    return made, SimpleNamespace(
        w=np.array(w), disturbance_bias=np.zeros(1), innovation_bias=bias, estimate=lambda: {"P": P}
    )


def ask(made: Reach, observer, *, seen=BOTH, target=TARGET, ahead=99.0):
    given = {"target": target, "side": NO_SIDE, "ahead": np.full(2, ahead), "seen": seen}
    return made.missed(observer, np.array([40.0, 30.0]), np.array([22.0]), **given)


@pytest.mark.parametrize(
    ("off", "more", "samples"),
    [
        ([0.54, 0.0], {}, 5),  # (0.54 - 0.1) / 0.4 - 0.5 = 0.6 a sample up to 3
        ([9.0, 0.0], {}, 2),
        ([-9.0, 0.0], {}, 2),
        ([0.94, 0.0], {"bias": 2.0}, 6),  # 0.84 / 0.8 - 0.5
        ([0.0, 0.16], {"J": np.zeros((2, 2))}, 5),  # of 0.05 degC
        ([0.0, 0.22], {}, 5),  # 1.2 - 0.5
        ([0.3, 0.0], {}, None),
    ],
)
def test_a_target_that_the_model_misses_is_unreachable_when_it_is_sure(off, more, samples):
    made, observer = watcher(TARGET + off, **more)
    answers = [ask(made, observer) for _ in range(31)]
    first = next((at + 1 for at, answer in enumerate(answers) if answer is not None), None)
    assert first in (samples, samples and samples + 1)  # where rounding leaves the sum at 3 - 1e-16
    if samples:
        at = int(np.argmax(np.abs(off)))
        assert answers[-1] == (at, pytest.approx(TARGET[at] + off[at]))
        assert ask(made, observer, target=TARGET + 0.1) is None  # it moves, and all begins anew
        assert ask(made, observer, seen=np.array(off) == 0.0) is None
    assert ask(*watcher(TARGET + off, **more), ahead=27.0, seen=np.array([True, False])) is None


@pytest.mark.parametrize(
    ("target", "held", "answer"),
    [  # of a, whose limits are 16 and 28
        (28.5, 28.004, 28.0),
        (28.5, 28.5, 28.0),  # the model says nothing
        (28.5, 25.0, 25.0),  # no drive holds its limit
        (15.5, 15.99, 16.0),
        (28.09, 28.09, None),
        (28.09, 28.0, None),
    ],
)
def test_a_target_beyond_its_own_limit_is_told_at_once(target, held, answer):
    made, observer = watcher([27.0, held])
    wanted = np.array([27.0, target])
    assert ask(made, observer, target=wanted) == (answer and (1, answer))
    made, observer = watcher([27.0, held])
    assert ask(made, observer, target=wanted, seen=np.array([True, False])) is None


def test_a_target_is_reachable_again_after_five_samples_in_a_row():
    made, observer = watcher([30.0, 26.5])
    for _ in range(10):
        answer = ask(made, observer)
    assert answer == (0, 30.0)
    for b, times in ((27.06, 9), (27.04, 4), (27.06, 1), (27.04, 4)):  # half of a tenth is in reach now
        made._held = lambda *given, b=b: (np.array([b, 26.5]), np.zeros((2, 2)))
        found = [ask(made, observer) for _ in range(times)]
        assert found == [(0, pytest.approx(27.06, abs=0.021))] * times
    assert [ask(made, observer) for _ in range(3)] == [None] * 3
