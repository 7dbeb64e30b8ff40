"""ARMAX: the noise's polynomial and the poles of known plants, ARX and output error as its ends."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from thermogrip.sysid.blackbox.noise_models import ArmaxSearch, armax_family, solve_armax
from thermogrip.sysid.blackbox.output_error import Records, oe_family
from thermogrip.sysid.plant.log_grid import Grid, Segment

A, B, LEVEL, SD = [1.0, -1.5, 0.56], 0.3, 20.0, 0.1  # poles at .8 and .7


def records_of(C, *, n=3000, seed=0, lost=0.0, segments=1):
    rng = np.random.default_rng(seed)
    ys, ws = [], []
    for _ in range(segments):
        q = np.repeat(rng.random(-(-n // 5)), 5)[:n]
        e = SD * rng.standard_normal(n)
        y = LEVEL + lfilter([0.0, B], A, q) + lfilter(C, A, e)
        ys.append(np.where(rng.random(n) < lost, np.nan, y))
        ws.append(q[:, None])
    return Records(ys, ws)


@pytest.mark.parametrize(
    ("C", "segments"), [([1.0, 0.0, 0.0], 1), ([1.0, 0.7, 0.1], 1), ([1.0, -0.9, 0.2], 3), (A, 1)]
)
def test_poles_gain_noise_and_level_of_a_known_plant_are_found(C, segments):
    found, noise = [], []
    for seed in range(4):
        search, records = ArmaxSearch(), records_of(C, n=3000 // segments, seed=seed, segments=segments)
        fit = search(records, 2, 1, 1)
        gain = fit.b.sum() / (1 + fit.a.sum())
        found.append([*fit.a, gain, (fit.constant / (1 + fit.a.sum()) - LEVEL)])
        noise.append(solve_armax(search._found[2][0], records, 1, 1).cost / 3000)
    np.testing.assert_allclose(np.mean(found, axis=0), [*A[1:], B / sum(A), 0.0], rtol=0.04, atol=0.2)
    assert np.sqrt(np.mean(noise)) == pytest.approx(SD, rel=0.03)  # the errors of one step are e


def test_noise_that_arx_takes_for_fast_poles_is_told_apart():
    records = records_of([1.0, -0.9, 0.2])
    search = ArmaxSearch()
    fit = search(records, 2, 1, 1)
    arx = solve_armax(np.zeros(2), records, 1, 1)
    assert np.abs(arx.shared[:2] - A[1:]).max() > 0.3
    np.testing.assert_allclose(fit.a, A[1:], atol=0.06)
    np.testing.assert_allclose(search._found[2][0], [-0.9, 0.2], atol=0.1)


def test_the_slopes_are_those_of_finite_differences():
    records, c = records_of([1.0, 0.5, 0.0], n=300, lost=0.0), np.array([0.3, -0.1])
    T, t = solve_armax(c, records, 1, 1).slopes(records)
    for i, slope in enumerate(T.T @ t):
        step = 1e-6 * np.eye(2)[i]
        costs = [solve_armax(c + sign * step, records, 1, 1).cost for sign in (1, -1)]
        assert -2 * slope == pytest.approx((costs[0] - costs[1]) / 2e-6, rel=1e-3)


def test_few_lost_readings_cost_little():
    fit = ArmaxSearch()(records_of([1.0, 0.7, 0.1], lost=0.03), 2, 1, 1)
    np.testing.assert_allclose(fit.a, A[1:], rtol=0.1)


def test_the_family_has_the_structures_of_output_error_with_c_beside():
    records = records_of([1.0, 0.7, 0.1], n=500)
    part = Segment(np.arange(500.0), records.y[0][:, None], records.w[0], np.zeros((500, 0)), "a")
    grid = Grid(("q",), (), ("t",), (), 1.0, (part,), 1.0, {})
    how = {"poles": (1, 2), "zeros": (1,), "delays": (1, 2), "terms": ((),)}
    found, plain = armax_family(grid, **how), oe_family(grid, **how)
    assert [s.label for s in found] == [s.label for s in plain]
    assert [s.size - p.size for s, p in zip(found, plain)] == [1, 1, 2, 2]
