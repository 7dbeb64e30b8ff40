"""Output error: unbiased where ARX is not, exact without noise, by its own gradient."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from thermogrip.sysid.arx import arx_model
from thermogrip.sysid.choose import choose
from thermogrip.sysid.oe import (
    _denominator_jacobian,
    _lagged,
    _project,
    drives,
    fit_filter,
    oe_family,
    oe_model,
)
from thermogrip.sysid.segments import make_grid

_SPEC = importlib.util.spec_from_file_location(
    "blackbox_truth", Path(__file__).with_name("blackbox_truth.py")
)
truth = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(truth)


def test_oe_finds_the_pole_within_four_cramer_rao_bounds_under_white_reading_noise():
    log = truth.first_order_log(2000, noise=0.2)
    model = oe_model(make_grid([log], average=1.0), poles=1, zeros=1, delay=truth.DELAY)
    u = log["q"].values
    v = lfilter([0.0] * 3 + [truth.GAIN], [1, -truth.POLE], u)
    dv_da = lfilter([0.0, 1.0], [1, -truth.POLE], v)
    dv_db = lfilter([0.0] * 3 + [1.0], [1, -truth.POLE], u)
    X = np.column_stack([dv_da, dv_db, np.ones(len(u))])
    sd = 0.2 * np.sqrt(np.linalg.inv(X.T @ X)[0, 0])
    assert abs(np.abs(model.poles()).max() - truth.POLE) < 4 * sd


def test_arx_is_biased_to_fast_poles_by_the_same_noise_and_oe_is_not():
    grid = make_grid([truth.first_order_log(2000, noise=0.2)], average=1.0)
    biased = np.abs(arx_model(grid, poles=1, zeros=1, delay=truth.DELAY).poles()).max()
    honest = np.abs(oe_model(grid, poles=1, zeros=1, delay=truth.DELAY).poles()).max()
    assert biased < truth.POLE - 0.01
    assert abs(honest - truth.POLE) < 0.003


def test_a_second_order_system_is_found_exactly_without_noise():
    u = np.repeat(np.random.default_rng(0).random(60), 20)
    a, b = np.poly([0.97, 0.7])[1:], np.array([0.03, 0.01])
    y = 20 + lfilter([0.0, *b], [1.0, *a], u)
    found = fit_filter([y], [u[:, None]], na=2, nb=2, delay=1)
    assert found is not None
    np.testing.assert_allclose(found.a, a, atol=1e-5)
    np.testing.assert_allclose(found.b[0], b, atol=1e-6)
    assert found.constant / (1 + a.sum()) == pytest.approx(20.0, abs=1e-4)


def test_each_segment_has_an_initial_state_of_its_own():
    u = np.repeat(np.random.default_rng(1).random((2, 30)), 20, axis=1)
    y = [
        lfilter([0, 0.5], [1, -0.95], row) + start * 0.95 ** np.arange(600)
        for row, start in zip(u, (30.0, -5.0))
    ]
    found = fit_filter(y, [row[:, None] for row in u], na=1, nb=1, delay=1)
    assert found is not None
    assert -found.a[0] == pytest.approx(0.95, abs=1e-6)
    assert found.rmse < 1e-5


def test_lost_readings_carry_no_weight():
    log = truth.first_order_log(1000, noise=0.0)
    log["t"].values[::3] = np.nan
    model = oe_model(make_grid([log], average=1.0), poles=1, zeros=1, delay=truth.DELAY)
    assert np.abs(model.poles()).max() == pytest.approx(truth.POLE, abs=1e-6)


def test_the_gradient_is_that_of_finite_differences():
    log = truth.first_order_log(300, noise=0.1)
    grid = make_grid([log], average=1.0)
    y, w = [grid.segments[0].y[:, 0]], drives(grid, ())
    a = np.array([-1.5, 0.56])

    def residual(a):
        return y[0] - _project(a, y, w, 1, 1)[2][0]

    J, miss = _denominator_jacobian(a, y, w, 1, 1, _project(a, y, w, 1, 1)[2])
    for i in range(2):
        step = 1e-6 * np.eye(2)[i]
        slope = (_project(a + step, y, w, 1, 1)[0] - _project(a - step, y, w, 1, 1)[0]) / 2e-6
        # of the cost: Kaufman's Jacobian has the exact gradient
        assert -2 * J[:, i] @ miss == pytest.approx(slope, rel=1e-3)
    np.testing.assert_allclose(miss, residual(a), atol=1e-9)


def test_a_model_with_the_wrong_delay_loses():
    grid = make_grid([truth.first_order_log(1500)], average=1.0)
    choice = choose(grid, lambda g: oe_family(g, poles=(1,), zeros=(1,), delays=(1, 3, 6)), warmup=50)
    assert choice.structure.label == f"na 1, nb 1, delay {truth.DELAY}"


def test_the_state_space_form_is_the_filter():
    log = truth.first_order_log(800, noise=0.0)
    grid = make_grid([log], average=1.0)
    model = oe_model(grid, poles=1, zeros=3, delay=2)  # one zero too many on either side
    impulse = np.zeros((1, 40, 1))
    impulse[0, 0, 0] = 1.0
    at_rest, _ = model.rollout(np.zeros((1, model.n_x)), 0 * impulse, np.zeros((1, 40, 0)), (), 1.0)
    y, _ = model.rollout(np.zeros((1, model.n_x)), impulse, np.zeros((1, 40, 0)), (), 1.0)
    want = lfilter([0.0] * 3 + [truth.GAIN], [1, -truth.POLE], impulse[0, :, 0])
    np.testing.assert_allclose((y - at_rest)[0, :-1, 0], want, atol=1e-4)


def test_before_a_segment_its_first_drive_was_held():
    np.testing.assert_array_equal(_lagged(np.array([[5.0], [6.0], [7.0]]), 2, 1), [[5, 5], [5, 5], [6, 5]])
