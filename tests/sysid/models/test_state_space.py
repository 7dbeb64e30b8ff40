"""The linear model: against scipy's filters, against its own step, at rest, and what it refuses."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.signal import dlsim

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.models.state_space import StateSpaceModel


def switched_model(seed: int = 0) -> StateSpaceModel:
    rng = np.random.default_rng(seed)
    A = np.diag([0.9, 0.5, 0.2]) + 0.05 * rng.standard_normal((3, 3))
    return StateSpaceModel(
        ("drive", "pump"),
        ("t_ambient",),
        ("t_tank", "t_surface"),
        A=A,
        B=rng.standard_normal((3, 2)),
        C=rng.standard_normal((2, 3)),
        dt=2.0,
        E=rng.standard_normal((3, 1)),
        c=np.array([1.0, 2.0, 3.0]),
        y0=np.array([20.0, 21.0]),
        switches=("pump",),
        terms=("drive*|drive|", "pump*drive"),
        F=rng.standard_normal((3, 2)),
        A_switch={"pump": 0.05 * rng.standard_normal((3, 3))},
    )


def schedule(n: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    u = np.stack([rng.standard_normal(n), (rng.random(n) > 0.7).astype(float)], axis=1)
    return u, 25 + rng.standard_normal((n, 1))


def test_a_free_run_of_a_mimo_model_is_scipys_dlsim():
    rng = np.random.default_rng(2)
    A = np.array([[0.8, 0.1], [-0.2, 0.7]])
    B, C, u = rng.standard_normal((2, 3)), rng.standard_normal((2, 2)), rng.standard_normal((400, 3))
    model = StateSpaceModel(("a", "b", "c"), (), ("y", "z"), A=A, B=B, C=C, dt=0.5)
    x0 = np.array([1.0, -2.0])
    _, want, _ = dlsim((A, B, C, np.zeros((2, 3)), 0.5), u, x0=x0)
    got, _ = model.rollout(x0[None], u[None], np.zeros((1, 400, 0)), (), 0.5)
    np.testing.assert_allclose(got[0, :-1], want, rtol=0, atol=1e-10)


def test_rollout_of_a_switched_model_is_its_own_step_repeated():
    model, (u, d) = switched_model(), schedule(200)
    x0 = np.array([[0.0, 1.0, -1.0], [2.0, 0.0, 0.0]])
    y, x_end = model.rollout(x0, u[None], d[None], (), 2.0)
    for b in range(2):
        x = list(x0[b])
        for k in range(200):
            np.testing.assert_allclose(y[b, k], model.output(x, ()), rtol=1e-9)
            x = model.step(x, u[k], d[k], (), 2.0)
        np.testing.assert_allclose(x_end[b], x, rtol=1e-9)


def test_each_member_of_a_batch_has_its_own_switch():
    model = switched_model()
    parts = [schedule(50, seed) for seed in (1, 2)]
    u, d = (np.stack(both) for both in zip(*parts))
    y, _ = model.rollout(np.zeros((2, 3)), u, d, (), 2.0)
    for b in range(2):
        alone, _ = model.rollout(np.zeros((1, 3)), u[b : b + 1], d[b : b + 1], (), 2.0)
        np.testing.assert_allclose(y[b], alone[0], rtol=1e-10)


def test_casadi_symbols_run_the_same_lines():
    model, (u, d) = switched_model(), schedule(1)
    x, us, ds = ca.SX.sym("x", 3), ca.SX.sym("u", 2), ca.SX.sym("d", 1)
    split = [ca.vertsplit(part) for part in (x, us, ds)]
    step = ca.Function("step", [x, us, ds], [ca.vertcat(*model.step(*split, (), 2.0))])
    want = model.step([1.0, 2.0, 3.0], u[0], d[0], (), 2.0)
    np.testing.assert_allclose(np.asarray(step([1.0, 2.0, 3.0], u[0], d[0])).ravel(), want, rtol=1e-14)


def test_a_step_of_three_times_dt_is_three_steps_with_the_input_held():
    model, (u, d) = switched_model(), schedule(40)
    x, x0 = [0.1, 0.2, 0.3], np.array([[0.1, 0.2, 0.3]])
    fine, x_fine = model.rollout(x0, np.repeat(u, 3, axis=0)[None], np.repeat(d, 3, axis=0)[None], (), 2.0)
    coarse, x_coarse = model.rollout(x0, u[None], d[None], (), 6.0)
    np.testing.assert_allclose(coarse, fine[:, ::3], rtol=1e-12)
    np.testing.assert_allclose(x_coarse, x_fine, rtol=1e-12)
    for _ in range(3):
        x = model.step(x, u[0], d[0], (), 2.0)
    np.testing.assert_allclose(model.step([0.1, 0.2, 0.3], u[0], d[0], (), 6.0), x, rtol=1e-14)
    with pytest.raises(ValueError, match="whole multiple"):
        model.step([0.1, 0.2, 0.3], u[0], d[0], (), 3.0)


def block(tau: float = 100.0, delay: int = 3) -> StateSpaceModel:
    """A heater block, 40 K at full power over an ambient of 25 degC, behind a delay line."""
    a, n = np.exp(-10 / tau), delay + 1
    A = np.diag(np.ones(delay), 1)
    A[0, 0] = a
    A[0, 1] = 40 * (1 - a)
    B = np.zeros((n, 1))
    B[-1, 0] = 1.0
    C = np.eye(n)[:1]
    return StateSpaceModel(("q",), ("amb",), ("t",), A=A, B=B, C=C, dt=10.0, E=np.eye(n)[:, :1] * (1 - a))


def test_at_rest_a_consistent_reading_stays_where_it_is():
    model = block()
    x = model.rest([45.0], [0.5], [25.0], ())
    y, _ = model.rollout(x[None], np.full((1, 50, 1), 0.5), np.full((1, 50, 1), 25.0), (), 10.0)
    np.testing.assert_allclose(y[0, :, 0], 45.0, atol=1e-6)


def test_at_rest_under_an_input_that_has_just_begun_means_rest_under_the_input_before():
    x = block().rest([25.0], [1.0], [25.0], ())
    np.testing.assert_allclose(x, [25.0, 0.0, 0.0, 0.0], atol=1e-4)


@pytest.mark.parametrize("spread", [0.01, 1.0, 9.0])
def test_rest_goes_by_no_scale_of_the_states_and_shares_what_is_missing_by_slopes(spread: float):
    """With u = (2, 3) the delayed drives are 0.5 u1 |u1| = 2 and u2 = 3; 100 K ask for 10, 5 more.

    An input's share goes by its slope, 0.5 * 2 |u1| = 2 and 1: D 2 / 5 = 2 and D / 5 = 1.
    """
    A = np.array([[0.9, 1.0, 1.0], [0, 0, 0], [0, 0, 0]])
    model = StateSpaceModel(
        ("a", "b"), (), ("t",), A=A, B=[[0, 0], [0, 0], [0, 1.0]], C=[[1.0, 0, 0]], dt=1.0, y0=[4.0],
        terms=("a*|a|",), F=[[0], [0.5], [0]], spread=spread * np.eye(3),
    )  # fmt: skip
    np.testing.assert_allclose(model.rest([104.0], [2.0, 3.0], [], ()), [100.0, 6.0, 4.0], rtol=1e-4)


def test_a_step_that_is_nearly_a_multiple_is_one():
    model = StateSpaceModel(("q",), (), ("t",), A=[[0.0]], B=[[1.0]], C=[[1.0]], dt=2.0)
    y, end = model.rollout([[5.0]], np.array([1.0, 4.0])[None, :, None], np.zeros((1, 2, 0)), (), 2.3)
    assert (y[0, :, 0].tolist(), end.tolist()) == ([5.0, 1.0, 4.0], [[4.0]])


def test_poles_are_those_of_the_worst_position_of_the_switches():
    switched = {"a": np.diag([0.3, 0.0]), "b": np.diag([0.2, 0.0])}
    model = StateSpaceModel(
        ("a", "b"), (), ("t",), A=np.diag([0.5, 0.1]), B=np.zeros((2, 2)), C=[[1.0, 0.0]], dt=2.0,
        switches=("a", "b"), A_switch=switched,
    )  # fmt: skip
    assert (sorted(model.poles().real), model.stable) == (pytest.approx([0.1, 1.0]), False)  # both on


def test_matrices_that_are_absent_are_zero_and_the_spread_is_one():
    model = StateSpaceModel(("q",), (), ("t",), A=np.zeros((2, 2)), B=[[1], [2]], C=[[1, 3]], dt=1.0)
    assert (model.spread.tolist(), model.E.shape, model.c.tolist()) == (np.eye(2).tolist(), (2, 0), [0, 0])


def test_an_unstable_model_reports_it_and_overflows_quietly():
    model = StateSpaceModel(("q",), (), ("t",), A=[[1.5]], B=[[1.0]], C=[[1.0]], dt=1.0)
    assert not model.stable
    y, _ = model.rollout(np.ones((1, 1)), np.ones((1, 9000, 1)), np.zeros((1, 9000, 0)), (), 1.0)
    assert not np.isfinite(y).all()


def test_a_dict_makes_the_model_again():
    model, (u, d) = switched_model(), schedule(20)
    again = StateSpaceModel.from_dict(model.to_dict())
    both = [some.rollout(np.ones((1, 3)), u[None], d[None], (), 2.0)[0] for some in (model, again)]
    np.testing.assert_array_equal(both[0], both[1])
    assert again.to_dict() == model.to_dict()
    assert (again.terms, again.switches) == (model.terms, model.switches)


@pytest.mark.parametrize("change", [{"A": [[1.0]]}, {"dt": "fast"}, {"terms": ["heat"]}, {"A": None}])
def test_a_broken_dict_is_the_users_to_repair(change):
    with pytest.raises(UserError, match="state-space"):
        StateSpaceModel.from_dict(switched_model().to_dict() | change)


def test_matrices_that_do_not_fit_or_are_not_numbers_are_refused():
    with pytest.raises(ValueError, match="B has shape"):
        StateSpaceModel(("q",), (), ("t",), A=np.eye(2), B=[[1.0]], C=[[1.0, 0.0]], dt=1.0)
    with pytest.raises(ValueError, match="not finite"):
        StateSpaceModel(("q",), (), ("t",), A=[[np.nan]], B=[[1.0]], C=[[1.0]], dt=1.0)
    for change, said in (
        ({"dt": 0.0}, "dt must be > 0 s, got 0"),
        ({"spread": [[1.0, 0.0]]}, "spread has shape"),
    ):
        with pytest.raises(ValueError, match=said):
            StateSpaceModel(
                ("q",), (), ("t",), **({"A": [[0.5]], "B": [[1.0]], "C": [[1.0]], "dt": 1.0} | change)
            )
    with pytest.raises(ValueError, match="switches must be inputs"):
        StateSpaceModel(("q",), (), ("t",), A=[[0.5]], B=[[1.0]], C=[[1.0]], dt=1.0, switches=("fan",))
