"""The noise of bin means: its inverse, and the slopes of its likelihood."""

from __future__ import annotations

import numpy as np
import pytest

from thermogrip.datasets.schema import make_grasps
from thermogrip.sysid.effusivity.data import Noise, noise_covariance, noise_fit, touches, whiten

TIME = np.round(np.arange(-2.0, 10.05, 0.1), 1)


def test_whitener_inverts_the_covariance_and_leaves_lost_bins_out():
    y = np.full((2, TIME.size), 30.0)
    y[1, 30:40] = np.nan
    data = touches(make_grasps(TIME, y + 3 * (TIME > 0), ["a", "b"]))
    w, log_det = whiten(data, Noise())
    cov = noise_covariance(data, Noise())
    for i in range(2):
        there = data.count[i] > 0
        part = cov[i][np.ix_(there, there)]
        inverse = (w[i].T @ w[i])[np.ix_(there, there)]
        np.testing.assert_allclose(inverse @ part, np.eye(there.sum()), atol=1e-8)
        assert log_det[i] == pytest.approx(np.linalg.slogdet(2 * np.pi * part)[1])
    assert (data.count[1] == 0).any()


def test_slopes_of_the_noise_are_those_of_its_likelihood():
    """The likelihood put together from the covariance, a sample lost, another uncertain parameter."""
    y = np.random.default_rng(3).normal(0.0, 0.05, (2, TIME.size)) + 3 * (TIME > 0)
    y[1, 30:40] = np.nan
    data = touches(make_grasps(TIME, y, ["a", "b"]))
    there = data.count > 0
    left = np.random.default_rng(4).normal(0.0, 0.1, there.shape) * there
    extra = 0.01 * there[:, :, None] * there[:, None, :]
    q = np.array([*np.log([0.05, 0.02, 3.0, 0.002]), 0.7])

    def cost(q):
        white, slow, memory, misfit = np.exp(q[:4])
        noise = Noise(white=white, slow=slow, correlation_time=memory, misfit=misfit, growth=q[4])
        cov = noise_covariance(data, noise) + extra
        want = sum(r @ np.linalg.solve(c, r) + np.linalg.slogdet(c)[1] for r, c in zip(left, cov))
        return 0.5 * want, noise_fit(data, noise, extra, left)

    want, (value, slopes) = cost(q)
    assert value == pytest.approx(want, rel=1e-10)
    steps = 1e-5 * np.eye(5)
    differences = [(cost(q + s)[0] - cost(q - s)[0]) / 2e-5 for s in steps]
    np.testing.assert_allclose(slopes, differences, rtol=1e-5, atol=1e-4)
