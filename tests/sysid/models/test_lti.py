"""Linear algebra of linear models, each piece against its definition."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.sysid.models.makers import steady_gain
from thermogrip.datasets.errors import UserError
from thermogrip.sysid.blackbox.order_selection import StartPrior, estimate_starts
from thermogrip.sysid.models.model import whole_steps
from thermogrip.sysid.models.state_space import (
    StateSpaceModel,
    constrained_lstsq,
    evaluate_terms,
    join_columns,
    products,
    read_terms,
    symmetric_root,
)
from thermogrip.sysid.plant.linearise import linearise_plant
from thermogrip.sysid.plant.plant import Plant


def test_columns_are_joined_in_the_last_axis_and_batches_broadcast():
    u, d = np.arange(6.0).reshape(1, 3, 2), 10 + np.arange(6.0).reshape(2, 3, 1)
    both = join_columns(u, d)
    assert both.shape == (2, 3, 3)
    assert both[1].tolist() == [[0.0, 1.0, 13.0], [2.0, 3.0, 14.0], [4.0, 5.0, 15.0]]
    flipped = join_columns(d, u)
    assert flipped[1, 2].tolist() == [15.0, 4.0, 5.0]
    terms = evaluate_terms(["a*|b|"], ["a", "b"], -np.ones((2, 3, 2)) * np.arange(1.0, 4.0)[:, None])
    assert terms.tolist() == [[[-1.0], [-4.0], [-9.0]]] * 2


@pytest.mark.parametrize(
    ("dt", "times"), [(2.0, 1), (6.0, 3), (6.0 * (1 + 9e-7), 3), (6.0 * (1 + 2e-6), 0), (1.0, 0)]
)
def test_a_step_is_a_whole_number_of_steps_within_a_millionth(dt: float, times: int):
    if times:
        assert whole_steps(dt, 2.0) == times
    else:
        with pytest.raises(
            ValueError, match=f"{dt:g} s is no whole multiple of the plant's step; take a multiple of 2 s"
        ):
            whole_steps(dt, 2.0)


def test_no_reading_or_a_run_that_diverges_leaves_the_start_at_rest():
    model = StateSpaceModel(("q",), (), ("t",), A=[[0.5]], B=[[1.0]], C=[[1.0]], dt=1.0)
    u, none, priors = np.full((4, 1), 2.0), np.zeros((4, 0)), [StartPrior(), StartPrior(0.2, 0.3)]
    assert (priors[0].noise, priors[0].nuisance) == (0.1, 0.0)
    how = {"dt": 1.0, "scale": np.ones(1), "priors": priors}
    x0, offset = estimate_starts(model, np.full((4, 1), np.nan), u, none, **how)
    np.testing.assert_allclose(x0, model.rest([np.nan], [2.0], [], ())[None].repeat(2, axis=0))
    assert offset.tolist() == [[0.0], [0.0]]
    wild = replace(model, A=np.array([[1e200]]))
    y = np.array([[3.0], [3.5], [3.2], [3.1]])
    x0, offset = estimate_starts(wild, y, u, none, **how)
    assert (x0.tolist(), offset.tolist()) == ([[3.0], [3.0]], [[0.0], [0.0]])


def test_directions_that_nearly_repeat_others_are_left_out():
    """A second condition that differs from the first by 2e-10 of it counts, by 5e-11 it does not."""
    for off, n in ((1e-9, 2), (5e-11, 1)):
        fixed = np.array([[1.0, 0.0], [1.0, off]])
        z = constrained_lstsq(np.eye(2), np.array([0.0, 7.0]), fixed, np.array([3.0, 3.0]))
        np.testing.assert_allclose(z, [3.0, 0.0 if n == 2 else 7.0], atol=1e-5)


@given(
    size=st.lists(st.floats(-6.0, 3.0).map(lambda e: 10.0**e), min_size=1, max_size=5),
    seed=st.integers(0, 99),
)
def test_a_root_gives_its_covariance_back(size: list[float], seed: int):
    n = len(size)
    axes = np.linalg.qr(np.random.default_rng(seed).standard_normal((n + 2, n + 2)))[0][:, :n]
    covariance = axes * size @ axes.T  # of rank n in n + 2 dimensions
    root = symmetric_root(covariance)
    np.testing.assert_allclose(root @ root.T, covariance, atol=1e-9 * max(size))


def test_fixed_values_hold_and_the_rest_is_least_squares_by_lagrange():
    rng = np.random.default_rng(0)
    rows, right = rng.standard_normal((12, 5)), rng.standard_normal(12)
    fixed, value = rng.standard_normal((2, 5)), rng.standard_normal(2)
    whole = np.block([[rows.T @ rows, fixed.T], [fixed, np.zeros((2, 2))]])
    want = np.linalg.solve(whole, np.concatenate([rows.T @ right, value]))[:5]
    np.testing.assert_allclose(constrained_lstsq(rows, right, fixed, value), want, atol=1e-9)
    free = np.linalg.lstsq(rows, right, rcond=None)[0]
    np.testing.assert_allclose(constrained_lstsq(rows, right, fixed[:0], value[:0]), free, atol=1e-9)


def test_products_are_of_the_columns_that_they_name():
    names, u, d = ["q", "pump", "room", "sun"], [-2.0, 3.0], [-5.0, 7.0]
    terms = {"q*|q|": -4.0, "pump*room": -15.0, "|room|*sun": 35.0, "q*q*sun": 28.0}
    rows = np.array([[*u, *d]])
    np.testing.assert_array_equal(evaluate_terms(list(terms), names, rows), [list(terms.values())])
    assert products(list(terms), names, [*u, *d]) == list(terms.values())
    with pytest.raises(ValueError, match="names 'moon', which is not among q, pump"):
        read_terms(["q*moon"], names)


def box(**units: str) -> Plant:
    """A first-order lag behind two products of measured signals, of outputs with levels of their own."""
    model = StateSpaceModel(
        ("q",),
        ("wind",),
        ("t", "t2"),
        A=[[0.9]],
        B=[[0.5]],
        E=[[0.2]],
        C=[[1.0], [-3.0]],
        dt=2.0,
        y0=[20.0, 50.0],
    )
    known = {"q": "1", "wind": "1", "t": "degC", "t2": "degC"} | units
    return Plant(model, {}, dt=2.0, units=known, valid={"wind": (2.0, 6.0)})


def test_the_matrices_of_a_linear_model_are_its_own_whatever_its_level():
    near = linearise_plant(box(), inputs={"q": 1.0}, dt=2.0)
    for got, want in ((near.A, [[0.9]]), (near.B, [[0.5, 0.2]]), (near.C, [[1.0], [-3.0]])):
        np.testing.assert_allclose(got, want, atol=1e-7)
    # a measured signal that is no temperature is where the logs had it, in the middle
    assert near.w.tolist() == [1.0, 4.0]
    np.testing.assert_allclose(near.x, [(0.5 * 1.0 + 0.2 * 4.0) / 0.1], rtol=1e-6)
    np.testing.assert_allclose(near.y, np.array([20.0, 50.0]) + np.array([1.0, -3.0]) * near.x, rtol=1e-6)
    np.testing.assert_allclose(near.gain(), np.array([[1.0], [-3.0]]) @ [[5.0, 2.0]], rtol=1e-5)
    room = linearise_plant(box(wind="degC"), inputs={"q": 1.0}, dt=2.0)
    assert room.w.tolist() == [1.0, 25.0]


def test_a_point_is_of_what_is_named_and_where_the_plant_is_put():
    plant = box(wind="degC")
    near = linearise_plant(plant, inputs={"q": 2.0}, disturbances={"wind": 7.0}, state=[3.0], dt=4.0)
    assert (near.w.tolist(), near.x.tolist(), near.y.tolist()) == ([2.0, 7.0], [3.0], [23.0, 41.0])
    assert (near.states, near.inputs, near.outputs) == (("x1",), ("q", "wind"), ("t", "t2"))
    assert near.dt == 4.0
    np.testing.assert_allclose([*near.A[0], *near.B[0]], [0.81, 0.95, 0.38], rtol=1e-6)  # two steps
    with pytest.raises(UserError, match="has no q there; its inputs and disturbances are q, wind"):
        linearise_plant(plant, disturbances={"q": 2.0})
    none = replace(plant, units=plant.units | {"wind": "1"}, valid={})
    assert linearise_plant(none).w.tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("A", "settles"), [(1 - 1e-6, True), (1.0, False), (1 + 5e-7, True), (1 + 2e-6, None), (-0.5, True)]
)
def test_a_plant_that_integrates_does_not_settle_and_one_that_grows_runs_away(A: float, settles: bool | None):
    """A pole a millionth beyond one is rounding; where the plant settles may be far: 0.5 / (1 - A)."""
    plant = replace(box(), model=replace(box().model, A=np.array([[A]]), E=np.zeros((1, 1))))
    point = {"inputs": {"q": 2e-6}, "dt": 2.0}
    if settles:
        near = linearise_plant(plant, **point)
        np.testing.assert_allclose(near.x, [1e-6 / (1 - A)], rtol=1e-3)
    else:
        with pytest.raises(UserError, match="does not settle" if settles is False else "runs away"):
            linearise_plant(plant, **point)


@pytest.mark.parametrize(("pole", "fits"), [(2e-8, True), (5e-9, False), (-0.3, False)])
def test_a_pole_at_or_below_zero_has_no_continuous_equal(pole: float, fits: bool):
    plant = replace(box(), model=replace(box().model, A=np.array([[pole]])))
    if fits:
        A = linearise_plant(plant, inputs={"q": 1.0}).A
        np.testing.assert_allclose(np.exp(2.0 * A), [[pole]], rtol=1e-2)
    else:
        with pytest.raises(UserError, match=r"delay or a pole below zero.*; export it at its own step, dt=2"):
            linearise_plant(plant, inputs={"q": 1.0})


def test_poles_that_turn_by_more_than_a_right_angle_have_a_continuous_equal():
    turn = 0.8 * np.array([[np.cos(2.0), -np.sin(2.0)], [np.sin(2.0), np.cos(2.0)]])
    model = StateSpaceModel(("q",), (), ("t",), A=turn, B=[[1.0], [0.5]], C=[[1.0, 2.0]], dt=4.0)
    near = linearise_plant(Plant(model, {}, dt=4.0), inputs={"q": 1.0})
    np.testing.assert_allclose(sorted(np.linalg.eigvals(near.A).imag), [-0.5, 0.5], rtol=1e-6)  # 2 rad in 4 s
    np.testing.assert_allclose(near.gain(), steady_gain(model), rtol=1e-6)


def test_a_plant_that_grows_says_how_fast():
    unstable = replace(box().model, A=np.array([[1.01]]))
    plant = replace(box(), model=unstable)
    with pytest.raises(UserError, match=rf"grows e-fold in {2.0 / np.log(1.01):.3g} s"):
        linearise_plant(plant, inputs={"q": 1.0}, dt=2.0)


@pytest.mark.parametrize(("noise", "nuisance"), [(0.1, 0.0), (0.3, 0.5), (0.05, 2.0)])
def test_a_start_is_ridge_regression_on_state_and_offsets(noise: float, nuisance: float):
    rng = np.random.default_rng(2)
    A, B, C = (
        np.array([[0.9, 0.05], [0.1, 0.8]]),
        np.array([[0.4], [0.1]]),
        np.array([[1.0, 0.0], [0.3, 1.0]]),
    )
    spread, scale = np.array([[2.0, 0.5], [0.5, 1.0]]), np.array([3.0, 0.5])
    model = StateSpaceModel(("q",), (), ("a", "b"), A=A, B=B, C=C, dt=1.0, y0=[20.0, 30.0], spread=spread)
    u, y = rng.random((15, 1)), np.array([20.0, 30.0]) + rng.normal(size=(15, 2))
    y[0, 1] = y[4] = np.nan
    priors = [StartPrior(noise, nuisance), StartPrior(0.2, 0.0)]
    x0, offset = estimate_starts(model, y, u, np.zeros((15, 0)), dt=1.0, scale=scale, priors=priors)

    rest = model.rest([y[0, 0], y[1, 1]], u.mean(axis=0), [], ())
    free = model.rollout(rest[None], u[None], np.zeros((1, 15, 0)), (), 1.0)[0][0]
    rows, right = [], []
    for k in range(15):
        for j in (0, 1):
            if np.isfinite(y[k, j]):
                by = np.append((C @ np.linalg.matrix_power(A, k))[j], np.eye(2)[j])
                rows.append(by / (noise * scale[j]))
                right.append((y[k, j] - free[k, j]) / (noise * scale[j]))
    state = np.linalg.cholesky(np.linalg.inv(spread)).T
    rows += [*np.hstack([state, np.zeros((2, 2))])]
    keep = 4 if nuisance else 2  # without a spread of their own there are no offsets
    rows += [np.append([0.0, 0.0], e / (nuisance * scale)) for e in np.eye(2)] if nuisance else []
    right += [0.0] * (keep if nuisance else 2)
    want = np.linalg.lstsq(np.array(rows)[:, :keep], np.array(right), rcond=None)[0]
    np.testing.assert_allclose(x0[0], rest + want[:2], atol=1e-6)
    np.testing.assert_allclose(offset[0], want[2:] if nuisance else [0.0, 0.0], atol=1e-6)
    assert offset[1].tolist() == [0.0, 0.0]
