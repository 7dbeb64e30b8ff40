"""Sums in logarithms and odds: beside scipy's, and where numbers would overflow."""

from __future__ import annotations

import numpy as np
import scipy.special
from hypothesis import given
from hypothesis import strategies as st

from thermogrip.datasets.log_space import expit, log_gamma, log_sum, logit, shares

NUMBERS = st.lists(st.floats(-1e5, 1e3) | st.just(-np.inf), min_size=6, max_size=6)


@given(NUMBERS)
def test_sums_are_those_of_scipy_along_any_axis(values):
    log_p = np.array(values).reshape(2, 3)
    for axis in (None, 0, 1):
        for keepdims in (False, True):
            want = scipy.special.logsumexp(log_p, axis=axis, keepdims=keepdims)
            got = log_sum(log_p, axis, keepdims=keepdims)
            np.testing.assert_allclose(got, want, rtol=1e-14, atol=1e-14)
            assert np.shape(got) == np.shape(want)


def test_shares_add_up_however_improbable_all_are():
    found = shares(np.array([[-5000.0, -5000.0 + np.log(3.0)]]), 1)
    np.testing.assert_allclose(found, [[0.25, 0.75]], rtol=1e-12)


@given(st.floats(-800, 800) | st.sampled_from([np.inf, -np.inf]))
def test_odds_are_those_of_scipy(x):
    np.testing.assert_allclose(expit(x), scipy.special.expit(x), rtol=1e-14, atol=1e-300)
    p = np.array([0.0, 1e-300, 0.02, 0.5, 1 - 1e-9, 1.0])
    np.testing.assert_allclose(logit(p), scipy.special.logit(p), rtol=1e-7)
    np.testing.assert_allclose(logit(p[:4]), scipy.special.logit(p[:4]), rtol=1e-14)


def test_gamma_functions_are_those_of_scipy():
    x = np.array([[0.5, 3.0, 2.5], [3.0, 3.0, 150.5]])
    np.testing.assert_allclose(log_gamma(x), scipy.special.gammaln(x), rtol=1e-14, atol=1e-15)
