"""ARX: finds a known system, its delay and its products; leaves out what it must not use."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from tests.sysid.models.makers import steady_gain
from thermogrip.datasets.schema import make_log
from thermogrip.sysid.blackbox.arx import Regression, arx_family
from thermogrip.sysid.plant.log_grid import make_grid


def arx_noise_log(n: int = 2000, sd: float = 0.05, seed: int = 0):
    """Noise that enters as ARX assumes: filtered by 1/A."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.random(n // 10) - 0.5, 10)
    y = 25 + lfilter([0, 0, 0, 0.5], [1, -0.95], u) + lfilter([sd], [1, -0.95], rng.standard_normal(n))
    return make_log(np.arange(float(n)), {"q": (u, "1", "input"), "t": (y, "degC", "output")})


def test_arx_finds_pole_and_gain_within_four_standard_errors_when_its_noise_model_holds(fit_one):
    log = arx_noise_log()
    model = fit_one("arx", make_grid([log], average=1.0), poles=1, delays=3)
    y, u = log["t"].values - 25, log["q"].values
    X = np.column_stack([y[2:-1], u[: len(u) - 3]])  # y[k-1], u[k-3]
    sd = 0.05 * np.sqrt(np.diag(np.linalg.inv(X.T @ X)))  # of (pole, b) by least squares theory
    pole = np.abs(model.poles()).max()
    assert abs(pole - 0.95) < 4 * sd[0]
    assert abs(steady_gain(model)[0, 0] * (1 - pole) - 0.5) < 4 * sd[1]


def test_a_noise_free_system_is_found_exactly_whatever_the_offset(first_order, fit_one):
    log = first_order.log(600, noise=0.0, level=-40.0)
    model = fit_one("arx", make_grid([log], average=1.0), poles=1, delays=first_order.delay)
    assert np.abs(model.poles()).max() == pytest.approx(first_order.pole, abs=1e-6)
    assert steady_gain(model)[0, 0] == pytest.approx(first_order.gain / (1 - first_order.pole), rel=1e-5)


def test_no_regressor_reaches_across_a_gap(first_order, fit_one):
    whole = first_order.log(1200, noise=0.0)
    cut = first_order.log(1200, noise=0.0, gap=True)
    grid = make_grid([cut], average=1.0)
    assert [len(s.time) for s in grid.segments] == [600, 559]
    for log in (whole, cut):  # had one reached across, the fit would not be exact
        model = fit_one("arx", make_grid([log], average=1.0), poles=1, delays=first_order.delay)
        assert np.abs(model.poles()).max() == pytest.approx(first_order.pole, abs=1e-6)


def test_rows_with_lost_readings_are_left_out_and_several_logs_are_one_regression(first_order, fit_one):
    lost = first_order.log(1200, noise=0.0)
    lost["t"].values[np.random.default_rng(1).random(1200) < 0.1] = np.nan
    several = [first_order.log(300, noise=0.0, seed=s, name=str(s)) for s in (1, 2, 3)]
    for logs in ([lost], several):
        model = fit_one("arx", make_grid(logs, average=1.0), poles=1, delays=first_order.delay)
        assert np.abs(model.poles()).max() == pytest.approx(first_order.pole, abs=1e-6)


def test_too_few_rows_give_no_model(first_order):
    assert not arx_family(make_grid([first_order.log(40)], average=1.0), poles=(9,))


@pytest.mark.parametrize(
    ("output", "poles", "late", "coupled", "columns"),  # of 2 outputs and 3 drives at lags 1 to 4, a constant
    [
        (1, 2, (2, 3), True, [0, 1, 2, 3, 11, 12, 13, 14, 15, 16, 20]),
        (1, 2, (1, 2), False, [1, 3, 8, 9, 10, 11, 12, 13, 20]),
        (0, 1, (4,), False, [0, 17, 18, 19, 20]),
    ],
)
def test_a_structure_uses_its_lags_of_the_one_regression(output, poles, late, coupled, columns):
    regression = Regression.of([np.ones((90, 2))], [np.ones((90, 3))], 4)
    assert regression.columns(output, poles, late, coupled=coupled).tolist() == columns
