"""Settled means level and drift inside the band, noise allowed for."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermogrip.rig.settle import has_settled, step_figures

T = np.arange(0.0, 61.0, 1.0)


def test_passing_through_the_band_is_not_settling() -> None:
    assert not has_settled(T, 0.1 * (T - 45.0), band=0.25)


def test_less_than_a_window_is_never_enough() -> None:
    assert not has_settled(T[:20], 0 * T[:20], band=0.25)
    assert not has_settled([], [], band=0.25)


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


def test_slow_noise_asks_for_more_margin_than_white_noise() -> None:
    rng = np.random.default_rng(3)
    slow = rng.normal(0.0, 1.0, (200, 200))
    for k in range(1, 200):
        slow[:, k] = 0.9 * slow[:, k - 1] + np.sqrt(1 - 0.81) * slow[:, k]
    white = rng.normal(0.0, 1.0, slow.shape)
    yes = [
        np.mean([has_settled(T, 0.06 * row[-T.size :], band=0.25) for row in rows]) for rows in (slow, white)
    ]
    assert yes[0] < yes[1]


@given(st.floats(-0.2, 0.2), st.floats(0.3, 5.0))
def test_a_quiet_error_is_judged_by_its_size(inside: float, outside: float) -> None:
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


def test_never_settling_has_no_settling_time_and_no_bias() -> None:
    figures = step_figures(T, 25.0 + 0 * T, 40.0)
    assert np.isnan(figures.settle_time)
    assert np.isnan(figures.bias)
    assert figures.overshoot == 0.0


def test_cooling_overshoots_downwards() -> None:
    y = np.where(T < 10, 30.0, 14.0)
    assert step_figures(T, y, 15.0, smooth=0.5).overshoot == pytest.approx(1.0)
    assert step_figures(T, 55.0 - y, 40.0, smooth=0.5).overshoot == pytest.approx(1.0)
