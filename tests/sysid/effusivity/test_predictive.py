"""What a gripper will read next: predicted from the past alone, with errors of the stated size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from thermogrip.datasets.examples import load_example_grasps
from thermogrip.sysid.effusivity.data import noise_covariance
from thermogrip.sysid.effusivity.laplace_approximation import jacobian, nodes_for
from thermogrip.sysid.effusivity.multi_touch import next_touch_prior
from thermogrip.sysid.effusivity.predictive import _coming, next_touch

NAMES = ["copper", "iron", "wood"]


def test_another_touch_reads_its_nuisances_through_the_slopes(device):
    """Situation by situation, candidate by candidate; nothing of build-up, onset and level is known yet."""
    grasp = load_example_grasps()["exp5_two_touch_unknown_object"].isel(grasp=[0])
    names = ["copper", "wood"]
    ahead = next_touch(device, grasp, names, [20.0, 35.0], rest=30.0, end=4.0)
    prior = next_touch_prior(device, grasp, names, rest=30.0)
    x, spread = prior.mean, prior.covariance
    p = np.exp(prior.log_evidence) / np.exp(prior.log_evidence).sum()
    np.testing.assert_allclose(np.exp(ahead.log_p), [p, p])
    # a second about -1.5 s, then half a second each from 0.3 s on
    t = np.array([-1.5, *np.arange(0.55, 4.0, 0.5)])
    coming = _coming(np.array([20.0, 35.0]), 21.0, 4.0, 0.1)
    np.testing.assert_allclose(coming.t, [t, t])
    np.testing.assert_allclose(coming.ramp[0], np.maximum(t + 1.0, 0.0))
    assert coming.count[0].tolist() == [5.0] * t.size
    np.testing.assert_allclose(coming.sample_t[1, 5:10], [0.35, 0.45, 0.55, 0.65, 0.75])
    assert (coming.level.tolist(), coming.t_ambient.tolist()) == ([20.0, 35.0], [21.0, 21.0])
    room = float(grasp["t_ambient"].values[0])
    for i, level in enumerate((20.0, 35.0)):
        for k in range(2):
            u = np.array(
                [[x[k, 1], np.log(device.stack.build_up), device.onset, level, x[k, 0], x[k, 2], x[k, 3]]]
            )
            total = np.zeros((7, 7))
            total[np.ix_([4, 0, 5, 6], [4, 0, 5, 6])] = spread[k]
            total[[1, 2, 3], [1, 2, 3]] = np.square([device.spreads.ln_build_up, device.spreads.onset, 0.35])
            one = _coming(np.array([level]), room, 4.0, 0.1)
            y, slopes = jacobian(device.stack, nodes_for(one), one, u, np.ones((1, 7), dtype=bool))
            np.testing.assert_allclose(ahead.mean[i, k], y[0], atol=1e-9)
            noisy = replace(one, excursion=np.abs(y[:, 1:] - level).max(axis=1))
            want = slopes[0] @ total @ slopes[0].T + noise_covariance(noisy, device.noise)[0]
            np.testing.assert_allclose(ahead.covariance[i, k], want, rtol=1e-9, atol=1e-12)
    usual = next_touch(device, grasp.drop_vars("t_ambient"), names, 20.0)
    np.testing.assert_array_equal(
        usual.mean, next_touch(device, grasp.drop_vars("t_ambient"), names, 20.0, rest=60.0, end=10.0).mean
    )
    assert usual.mean.shape == (1, 2, 20)
