"""Box-Jenkins: nearer than output error under noise that lasts, the same under white noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from thermogrip.sysid.blackbox.noise_models import autoregression, bj_family, with_noise
from thermogrip.sysid.blackbox.output_error import Filter, Records, Search, fit_rest, oe_family
from thermogrip.sysid.plant.log_grid import Grid, Segment

POLE, GAIN, LEVEL = 0.8, 0.5, 20.0  # of y+ = 0.8 y + 0.5 q, about 20


def records_of(noise_poles, *, n=2000, seed=0, sd=0.1, lost=0.0, segments=1):
    rng = np.random.default_rng(seed)
    ys, ws = [], []
    for _ in range(segments):
        q = np.repeat(rng.random(-(-n // 5)), 5)[:n]
        v = lfilter([1.0], np.poly(noise_poles), sd * rng.standard_normal(n))
        y = LEVEL + lfilter([0.0, GAIN], [1.0, -POLE], q) + v
        ys.append(np.where(rng.random(n) < lost, np.nan, y))
        ws.append(q[:, None])
    return Records(ys, ws)


def off(found: Filter) -> float:
    return abs(-found.a[0] - POLE)


@pytest.mark.parametrize(("lost", "segments"), [(0.0, 1), (0.0, 3), (0.05, 1)])
def test_noise_that_lasts_costs_less_than_with_output_error(lost, segments):
    plain, better = [], []
    for seed in range(12):
        records = records_of([0.99], n=2000 // segments, seed=seed, lost=lost, segments=segments)
        found = Search()(records, 1, 1, 1)
        plain.append(off(found))
        after = with_noise(found, records)
        better.append(off(after))
    # by (X'R X) of least squares and (X'R^-1 X)^-1 the pole's sd is 4.4 times less; each mean is sure to 22 %
    assert np.mean(better) < 0.5 * np.mean(plain)


def test_the_pole_is_within_four_cramer_rao_bounds():
    records = records_of([0.99])
    found = with_noise(Search()(records, 1, 1, 1), records)
    D = [1.0, -0.99]
    v = lfilter([0.0, GAIN], [1.0, -POLE], records.w[0][:, 0])
    columns = [lfilter([0.0, 1.0], [1.0, -POLE], v), lfilter([0.0, 1.0], [1.0, -POLE], records.w[0][:, 0])]
    X = np.column_stack([*(lfilter(D, [1.0], c) for c in columns), np.full(len(v), 0.01)])
    sd = 0.1 * np.sqrt(np.linalg.inv(X.T @ X)[0, 0])
    assert off(found) < 4 * sd
    assert found.constant / (1 + found.a[0]) == pytest.approx(LEVEL, abs=4 * 0.1 / 0.01 / np.sqrt(2000))


def test_white_noise_leaves_the_output_error_fit():
    records = records_of([])
    found = Search()(records, 1, 1, 1)
    after = with_noise(found, records)
    np.testing.assert_allclose((after.a[0], after.b[0, 0]), (found.a[0], found.b[0, 0]))
    # constant and initial condition of the same least squares, solved alone
    np.testing.assert_allclose(after.constant, found.constant, rtol=1e-6)
    np.testing.assert_allclose(after.first, found.first, rtol=1e-4, atol=1e-5)


def test_with_every_third_reading_lost_it_stays_the_output_error_fit():
    records = records_of([0.99])
    records = Records([np.where(np.arange(2000) % 3, records.y[0], np.nan)], records.w)
    found = Search()(records, 1, 1, 1)
    assert with_noise(found, records).a.tolist() == found.a.tolist()


@pytest.mark.parametrize(
    ("poles", "order"), [([], 0), ([0.9], 1), ([0.9, -0.5], 2), ([0.9, 0.5, -0.5], 3), ([0.9] * 4, 3)]
)
def test_the_autoregression_is_that_of_the_noise(poles, order):
    e = lfilter([1.0], np.poly(poles), np.random.default_rng(5).standard_normal(20_000))
    D = autoregression([e[:12_000], e[12_000:]], [np.ones(12_000, bool), np.ones(8000, bool)])
    assert len(D) == 1 + order
    if len(poles) < 4:  # sd of a coefficient is about 1/sqrt(n) = .007
        np.testing.assert_allclose(D, np.poly(poles), atol=0.03)


def test_lost_errors_are_no_pairs():
    rng = np.random.default_rng(1)
    e = lfilter([1.0], [1.0, -0.9], rng.standard_normal(20_000))
    known = rng.random(20_000) > 0.3
    D = autoregression([np.where(known, e, 0.0)], [known])
    # covariances of half of the pairs are less sure, so a lag more may seem needed
    np.testing.assert_allclose([D[1], D.sum()], [-0.9, 0.1], atol=0.05)
    assert autoregression([np.zeros(50)], [np.ones(50, bool)]).tolist() == [1.0]


def test_constant_and_initial_conditions_are_those_of_the_readings():
    records = records_of([], sd=0.0, segments=2)
    found = Search()(records, 1, 1, 1)
    wrong = Filter(found.a, found.b, 99.0, 1, np.full((2, 1), 7.0))
    again, misses = fit_rest(wrong, records)
    assert again.constant / (1 + again.a[0]) == pytest.approx(LEVEL, abs=1e-3)
    assert max(np.abs(miss).max() for miss in misses) < 1e-3


def grid_of(records: Records) -> Grid:
    n = len(records.y[0])
    part = Segment(np.arange(float(n)), records.y[0][:, None], records.w[0], np.zeros((n, 0)), "a")
    return Grid(("q",), (), ("t",), (), 1.0, (part,), 1.0, {})


def test_the_family_has_the_structures_of_output_error_with_the_noise_beside():
    grid = grid_of(records_of([0.99], n=500))
    how = {"poles": (1, 2), "zeros": (1,), "delays": (1, 2)}
    found, plain = bj_family(grid, **how), oe_family(grid, **how)
    assert [s.label for s in found] == [s.label for s in plain]
    assert [s.size for s in found] == [s.size + 1 for s in plain]
    wanted = list(found)[2]
    (alone,) = bj_family(grid, **how, only=[wanted]).items()
    assert alone[0] == wanted
    np.testing.assert_allclose(alone[1].poles(), found[wanted].poles(), atol=2e-3)
