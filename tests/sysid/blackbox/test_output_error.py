"""Output error: unbiased where ARX is not, exact without noise, by its own gradient."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from scipy.signal import lfilter

from tests.sysid.models.makers import steady_gain
from thermogrip.datasets.schema import make_log
from thermogrip.sysid.blackbox.order_selection import StartPrior, choose, drives, estimate_starts
from thermogrip.sysid.blackbox.output_error import (
    Records,
    Search,
    oe_family,
    real_pole_starts,
    solve,
    with_pole,
)
from thermogrip.sysid.plant.log_grid import make_grid


def test_oe_finds_the_pole_within_four_cramer_rao_bounds_under_white_reading_noise(first_order, fit_one):
    log = first_order.log(2000, noise=0.2)
    model = fit_one("oe", make_grid([log], average=1.0), poles=1, zeros=1, delays=first_order.delay)
    u = log["q"].values
    v = lfilter([0.0] * 3 + [first_order.gain], [1, -first_order.pole], u)
    dv_da = lfilter([0.0, 1.0], [1, -first_order.pole], v)
    dv_db = lfilter([0.0] * 3 + [1.0], [1, -first_order.pole], u)
    X = np.column_stack([dv_da, dv_db, np.ones(len(u))])
    sd = 0.2 * np.sqrt(np.linalg.inv(X.T @ X)[0, 0])
    assert abs(np.abs(model.poles()).max() - first_order.pole) < 4 * sd


def test_arx_is_biased_to_fast_poles_by_the_same_noise_and_oe_is_not(first_order, fit_one):
    grid = make_grid([first_order.log(2000, noise=0.2)], average=1.0)
    biased = np.abs(fit_one("arx", grid, poles=1, delays=first_order.delay).poles()).max()
    unbiased = np.abs(fit_one("oe", grid, poles=1, zeros=1, delays=first_order.delay).poles()).max()
    assert biased < first_order.pole - 0.01
    assert abs(unbiased - first_order.pole) < 0.003


def test_a_second_order_system_is_found_exactly_without_noise(fit_one):
    u = np.repeat(np.random.default_rng(0).random(61), 20)[19:1219]  # it steps at the second row
    a, b = np.poly([0.97, 0.7])[1:], np.array([0.03, 0.01])
    y = 20 + lfilter([0.0, *b], [1.0, *a], u)
    log = make_log(np.arange(1200.0), {"q": (u, "1", "input"), "t": (y, "degC", "output")})
    model = fit_one("oe", make_grid([log], average=1.0), poles=2, zeros=2)
    np.testing.assert_allclose(-model.A[:, 0], a, atol=1e-5)
    np.testing.assert_allclose(model.B[:, 0], b, atol=1e-6)
    assert model.c[0] / (1 + a.sum()) == pytest.approx(20.0, abs=1e-4)


def test_each_segment_has_an_initial_state_of_its_own(fit_one):
    u = np.repeat(np.random.default_rng(1).random((2, 30)), 20, axis=1)
    logs = []
    for name, row, start in zip("ab", u, (30.0, -5.0)):
        y = lfilter([0, 0.5], [1, -0.95], row) + start * 0.95 ** np.arange(600)
        signals = {"q": (row, "1", "input"), "t": (y, "degC", "output")}
        logs.append(make_log(np.arange(600.0), signals, name=name))
    model = fit_one("oe", make_grid(logs, average=1.0), poles=1, zeros=1)
    assert np.abs(model.poles()).max() == pytest.approx(0.95, abs=1e-6)
    assert steady_gain(model)[0, 0] == pytest.approx(10.0, rel=1e-5)


def test_a_search_ends_where_every_reading_was_lost():
    drive = np.random.default_rng(0).random((80, 1))
    found = Search()(Records([np.full(80, np.nan)], [drive]), 2, 1, 1)
    assert found is None or np.isfinite(found.a).all()


def test_lost_readings_carry_no_weight(first_order, fit_one):
    log = first_order.log(1000, noise=0.0)
    log["t"].values[::3] = np.nan
    model = fit_one("oe", make_grid([log], average=1.0), poles=1, zeros=1, delays=first_order.delay)
    assert np.abs(model.poles()).max() == pytest.approx(first_order.pole, abs=1e-6)


@pytest.mark.parametrize("lost", [0, 3])
def test_the_gradient_is_that_of_finite_differences(lost, first_order):
    log = first_order.log(300, noise=0.1)
    if lost:
        log["t"].values[::lost] = np.nan
    grid = make_grid([log], average=1.0)
    records = Records([grid.segments[0].y[:, 0]], drives(grid, ()))
    a = np.array([-1.5, 0.56])
    T, t = solve(a, records, 1, 1).slopes(records)
    slope = T.T @ t
    for i in range(2):
        step = 1e-6 * np.eye(2)[i]
        numeric = (solve(a + step, records, 1, 1).cost - solve(a - step, records, 1, 1).cost) / 2e-6
        assert -2 * slope[i] == pytest.approx(numeric, rel=1e-3)  # Kaufman's Jacobian has the exact gradient


@pytest.mark.parametrize("cut", [(), (900,), (300, 500)])
def test_rounding_leaves_the_cost_and_the_fit_of_slow_poles_as_they_are(cut):
    rng = np.random.default_rng(4)
    poles = (0.995, 0.985, 0.97)  # shifts of their responses are nearly dependent
    w = np.repeat(rng.random((40, 2)), 40, axis=0)
    y = 25 + 1e-4 * w @ (1.0, 0.5)
    y = lfilter([1.0], np.poly(poles), y - 25) + 25 + 0.1 * rng.standard_normal(1600)

    def found(size):
        part = np.split(y * (1 + size * rng.standard_normal(1600)), cut), np.split(w, cut)
        records = Records(*part)
        best = Search()(records, 3, 2, 1)
        return np.append(best.a, solve(best.a, records, 2, 1).cost), best.b.sum(axis=1) / (1 + best.a.sum())

    (once, gains), (again, same) = found(0.0), found(1e-12)
    np.testing.assert_allclose(again, once, rtol=2e-5)
    np.testing.assert_allclose(same, gains, rtol=1e-4)
    assert once[-1] < 1.02 * 0.01 * 1600


def test_shifted_columns_are_the_filtered_lags():
    rng = np.random.default_rng(3)
    y, w, a = 20 + rng.random(60), 5 + rng.random((60, 2)), np.array([-1.2, 0.4])
    found = solve(a, Records([y], [w]), 2, 3)
    held = np.vstack([np.tile(w[0], (4, 1)), w])  # the first row stood before the segment
    lags = [held[4 - lag : 64 - lag, j] for j in range(2) for lag in (3, 4)]
    X = lfilter([1.0], [1.0, *a], np.column_stack([*lags, np.ones(60), np.eye(60, 2)]), axis=0)
    np.testing.assert_allclose(found.outputs[0], X @ np.linalg.lstsq(X, y, rcond=None)[0], atol=1e-6)
    np.testing.assert_allclose(with_pole(np.array([-1.3, 0.4])), np.poly([0.8, 0.5, 0.0625])[1:])
    found = [np.roots([1.0, *some]) for some in real_pole_starts(Records([y], [w]), 2)[::5]]  # 3 to 20 rows
    np.testing.assert_allclose(found, np.exp([[-1 / 3, -4 / 3], [-1 / 20, -1 / 5]]))


def test_a_search_over_many_structures_ends_no_worse_than_one_from_all_starts(first_order, fit_one):
    grid = make_grid([first_order.log(600, noise=0.2)], average=1.0)
    family = oe_family(grid, poles=(1, 2), zeros=(1, 2), delays=(1, 3))
    y, u, d = (getattr(grid.segments[0], name) for name in "yud")
    for orders in ((1, 1, 3), (1, 2, 3), (2, 2, 1)):
        label = "na {}, nb {}, delay {}".format(*orders)
        shared = next(model for structure, model in family.items() if structure.label == label)
        alone = fit_one("oe", grid, poles=orders[0], zeros=orders[1], delays=orders[2])
        errors = []
        for model in (shared, alone):
            x0, _ = estimate_starts(model, y, u, d, dt=1.0, scale=np.std(y, axis=0), priors=[StartPrior()])
            run, _ = model.rollout(x0, u[None], d[None], (), grid.dt)
            errors.append(np.mean((run[0, :-1] - y) ** 2))
        assert errors[0] <= 1.002 * errors[1]


def test_one_structure_alone_is_fitted_when_it_is_asked_for(first_order):
    grid = make_grid([first_order.log(300)], average=1.0)
    whole = oe_family(grid, poles=(1, 2), zeros=(1,), delays=(1, 2))
    wanted = list(whole)[1]
    assert list(oe_family(grid, poles=(1, 2), zeros=(1,), delays=(1, 2), only=[wanted])) == [wanted]


def test_a_model_with_the_wrong_delay_loses(first_order):
    grid = make_grid([first_order.log(1500)], average=1.0)
    choice = choose(grid, partial(oe_family, poles=(1,), zeros=(1,), delays=(1, 3, 6)), warmup=50)
    assert choice.structure.label == f"na 1, nb 1, delay {first_order.delay}"


def test_the_state_space_form_is_the_filter(first_order, fit_one):
    log = first_order.log(800, noise=0.0)
    grid = make_grid([log], average=1.0)
    model = fit_one("oe", grid, poles=1, zeros=3, delays=2)  # one zero too many on either side
    impulse = np.zeros((1, 40, 1))
    impulse[0, 0, 0] = 1.0
    at_rest, _ = model.rollout(np.zeros((1, model.n_x)), 0 * impulse, np.zeros((1, 40, 0)), (), 1.0)
    y, _ = model.rollout(np.zeros((1, model.n_x)), impulse, np.zeros((1, 40, 0)), (), 1.0)
    want = lfilter([0.0] * 3 + [first_order.gain], [1, -first_order.pole], impulse[0, :, 0])
    np.testing.assert_allclose((y - at_rest)[0, :-1, 0], want, atol=1e-4)


def test_the_spread_is_that_of_the_fitted_run(first_order, fit_one):
    log = first_order.log(800, noise=0.0)
    grid = make_grid([log], average=1.0)
    model = fit_one("oe", grid, poles=1, zeros=2, delays=2)
    assert (model.C @ model.spread @ model.C.T)[0, 0] == pytest.approx(log["t"].values.var(ddof=1), rel=0.01)
