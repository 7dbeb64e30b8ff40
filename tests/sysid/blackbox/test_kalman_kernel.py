"""The filter gives the density of the readings that are there, the smoother the state given all of them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from thermogrip.sysid.blackbox.kalman_kernel import run_filter, run_smoother
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.log_grid import Segment

K = np.array([[0.4, 0.1], [0.0, 0.3], [0.2, -0.5]])
R = np.array([[0.5, 0.2], [0.2, 0.3]])
X0 = np.array([0.3, -0.2, 1.0])


def coupled(**changes):
    """Two outputs of three states, a switch that changes how they couple, a product of inputs, offsets."""
    parts = {
        "A": [[0.8, 0.1, 0.0], [0.0, 0.6, 0.2], [0.1, 0.0, 0.5]],
        "B": [[0.3, 0.0], [0.0, 0.1], [0.2, 0.0]],
        "C": [[1.0, 0.5, 0.0], [0.0, 1.0, -1.0]],
        "E": [[0.1], [0.0], [0.2]],
        "F": [[0.0], [0.3], [0.0]],
        "c": [0.1, 0.0, -0.1],
        "y0": [20.0, 25.0],
        "A_switch": {"pump": [[0.0, 0.1, 0.0], [0.1, 0.0, 0.0], [0.0, 0.0, 0.2]]},
    }
    return StateSpaceModel(
        ("q", "pump"), ("room",), ("t1", "t2"), dt=1.0, switches=("pump",), terms=("|q|",), **parts | changes
    )


def record(n=9, seed=0, lost=0.0):
    rng = np.random.default_rng(seed)
    u = np.column_stack([rng.normal(size=n), np.arange(n) % 4 < 2])
    y = np.array([20.0, 25.0]) + rng.normal(size=(n, 2))
    y[rng.random((n, 2)) < lost] = np.nan
    return Segment(np.arange(float(n)), y, u, rng.normal(size=(n, 1)), "a")


def filtered(model, segment, x0, gain, covariance):
    """ln p of the readings by the filter."""
    at = segment.u[:, 1].astype(int)  # the pump
    stack = np.stack([model.A, model.A + model.A_switch["pump"]])
    push, P0 = np.ascontiguousarray(model.push(segment.u, segment.d)), np.zeros((3, 3))
    noise = gain @ covariance @ gain.T, gain @ covariance, covariance
    return -run_filter(stack, at, push, model.C, segment.y - model.y0, *noise, x0.copy(), P0)[0]


def dense(model, segment, x0, gain, covariance):
    """ln p of the readings from the mean and covariance of all of them, written down by hand."""
    n, p = segment.y.shape
    free = model.rollout(x0[None], segment.u[None], segment.d[None], (), model.dt)[0][0, :-1]
    through = np.zeros((n * p, n * p))  # from the innovations of a row to the readings of a later one
    for row in range(n):
        state = gain.copy()
        through[row * p : (row + 1) * p, row * p : (row + 1) * p] = np.eye(p)
        for later in range(row + 1, n):
            through[later * p : (later + 1) * p, row * p : (row + 1) * p] = model.C @ state
            switched = sum(segment.u[later, model.inputs.index(k)] * m for k, m in model.A_switch.items())
            state = (model.A + switched) @ state
    whole = through @ np.kron(np.eye(n), covariance) @ through.T
    read = np.isfinite(segment.y).ravel()
    density = multivariate_normal(free.ravel()[read], whole[np.ix_(read, read)])
    return float(density.logpdf(segment.y.ravel()[read]))


@settings(max_examples=25)
@given(seed=st.integers(0, 10**6), lost=st.floats(0.0, 0.9))
def test_the_likelihood_is_the_normal_density_of_the_readings_that_are_there(seed, lost):
    segment = record(seed=seed, lost=lost)
    segment.y[0, 0] = 20.0  # scipy has no density of nothing
    found = filtered(coupled(), segment, X0, K, R)
    assert found == pytest.approx(dense(coupled(), segment, X0, K, R), abs=1e-9)


@pytest.mark.parametrize("where", [np.s_[:, 1], np.s_[3:6, :], np.s_[4, 0], np.s_[0, :]])
def test_a_lost_channel_lost_rows_and_a_lost_start_are_integrated_over(where):
    segment = record()
    segment.y[where] = np.nan
    found = filtered(coupled(), segment, X0, K, R)
    assert found == pytest.approx(dense(coupled(), segment, X0, K, R), abs=1e-9)


def noisy_system(seed=0):
    """Arguments of the kernel's filter: correlated noise, a doubtful start, lost channels and a lost row."""
    rng = np.random.default_rng(seed)
    n, p, rows = 3, 2, 12
    y = rng.normal(size=(rows, p))
    y[rng.random((rows, p)) < 0.4] = np.nan
    y[4] = np.nan
    root = rng.normal(size=(n + p, n + p))
    joint = root @ root.T
    noise = (joint[:n, :n].copy(), joint[:n, n:].copy(), joint[n:, n:].copy())
    A, C, b = 0.5 * rng.normal(size=(2, n, n)), rng.normal(size=(p, n)), rng.normal(size=(rows, n))
    return [A, rng.integers(0, 2, rows), b, C, y, *noise, rng.normal(size=n), 0.3 * np.eye(n)]


def test_the_smoother_is_the_mean_and_covariance_given_all_readings():
    A, at, b, C, y, Q, S, R_, x0, P0 = system = noisy_system(1)
    rows, p = y.shape
    n = len(x0)
    size = n + rows * (n + p)  # of [x0; v_0, e_0; v_1, e_1; ...], of which all is a sum
    joint = np.zeros((size, size))
    joint[:n, :n] = P0
    for t in range(rows):
        own = slice(n + t * (n + p), n + (t + 1) * (n + p))
        joint[own, own] = np.block([[Q, S], [S.T, R_]])
    state, mean, states, means, seen = np.eye(n, size), x0, [], [], []
    for t in range(rows):
        own = n + t * (n + p)
        states.append(state)
        means.append(mean)
        seen.append(C @ state + np.eye(p, size, own + n))
        state, mean = A[at[t]] @ state + np.eye(n, size, own), A[at[t]] @ mean + b[t]
    read = np.isfinite(y).ravel()
    H = np.concatenate(seen)[read]
    miss = y.ravel()[read] - np.concatenate([C @ m for m in means])[read]
    found, covariance = run_smoother(A, at, C, *run_filter(*system)[1:])
    for t in range(rows):
        cross = states[t] @ joint @ H.T @ np.linalg.inv(H @ joint @ H.T)
        np.testing.assert_allclose(found[t], means[t] + cross @ miss, atol=1e-9)
        want = states[t] @ joint @ states[t].T - cross @ H @ joint @ states[t].T
        np.testing.assert_allclose(covariance[t], want, atol=1e-9)
