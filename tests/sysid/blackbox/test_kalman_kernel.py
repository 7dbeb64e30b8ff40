"""The filter gives the density of the readings that are there, the smoother the state given all of them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from thermogrip.sysid.blackbox.kalman_kernel import run_filter, run_smoother


def noisy_system(seed: int):
    """Arguments of the kernel's filter: two matrices, correlated noise, an uncertain start, readings lost."""
    rng = np.random.default_rng(seed)
    n, p, rows = 3, 2, 12
    y = rng.normal(size=(rows, p))
    y[rng.random((rows, p)) < 0.4] = np.nan
    y[4] = np.nan
    root = rng.normal(size=(n + p, n + p))
    joint = root @ root.T
    noise = (joint[:n, :n].copy(), joint[:n, n:].copy(), joint[n:, n:].copy())
    A, C, b = 0.5 * rng.normal(size=(2, n, n)), rng.normal(size=(p, n)), rng.normal(size=(rows, n))
    P0 = (0.3 if seed % 2 else 0.0) * np.eye(n)  # a start that is known, or not
    return [A, rng.integers(0, 2, rows), b, C, y, *noise, rng.normal(size=n), P0]


@pytest.mark.parametrize("seed", range(6))
def test_filter_and_smoother_are_those_of_the_joint_normal_distribution_of_all_states_and_readings(seed):
    A, at, b, C, y, Q, S, R, x0, P0 = system = noisy_system(seed)
    rows, p = y.shape
    n = len(x0)
    size = n + rows * (n + p)  # of [x0; v_0, e_0; v_1, e_1; ...], of which all is a sum
    joint = np.zeros((size, size))
    joint[:n, :n] = P0
    for t in range(rows):
        own = slice(n + t * (n + p), n + (t + 1) * (n + p))
        joint[own, own] = np.block([[Q, S], [S.T, R]])
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
    whole = H @ joint @ H.T
    cost, *filtered = run_filter(*system)
    assert -cost == pytest.approx(multivariate_normal(cov=whole).logpdf(miss), abs=1e-8)
    found, covariance = run_smoother(A, at, C, *filtered)
    for t in range(rows):
        cross = states[t] @ joint @ H.T @ np.linalg.inv(whole)
        np.testing.assert_allclose(found[t], means[t] + cross @ miss, atol=1e-8)
        want = states[t] @ joint @ states[t].T - cross @ H @ joint @ states[t].T
        np.testing.assert_allclose(covariance[t], want, atol=1e-8)
