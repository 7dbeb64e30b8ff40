"""Settled means level and drift inside the band, noise allowed for."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from thermogrip.rig.session.session import _standard_error, has_settled, step_figures

T = np.arange(0.0, 61.0, 1.0)


def test_passing_through_the_band_is_not_settling() -> None:
    assert not has_settled(T, 0.1 * (T - 45.0), band=0.25)


@pytest.mark.parametrize(("sd", "expected"), [(0.04, True), (2.0, False)])
def test_noise_that_hides_the_band_is_not_settled(sd: float, expected: bool) -> None:
    # 2 sqrt(12) sd / sqrt(31) of drift uncertainty: 0.05 K at sd 0.04, 2.5 K at sd 2
    noise = np.random.default_rng(1).normal(0.0, sd, (40, T.size))
    answers = [has_settled(T, row, band=0.25) for row in noise]
    assert np.mean(answers) == pytest.approx(float(expected), abs=0.1)


def test_a_true_bias_at_the_edge_of_the_band_is_seldom_called_settled() -> None:
    # two standard errors: 2.3 % for independent noise; the bound is 3 sd of a binomial of 400 above that
    noise = np.random.default_rng(2).normal(0.25, 0.06, (400, T.size))
    assert np.mean([has_settled(T, row, band=0.25) for row in noise]) <= 0.023 + 3 * np.sqrt(
        0.023 * 0.977 / 400
    )


def test_a_true_drift_at_the_edge_of_the_band_is_seldom_called_settled() -> None:
    noise = np.random.default_rng(7).normal(0.0, 0.06, (400, T.size))
    answers = [has_settled(T, 0.25 * (T - 45.0) / 30 + row, band=0.25) for row in noise]
    assert np.mean(answers) <= 0.023 + 3 * np.sqrt(0.023 * 0.977 / 400)


def test_of_a_dozen_readings_two_standard_errors_are_nearly_those_of_students_t() -> None:
    """P(t_9 > 2) = 0.038; that the lag-one correlation is estimated too adds a fifth or so."""
    few = np.arange(0.0, 61.0, 6.0)
    noise = np.random.default_rng(8).normal(0.25, 0.06, (1500, few.size))
    assert np.mean([has_settled(few, row, band=0.25, window=60.0) for row in noise]) < 0.06


@pytest.mark.parametrize(("n", "r", "least"), [(3000, 0.7, 0.95), (31, 0.5, 0.82)])
def test_the_standard_error_is_that_of_the_mean_of_correlated_readings(
    n: int, r: float, least: float
) -> None:
    """AR(1); of thirty readings neither spread nor correlation are known, and the error is a sixth small."""
    rng = np.random.default_rng(9)
    e = lfilter([np.sqrt(1 - r**2)], [1, -r], rng.normal(size=(300, n + 60)), axis=1)[:, 60:]
    apart = np.arange(1 - n, n)
    true = np.sqrt(((n - np.abs(apart)) * r ** np.abs(apart)).sum()) / n
    t = np.arange(n) - (n - 1) / 2
    found = [_standard_error(row - np.polyval(np.polyfit(t, row, 1), t), 1e-9) for row in e]
    assert least < np.median(found) / true < 1.05


@pytest.mark.parametrize(
    ("residual", "quantum", "error"),
    [([1.0, 1.0, -1.0, -1.0] * 4, 0.1, 0.306681),  # s = sqrt(16/14); lag 1/16, r = 0.13672, n_eff = 12.151
     ([1.0, -1.0] * 2, 0.1, np.sqrt(2) / 2), ([0.0] * 8, 0.1, 0.0115728),  # r = 0; r = 1/8, n_eff = 6.2222
     ([1.0] * 50 + [-1.0] * 50, 0.1, np.sqrt(100 / 98 / (100 * 0.05 / 1.95))),  # r is 0.95 at most
     ([2.0, 2.0, -2.0, -2.0], 0.1, 2.0), ([1.0, -1.0] * 2, 9.0, 9 / np.sqrt(12) / 2)],  # n_eff is 2 at least
)  # fmt: skip
def test_the_standard_error_in_numbers(residual: list[float], quantum: float, error: float) -> None:
    assert _standard_error(np.array(residual), quantum) == pytest.approx(error, rel=1e-5)


def test_a_quantum_alone_asks_for_its_rounding_error() -> None:
    """31 equal readings of 1/16 K: 0.0180 / sqrt(29.1) = 0.0033 K of level, 0.0116 K of drift, twice.

    The correlation of nothing is anything up to 0.95, which makes them 0.0128 and 0.0442 K at most.
    """
    for level, answer in ((0.224, True), (0.2434, False)):
        assert has_settled(T, np.full(T.size, level), band=0.25) == answer
    for drift, answer in ((0.161, True), (0.2270, False)):
        assert has_settled(T, drift * (T - 45.0) / 30, band=0.25) == answer


def test_only_the_window_counts_and_it_may_be_all_there_is() -> None:
    assert has_settled(T, np.where(T < 30, 9.0, 0.1), band=0.25)
    for n, answer in ((0, False), (20, False), (30, False), (31, True)):
        assert has_settled(T[:n], np.full(n, 0.1), band=0.25) == answer
    for n, answer in ((4, False), (5, True)):  # of four readings nothing is known, however quiet
        assert has_settled(np.linspace(0.0, 30.0, n), np.zeros(n), band=0.25) == answer


@given(st.floats(-0.2, 0.2), st.floats(0.3, 5.0))
def test_a_quiet_error_is_evaluated_by_its_size(inside: float, outside: float) -> None:
    assert has_settled(T, np.full(T.size, inside), band=0.25)
    assert not has_settled(T, np.full(T.size, outside), band=0.25)


def test_lost_samples_are_left_out() -> None:
    error = np.where(T % 7 == 0, np.nan, 0.02)
    assert has_settled(T, error, band=0.25)
    assert not has_settled(T, np.full(T.size, np.nan), band=0.25)


def test_figures_of_a_damped_oscillation_are_those_of_its_formula() -> None:
    t = np.arange(0.0, 600.0, 0.1)
    y = 40.0 - 20.0 * np.exp(-t / 40) * np.cos(2 * np.pi * t / 60)
    figures = step_figures(t, y, 40.0, band=0.25, smooth=0.3)
    peak = 20.0 * (np.exp(-t / 40) * -np.cos(2 * np.pi * t / 60)).max()
    last_out = t[np.flatnonzero(np.abs(y - 40.0) > 0.25)[-1]]
    assert figures.overshoot == pytest.approx(peak, abs=1e-3)
    assert figures.settle_time == pytest.approx(last_out, abs=0.5)
    assert abs(figures.bias) < 0.01


def test_settling_counts_from_the_first_reading_and_ends_with_the_last_one_outside() -> None:
    t = 100.0 + 10.0 * np.arange(40)
    y = np.where(t < 250, 20.0, 40.1)
    y[30:] += 0.05  # the last 120 s are thirteen readings, ten of them after this
    figures = step_figures(t, y, 40.0, smooth=1.0)
    assert figures.settle_time == 150.0
    assert figures.bias == pytest.approx(0.1 + 0.05 * 10 / 13)
    assert figures.overshoot == pytest.approx(0.15)


BUMP = (T > 20) & (T < 40)
PEAK = np.select([T < 5, T == 30], [20.0, 41.0], 40.0)


@pytest.mark.parametrize(
    ("y", "target", "smooth", "want"),
    [
        (np.full(T.size, 25.0), 40.0, 5.0, (np.nan, 0.0, np.nan)),  # never there
        (np.full(T.size, np.nan), 40.0, 5.0, (np.nan, 0.0, np.nan)),  # nor read
        (np.where(T < 40, 20.0, 40.2), 40.0, 0.5, (40.0, 0.2, 0.2)),  # the bias is of what has settled
        (np.where(BUMP, 41.1, 40.1), 40.0, 0.5, (40.0, 1.1, 0.1)),  # what begins there overshoots ...
        (np.where(BUMP, 39.1, 40.1), 40.0, 0.5, (40.0, 0.9, 0.1)),  # ... to either side
        (PEAK, 40.0, 4.0, (7.0, 0.2, 1 / 54)),  # means over both halves of the smoothing
        (np.where(T < 10, 30.0, 14.9), 15.0, 0.5, (10.0, 0.1, -0.1)),  # cooling overshoots downwards
    ],
)
def test_the_figures_of_a_step(
    y: np.ndarray, target: float, smooth: float, want: tuple[float, float, float]
) -> None:
    found = step_figures(T, y, target, smooth=smooth)
    assert (found.settle_time, found.overshoot, found.bias) == pytest.approx(want, nan_ok=True)
