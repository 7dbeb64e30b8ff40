"""Innovations of a slow error, against the Cholesky factor of its covariance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_triangular, toeplitz

from thermogrip.sysid.greybox.problem import innovations


@pytest.mark.parametrize(("sd", "time", "noise"), [(0.1, 300.0, 0.05), (0.3, 20.0, 0.1), (0.02, 60.0, 0.2)])
def test_innovations_are_what_the_past_does_not_foresee(sd: float, time: float, noise: float):
    bin_s, m = 2.0, 900
    covariance = toeplitz(sd**2 * np.exp(-bin_s * np.arange(m) / time) + noise**2 * (np.arange(m) == 0))
    errors = np.random.default_rng(0).normal(size=(3, m))
    want = solve_triangular(np.linalg.cholesky(covariance), errors.T, lower=True).T
    found = innovations(errors, sd=sd, time=time, variance=noise**2, bin_s=bin_s)
    # the filter is the steady one: what it knew at the start is forgotten by then
    np.testing.assert_allclose(found[:, 800:], want[:, 800:], atol=1e-6)


def test_without_a_wander_innovations_are_the_errors_in_their_own_sd():
    errors = np.random.default_rng(1).normal(size=(2, 50))
    found = innovations(errors, sd=0.0, time=60.0, variance=0.04, bin_s=5.0)
    np.testing.assert_allclose(found, errors / 0.2)
