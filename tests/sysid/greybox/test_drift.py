"""Trends of a rig over months: against exact formulas, known slopes, steady fleets, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.sysid.greybox.makers import BOARD, N_FREE, OWN, WIDTH, plant_at
from thermogrip.datasets.errors import UserError
from thermogrip.sysid.greybox import drift as kernel
from thermogrip.sysid.greybox.drift import find_drift
from thermogrip.sysid.greybox.population import Told

MONTHS = (0.0, 31.0, 59.0, 90.0, 120.0, 151.0)
ROOM = BOARD.free.index("t_room")


def fleet(rng, n, *, scatter=0.1, slope=None, days=MONTHS, size=6.0):
    """Return fits of a log a month of n rigs, which ``slope`` (k,) moves from the first log to the last."""
    at = (np.array(days) - days[0]) / (days[-1] - days[0])
    fits = {}
    for i in range(n):
        middle, logs = 0.5 * rng.normal(size=N_FREE), []
        for tau in at:
            true = middle + scatter * rng.normal(size=N_FREE) + (0 if slope is None or i else tau * slope)
            J = size * rng.normal(size=(10, N_FREE))
            S = np.linalg.inv(J.T @ J + np.eye(N_FREE))
            logs.append(plant_at(S @ J.T @ (J @ true + rng.normal(size=10)), S))
        fits[f"r{i}"] = logs
    return fits, dict.fromkeys(fits, days)


def test_mean_slope_and_days_are_those_of_generalised_least_squares():
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(4, 3, 3)) + 2 * np.eye(3)
    precision, z, T = roots @ roots.transpose(0, 2, 1), rng.normal(size=(4, 3)), np.array([0.3, 1.0, 0.1])
    tau = np.array([-0.5, -0.3, 0.1, 0.5])
    found = kernel._trend(Told(precision, np.einsum("nij,nj->ni", precision, z)), tau, T)
    X = np.vstack([np.hstack([np.eye(3), t * np.eye(3)]) for t in tau])
    cov = np.zeros((12, 12))
    for i, own in enumerate(np.linalg.inv(precision)):
        cov[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = own + np.diag(T)
    prior = np.diag([1.0] * 3 + [4.0] * 3)
    # the joint normal of beta and the fits, conditioned on the fits
    gain = prior @ X.T @ np.linalg.inv(X @ prior @ X.T + cov)
    np.testing.assert_allclose(found.beta, gain @ z.ravel())
    np.testing.assert_allclose(found.covariance, prior - gain @ X @ prior, atol=1e-12)
    day = X @ prior @ X.T + np.kron(np.eye(4), np.diag(T))
    of_day = day @ np.linalg.inv(X @ prior @ X.T + cov)
    np.testing.assert_allclose(found.days.ravel(), of_day @ z.ravel())
    left = np.diag(day - of_day @ day)
    np.testing.assert_allclose(found.day_sd.ravel() ** 2, left)


def test_known_slopes_are_covered_and_the_scatter_is_found():
    rng, off, scatters = np.random.default_rng(1), [], []
    slope = np.linspace(-1.0, 1.0, N_FREE)
    for _ in range(15):
        fits, days = fleet(rng, 6, slope=slope)
        rigs, scatter = find_drift(fits, days)
        scatters.append(scatter / WIDTH[OWN])
        off += [(rigs[0].change - (WIDTH * slope)[OWN]) / rigs[0].change_sd]
        off += [rig.change / rig.change_sd for rig in rigs[1:]]
    # 540 intervals, six of a rig; 90 % and three standard errors of as many independent rigs
    assert np.mean(np.abs(off) < 1.645) == pytest.approx(0.9, abs=0.06)
    np.testing.assert_allclose(np.mean(scatters, axis=0), 0.1, rtol=0.3)


@pytest.mark.parametrize("moved", [0.0, 2.0])
def test_a_rig_that_moves_is_named_with_its_parameter(moved):
    slope = np.zeros(N_FREE)
    slope[2] = moved
    fits, days = fleet(np.random.default_rng(2), 8, slope=slope)
    rigs, _ = find_drift(fits, days)
    assert [rig.name for rig in rigs if rig.drifts] == (["r0"] if moved else [])
    assert rigs[0].farthest == 2 or not moved


def test_steady_fleets_raise_few_alarms():
    rng = np.random.default_rng(3)
    alarms = sum(
        any(rig.drifts for rig in find_drift(*fleet(rng, 5, days=MONTHS[:4], scatter=0.3))[0])
        for _ in range(40)
    )
    # one fleet of twenty at the most: of 40 more than 6 has a chance of 0.003
    assert alarms <= 6


def test_a_room_that_warms_is_no_drift_of_the_rig():
    slope = np.zeros(N_FREE)
    slope[ROOM] = 3.0
    rigs, _ = find_drift(*fleet(np.random.default_rng(4), 8, slope=slope))
    assert rigs[0].change.size == N_FREE - 1
    assert not rigs[0].drifts


def test_logs_that_say_nothing_have_no_trend():
    blind = [plant_at(np.zeros(N_FREE), np.eye(N_FREE))] * 6
    fits, days = fleet(np.random.default_rng(5), 4)
    rigs, _ = find_drift(fits | {"blind": blind}, days | {"blind": MONTHS})
    np.testing.assert_allclose(rigs[-1].change, 0, atol=1e-9)
    np.testing.assert_allclose(rigs[-1].change_sd, 2 * WIDTH[OWN])
    assert rigs[-1].chance == 1.0


def test_the_order_of_logs_and_the_unit_of_time_do_not_matter():
    fits, days = fleet(np.random.default_rng(6), 3)
    order = [3, 0, 5, 1, 4, 2]
    shuffled = {name: [plants[k] for k in order] for name, plants in fits.items()}
    first, _ = find_drift(fits, days)
    again, _ = find_drift(shuffled, {name: [24 * MONTHS[k] for k in order] for name in fits})
    for one, other in zip(first, again):
        np.testing.assert_allclose(other.change, one.change, atol=1e-9)
        np.testing.assert_allclose(other.theta, one.theta[order], atol=1e-9)


def test_what_has_no_trend_is_refused():
    fits, days = fleet(np.random.default_rng(7), 2)
    with pytest.raises(UserError, match="no rig has three logs"):
        find_drift({name: plants[:2] for name, plants in fits.items()}, days)
    with pytest.raises(UserError, match="rig r1 are of one time"):
        find_drift(fits, days | {"r1": [7.0] * 6})
    broken = [replace(fits["r1"][0], covariance=None), *fits["r1"][1:]]
    with pytest.raises(UserError, match="rig r1 has no fits"):
        find_drift(fits | {"r1": broken}, days)
    # a rig of two logs stands beside the others, without a trend
    rigs, _ = find_drift(fits | {"r1": fits["r1"][:2]}, days)
    assert [rig.name for rig in rigs] == ["r0"]
