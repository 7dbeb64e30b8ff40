"""The program and its cost by hand; how far a drive is pushed towards a Peltier optimum."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tests.mpc.makers import WAYS, crossed
from thermogrip.mpc.closed_loop.simulate import Surroundings, simulate_closed_loop
from thermogrip.mpc.controllers.mpc import design_controller
from thermogrip.mpc.design.design import Design, PILoop, default_design
from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.optimiser.qp import QPAnswer
from thermogrip.mpc.optimiser.rti import Optimiser, Problem, Sample, allowed_share
from thermogrip.mpc.plant.prediction import PredictionModel
from thermogrip.mpc.tuning.minimum_time import full_drive_bound
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

OPTIMUM = -0.55  # of the reversing tank, whose range ends at -1


def lowest_allowed(optimiser, bias: float, effective: float) -> float:
    """Return the lower end for a plan at which drive and bias together are ``effective``."""
    guess = np.full((optimiser.n_b, 1), effective - bias)
    left = np.full((optimiser.n_b, 1), 1 - effective / OPTIMUM)  # of the gain, which fades in proportion
    problem = Problem(np.array([effective - bias]), np.zeros((1, 1)), np.zeros(1), [0], [])
    low, _ = optimiser._range(guess, np.array([bias]), left, problem)
    return float(low[-1, 0])


@pytest.mark.parametrize("bias", [-0.15, 0.0, 0.15])
def test_a_bias_of_the_drive_does_not_move_the_optimum(reversing_tank, bias):
    # a plant that cools better than its model is no plant whose optimum comes earlier
    optimiser = design_controller(reversing_tank, dt=2.0).optimiser
    assert lowest_allowed(optimiser, bias, -0.4) == pytest.approx(0.85 * OPTIMUM, abs=1e-9)


@pytest.mark.parametrize(
    ("end", "allowed"),
    [(-0.5, -0.5), (OPTIMUM, OPTIMUM), (-0.575, 0.9090909 * OPTIMUM), (-0.62, 0.85 * OPTIMUM)],
)
def test_a_range_that_ends_before_the_optimum_is_had_whole(reversing_tank, end, allowed):
    optimiser = design_controller(reversing_tank, dt=2.0, drive_range={"drive": (end, 1.0)}).optimiser
    assert lowest_allowed(optimiser, 0.0, -0.4) == pytest.approx(allowed, abs=1e-6)


@pytest.mark.parametrize("make", WAYS)
@pytest.mark.parametrize(("joule", "coldest"), [(0.05, -1.0), (0.1, 0.85 * OPTIMUM)])
def test_far_below_what_can_be_held_the_drive_stays_where_it_may(tank_maker, make, joule, coldest):
    # optima at -1.1, beyond the range, and at -0.55
    plant = tank_maker(heat=0.11, joule=joule)
    controller = make(plant, default_design(plant, dt=2.0))
    run = simulate_closed_loop(
        controller, plant, [(5.0, 200.0)], start=25.0, surroundings=Surroundings(noise=0.0, quantum=0.0)
    )
    assert np.min(run.drive["drive"][20:]) == pytest.approx(coldest, abs=0.02)


def test_a_drive_leaves_an_end_of_its_range_where_the_model_answers_nothing():
    """Cooled by the square of a drive of 0 to 100, from 80 degC at 5 less a bias of 5: its gain is 0."""
    a = float(np.exp(-1 / 60))
    F = np.full((1, 1), -60.0 / 100**2 * (1 - a))
    model = StateSpaceModel(
        ("q",), (), ("t",), A=np.full((1, 1), a), B=np.zeros((1, 1)), C=np.eye(1), dt=1.0, y0=[80.0],
        terms=("q*q",), F=F,
    )  # fmt: skip
    plant = Plant(model, {}, dt=1.0, units={"q": "percent"}, valid={"q": (0.0, 100.0), "t": (20.0, 80.0)})
    controller = design_controller(plant)
    at, n_b = np.array([5.0]), controller.optimiser.n_b
    asked = np.array([[40.0], [-1.0], [0.0]])
    now = Sample(np.zeros(1), at, np.full((n_b, 1), 5.0), np.zeros(0), *asked, -at)
    plan = controller.optimiser.solve(now).plan
    assert plan[0, 0] > 5.0
    assert plan.max() > 50.0


@pytest.mark.parametrize("make", WAYS)
def test_a_tank_that_cools_better_than_its_model_arrives_as_soon_as_its_drive_allows(tank_maker, make):
    plant, truth = tank_maker(heat=0.11, joule=0.055), tank_maker(heat=0.13, joule=0.045)
    controller = make(plant, default_design(plant, dt=2.0))
    spec = Spec(steps=[(25.0, 15.0)], hold_s=400.0, sensor_offset_degC=0.0)
    flat_out = full_drive_bound(truth, controller.design, (25.0, 15.0), spec)
    segment = simulate_closed_loop(controller, truth, [(15.0, 400.0)], start=25.0).segments[0]
    assert segment.settle_s <= 1.25 * flat_out  # 1.11; 1.41 where a bias moves the optimum
    assert segment.overshoot <= 0.3
    assert abs(segment.bias) <= 0.05


# ---- the program of two drives, q1 in percent and q2 of 255, by hand ----

DESIGN = Design(
    dt=2.0, controlled=("b", "a"), blocks=(1, 2, 3), drive_range={"q1": (-50.0, 100.0), "q2": (0.0, 80.0)},
    slew_per_s={"q1": 4.0, "q2": 10.0}, track=1.5, terminal=5.0, move=3.0, drive=0.7, overshoot=0.2,
    limits={"a": (16.0, 28.0)}, price=7.0, deadline_s=0.0,
)  # fmt: skip
SPAN, ROOM = np.array([100.0, 255.0]), 22.0
START, LAST = np.array([25.0, 21.0]), np.array([40.0, 30.0])  # a and b; q1 and q2
TARGET, BIAS = np.array([27.0, 26.5]), np.array([0.4, -0.3])  # of b and a; of a and b
EACH = np.broadcast_to(TARGET, (6, 2))  # of each sample
PLANS = np.array([
    [[45.0, 40.0], [30.0, 70.0], [-20.0, 10.0]],
    [[60.0, 5.0], [90.0, 0.0], [100.0, 80.0]],
])  # fmt: skip


@pytest.fixture
def optimiser() -> Optimiser:
    return Optimiser(PredictionModel(crossed("0_255")), DESIGN)


def problem(side=(0.0, 0.0), counted=(0, 1), more: float = 0.0) -> Problem:
    return Problem(LAST, EACH, np.array(side), list(counted), [], more)


def outputs(plan: np.ndarray) -> np.ndarray:
    """Return a and b (6, 2) under a plan of three blocks."""
    a, b = START
    rows = []
    for q1, q2 in np.repeat(plan, (1, 2, 3), axis=0):
        a, b = 0.9 * a + 0.02 * q2 + 0.1 * ROOM, 0.8 * b + 0.05 * q1 + 0.2 * ROOM
        rows.append([a, b])
    return np.array(rows) + BIAS


def cost(plan: np.ndarray, side: tuple[float, float] = (0.0, 0.0), limits: bool = True) -> float:
    y, before, total = outputs(plan), LAST, 0.0
    for v, samples in zip(plan, (1, 2, 3), strict=True):
        total += np.sum(3.0 * ((v - before) / SPAN) ** 2 + 0.7 * samples * (v / SPAN) ** 2)
        before = v
    for k, (a, b) in enumerate(y):
        errors, slack = (b - 27.0, a - 26.5), [max(0.0, 16.0 - a), max(0.0, a - 28.0)] if limits else []
        total += (1.5 + 5.0 * (k == 5)) * (errors[0] ** 2 + errors[1] ** 2)
        slack += [max(0.0, way * e - 0.2) for way, e in zip(side, errors, strict=True) if way]
        total += sum(7.0**0.5 * s + 7.0 * s**2 for s in slack)
    return float(total)


def condensed(optimiser: Optimiser) -> tuple[np.ndarray, np.ndarray]:
    """Return how the outputs answer to the plan in shares of its range (6, 2, 6), and those without one."""
    still = outputs(np.zeros((3, 2)))
    units = np.eye(6).reshape(6, 3, 2) * SPAN
    return np.stack([outputs(unit) - still for unit in units], axis=-1), still


@pytest.mark.parametrize("side", [(0.0, 0.0), (1.0, -1.0), (-1.0, 1.0)])
def test_the_merit_of_a_plan_is_its_cost(optimiser, side):
    y = np.stack([outputs(plan) for plan in PLANS])
    found = optimiser._merit(PLANS, y, problem(side))
    np.testing.assert_allclose(found, [cost(plan, side) for plan in PLANS])
    rest = optimiser._merit(PLANS, y, problem(side, counted=[1]))  # b is lost: it costs nothing
    weights = np.array([1.5] * 5 + [6.5])
    off = (y[:, :, 1] - 27.0) * (side[0] or 1.0)
    over = np.maximum(0.0, off - 0.2) * bool(side[0])
    np.testing.assert_allclose(found - rest, off**2 @ weights + (7.0**0.5 * over + 7.0 * over**2).sum(axis=1))


def test_the_program_costs_what_the_plan_costs_and_its_minimum_is_the_linear_law(optimiser):
    G, free = condensed(optimiser)
    H, f = optimiser._cost(G, free, problem())
    one, two = ((plan / SPAN).ravel() for plan in PLANS)
    found = 0.5 * (two @ H @ two - one @ H @ one) + f @ (two - one)
    assert found == pytest.approx(cost(PLANS[1], limits=False) - cost(PLANS[0], limits=False))
    same, on_free, on_last = optimiser.linear_gains(G)
    np.testing.assert_allclose(same, H)
    best = on_free @ (free[:, [1, 0]] - TARGET).ravel() + on_last @ LAST
    np.testing.assert_allclose(best, -np.tile(SPAN, 3) * np.linalg.solve(H, f))
    H, f = optimiser._cost(G, free, problem(counted=[1]))
    lost = 0.5 * (two @ H @ two - one @ H @ one) + f @ (two - one)
    weights = np.array([1.5] * 5 + [6.5])
    of_b = [weights @ (outputs(plan)[:, 1] - 27.0) ** 2 for plan in PLANS]
    assert found - lost == pytest.approx(of_b[1] - of_b[0])


@pytest.mark.parametrize(("side", "more"), [((1.0, 0.0), 0.0), ((-1.0, 1.0), 0.5), ((0.0, -1.0), -0.25)])
def test_the_rows_of_the_program_are_what_a_plan_has_left_to_its_limits(optimiser, side, more):
    G, free = condensed(optimiser)
    ends = np.full((3, 2), [-50.0, 0.0]), np.full((3, 2), [100.0, 80.0])
    A, lower, upper = optimiser._constraints(G, free, ends, problem(side, more=more))
    slew = np.array([1 + more, 1.5, 2.5])[:, None] * [8.0, 20.0]  # between the middles of the blocks
    for plan in PLANS:
        y, change = outputs(plan), np.diff(plan, axis=0, prepend=LAST[None])
        left = [(plan - ends[0]) / SPAN, (change + slew) / SPAN]
        right = [(ends[1] - plan) / SPAN, (slew - change) / SPAN]
        for row, target, way in ((1, 27.0, side[0]), (0, 26.5, side[1])):
            left.append(y[:, row] - (target - 0.2) if way < 0 else np.full(6, np.inf))
            right.append(target + 0.2 - y[:, row] if way > 0 else np.full(6, np.inf))
        left, right = [*left, y[:, 0] - 16.0], [*right, 28.0 - y[:, 0]]
        value = A @ (plan / SPAN).ravel()
        np.testing.assert_allclose(value - lower, np.concatenate([each.ravel() for each in left]), atol=1e-12)
        np.testing.assert_allclose(
            upper - value, np.concatenate([each.ravel() for each in right]), atol=1e-12
        )
    qp = optimiser.qp
    assert qp.soft.tolist() == [False] * 12 + [True] * 18
    assert sorted(set(qp.linear.tolist())) == pytest.approx([7.0**0.5, 7.0])  # the larger one is of hard rows
    assert (set(qp.quadratic), qp.time_limit_s) == ({14.0}, 1e-3)


@pytest.mark.parametrize(
    ("end", "share"), [(0.5, 0.85), (0.9, 0.9), (1.0, 1.0), (1.05, 0.9), (1.075, 0.85), (9.0, 0.85)]
)
def test_the_share_of_the_way_to_an_optimum(end, share):
    assert allowed_share(np.array([2 * end]), np.array([2.0]), SPAN[:1]) == pytest.approx(share)
    assert allowed_share(np.array([end]), np.zeros(1), SPAN[:1]) == 0.85


def test_gains_at_rest(optimiser):
    at_rest = optimiser.at_rest
    assert (at_rest.strongest.tolist(), at_rest.pair.tolist()) == ([0, 1], [0, 1])
    G, _ = condensed(optimiser)
    sums = G.sum(axis=0).reshape(2, 3, 2)
    np.testing.assert_allclose(at_rest.response, np.stack([sums[1, :, 0], sums[0, :, 1]], axis=1))
    loops = (PILoop("q2", "b", Kc=1.0, Ti=1.0), PILoop("q1", "a", Kc=1.0, Ti=1.0))
    assert Optimiser(optimiser.model, replace(DESIGN, loops=loops)).at_rest.pair.tolist() == [1, 0]


def test_a_solve_predicts_what_its_plan_does_and_parks_what_is_lost(optimiser):
    bias = np.array([4.0, -6.0])
    room, side, guess = np.array([ROOM]), np.array([1.0, -1.0]), np.tile(LAST, (3, 1))
    ask = {"target": TARGET, "side": side, "bias": BIAS, "drive_bias": bias}
    found = optimiser.solve(Sample(START, LAST, guess, room, **ask))
    assert found.status == "solved"
    np.testing.assert_allclose(found.y, outputs(found.plan + bias), atol=1e-9)
    assert found.plan[0, 0] - 40.0 == pytest.approx(8.0)  # a is in its band, b far below its target
    np.testing.assert_allclose(found.authority, [1.0, 1.0])
    longer = optimiser.solve(Sample(START, LAST, guess, room, **ask, slew_s=2.5))
    assert longer.plan[0, 0] - 40.0 == pytest.approx(10.0)
    lost = optimiser.solve(Sample(START, LAST, guess, room, **ask, lost=np.array([True, False]), slew_s=2.0))
    np.testing.assert_allclose(lost.plan[:, 0], [32.0, 20.0, 0.0])
    assert abs(lost.y[-1, 0] - 26.5) < 0.5  # while a goes on to its target
    optimiser.qp = SimpleNamespace(
        solve=lambda *given: QPAnswer(np.full(6, np.nan), "cycling", 4, np.zeros(0))
    )
    failed = optimiser.solve(Sample(START, LAST, guess, room, **ask))
    assert (failed.status, failed.broken) == ("cycling", {})
    assert np.isnan(failed.plan).all()
    np.testing.assert_allclose(failed.y, outputs(guess + bias), atol=1e-9)
