"""A fifth of the readings lost: every model still fits, and nearly as well as with all of them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.signal import lfilter
from scipy.stats import multivariate_normal

from thermogrip.datasets.schema import make_log
from thermogrip.sysid.blackbox import missing_data
from thermogrip.sysid.blackbox.fit import BLACK_BOXES, FAMILIES
from thermogrip.sysid.blackbox.missing_data import MANY, expected_moments, fill_readings
from thermogrip.sysid.plant.log_grid import Segment, make_grid


def heater_log(n=900, *, seed=0, lost=0.0):
    rng = np.random.default_rng(seed)
    q = np.repeat(rng.random(n // 25), 25)
    t = 25 + lfilter([0, 0.5], [1, -0.95], q) + 0.02 * rng.standard_normal(n)
    t = np.where(rng.random(n) < lost, np.nan, t)
    return make_log(np.arange(float(n)), {"q": (q, "1", "input"), "t": (t, "degC", "output")})


def error(model, segment):
    x0 = model.rest(segment.y[0], segment.u[0], segment.d[0], ())
    seen, _ = model.rollout(x0[None], segment.u[None], segment.d[None], (), 1.0)
    return float(np.sqrt(np.mean((seen[0, :-1] - segment.y)[100:] ** 2)))


@pytest.mark.parametrize("kind", BLACK_BOXES)
def test_every_black_box_fits_with_a_fifth_of_the_readings_lost(kind):
    fresh = make_grid([heater_log(seed=1)], average=1.0).segments[0]
    assert np.isnan(heater_log(lost=0.2)["t"].values).mean() == pytest.approx(0.2, abs=0.04)
    models = FAMILIES[kind](make_grid([heater_log(lost=0.2)], average=1.0)).values()
    assert min(error(model, fresh) for model in models) < 0.15  # of a spread of 2.4 degC


def pulled_walk(n, *, seed=0, lost=0.4, pole=0.8, rise=1.0):
    """A first-order ARX process, of which some was lost, as a segment and its drive."""
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(n, 1))
    y = lfilter([0, rise], [1, -pole], q[:, 0]) + lfilter([1.0], [1, -pole], rng.normal(size=n))
    y[rng.random(n) < lost] = np.nan
    return Segment(np.arange(float(n)), y[:, None], q, np.zeros((n, 0)), "a"), q


def walk_density(segment, theta):
    """ln p of the readings after the first by their dense covariance; theta: pole, rise, level, ln sd."""
    pole, rise, level, ln_sd = theta
    y, q, n = segment.y[:, 0], segment.u[:, 0], len(segment.time)
    # before the first reading the drift may be anywhere in its spread; a known one is where it is
    known = np.isfinite(y[0])
    first = y[0] if known else np.nanmean(y)
    mean, spread = [], 0.0 if known else np.nanvar(y)
    for k in range(1, n):
        mean.append(pole * (first if k == 1 else mean[-1]) + rise * q[k - 1] + level)
    powers = pole ** np.subtract.outer(np.arange(n - 1), np.arange(n - 1)).clip(0)
    through = np.tril(powers)
    whole = np.exp(2 * ln_sd) * through @ through.T
    whole += spread * np.outer(*2 * [pole ** np.arange(1, n)])
    read = np.isfinite(y[1:])
    return multivariate_normal(np.array(mean)[read], whole[np.ix_(read, read)]).logpdf(y[1:][read])


def test_the_moments_are_those_of_the_greatest_likelihood_of_what_was_read():
    segment, q = pulled_walk(150)
    none = np.zeros((150, 0))
    found = expected_moments([segment], [q], [none], past_y=1, past_w=1)
    assert np.all(np.diff(found.log_likelihood) > -1e-9)
    pole, rise, level = np.linalg.solve(found.gram, found.cross)[:, 0]

    def miss(theta):
        return -walk_density(segment, theta)

    best = minimize(miss, [pole, rise, level, 0.0], method="BFGS")
    spread = np.sqrt(np.diag(best.hess_inv)[:3])
    # the last round gained less than 0.02 of ln p: the rest of the way is a fraction of a standard error
    np.testing.assert_array_less(np.abs(best.x[:3] - [pole, rise, level]), 0.5 * spread)
    np.testing.assert_array_less(np.abs(best.x[:2] - [0.8, 1.0]), 4 * spread[:2])
    # and up to the units of the spread it is the density itself
    read = int(np.isfinite(segment.y[1:]).sum())
    own = found.log_likelihood[-1] - read * np.log(np.nanstd(segment.y))
    assert own == pytest.approx(-best.fun, abs=0.1)


@pytest.mark.parametrize(("lost", "burst"), [(0.3, 1), (0.5, 1), (0.5, 10)])
def test_arx_is_not_biased_by_lost_readings(lost, burst, coupled, fit_one):
    """Its scatter is that of least squares on all rows, as much wider as fewer readings can make it."""
    off = []
    for seed in range(6):
        whole = coupled.log(1500, seed=seed, process=0.1)
        y, u = (np.stack([whole[n].values for n in names], axis=1) for names in (("t1", "t2"), ("q1", "q2")))
        X = np.column_stack([y[:-1], u[:-1], np.ones(len(y) - 1)])
        sd = 0.1 * np.sqrt(np.diag(np.linalg.inv(X.T @ X))[:2])
        log = coupled.log(1500, seed=seed, process=0.1, lost=lost, burst=burst)
        model = fit_one("arx", make_grid([log], average=1.0), poles=1, zeros=1)
        off.append((model.A[:2, :2] - coupled.A) / sd)
    # mean of 6: sd 1/sqrt(6) of a fit's own; half of the readings of each channel leave a quarter of the rows
    assert np.abs(np.mean(off, axis=0)).max() < 4 / np.sqrt(6) * 2


def test_a_channel_that_one_log_lacks_is_learnt_from_the_other(coupled, fit_one):
    silent, whole = coupled.log(900, seed=1, process=0.1, lost=0.2), coupled.log(900, seed=2, process=0.1)
    silent["t2"].values[20:] = np.nan
    models = [
        fit_one("arx", make_grid(logs, average=1.0), poles=1, zeros=1) for logs in ([silent, whole], [whole])
    ]
    both, alone = (np.abs(model.A[:2, :2] - coupled.A).max() for model in models)
    assert both < alone + 0.01


def test_guesses_keep_what_was_read_and_follow_the_drive_where_nothing_was():
    rng = np.random.default_rng(0)
    q = np.repeat(rng.random(60), 10)[:, None]
    true = lfilter([0, 0.5], [1, -0.9], q[:, 0])[:, None]
    y = true + 0.01 * rng.standard_normal(true.shape)
    y[200:260] = np.nan  # five steps of the drive
    segment = Segment(np.arange(600.0), y, q, np.zeros((600, 0)), "a")
    filled = fill_readings([segment], [q])[0]
    known = np.isfinite(y)
    np.testing.assert_allclose(filled[known], y[known], atol=1e-6)
    line = np.interp(np.arange(200, 260), [199, 260], y[[199, 260], 0])
    wrong = [np.sqrt(np.mean((guess - true[200:260, 0]) ** 2)) for guess in (filled[200:260, 0], line)]
    assert wrong[0] < 0.05 < 0.3 < wrong[1]


@pytest.mark.parametrize("kind", ["arx", "subspace"])
def test_many_lost_readings_are_counted_over_the_whole_grid_so_that_every_fold_has_the_same_structures(kind):
    rng = np.random.default_rng(0)
    for lost, wanted in ((0.002, False), (0.3, True)):
        log = heater_log()
        log["t"].values[450:][rng.random(450) < 2 * lost] = np.nan  # in the second half alone
        grid = make_grid([log], average=1.0)
        assert (grid.lost > MANY) == wanted
        parts = [grid.having([grid.segments[0].part(*rows)]) for rows in ((0, 450), (450, 900))]
        assert all(part.lost == grid.lost for part in parts)
        first, second = ({s.label for s in FAMILIES[kind](part)} for part in parts)
        assert first & second


def test_subspace_models_of_a_log_with_long_holes_are_those_of_the_whole_log(coupled, fit_one):
    """Bursts of 20 rows leave no window of 30 whole; lines through them pull the gain by a tenth and more."""
    true, misses = np.linalg.solve(np.eye(2) - coupled.A, coupled.B), []
    for how in ({}, {"lost": 0.4, "burst": 20}):
        grid = make_grid([coupled.log(1500, seed=3, process=0.1, **how)], average=1.0)
        gain = fit_one("subspace", grid, orders=2, rows=15, variant="moesp").gain()
        misses.append(np.abs(gain - true).max() / np.abs(true).max())
    assert misses[1] < misses[0] + 0.1


def test_whole_readings_with_a_switch_have_columns_lag_by_lag():
    rng, n = np.random.default_rng(2), 40
    y, q, on = rng.normal(size=(n, 2)) + [3, -7], rng.normal(size=(n, 2)) * [1, 5], rng.random((n, 1))
    parts = [Segment(np.arange(float(len(some))), some, some, some, "a") for some in (y, y[:4])]
    found = expected_moments(parts, [q, q[:4]], [on, on[:4]], past_y=2, past_w=3)
    late = [y[2:-1], y[1:-2], 0 * y[:-3]]  # a third lag that no reading has; four rows are too few
    X = np.hstack([*late, *(on[2:-1] * some for some in late), q[2:-1], q[1:-2], q[:-3], np.ones((37, 1))])
    np.testing.assert_allclose(found.gram, X.T @ X, atol=1e-8)
    np.testing.assert_allclose(found.cross, X.T @ y[3:], atol=1e-8)
    assert found.read == 74


def test_covariances_enter_the_sums_with_the_factors_of_their_row():
    y = np.array([[1.0], [3.0], [np.nan], [5.0]])  # sd 1.633
    on, q = np.array([[0.5], [0.25], [2.0], [9.0]]), np.zeros((4, 1))
    em = missing_data._Em([(Segment(np.arange(4.0), y, q, q, "a"), q, on)], 1, 1)
    (z, V) = em.bridged()[0]
    V[1] = [[4.0, 3.0], [3.0, 2.0]]  # of [y2, y1]: the row of factor 0.25
    none = em.sums([(z, 0 * V)])
    more = [some - other for some, other in zip(em.sums([(z, V)]), none)]
    np.testing.assert_allclose(more[0][:2, :2], [[2, 0.5], [0.5, 0.125]])
    assert np.abs(more[0]).sum() == pytest.approx(3.125)
    np.testing.assert_allclose(more[1][:, 0], [3, 0.75, 0, 0])
    np.testing.assert_allclose(more[2], [[4]])
    natural = em.sums([(z, V)], natural=True)[0] - em.sums([(z, 0 * V)], natural=True)[0]
    np.testing.assert_allclose(natural[:2, :2], np.array([[2, 0.5], [0.5, 0.125]]) * 8 / 3)
    np.testing.assert_allclose(z * np.sqrt(8 / 3) + 3, [[3, 1], [4, 3], [5, 4]])  # a line through the hole
    A = em._transitions(np.array([[0.7], [0.1], [9.0], [9.0]]), np.array([[0.0], [2.0]]))
    np.testing.assert_allclose(A, [[[0.7, 0], [1, 0]], [[0.9, 0], [1, 0]]])


@pytest.mark.parametrize(
    ("rows", "rounds"), [(29, 0), (30, 5)]
)  # more than 2 (4 (1 + 2) + 1) readings after 4 rows
def test_five_rounds_are_a_first_guess_where_readings_suffice(monkeypatch, rows, rounds):
    rng, count = np.random.default_rng(0), []
    own = missing_data._Em.smoothed
    monkeypatch.setattr(missing_data._Em, "smoothed", lambda *args: count.append(1) or own(*args))
    y, q = rng.normal(size=(rows, 1)) + 20, rng.normal(size=(rows, 2))
    y[2], y[20] = np.nan, np.nan
    parts = [Segment(np.arange(float(len(some))), some, some, some, "a") for some in (y, y[:5], y[:6])]
    filled = fill_readings(parts, [q, q[:5], q[:6]])
    assert len(count) == rounds
    assert np.isnan(filled[1]).sum() == 1  # too short to be filled
    assert [filled[0].shape, filled[2].shape] == [y.shape, (6, 1)]
    assert filled[0][2, 0] == pytest.approx((y[1, 0] + y[3, 0]) / 2)  # before the first regression a line


def test_rounds_end_where_they_gain_less_than_a_fiftieth(monkeypatch):
    segment, q = pulled_walk(30)
    costs = iter([1.0, 1.5, 1.52, 1.535, 9.0])
    own = missing_data._Em.smoothed
    monkeypatch.setattr(missing_data._Em, "smoothed", lambda *args: (own(*args)[0], next(costs)))
    found = expected_moments([segment], [q], [np.zeros((30, 0))], past_y=1, past_w=1)
    assert found.log_likelihood == (1.0, 1.5, 1.52, 1.535)
    costs = iter(range(100))
    assert expected_moments([segment], [q], [np.zeros((30, 0))], past_y=1, past_w=1).log_likelihood[-1] == 59
